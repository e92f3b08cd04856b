"""What a method found in a scene, what it flagged wrongly, and what the movers cost, with standard errors."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Int

from vcjax.study.summary import DEGREES_OF_FREEDOM, anees_bounds, mean_and_error, per_run

MIN_FRAMES_MAPPED = 20
"""In `found_fraction` a mover counts if it was in the map for so many frames, or was flagged."""


class Counts(NamedTuple):
    """Unique features of each run; none of a run that failed."""

    found: Int[np.ndarray, " seed"]
    """Movers flagged."""
    movers: Int[np.ndarray, " seed"]
    """Movers ever mapped."""
    flagged: Int[np.ndarray, " seed"]
    """Static features flagged."""
    static: Int[np.ndarray, " seed"]
    """Static features ever mapped."""


def counts(runs: xr.Dataset) -> Counts:
    """How many movers and static features were mapped and flagged in each run."""
    is_mapped = (runs.frames_mapped.values > 0) & runs.is_finite.values.astype(bool)[:, None]
    is_moving, is_called = runs.is_moving.values, is_flagged(runs)
    kinds = (is_called & is_moving, is_moving, is_called & ~is_moving, ~is_moving)
    return Counts(*((is_mapped & kind).sum(axis=1) for kind in kinds))


def is_flagged(runs: xr.Dataset) -> Bool[np.ndarray, "seed feature"]:
    """Which features gate or detector ever deleted."""
    return (runs.dynamic_deletions + runs.inconsistent_deletions).values > 0


def scores(runs: xr.Dataset, static: xr.Dataset) -> dict[str, Any]:
    """What a method found in a scene, and what its movers cost against the same scene without them.

    Shares and delays are of features pooled over the runs: with aᵢ and bᵢ the sums of run i, r = Σ aᵢ / Σ bᵢ with the
    standard error √(n/(n − 1) Σ (aᵢ − r bᵢ)²) / Σ bᵢ, since the features of a run depend on each other.

    Args:
        runs: runs of the scene, dimensions (seed, frame, feature).
        static: runs of the scene without movers, of the same seeds.

    Returns: with `mean` and `se`: `found_fraction`, unique movers flagged of those in the map for at least
        `MIN_FRAMES_MAPPED` frames or flagged, which flatters: one that was mapped for less counts if it was found and
        not if it was missed; `found_of_mapped_fraction`, of all movers ever mapped, and `found_per_run`, unique movers
        flagged in a run; `static_flagged_fraction`, static features ever flagged of those ever mapped; `delay_frames`,
        from first birth to first deletion of the movers found; `position_rmse_cm`, `orientation_error_deg`,
        `anees_position`, `anees_pose` and `anees_map` of a run; `velocity_error_m_s` and `velocity_nees` (over 3) of
        the movers whose velocity was known when they were flagged; and `position_ratio`, position error against the
        static scene's over the seeds finite in both. Counts: `movers`, `movers_mapped`, `movers_found`,
        `static_mapped`, `static_flagged`, `runs`, `runs_failed` and `runs_map_full`. `anees_bounds` has, for each
        ANEES, the `lower` and `upper` bound of 95 % of consistent filters (see `summary.summarise`). Failed runs are
        left out. NaN where there is nothing to count.

    References: Cochran 1977, *Sampling Techniques*, section 2.11, for the standard error of a ratio.
    """
    figures, static_figures = per_run(runs), per_run(static)
    is_finite = runs.is_finite.values.astype(bool)
    count = Counts(*(each[is_finite] for each in counts(runs)))
    is_found = (is_flagged(runs) & runs.is_moving.values)[is_finite]
    velocity = {name: runs[name].values[is_finite] for name in ("velocity_error_m_s", "velocity_nees")}
    is_known = is_found & ~np.isnan(velocity["velocity_error_m_s"])
    error, nees = (np.where(is_known, each, 0).sum(axis=1) for each in velocity.values())
    delay = np.where(is_found, (runs.first_deleted - runs.first_mapped).values[is_finite], 0)
    is_long = runs.is_moving.values & (runs.frames_mapped.values[is_finite] >= MIN_FRAMES_MAPPED)
    movers = (is_found | is_long).sum(axis=1)
    both = (runs.is_finite & static.is_finite).values
    rmse = [each.position_rmse_cm.values[both] for each in (figures, static_figures)]
    return {
        "found_fraction": pooled(count.found, movers),
        "found_of_mapped_fraction": pooled(count.found, count.movers),
        "found_per_run": pooled(count.found, np.ones(len(movers))),
        "static_flagged_fraction": pooled(count.flagged, count.static),
        "delay_frames": pooled(delay.sum(axis=1), count.found),
        "velocity_error_m_s": pooled(error, is_known.sum(axis=1)),
        "velocity_nees": pooled(nees / 3, is_known.sum(axis=1)),
        **{name: _mean(figures[name]) for name in ("position_rmse_cm", "orientation_error_deg", *DEGREES_OF_FREEDOM)},
        "anees_bounds": {name: _bounds(figures[name], dof) for name, dof in DEGREES_OF_FREEDOM.items()},
        "position_ratio": pooled(*rmse),
        "movers": int(movers.sum()),
        "movers_mapped": int(count.movers.sum()),
        "movers_found": int(count.found.sum()),
        "static_mapped": int(count.static.sum()),
        "static_flagged": int(count.flagged.sum()),
        "runs": len(is_finite),
        "runs_failed": int((~is_finite).sum()),
        "runs_map_full": int((runs.map_full_frames > 0).sum()),
    }


def pooled(part: np.ndarray, whole: np.ndarray) -> dict[str, float]:
    """Σ part / Σ whole over runs with its standard error (see `scores`); NaN where there is no whole, or one run."""
    num, total = len(whole), float(np.sum(whole))
    if total == 0:
        return {"mean": np.nan, "se": np.nan}
    ratio = float(np.sum(part)) / total
    square = float(np.sum((part - ratio * whole) ** 2))
    return {"mean": ratio, "se": np.sqrt(num / (num - 1) * square) / total if num > 1 else np.nan}


def _mean(values: xr.DataArray) -> dict[str, float]:
    """Mean and standard error over the runs that have it."""
    mean, error = mean_and_error(values, values.notnull())
    return {"mean": float(mean), "se": float(error)}


def _bounds(values: xr.DataArray, dof: int) -> dict[str, float]:
    """Of an average of consistent runs, as many as have it."""
    lower, upper = anees_bounds(int(values.notnull().sum()) or np.nan, dof)
    return {"lower": float(lower), "upper": float(upper)}
