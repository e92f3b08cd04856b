"""How well one run over a labelled recording has told moving tracks from static ones.

Scored are the tracks that are labelled static or moving and of which the gate or the detector had anything to say: what
was never a candidate cannot be found. Intervals are by bootstrap over tracks, movers and static ones by themselves, as
if they were independent. Those on one object are not quite, which makes the intervals somewhat narrow.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vcjax.recorded.verdicts import TrackVerdicts
from vcjax.sources.recording_file import RecordingFile, TrackLabel, TrackLabels
from vcjax.study import roc

_RESAMPLES_AT_ONCE = 50
Interval = tuple[float, float, float]
"""A figure, and the bounds of its 95 % interval."""


class TrackDetection(NamedTuple):
    """Counts of tracks, and figures of merit; NaN where one is not defined."""

    num_movers_labelled: int
    """Tracks labelled moving, whether the filter looked at them or not."""
    num_movers: int
    """Those that were scored."""
    num_static: int
    """Tracks labelled static that were scored."""
    num_found: int
    """Movers called dynamic or deleted."""
    num_false: int
    """Static tracks called dynamic or deleted."""
    precision: Interval
    """found / (found + false)."""
    recall: Interval
    """found / movers."""
    f1: Interval
    """2 found / (found + false + movers)."""
    auc: Interval
    """Area under the ROC of the tracks' largest margin."""
    detector_auc: Interval
    """The same of the detector's margin."""


def labels_of(content: RecordingFile) -> TrackLabels | None:
    """The labels of a recording, or those of a simulation's truth, whose feature numbers are track ids."""
    if content.labels is not None:
        return content.labels
    if content.truth is None or not len(content.truth.is_moving):
        return None
    is_moving = np.asarray(content.truth.is_moving)
    return TrackLabels(np.arange(len(is_moving)), np.where(is_moving, TrackLabel.MOVING, TrackLabel.STATIC))


def track_detection(tracks: TrackVerdicts, labels: TrackLabels) -> TrackDetection:
    """Score the verdicts of a run.

    Args:
        tracks: what became of the tracks.
        labels: what they follow; unknown and bad ones do not count.
    """
    label = dict(zip(np.asarray(labels.track_id).tolist(), np.asarray(labels.label).tolist(), strict=True))
    told = np.array([label.get(i, int(TrackLabel.UNKNOWN)) for i in tracks.track_id.tolist()], int)
    is_mover, is_scored = told == TrackLabel.MOVING, np.isin(told, [TrackLabel.MOVING, TrackLabel.STATIC])
    is_mover, is_called = is_mover[is_scored], tracks.is_called[is_scored]
    # One track to a "seed", so that the resamples are over tracks.
    margins = tracks.margin, tracks.detector_margin
    by_gate, by_detector = (roc.Tracks(margin[is_scored, None], is_mover[:, None]) for margin in margins)

    def figures(weights: np.ndarray) -> np.ndarray:
        found, called, movers = weights @ (is_called & is_mover), weights @ is_called, weights @ is_mover
        with np.errstate(invalid="ignore", divide="ignore"):
            f1 = np.where(movers > 0, 2 * found / (called + movers), np.nan)
            areas = [roc.area(scored, weights) for scored in (by_gate, by_detector)]
            return np.stack([found / called, found / movers, f1, *areas])

    found = figures(np.ones((1, len(is_mover))))[:, 0]
    drawn = [figures(weights) for weights in _resamples(is_mover)]
    bounds = np.transpose([_bounds(values) for values in np.concatenate(drawn, axis=1)])
    intervals: list[Interval] = [
        (float(f), float(low), float(high)) for f, low, high in zip(found, *bounds, strict=True)
    ]
    return TrackDetection(
        int(np.sum(np.asarray(labels.label) == TrackLabel.MOVING)),
        int(is_mover.sum()),
        int((~is_mover).sum()),
        int((is_called & is_mover).sum()),
        int((is_called & ~is_mover).sum()),
        *intervals,
    )


def _resamples(is_mover: np.ndarray) -> Iterator[np.ndarray]:
    """How often each track is drawn in each resample, some resamples at a time; the same whenever asked."""
    rng = np.random.default_rng(0)
    for _ in range(0, roc.NUM_RESAMPLES, _RESAMPLES_AT_ONCE):
        weights = np.zeros((_RESAMPLES_AT_ONCE, len(is_mover)))
        for stratum in (is_mover, ~is_mover):
            if num := int(stratum.sum()):
                weights[:, stratum] = rng.multinomial(num, np.full(num, 1 / num), _RESAMPLES_AT_ONCE)
        yield weights


def _bounds(values: np.ndarray) -> np.ndarray:
    """Bounds of the resampled values, of those that are defined: in a few nobody may have been called dynamic."""
    values = values[np.isfinite(values)]
    return roc.interval(values) if len(values) else np.full(2, np.nan)


def track_detection_text(found: TrackDetection) -> str:
    """The scores in words."""
    rows = [
        ("movers", f"{found.num_found} found of {found.num_movers} judged ({found.num_movers_labelled} labelled)"),
        ("static", f"{found.num_false} called dynamic or deleted of {found.num_static} judged"),
    ]
    for name, label in (
        ("precision", "precision"),
        ("recall", "recall"),
        ("f1", "F1"),
        ("auc", "AUC, gate"),
        ("detector_auc", "AUC, detector"),
    ):
        value, low, high = getattr(found, name)
        rows.append((label, _interval(value, low, high)))
    return "\n".join(f"{name:26s} {text}" for name, text in rows)


def _interval(value: float, low: float, high: float) -> str:
    if not np.isfinite(value):
        return "not defined"
    return f"{value:.3f}" + (f" (95 %: {low:.3f} to {high:.3f})" if np.isfinite(low + high) else "")
