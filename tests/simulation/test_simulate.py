"""Simulation: the geometry by an independent route, common random numbers, noise, derivatives and batches."""

import equinox as eqx
import jax
import numpy as np
import pytest
from reference import geometry
from scipy import stats

from vcjax.recording import last_sightings, validate
from vcjax.simulation.scenarios import paper
from vcjax.simulation.simulate import simulate

KEY = jax.random.key(0)
run = jax.jit(eqx.debug.assert_max_traces(simulate, max_traces=1))
EXPERIMENTS = {
    "forward, steady": dict(),
    "curved, oscillating": dict(robot="curved", oscillation_amplitude_m=0.05),
    "lateral, movers": dict(robot="lateral", dynamic="lateral", dynamic_speed_m_s=0.5),
    "forward, oscillating, movers": dict(dynamic="inverse_forward", oscillation_amplitude_m=0.1, noise="six_axis"),
}
every_experiment = pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=EXPERIMENTS)


def pixel_noise(**experiment):
    """What is left of a simulation's pixels without those of the same simulation without noise."""
    noisy, _ = run(paper(**experiment), KEY)
    clean, _ = run(paper(**experiment | dict(pixel_error_std_px=0.0)), KEY)
    return np.asarray(noisy.uv_px - clean.uv_px), np.abs(np.asarray(clean.uv_px)).max(axis=-1) < 1e4


# ---- geometry -------------------------------------------------------------------------------------------------------


@every_experiment
def test_projections_are_those_of_an_independent_model(experiment):
    scenario = paper(**experiment | dict(pixel_error_std_px=0.0))
    recording, truth = run(scenario, KEY)
    time = np.arange(1, 161) / 10
    control = np.array([*scenario.increment[:2], 0, 0, 0, np.deg2rad(scenario.increment[2])])
    robot = np.array([*scenario.start[:2], 0, 1, 0, 0, 0])
    mount = np.concatenate([scenario.mount[:3], geometry.q_from_euler(np.deg2rad(scenario.mount[3:]))])
    A, f = scenario.oscillation.amplitude_m, scenario.oscillation.frequency_hz
    for t in range(160):
        robot = geometry.move(robot, control)
        sensor = mount + np.array([0, A * np.sin(2 * np.pi * f * time[t]), 0, 0, 0, 0, 0])
        landmarks = scenario.landmarks_m.copy()
        landmarks[scenario.movers.ids] += time[t] * scenario.movers.speed_m_s * scenario.movers.direction
        np.testing.assert_allclose(truth.robot[t], robot, rtol=0, atol=1e-11)
        np.testing.assert_allclose(truth.sensor[t], sensor, rtol=0, atol=1e-13)
        np.testing.assert_allclose(truth.landmarks_m[t], landmarks, rtol=0, atol=1e-12)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = geometry.depth(robot[:, None], sensor[:, None], landmarks.T)
            uv = geometry.project(robot[:, None], sensor[:, None], landmarks.T, scenario.camera.intrinsics_px).T
        is_seen = (depth > 1e-9) & np.all((uv >= 0) & (uv <= [640, 480]), axis=1)
        np.testing.assert_array_equal(recording.is_valid[t], is_seen)
        np.testing.assert_allclose(np.asarray(recording.uv_px)[t][is_seen], uv[is_seen], rtol=0, atol=1e-9)


def test_forward_path_ends_at_the_origin():
    _, truth = run(paper("forward"), KEY)
    np.testing.assert_allclose(truth.robot[-1], [0, 0, 0, 1, 0, 0, 0], rtol=0, atol=1e-12)


def test_curved_path_turns_by_80_degrees_on_a_circle():
    _, truth = run(paper("curved"), KEY)
    q = np.asarray(truth.robot)[-1, 3:]
    np.testing.assert_allclose(2 * np.arctan2(q[3], q[0]), np.deg2rad(80), rtol=1e-12)
    # The chord of 160 equal steps on a circle.
    chord = 0.05 * np.sin(np.deg2rad(40)) / np.sin(np.deg2rad(0.25))
    assert np.linalg.norm(truth.robot[-1, :2] - np.array([-8, -8])) == pytest.approx(chord, rel=1e-12)


@pytest.mark.parametrize(("dynamic", "step"), [("lateral", (0, 0.05, 0)), ("inverse_forward", (-0.05, 0, 0))])
def test_movers_move_and_only_they(dynamic, step):
    scenario = paper(dynamic=dynamic, dynamic_speed_m_s=0.5)
    _, truth = run(scenario, KEY)
    ids = scenario.movers.ids
    steps = np.diff(np.concatenate([scenario.landmarks_m[None], truth.landmarks_m]), axis=0)
    np.testing.assert_allclose(steps[:, ids], np.broadcast_to(step, (160, 6, 3)), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(np.delete(steps, ids, axis=1), 0)
    np.testing.assert_array_equal(np.flatnonzero(truth.is_moving), ids)


@pytest.mark.parametrize("amplitude", [0.0, 0.05])
def test_commanded_shifts_add_up_to_the_oscillation(amplitude):
    recording, truth = run(paper(oscillation_amplitude_m=amplitude), KEY)
    displacement = amplitude * np.sin(2 * np.pi * 3 * np.arange(1, 161) / 10)
    shifts = np.cumsum(recording.sensor_shift_m, axis=0)
    np.testing.assert_allclose(shifts[:, 1], displacement, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(shifts[:, ::2], 0)
    np.testing.assert_allclose(truth.sensor[:, :3] - recording.sensor_start[:3], shifts, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(truth.sensor[:, 3:], np.broadcast_to(recording.sensor_start[3:], (160, 4)))


# ---- what a filter reads --------------------------------------------------------------------------------------------


@every_experiment
def test_recording_is_valid_and_knows_its_last_sightings(experiment):
    recording, _ = run(paper(**experiment), KEY)
    validate(recording)
    np.testing.assert_array_equal(recording.is_last, last_sightings(recording.track_id, recording.is_valid))
    np.testing.assert_array_equal(recording.track_id, np.broadcast_to(np.arange(162), (160, 162)))
    np.testing.assert_allclose(recording.time_s, np.arange(1, 161) / 10, rtol=1e-15)
    np.testing.assert_array_equal(recording.start_cov, 0)
    inside = np.all((recording.uv_px >= 0) & (recording.uv_px <= np.array([640, 480])), axis=-1)
    assert not np.any(recording.is_valid & ~inside)
    assert 20 < np.mean(np.sum(recording.is_valid, axis=1)) < 100


def test_covariance_of_the_odometry_is_that_of_its_noise():
    scenario = paper(noise="six_axis")
    recording, _ = run(scenario, KEY)
    expected = np.diag([0.005**2] * 3 + [np.deg2rad(0.05) ** 2] * 3)
    np.testing.assert_allclose(recording.odometry_cov, np.broadcast_to(expected, (160, 6, 6)), rtol=1e-14)


# ---- noise ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "other",
    [
        dict(oscillation_amplitude_m=0.05),
        dict(dynamic="lateral", dynamic_speed_m_s=0.5),
        dict(dynamic="inverse_forward", oscillation_amplitude_m=0.1, oscillation_frequency_hz=2.0),
    ],
    ids=["oscillation", "movers", "both"],
)
def test_what_is_compared_sees_the_same_noise(other):
    recording, _ = run(paper(), KEY)
    compared, _ = run(paper(**other), KEY)
    np.testing.assert_array_equal(compared.odometry, recording.odometry)
    (noise, near), (noise_compared, near_compared) = pixel_noise(), pixel_noise(**other)
    both = near & near_compared
    np.testing.assert_allclose(noise_compared[both], noise[both], rtol=0, atol=1e-9)
    assert both.mean() > 0.9
    assert noise[both].std() > 0.9


def test_another_key_gives_other_noise():
    (a, _), (b, _) = run(paper(), KEY), run(paper(), jax.random.key(1))
    assert np.all(a.odometry[:, [0, 1, 5]] != b.odometry[:, [0, 1, 5]])
    assert np.all(a.uv_px[a.is_valid & b.is_valid] != b.uv_px[a.is_valid & b.is_valid])


def assert_chi2(white):
    """What should be standard normal has a sum of squares within its two-sided 99.9 % interval, and no mean."""
    low, high = stats.chi2.interval(0.999, white.size)
    assert low < np.sum(white**2) < high
    assert abs(np.mean(white)) * np.sqrt(white.size) < stats.norm.isf(0.0005)


def test_odometry_noise_has_its_standard_deviations():
    scenario = paper("curved", noise="six_axis")
    recording, _ = run(scenario, KEY)
    true = [0.05, 0, 0, 0, 0, np.deg2rad(0.5)]
    std = [0.005] * 3 + [np.deg2rad(0.05)] * 3
    white = (np.asarray(recording.odometry) - true) / std
    for axis in range(6):
        assert_chi2(white[:, axis])
    np.testing.assert_allclose(np.corrcoef(white.T), np.eye(6), rtol=0, atol=stats.norm.isf(1e-4) / np.sqrt(160))


def test_planar_odometry_noise_is_planar():
    recording, _ = run(paper(), KEY)
    np.testing.assert_array_equal(recording.odometry[:, 2:5], 0)
    assert_chi2((np.asarray(recording.odometry)[:, [0, 1, 5]] - [0.05, 0, 0]) / [0.005, 0.005, np.deg2rad(0.05)])


def test_pixel_noise_has_its_standard_deviation():
    noise, near = pixel_noise(pixel_error_std_px=1.5)
    assert_chi2(noise[near] / 1.5)
    u, v = noise[near].T
    assert abs(np.corrcoef(u, v)[0, 1]) < stats.norm.isf(1e-4) / np.sqrt(u.size)


# ---- derivatives and batches ----------------------------------------------------------------------------------------

NUMBERS = {
    "amplitude": (lambda s: s.oscillation.amplitude_m, 1e-6),
    "frequency": (lambda s: s.oscillation.frequency_hz, 1e-7),
    "speed": (lambda s: s.movers.speed_m_s, 1e-6),
    "pixel noise": (lambda s: s.pixel_std_px, 1e-4),
}
MOVING = paper(dynamic="lateral", dynamic_speed_m_s=0.5, oscillation_amplitude_m=0.05)


@jax.jit
def derivatives_of_pixels(scenario, directions):
    """Which pixels are valid, and the pixels' derivative along each of some directions of change."""

    def pixels(scenario):
        recording, _ = simulate(scenario, KEY)
        return recording.uv_px, recording.is_valid

    (_, is_valid), push = jax.linearize(pixels, scenario)
    return is_valid, jax.vmap(lambda d: push(d)[0])(directions)


def test_pixels_are_differentiable_by_every_number():
    zero = jax.tree.map(lambda leaf: np.zeros(np.shape(leaf), jax.dtypes.float0 if _is_int(leaf) else float), MOVING)
    directions = [eqx.tree_at(where, zero, np.float64(1)) for where, _ in NUMBERS.values()]
    is_valid, derivatives = derivatives_of_pixels(MOVING, jax.tree.map(lambda *d: np.stack(d), *directions))
    assert np.all(np.isfinite(derivatives))
    for (where, step), derivative in zip(NUMBERS.values(), derivatives, strict=True):
        ahead, behind = (run(eqx.tree_at(where, MOVING, where(MOVING) + h), KEY)[0] for h in (step, -step))
        same = is_valid & ahead.is_valid & behind.is_valid
        difference = (ahead.uv_px - behind.uv_px)[same] / (2 * step)
        np.testing.assert_allclose(derivative[same], difference, rtol=1e-4, atol=1e-4)
        assert np.abs(difference).max() > 1


def test_seeds_form_a_batch():
    keys = jax.random.split(KEY, 3)
    recordings, truths = jax.jit(jax.vmap(simulate, in_axes=(None, 0)))(MOVING, keys)
    for i, key in enumerate(keys):
        recording, truth = run(MOVING, key)
        alone, batched = (recording, truth), jax.tree.map(lambda leaf, i=i: leaf[i], (recordings, truths))
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(batched), strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-10)


def test_other_numbers_compile_nothing_new():
    for experiment in EXPERIMENTS.values():
        run(paper(**experiment), KEY)  # refuses to be traced twice


def _is_int(leaf):
    return np.issubdtype(np.asarray(leaf).dtype, np.integer)


@pytest.mark.parametrize("amplitude_m", [0.0, 0.05])
def test_a_point_that_comes_towards_the_camera_mimics_a_nearer_static_one(amplitude_m):
    """Moving at -βu under a straight path u it is seen as a static point at 1/(1+β) of its distance.

    Exactly so by a steady camera; the oscillating one sees the two f A β sin(2πft)/d apart, d the mover's depth.
    """
    beta, camera = 0.5, np.array([-8.0, 0.0, 0.6])  # the camera before the first frame
    mover = np.array([4.0, -2.0, 1.0])
    mimic = camera + (mover - camera) / (1 + beta)
    scenario = paper(
        dynamic="inverse_forward",
        dynamic_speed_m_s=beta * 0.5,
        pixel_error_std_px=0.0,
        oscillation_amplitude_m=amplitude_m,
    )
    ids = np.asarray(scenario.movers.ids)
    is_mover = np.all(scenario.landmarks_m[ids] == mover, axis=1)
    places = np.array(scenario.landmarks_m)
    places[0] = mimic
    recording, truth = run(eqx.tree_at(lambda s: s.landmarks_m, scenario, places), KEY)
    moving = ids[is_mover][0]
    apart = np.asarray(recording.uv_px[:, moving] - recording.uv_px[:, 0])
    depth = np.asarray(truth.landmarks_m[:, moving, 0] - truth.robot[:, 0])
    au = np.asarray(recording.camera.intrinsics_px)[2]
    swing = amplitude_m * np.sin(2 * np.pi * 3.0 * np.asarray(recording.time_s))
    in_front = depth > 0.5
    assert in_front.sum() > 80
    np.testing.assert_allclose(apart[in_front, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(apart[in_front, 0]), np.abs(au * beta * swing / depth)[in_front], atol=1e-9)
