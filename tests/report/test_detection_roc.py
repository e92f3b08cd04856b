"""Curves of methods: what is pooled, and what a score that tells all or nothing gives."""

import numpy as np
from fake_runs import fake_runs

from vcjax.report.detection_roc import _pooled, roc_figure, separation
from vcjax.study.detection_scenes import Scene
from vcjax.study.paper import Cell

RUNS = fake_runs(Cell(4, "forward", "lateral", 1.0, "VC", True), num_seeds=6)


def scored(score):
    """The runs with a score for each feature, that of a detector alone."""
    shape = RUNS.frames_mapped.shape
    margin = (("seed", "feature"), np.broadcast_to(score, shape).astype(float))
    nothing = (("seed", "feature"), np.full(shape, np.nan))
    return RUNS.assign(detector_margin=margin, dynamic_margin=nothing, is_finite=("seed", np.ones(6, bool)))


def test_a_score_that_tells_movers_apart_has_an_area_of_one_and_one_that_does_not_of_a_half():
    is_moving = RUNS.is_moving.values
    told, blind = separation(scored(np.where(is_moving, 1.0, -1.0))), separation(scored(np.zeros(len(is_moving))))
    assert told == {name: {"mean": 1.0, "lower": 1.0, "upper": 1.0} for name in ("auc", "recall_at_1_percent")}
    assert blind["auc"] == {"mean": 0.5, "lower": 0.5, "upper": 0.5} and blind["recall_at_1_percent"]["mean"] == 0.0
    rng = np.random.default_rng(0)
    noisy = separation(scored(is_moving + rng.normal(size=(6, len(is_moving)))))["auc"]
    assert 0.6 < noisy["lower"] < noisy["mean"] < noisy["upper"] < 0.9


def test_the_tracks_of_one_seed_in_all_scenes_of_an_amplitude_belong_together():
    apart, mixed = scored(np.where(RUNS.is_moving, 1.0, -1.0)), scored(np.zeros(RUNS.sizes["feature"]))
    runs = {
        ("VC", Scene(0.1, "lateral", 1.0)): apart,
        ("VC", Scene(0.1, "lateral", 0.5)): mixed,
        ("RE", Scene(0.1, "lateral", 0.5)): mixed,
        ("VC", Scene(0.1, harder="late")): mixed,
        ("VC", Scene(0.1)): mixed,
    }
    pooled = _pooled(runs)
    assert set(pooled) == {(0.1, "VC"), (0.1, "RE")}
    both = np.concatenate([apart.detector_margin, mixed.detector_margin], axis=1)
    np.testing.assert_array_equal(pooled[0.1, "VC"].score, both)
    assert [len(axes.lines) for axes in roc_figure(runs).axes] == [3, 2]  # of each method, and the 1 % line
