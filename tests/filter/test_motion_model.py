"""Motion models against plain NumPy: predictions with what is carried, corrections that reach it, gaps in time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filter_runs import filtered, frame_of, head, predict, recorded, step
from reference import geometry as geo
from scipy.linalg import expm

from vcjax.filter.config import FilterConfig
from vcjax.filter.features import Block, observe, predict_features
from vcjax.filter.motion_model import BiasedOdometry, ConstantVelocity, Odometry
from vcjax.filter.state import full_cov
from vcjax.gates.reprojection import ReprojectionError

CARRIED = np.array([0.3, -0.1, 0.2, 0.05, 0.2, -0.3])
MOTIONS = {
    "constant velocity": ConstantVelocity(acceleration=0.5, angular_acceleration=0.7, start_velocity_std_m_s=0.3),
    "biased odometry": BiasedOdometry(velocity_bias_std_m_s=0.1, rate_bias_std_rad_s=0.02, rate_bias_walk=0.03),
}


def config_of(motion) -> FilterConfig:
    return FilterConfig(motion=motion, max_landmarks=11, max_updates=4)


def some_state(motion):
    """A state with a map, whose carried coordinates are not zero, and the next frame."""
    recording = head(recorded(0, robot="curved"), 6)
    states = [state for state, _ in filtered(config_of(motion), recording)]
    state = states[-2]
    return dataclasses.replace(state, vehicle=state.vehicle.at[14:].set(CARRIED)), frame_of(recording, 5)


def moved(motion, r, odometry, dt):
    """Robot pose and carried coordinates after the step: r (13,)."""
    frame, carried = r[:7], r[7:]
    if isinstance(motion, ConstantVelocity):
        q = geo.q_product(frame[3:], geo.q_from_rotation_vector(carried[3:] * dt))
        return np.concatenate([frame[:3] + carried[:3] * dt, q, carried])
    return np.concatenate([geo.move(frame, odometry - carried * dt), carried])


def differences(function, x):
    """∂function/∂x by central differences."""
    steps = 1e-6 * np.eye(len(x))
    return np.stack([(function(x + h) - function(x - h)) / 2e-6 for h in steps], axis=1)


@pytest.mark.parametrize("dt", [0.1, 1.3])
@pytest.mark.parametrize("name", MOTIONS)
def test_prediction_is_that_of_plain_numpy(name, dt):
    motion = MOTIONS[name]
    state, frame = some_state(motion)
    frame = dataclasses.replace(frame, time_step_s=jnp.asarray(dt))
    after = predict(config_of(motion), state, frame)

    rows, odometry = np.r_[0:7, 14:20], np.asarray(frame.odometry)
    r = np.asarray(state.vehicle)[rows]
    expected = moved(motion, r, odometry, dt)
    np.testing.assert_allclose(np.asarray(after.vehicle)[rows], expected, rtol=0, atol=1e-12)
    F = differences(lambda r: moved(motion, r, odometry, dt), r)
    if isinstance(motion, ConstantVelocity):
        # White acceleration through a double integrator, by its matrix exponential (Van Loan 1978).
        A, zero = np.kron([[0, 1], [0, 0]], np.eye(6)), np.zeros((12, 12))
        density = np.diag([0] * 6 + [0.5**2] * 3 + [0.7**2] * 3)
        big = expm(np.block([[-A, density], [zero, A.T]]) * dt)
        G = np.zeros((13, 12))
        turned = [geo.q_product(expected[3:7], np.array([0, *(0.5 * e)])) for e in np.eye(3)]
        G[:3, :3], G[3:7, 3:6], G[7:, 6:] = np.eye(3), np.stack(turned, axis=1), np.eye(6)
        Q = G @ big[12:, 12:].T @ big[:12, 12:] @ G.T
    else:
        G = differences(lambda u: moved(motion, r, u, dt), odometry)
        Q = G @ np.asarray(frame.odometry_cov) @ G.T
        Q[10:, 10:] += 0.03**2 * dt * np.eye(3)
    before = np.asarray(full_cov(state))
    whole = np.eye(len(before))
    whole[np.ix_(rows, rows)] = F
    expected = whole @ before @ whole.T
    expected[np.ix_(rows, rows)] += Q
    np.testing.assert_allclose(full_cov(after), expected, rtol=0, atol=2e-9)


def test_a_correction_reaches_what_is_carried_and_no_pixel_shows_it():
    motion = MOTIONS["constant velocity"]
    config = dataclasses.replace(config_of(motion), choose_among="measured", gate=ReprojectionError(th1=1e9))
    state, frame = some_state(motion)
    predicted = predict(config, state, frame)
    # One of the mapped features is seen, and no other.
    is_visible = np.asarray(predict_features(config, predicted, frame.camera).is_visible)
    is_seen = np.asarray(frame.is_valid) & np.isin(frame.track_id, np.asarray(state.track_id)[is_visible])
    only = np.flatnonzero(is_seen)[0]
    frame = dataclasses.replace(frame, is_valid=jnp.arange(len(is_seen)) == only)
    after, info = jax.device_get(step(config, state, frame))
    (k,) = np.flatnonzero(info.is_accepted)
    (slot,) = np.flatnonzero(np.asarray(predicted.track_id) == info.candidate_id[k])
    block = Block(predicted.vehicle, predicted.landmarks[slot], predicted.to_coordinates[slot])
    h = np.asarray(observe(config, frame.camera, block).H)
    np.testing.assert_array_equal(h[:, 14:20], 0)
    P = np.asarray(full_cov(predicted))
    H = np.zeros((2, len(P)))
    H[:, :20], H[:, 20 + 7 * slot : 27 + 7 * slot] = h[:, :20], h[:, 20:]
    S = H @ P @ H.T + np.eye(2)
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(info.innovation_cov[k], S, rtol=1e-9)
    moved_by = (K @ info.innovation[k])[14:20]
    assert np.abs(moved_by).max() > 1e-4
    np.testing.assert_allclose(info.carried, CARRIED + moved_by, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.P_vv[14:, 14:], (P - K @ S @ K.T)[14:20, 14:20], rtol=0, atol=1e-12)


def test_odometry_with_a_bias_of_zero_is_plain_odometry():
    recording = head(recorded(0, robot="curved"), 12)
    none = BiasedOdometry(rate_bias_std_rad_s=0.0)
    for (one, info), (other, _) in zip(
        filtered(config_of(Odometry()), recording), filtered(config_of(none), recording), strict=True
    ):
        np.testing.assert_allclose(other.vehicle[:14], one.vehicle, rtol=0, atol=1e-11)
        np.testing.assert_allclose(other.P_mm[:70, :70], one.P_mm[:70, :70], rtol=0, atol=1e-10)
        assert info.carried.shape == (0,)
    np.testing.assert_array_equal(other.vehicle[14:], 0)


def test_a_constant_bias_is_found():
    recording = recorded(0, robot="curved")
    bias = np.array([0, 0, 0, 0, 0, 0.02])
    biased = dataclasses.replace(recording, odometry=recording.odometry + 0.1 * bias)
    *_, (_, info) = filtered(config_of(BiasedOdometry(rate_bias_std_rad_s=0.02)), head(biased, 80))
    error = info.carried[5] - bias[5]
    assert info.carried_std[5] < 0.005 and np.abs(error) < 3 * info.carried_std[5]


def test_a_gap_in_time_widens_the_doubt_as_frames_without_features_do():
    motion = MOTIONS["constant velocity"]
    state, frame = some_state(motion)
    empty = dataclasses.replace(frame, is_valid=jnp.zeros_like(frame.is_valid), time_step_s=jnp.asarray(0.1))
    config, after = config_of(motion), state
    for _ in range(10):
        after, info = step(config, after, empty)
        assert info.is_blind and info.is_finite
    gap, _ = step(config, state, dataclasses.replace(empty, time_step_s=jnp.asarray(1.0)))
    std = [np.sqrt(np.diag(s.P_vv)[[0, 1, 2, 14, 15, 16, 17, 18, 19]]) for s in (state, after, gap)]
    assert np.all(std[1] > 1.1 * std[0])
    np.testing.assert_allclose(std[2], std[1], rtol=1e-6)  # linear in place and velocity: the same to rounding
    np.testing.assert_allclose(gap.vehicle[:3], after.vehicle[:3], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ConstantVelocity(acceleration=-1.0), r"ConstantVelocity\(acceleration=-1.0\)"),
        (lambda: BiasedOdometry(rate_bias_walk=np.nan), r"BiasedOdometry\(rate_bias_walk=nan\)"),
        (lambda: FilterConfig(motion="odometry"), r"FilterConfig\(motion='odometry'\)"),  # type: ignore
    ],
)
def test_bad_numbers_are_refused(make, message, unchecked):
    with pytest.raises(ValueError, match=message):
        make()
