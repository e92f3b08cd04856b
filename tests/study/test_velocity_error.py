"""How far a detector's velocities are from the truth when it flags, against Python loops."""

import jax
import numpy as np
import pytest
import tiny_runs

import vcjax as vc
from vcjax.gates.either import Either
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.velocity_glr import VelocityGLR
from vcjax.study.velocity_error import velocity_errors

RATE_HZ = 10.0
DETECTOR = VelocityGLR(threshold=2.0)


@pytest.fixture(scope="module")
def run_and_truth():
    """A run in which movers and static features are flagged, some of them again after another birth."""
    recording, truth = tiny_runs.simulate_once(tiny_runs.scenario(), jax.random.key(3))
    config = tiny_runs.config(vc.ReprojectionError(3.0), detector=DETECTOR)
    _, info = tiny_runs.run_once(config, recording)
    return info, truth


def test_errors_at_the_first_deletion_equal_python_loops(run_and_truth):
    info, truth = run_and_truth
    found = jax.device_get(velocity_errors(DETECTOR, info, truth, RATE_HZ))
    v, cov = jax.device_get(DETECTOR.velocity(info.detector))
    info, truth = jax.device_get((info, truth))
    born, error, nees, again = {}, {}, {}, 0
    for t in range(tiny_runs.NUM_FRAMES):
        for slot in np.flatnonzero(info.inconsistent_id[t] >= 0):
            feature = int(info.inconsistent_id[t, slot])
            if feature in error:
                again += 1
                continue
            places, frames = truth.landmarks_m[:, feature], t - born[feature]
            e = v[t, slot] - RATE_HZ * (places[t] - places[born[feature]]) / frames
            error[feature], nees[feature] = np.sqrt(e @ e), e @ np.linalg.inv(cov[t, slot]) @ e
        born |= {int(feature): t for feature in info.born_id[t][info.born_id[t] >= 0]}
    assert again > 0 and {bool(truth.is_moving[f]) for f in error} == {True, False}
    num = len(truth.is_moving)
    for name, expected in (("velocity_error_m_s", error), ("velocity_nees", nees)):
        expected = [expected.get(f, np.nan) for f in range(num)]
        np.testing.assert_allclose(found[name], expected, rtol=1e-9, err_msg=name)


def test_who_estimates_no_velocity_has_no_error(run_and_truth):
    info, truth = run_and_truth
    assert Either(InlierRatio(), InlierRatio()).velocity((None, None)) is None
    errors = velocity_errors(InlierRatio(), info, truth, RATE_HZ)
    assert all(np.isnan(error).all() and error.shape == truth.is_moving.shape for error in errors.values())


def test_of_two_detectors_the_one_that_estimates_a_velocity_is_asked(run_and_truth):
    info, _ = run_and_truth
    expected = DETECTOR.velocity(info.detector)
    for pair, state in (
        (Either(InlierRatio(), DETECTOR), (None, info.detector)),
        (Either(DETECTOR, InlierRatio()), (info.detector, None)),
    ):
        for one, other in zip(pair.velocity(state), expected, strict=True):
            np.testing.assert_array_equal(one, other)
