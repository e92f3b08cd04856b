"""Operating curves: what a method finds, and flags wrongly, when it is run at one threshold after another.

What flags for good, once, shows no more of a track than how far its first crossing went, so that a curve over
thresholds cannot be read off one run (as `roc` does of gates that let a track come back). Here each point is a run of
its own. Intervals are by bootstrap over seeds, which keeps all features of a seed together, in all scenes.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vcjax.study import roc
from vcjax.study.detection_scores import Counts

Curves = Mapping[tuple[str, float], Mapping[float, Counts]]
"""Method and amplitude (m) → threshold → counts of each seed, of all scenes with movers but the harder ones."""


def added(parts: Iterable[Counts]) -> Counts:
    """Counts of each seed over several scenes."""
    return Counts(*(np.sum(each, axis=0) for each in zip(*parts, strict=True)))


def operating_point(counts: Counts) -> dict[str, Any]:
    """Shares of the features of all seeds, with 95 % intervals.

    Returns: `static_flagged_fraction`, of the static features ever mapped; `found_of_mapped_fraction`, of the movers
        ever mapped: recall; `precision`, movers among what was flagged; each with `mean`, `lower` and `upper`, NaN
        where there is nothing to count, in the interval if that is so in any resample or there are fewer seeds than
        `roc.MIN_SEEDS`. And the sums of `Counts`.
    """
    flagged = counts.found + counts.flagged
    return {
        "static_flagged_fraction": _share(counts.flagged, counts.static),
        "found_of_mapped_fraction": _share(counts.found, counts.movers),
        "precision": _share(counts.found, flagged),
        **{name: int(each.sum()) for name, each in counts._asdict().items()},
    }


def _share(part: np.ndarray, whole: np.ndarray) -> dict[str, float]:
    """Σ part / Σ whole over the seeds."""
    weights = roc.resamples(len(whole))
    with np.errstate(invalid="ignore"):
        shares = weights @ part / (weights @ whole) if len(whole) >= roc.MIN_SEEDS else np.full(len(weights), np.nan)
        lower, upper = roc.interval(shares)
        return {"mean": float(np.divide(part.sum(), whole.sum())), "lower": float(lower), "upper": float(upper)}
