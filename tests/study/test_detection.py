"""What a run found out about each feature, against Python loops."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_runs
from hypothesis import given
from hypothesis import strategies as st

import vcjax as vc
from vcjax.study.detection import area_under_roc, detections


@pytest.fixture(scope="module")
def run_and_truth():
    recording, truth = tiny_runs.simulate_once(tiny_runs.scenario(), jax.random.key(3))
    _, info = tiny_runs.run_once(tiny_runs.config(tiny_runs.STRICT), recording)
    return info, truth


def test_margins_and_first_frames_equal_python_loops(run_and_truth):
    info, truth = run_and_truth
    found = jax.device_get(detections(info, truth))
    info = jax.device_get(info)
    margin, mapped, deleted = {}, {}, {}
    for t in range(tiny_runs.NUM_FRAMES):
        for k in np.flatnonzero(info.is_measured[t]):
            feature, th1, th2 = int(info.candidate_id[t, k]), tiny_runs.STRICT.th1, tiny_runs.STRICT.th2
            m = info.re1[t, k] - th1
            if not info.is_accepted[t, k]:
                m = min(m, info.re1_prior[t, k] - info.re2[t, k] - th2)
                assert (m > 0) == info.is_dynamic[t, k]
            margin[feature] = max(margin.get(feature, -np.inf), m)
            if info.is_dynamic[t, k]:
                deleted.setdefault(feature, t + 1)
        for feature in info.track_id[t][info.track_id[t] >= 0].tolist():
            mapped.setdefault(feature, t + 1)
        for feature in info.inconsistent_id[t][info.inconsistent_id[t] >= 0].tolist():
            deleted.setdefault(feature, t + 1)
    assert len(deleted) > 3 and len(margin) > len(deleted)
    num = len(truth.is_moving)
    for name, by_feature, none in (
        ("dynamic_margin", margin, np.nan),
        ("first_mapped", mapped, 0),
        ("first_deleted", deleted, 0),
    ):
        np.testing.assert_allclose(found[name], [by_feature.get(f, none) for f in range(num)], rtol=1e-14, err_msg=name)


def test_a_feature_has_the_largest_margin_of_the_detector(run_and_truth):
    """Whatever slots it was in; NaN says nothing, and neither does what is said of a slot that nobody held."""
    info, truth = run_and_truth
    rng = np.random.default_rng(0)
    margins = rng.normal(size=info.detector_margin.shape)
    margins[rng.random(margins.shape) < 0.5] = np.nan
    info = eqx.tree_at(lambda i: i.detector_margin, info, jnp.asarray(margins))
    found = detections(info, truth)
    largest = {}
    for feature, margin in zip(np.ravel(info.watched_id), margins.ravel(), strict=True):
        if feature >= 0 and not np.isnan(margin):
            largest[int(feature)] = max(largest.get(int(feature), -np.inf), margin)
    expected = np.array([largest.get(f, np.nan) for f in range(len(truth.is_moving))])
    np.testing.assert_array_equal(found["detector_margin"], expected)
    assert len(largest) > 2
    np.testing.assert_allclose(found["detector_auc"], area_under_roc(jnp.asarray(expected), truth.is_moving))
    held = np.asarray(run_and_truth[0].watched_id)[1:] >= 0
    np.testing.assert_array_equal(np.isnan(np.asarray(run_and_truth[0].detector_margin)[1:][~held]), True)


def test_without_verdicts_the_margin_is_that_of_the_update_gate():
    recording, _ = tiny_runs.simulate_once(tiny_runs.scenario(), jax.random.key(3))
    _, info = tiny_runs.run_once(tiny_runs.config(vc.ReprojectionError(1.0)), recording)
    expected = np.where(info.is_measured, info.re1 - 1.0, np.nan)
    np.testing.assert_array_equal(info.dynamic_margin, expected)
    assert np.any(np.asarray(info.dynamic_margin) > 0)


@given(st.lists(st.tuples(st.integers(-3, 3), st.booleans(), st.booleans()), min_size=1, max_size=12))
def test_area_is_the_share_of_pairs_in_order(entries):
    score = np.array([s if counts else np.nan for s, _, counts in entries], float)
    is_mover = np.array([mover for _, mover, _ in entries])
    pairs = [
        (score[m] > score[o]) + 0.5 * (score[m] == score[o])
        for m in np.flatnonzero(is_mover & ~np.isnan(score))
        for o in np.flatnonzero(~is_mover & ~np.isnan(score))
    ]
    found = area_under_roc(jnp.asarray(score), jnp.asarray(is_mover))
    np.testing.assert_allclose(found, np.mean(pairs) if pairs else np.nan, rtol=1e-12)
