"""How well tracks are told apart by a score, at every threshold at once: ROC and precision–recall curves.

This holds where a track goes on after it crossed a threshold, as with VC without a blacklist: a feature that was
deleted is born again and looked at again. Of what is deleted for good the score ends with the first crossing, and tells
by how much that went too far: what another threshold would do takes another run (`operating_curves`).

A track's score is how dynamic it ever looked to what deletes tracks, gate and detector (`track_scores`). For curves the
tracks of all runs are pooled: each counts once, with its run's weight. Intervals are by bootstrap over seeds, since
the tracks of a run depend on each other: a resample draws as many seeds as there are, with replacement, and keeps all
tracks of each. Equal numbers of seeds and resamples draw equal seeds, so that two settings can be compared in pairs.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

FALSE_RATES = np.geomspace(1e-3, 1.0, 61)
"""Shares of the static tracks called dynamic at which curves are given."""
RECALLS = np.linspace(0.02, 1.0, 50)
"""Shares of the movers found at which curves are given."""
NUM_RESAMPLES = 1000
MIN_SEEDS = 8
"""Of fewer, resamples all lie on one side of a value by mere chance too often for an interval of 95 %."""
_CONFIDENCE = 0.95


def track_scores(runs: Any) -> Any:
    """The largest margin of each track, of gate and detector whichever is larger: above 0 where it was deleted.

    Both margins are distances to thresholds in χ² units, and either deletes where it is above 0. The margin of a gate
    without verdicts, which leaves out and deletes nothing, does not count; a gate is taken for one if in none of the
    runs it has deleted anything, though margins were above 0. Of a track deleted for good the score is that of its
    first crossing, by which such tracks can hardly be ranked among themselves.

    Args:
        runs: runs of one filter, an `xarray.Dataset` with the `dynamic_margin`, `detector_margin` and
            `dynamic_deletions` (..., feature) of `results`, and `is_finite`.

    Returns: xarray.DataArray (..., feature): NaN of a feature that was never a measured candidate, nor judged by the
        detector, and in runs that failed; -∞ of one of which neither had anything to say.
    """
    gate, detector = (runs[name].where(runs.is_finite) for name in ("dynamic_margin", "detector_margin"))
    is_track = gate.notnull() | detector.notnull()
    if bool((gate > 0).any()) and not bool((runs.dynamic_deletions > 0).where(runs.is_finite, False).any()):
        gate = gate.where(False)
    score = np.fmax(gate, detector)
    return score.where(score.notnull(), -np.inf).where(is_track)


def area_of_each(score: Float[np.ndarray, "*r F"], is_mover: Bool[np.ndarray, "... F"]) -> Float[np.ndarray, "*r"]:
    """Area under the ROC of each run by itself, from the mean ranks of its tracks (Mann–Whitney).

    Args:
        score: NaN of what does not count as a track.
        is_mover: labels, for each run or for all.

    Returns: the share of pairs of a mover and another in the right order, ties half; NaN where there are no pairs.
    """
    counts = ~np.isnan(score)
    ranks = stats.rankdata(np.where(counts, score, np.inf), axis=-1)
    movers, others = (counts & is_mover).sum(axis=-1), (counts & ~is_mover).sum(axis=-1)
    right = np.where(counts & is_mover, ranks, 0.0).sum(axis=-1) - movers * (movers + 1) / 2
    pairs = movers * others
    return np.where(pairs > 0, right / np.where(pairs > 0, pairs, 1), np.nan)


class Tracks(NamedTuple):
    """Scores beside labels, run by run."""

    score: Float[np.ndarray, "seed n"]
    """NaN of what does not count as a track."""
    is_mover: Bool[np.ndarray, "seed n"]


def recall_at(
    tracks: Tracks,
    false_rates: Float[np.ndarray, " r"] = FALSE_RATES,
    weights: Float[np.ndarray, "b seed"] | None = None,
) -> Float[np.ndarray, "b r"]:
    """Share of the movers found when at most these shares of the static tracks are called dynamic: the ROC.

    Args:
        tracks: pooled tracks.
        false_rates: in [0, 1].
        weights: how often each seed counts, for each resample; once in the only one if None.

    Returns: recall of each resample at each rate, the largest that a threshold allows; NaN without movers.
    """
    hits, false = _counts(tracks, weights)
    with np.errstate(invalid="ignore"):
        recall, false_rate = hits / hits[:, -1:], false / np.maximum(false[:, -1:], 1e-300)
    places = np.stack([np.searchsorted(row, false_rates + 1e-12, side="right") - 1 for row in false_rate])
    return np.take_along_axis(recall, places, axis=1)


def precision_at(
    tracks: Tracks,
    recalls: Float[np.ndarray, " r"] = RECALLS,
    weights: Float[np.ndarray, "b seed"] | None = None,
) -> Float[np.ndarray, "b r"]:
    """Share of movers among the tracks called dynamic when at least these shares of the movers are found.

    Arguments and shape as of `recall_at`; recalls in (0, 1]. The largest that a threshold allows; NaN without movers.
    """
    hits, false = _counts(tracks, weights)
    with np.errstate(invalid="ignore"):
        recall, precision = hits / hits[:, -1:], hits / (hits + false)
    # The best precision at this recall or any higher one.
    best = np.flip(np.fmax.accumulate(np.flip(precision, axis=1), axis=1), axis=1)
    places = np.stack([np.searchsorted(row, recalls - 1e-12) for row in recall])
    places = np.minimum(places, recall.shape[1] - 1)
    return np.where(np.isnan(recall[:, -1:]), np.nan, np.take_along_axis(best, places, axis=1))


def area(tracks: Tracks, weights: Float[np.ndarray, "b seed"] | None = None) -> Float[np.ndarray, " b"]:
    """Area under the ROC of each resample: the share of pairs of a mover and another in the right order, ties half.

    Arguments as of `recall_at`. NaN where there are no pairs.
    """
    hits, false = _counts(tracks, weights)
    pairs = hits[:, -1] * false[:, -1]
    under = np.sum(np.diff(false, axis=1) * (hits[:, 1:] + hits[:, :-1]) / 2, axis=1)
    return np.where(pairs > 0, under / np.where(pairs > 0, pairs, 1.0), np.nan)


def resampled(
    curve: Callable[..., np.ndarray], tracks: Tracks, levels: Float[np.ndarray, " r"], num: int = NUM_RESAMPLES
) -> Float[np.ndarray, "b r"]:
    """`recall_at` or `precision_at` of every resample; NaN of fewer than `MIN_SEEDS` seeds."""
    if len(tracks.score) < MIN_SEEDS:
        return np.full((num, len(levels)), np.nan)
    # A few at a time, which bounds the memory.
    weights = resamples(len(tracks.score), num)
    return np.concatenate([curve(tracks, levels, weights[i : i + 50]) for i in range(0, num, 50)])


def resamples(num_seeds: int, num: int = NUM_RESAMPLES) -> Float[np.ndarray, "b seed"]:
    """How often each seed is drawn in each resample; the same whenever asked."""
    return np.random.default_rng(0).multinomial(num_seeds, np.full(num_seeds, 1 / num_seeds), num).astype(float)


def interval(values: Float[np.ndarray, "b ..."]) -> Float[np.ndarray, "2 ..."]:
    """Bounds of the central 95 % of resampled values (percentile bootstrap); NaN where any of them is."""
    tail = (1 - _CONFIDENCE) / 2
    return np.quantile(values, [tail, 1 - tail], axis=0)


def _counts(tracks: Tracks, weights: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Movers and others with a score of at least each that occurs, (b, m), from none to all."""
    weights = np.ones((1, len(tracks.score))) if weights is None else weights
    counts = ~np.isnan(tracks.score)
    score, is_mover = tracks.score[counts], tracks.is_mover[counts]
    seed = np.nonzero(counts)[0]
    order = np.argsort(-score, kind="stable")
    # Equal scores are called dynamic together.
    is_last = np.append(score[order][1:] != score[order][:-1], True) if len(score) else np.zeros(0, bool)
    weight = weights[:, seed[order]]
    none = np.zeros((len(weights), 1))
    hits, false = (np.cumsum(weight * chosen, axis=1)[:, is_last] for chosen in (is_mover[order], ~is_mover[order]))
    return np.concatenate([none, hits], axis=1), np.concatenate([none, false], axis=1)
