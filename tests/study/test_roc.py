"""ROC and precision–recall curves against every threshold tried, and their bootstrap."""

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from vcjax.study import roc
from vcjax.study.roc import Tracks, precision_at, recall_at, resampled, resamples, track_scores

TRACKS = st.lists(
    st.tuples(st.integers(-3, 3), st.booleans(), st.sampled_from([True, True, False])), min_size=4, max_size=16
)


def made(entries) -> Tracks:
    """Two seeds with half of the entries each."""
    num = len(entries) // 2
    score = np.array([s if counts else np.nan for s, _, counts in entries[: 2 * num]], float)
    is_mover = np.array([mover for _, mover, _ in entries[: 2 * num]])
    return Tracks(score.reshape(2, num), is_mover.reshape(2, num))


def tried(tracks: Tracks) -> list[tuple[float, float, float]]:
    """(static share, recall, precision) of every threshold."""
    counts = ~np.isnan(tracks.score)
    found = []
    for threshold in (np.inf, *np.unique(tracks.score[counts])):
        called = counts & (tracks.score >= threshold)
        hits, false = (called & tracks.is_mover).sum(), (called & ~tracks.is_mover).sum()
        movers, others = (counts & tracks.is_mover).sum(), (counts & ~tracks.is_mover).sum()
        share = false / others if others else 0.0
        found.append((share, hits / movers if movers else np.nan, hits / called.sum() if called.any() else np.nan))
    return found


@given(TRACKS)
def test_curves_are_the_best_that_a_threshold_allows(entries):
    tracks = made(entries)
    points = tried(tracks)
    has_movers = not np.isnan(points[0][1])
    rates, recalls = np.array([0.0, 0.2, 0.5, 1.0]), np.array([0.1, 0.5, 1.0])
    expected = [max(r for share, r, _ in points if share <= rate) if has_movers else np.nan for rate in rates]
    np.testing.assert_allclose(recall_at(tracks, rates)[0], expected)
    precise = [max(p for _, r, p in points if r >= recall - 1e-12) if has_movers else np.nan for recall in recalls]
    np.testing.assert_allclose(precision_at(tracks, recalls)[0], precise)


@given(TRACKS)
def test_the_area_of_a_run_is_the_share_of_its_pairs_in_order(entries):
    tracks = made(entries)
    lowest = np.where(tracks.score == -3, -np.inf, tracks.score)  # tracks of which nothing was said are ties
    for score, is_mover, found in zip(lowest, tracks.is_mover, roc.area_of_each(lowest, tracks.is_mover), strict=True):
        movers, others = (score[mask & ~np.isnan(score)] for mask in (is_mover, ~is_mover))
        pairs = [(m > o) + 0.5 * (m == o) for m in movers for o in others]
        np.testing.assert_allclose(found, np.mean(pairs) if pairs else np.nan)


def runs_with(gate, detector, gate_deletions) -> xr.Dataset:
    data = {"dynamic_margin": gate, "detector_margin": detector, "dynamic_deletions": gate_deletions}
    finite = {"is_finite": ("seed", [True] * (len(gate) - 1) + [False])}
    return xr.Dataset({name: (("seed", "feature"), np.array(value)) for name, value in data.items()} | finite)


def test_a_track_is_scored_by_what_deletes_it():
    nan, inf = np.nan, np.inf
    gate = [[2.0, -1.0, -3.0, nan, nan], [9.0, 9.0, 9.0, 9.0, 9.0]]
    detector = [[-4.0, 5.0, nan, -2.0, nan], [9.0, 9.0, 9.0, 9.0, 9.0]]
    by_gate = track_scores(runs_with(gate, detector, [[1, 0, 0, 0, 0]] * 2))
    np.testing.assert_array_equal(by_gate, [[2.0, 5.0, -3.0, -2.0, nan], [nan] * 5])
    # A gate that leaves out and deletes nothing has no say; the second of the runs failed, and says nothing of it.
    by_detector = track_scores(runs_with(gate, detector, [[0] * 5, [1] * 5]))
    np.testing.assert_array_equal(by_detector, [[-4.0, 5.0, -inf, -2.0, nan], [nan] * 5])
    tracks = Tracks(by_detector.values, np.array([[False, True, False, False, False]] * 2))
    np.testing.assert_array_equal(recall_at(tracks, np.array([0.0])), 1.0)


def test_tracks_of_which_nothing_was_said_are_called_dynamic_together():
    tracks = Tracks(np.array([[-np.inf, -np.inf, -np.inf, 1.0]]), np.array([[True, False, False, True]]))
    np.testing.assert_array_equal(recall_at(tracks, np.array([0.0, 0.5, 1.0]))[0], [0.5, 0.5, 1.0])


def test_a_seed_drawn_twice_counts_twice():
    rng = np.random.default_rng(1)
    tracks = Tracks(rng.normal(size=(3, 20)), rng.random((3, 20)) < 0.3)
    twice = Tracks(tracks.score[[0, 2, 2]], tracks.is_mover[[0, 2, 2]])
    weights = np.array([[1.0, 0.0, 2.0]])
    np.testing.assert_allclose(recall_at(tracks, weights=weights), recall_at(twice))
    np.testing.assert_allclose(precision_at(tracks, weights=weights), precision_at(twice))


def test_resamples_are_the_same_whenever_asked_and_draw_as_many_seeds():
    weights = resamples(8, 60)
    np.testing.assert_array_equal(weights, resamples(8, 60))
    np.testing.assert_array_equal(weights.sum(axis=1), 8)
    assert weights.mean() == pytest.approx(1) and weights.var() == pytest.approx(1 - 1 / 8, abs=0.15)
    rng = np.random.default_rng(0)
    tracks = Tracks(rng.normal(size=(8, 9)), rng.random((8, 9)) < 0.5)
    levels = np.array([0.1, 0.3])
    np.testing.assert_array_equal(resampled(recall_at, tracks, levels, 60), recall_at(tracks, levels, weights))
    too_few = Tracks(tracks.score[:7], tracks.is_mover[:7])
    assert np.isnan(resampled(recall_at, too_few, levels, 60)).all()


def test_the_interval_covers_as_often_as_it_says():
    """Movers score one deviation higher: recall at 10 % static is 1 - Φ(z₀.₉ - 1); 200 sets of 60 seeds."""
    from scipy import stats

    truth, covered = 1 - stats.norm.cdf(stats.norm.ppf(0.9) - 1), 0
    for number in range(200):
        rng = np.random.default_rng(number)
        is_mover = np.arange(30) < 6
        tracks = Tracks(rng.normal(size=(60, 30)) + is_mover, np.tile(is_mover, (60, 1)))
        low, high = roc.interval(resampled(recall_at, tracks, np.array([0.1]), 200)[:, 0])
        covered += low <= truth <= high
    assert stats.binom.cdf(covered, 200, 0.95) > 1e-3 and covered < 200
