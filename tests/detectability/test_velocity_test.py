"""Detectability against plain least squares, the recursive test, numeric derivatives, and where there is nothing."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import geometry
from scipy import stats

from vcjax.detectability.chi_squared import quantile
from vcjax.detectability.velocity_test import VelocityTest, evidence, information, mover_power, power
from vcjax.simulation.courses import Course
from vcjax.simulation.scenarios import paper

PLACE, VELOCITY = np.array([0.0, 1.0, 1.2]), np.array([0.024, 0.02, -0.016])
BARE = VelocityTest(pose_noise=0.0, inverse_depth_std=np.inf)
SCENE = paper(oscillation_amplitude_m=0.05, num_frames=30)
of_information, of_power = jax.jit(information), jax.jit(power)
of_movers = jax.jit(mover_power)


# ---- second opinion in plain NumPy ----------------------------------------------------------------------------------


@cache
def cameras(robot="forward"):
    """Robot and sensor in each of 30 frames, by plain NumPy: (30, 7) each."""
    start = {"forward": [-8.0, 0, 0], "curved": [-8.0, -8, 0]}[robot]
    robots, sensors, pose = [], [], np.array([*start, 1.0, 0, 0, 0])
    turn = np.deg2rad(0.5) if robot == "curved" else 0.0
    mount = np.array([0, 0, 0.6, *geometry.q_from_euler(np.deg2rad([-90.0, 0, -90]))])
    for k in range(1, 31):
        pose = geometry.move(pose, np.array([0.05, 0, 0, 0, 0, turn]))
        robots.append(pose)
        sensors.append(mount + np.array([0, 0.05 * np.sin(2 * np.pi * 3 * k / 10), 0, 0, 0, 0, 0]))
    return np.array(robots), np.array(sensors)


def seen(robot, sensor, place):
    """Pixels (2, …) of places (3, …) from poses (7, …)."""
    return geometry.project(robot, sensor, place, np.array([320.0, 240, 320, 320]))


def pixels(parameters, robots, sensors):
    """Pixels (60,) of a feature at p + v t in 30 frames."""
    places = parameters[:3, None] + np.arange(1, 31) / 10 * parameters[3:, None]
    return seen(robots.T, sensors.T, places).T.ravel()


def jacobian(function, x, h=1e-6):
    """By central differences, (outputs, inputs)."""
    columns = [(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    return np.stack(columns, axis=1)


def schur(whole):
    """What a 6 × 6 information says of the last three."""
    return whole[3:, 3:] - whole[3:, :3] @ np.linalg.solve(whole[:3, :3], whole[:3, 3:])


def test_information_is_that_of_least_squares():
    """Estimates of place and velocity from simulated pixels scatter as C⁻¹ says; the test's power is as predicted."""
    robots, sensors = cameras()
    truth = np.concatenate([PLACE, VELOCITY])
    clean, J = pixels(truth, robots, sensors), jacobian(lambda x: pixels(x, robots, sensors), truth)
    C = np.asarray(of_information(SCENE, BARE, jnp.asarray(PLACE), jnp.asarray(VELOCITY)))
    np.testing.assert_allclose(C, schur(J.T @ J), rtol=1e-5)

    random, num = np.random.default_rng(0), 400
    estimates = []
    for _ in range(num):
        measured, x = clean + random.standard_normal(clean.shape), truth.copy()
        for _ in range(4):  # Gauss and Newton, from the truth
            residual = measured - pixels(x, robots, sensors)
            x = x + np.linalg.lstsq(jacobian(lambda x: pixels(x, robots, sensors), x), residual, rcond=None)[0]
        assert np.abs(residual).max() < 10
        estimates.append(x[3:])
    errors = np.array(estimates) - VELOCITY
    distance = np.einsum("ni,ij,nj->n", errors, C, errors)
    low, high = stats.chi2.interval(0.999, 3 * num)
    assert low < distance.sum() < high
    assert stats.kstest(distance, "chi2", (3,)).pvalue > 1e-3
    bias = num * errors.mean(axis=0) @ C @ errors.mean(axis=0)
    assert bias < stats.chi2.isf(1e-3, 3)

    for rate in (1e-3, 0.01):
        q = float(quantile(rate))
        found = sum(float(v @ C @ v) > q for v in estimates)
        test = dataclasses.replace(BARE, false_alarm_rate=rate)
        expected = float(of_power(SCENE, test, jnp.asarray(PLACE), jnp.asarray(VELOCITY)))
        low, high = stats.binom.interval(0.999, num, expected)
        assert 0.2 < expected < 0.98 and low <= found <= high


def test_recursive_test_sums_up_the_same_information():
    """B, d and C of the recursive GLR beside a Kalman filter of a static point, with the Jacobians of `information`."""
    robots, sensors = cameras()
    H = jacobian(lambda p: pixels(np.concatenate([p, np.zeros(3)]), robots, sensors), PLACE).reshape(30, 2, 3)
    camera = robots[0, :3] + sensors[0, :3]
    ray, distance = (PLACE - camera) / np.linalg.norm(PLACE - camera), np.linalg.norm(PLACE - camera)
    # Birth from the first pixel and the depth assumed.
    P = np.linalg.inv(H[0].T @ H[0] + np.outer(ray, ray) / (0.5 * distance**2) ** 2)
    B, C = np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(1, 30):
        B = B + 0.1 * np.eye(3)
        S = H[k] @ P @ H[k].T + np.eye(2)
        K, G = P @ H[k].T @ np.linalg.inv(S), H[k] @ B
        C, B, P = C + G.T @ np.linalg.inv(S) @ G, B - K @ G, P - K @ S @ K.T
    test = VelocityTest(pose_noise=0.0)
    found = of_information(SCENE, test, jnp.asarray(PLACE), jnp.zeros(3))
    np.testing.assert_allclose(found, C, rtol=2e-5, atol=1e-6 * np.abs(C).max())


def test_errors_of_pose_and_displacement_are_noise_of_the_pixels():
    """S against numeric derivatives by pose and displacement; odometry errors on all axes, and a jitter."""
    scenario = paper(
        "curved", oscillation_amplitude_m=0.05, num_frames=30, noise="six_axis", oscillation_error_std_m=0.005
    )
    place = np.array([-3.0, -7.0, 1.2])
    robots, sensors = cameras(robot="curved")
    std = 2.0 * np.array([0.005] * 3 + [np.deg2rad(0.05)] * 3)
    whole = np.zeros((6, 6))
    for k in range(30):
        by_pose = jacobian(lambda n, k=k: seen(geometry.move(robots[k], n), sensors[k], place), np.zeros(6), 1e-5)
        by_shift = jacobian(lambda n, k=k: seen(robots[k], sensors[k] + n * np.eye(7)[1], place), np.zeros(1), 1e-5)
        S = np.eye(2) + by_pose * std**2 @ by_pose.T + 0.005**2 * by_shift @ by_shift.T
        H = jacobian(lambda p, k=k: seen(robots[k], sensors[k], p), place)
        J = np.concatenate([H, (k + 1) / 10 * H], axis=1)
        whole += J.T @ np.linalg.solve(S, J)
    test = dataclasses.replace(BARE, pose_noise=2.0)
    found = of_information(scenario, test, jnp.asarray(place), jnp.zeros(3))
    np.testing.assert_allclose(found, schur(whole), rtol=1e-4, atol=1e-6 * np.abs(found).max())


# ---- where there is nothing to tell ---------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [0.25, 0.5, 1.0])
def test_a_steady_camera_cannot_tell_what_comes_straight_towards_it(speed):
    """Along the path C is empty, whatever else it has; an oscillation fills it."""
    test = VelocityTest(inverse_depth_std=np.inf)
    scene = paper(dynamic="inverse_forward", dynamic_speed_m_s=speed)
    np.testing.assert_allclose(of_movers(scene, test), 1e-3, rtol=0, atol=1e-8)
    C = of_information(scene, test, jnp.array([4.0, 2.0, 1.0]), jnp.array([-speed, 0, 0]))
    values, vectors = np.linalg.eigh(C)
    assert values[0] < 1e-10 * values[1] and abs(vectors[0, 0]) > 1 - 1e-9
    # What a filter assumes of depths hardly helps: the two places of a mover and of what it mimics are both likely.
    np.testing.assert_allclose(of_movers(scene, VelocityTest()), 1e-3, rtol=0, atol=1e-4)
    swinging = paper(dynamic="inverse_forward", dynamic_speed_m_s=speed, oscillation_amplitude_m=0.1)
    assert np.all(of_movers(swinging, test) > 0.99)
    sideways = paper(dynamic="lateral", dynamic_speed_m_s=speed)
    assert np.all(of_movers(sideways, test) > 0.99)


def test_never_in_view_or_in_one_frame_there_is_no_power():
    behind = of_power(SCENE, VelocityTest(), jnp.array([-12.0, 0.0, 1.0]), jnp.array([0.0, 0.5, 0.0]))
    once = of_power(SCENE, VelocityTest(within_frames=1.0), jnp.asarray(PLACE), jnp.array([0.0, 0.5, 0.0]))
    still = of_power(SCENE, VelocityTest(), jnp.asarray(PLACE), jnp.zeros(3))
    np.testing.assert_allclose([behind, once, still], 1e-3, rtol=1e-9)
    rates = of_power(SCENE, VelocityTest(0.2), jnp.asarray(PLACE), jnp.zeros(3))
    np.testing.assert_allclose(rates, 0.2, rtol=1e-12)


# ---- properties -----------------------------------------------------------------------------------------------------

places = st.tuples(st.floats(-6, 8), st.floats(-6, 6), st.floats(0, 2))
velocities = st.tuples(*[st.floats(-1, 1)] * 3)


@given(places, velocities, st.integers(1, 29))
def test_information_grows_with_frames_and_has_no_negative_direction(place, velocity, num):
    few, more = (
        np.asarray(of_information(SCENE, VelocityTest(within_frames=n), jnp.asarray(place), jnp.asarray(velocity)))
        for n in (float(num), num + 1.0)
    )
    size = 1e-9 * (1 + np.trace(more))
    assert np.linalg.eigvalsh(few)[0] > -size and np.linalg.eigvalsh(more - few)[0] > -size


@given(places, velocities)
def test_derivatives_are_finite_everywhere(place, velocity):
    value, gradient = jitted_gradient(jnp.asarray(place), jnp.asarray(velocity))
    assert 0 < value <= 1 and np.all(np.isfinite(gradient[0])) and np.all(np.isfinite(gradient[1]))


@jax.jit
def jitted_gradient(place, velocity):
    return jax.value_and_grad(lambda p, v: power(SCENE, VelocityTest(), p, v), (0, 1))(place, velocity)


def test_noise_and_use_scale_the_information():
    args = jnp.asarray(PLACE), jnp.asarray(VELOCITY)
    once = of_information(SCENE, BARE, *args)
    noisy = of_information(dataclasses.replace(SCENE, pixel_std_px=3.0), BARE, *args)
    np.testing.assert_allclose(9 * noisy, once, rtol=1e-6, atol=1e-6)
    used = of_information(SCENE, dataclasses.replace(BARE, use_rate=0.25), *args)
    np.testing.assert_allclose(4 * used, once, rtol=1e-6, atol=1e-6)
    jittering = of_information(dataclasses.replace(SCENE, oscillation_std_m=0.005), BARE, *args)
    assert np.linalg.eigvalsh(once - jittering)[0] > -1e-6 and jittering[0, 0] < 0.99 * once[0, 0]


def test_power_is_differentiable_by_oscillation_place_and_velocity():
    direction = np.array([-0.15, 0.0, 0.0])

    def value(numbers):
        A, f, place, velocity = numbers[0], numbers[1], numbers[2:5], numbers[5:]
        scene = eqx.tree_at(lambda s: (s.oscillation.amplitude_m, s.oscillation.frequency_hz), SCENE, (A, f))
        return power(scene, VelocityTest(), place, velocity)

    at = jnp.asarray(np.concatenate([[0.05, 2.7], [-4.0, 1.0, 1.2], direction]))
    gradient, value = jax.jit(jax.grad(value)), jax.jit(value)
    found = np.asarray(gradient(at))
    h = 1e-5
    differences = [(value(at + h * e) - value(at - h * e)) / (2 * h) for e in jnp.eye(8)]
    assert 0.1 < float(value(at)) < 0.9
    np.testing.assert_allclose(found, differences, rtol=1e-5, atol=1e-7)
    assert found[0] > 1 and np.all(found != 0)


# ---- movers of a scenario -------------------------------------------------------------------------------------------


def test_movers_of_a_scenario_one_by_one():
    scene = paper(dynamic="inverse_forward", dynamic_speed_m_s=0.25, oscillation_amplitude_m=0.05)
    test = VelocityTest(within_frames=80.0)
    found = of_movers(scene, test)
    for number, i in enumerate(scene.movers.ids):
        one = of_power(scene, test, jnp.asarray(scene.landmarks_m[i]), jnp.array([-0.25, 0.0, 0.0]))
        np.testing.assert_allclose(found[number], one, rtol=1e-9)
    assert np.all((found > 0.05) & (found < 0.95))
    # A course of one leg is a constant velocity.
    course = dataclasses.replace(scene, movers=dataclasses.replace(scene.movers, course=Course()))
    np.testing.assert_allclose(of_movers(course, test), found, rtol=1e-6)


def test_what_starts_late_mimics_nothing():
    """Even a steady camera can tell it, as no static point is seen so; one that stops after the test it cannot."""
    test = VelocityTest(within_frames=80.0)
    always, stops, late = (
        of_movers(paper(dynamic="inverse_forward", dynamic_speed_m_s=0.5, dynamic_course=course), test)
        for course in (None, "stops", "late")
    )
    np.testing.assert_allclose([always, stops], 1e-3, rtol=0, atol=1e-4)
    assert np.all(late[np.array([0, 2, 3, 5])] > 0.9)  # those beside the path
    stands = paper(dynamic="lateral", dynamic_speed_m_s=0.0, dynamic_course="late")
    np.testing.assert_allclose(of_movers(stands, test), 1e-3, rtol=1e-9)


def test_places_and_velocities_form_a_batch_and_numbers_compile_nothing_new():
    many = jax.jit(eqx.debug.assert_max_traces(jax.vmap(power, in_axes=(None, None, 0, 0)), max_traces=1))
    at, speeds = jnp.asarray([PLACE, PLACE + 1]), jnp.asarray([VELOCITY, -VELOCITY])
    for scene, test in ((SCENE, VelocityTest()), (paper("curved", num_frames=30), VelocityTest(0.01, 20.0))):
        batched = many(scene, test, at, speeds)
        alone = [of_power(scene, test, p, v) for p, v in zip(at, speeds, strict=True)]
        np.testing.assert_allclose(batched, alone, rtol=1e-9)


def test_frames_that_count_are_counted():
    path = jnp.broadcast_to(jnp.asarray(PLACE), (30, 3))
    found = jax.jit(evidence)
    assert found(SCENE, VelocityTest(), path).num_frames == 30
    assert found(SCENE, VelocityTest(within_frames=7.0), path).num_frames == 7
    hidden = path.at[:10].set(jnp.array([-20.0, 0, 0]))
    assert found(SCENE, VelocityTest(within_frames=7.0), hidden).num_frames == 7


BAD = {
    "rate 0": (dict(false_alarm_rate=0), r"VelocityTest\(false_alarm_rate=0.0\): a rate is between 0 and 1, both ex"),
    "rate 1": (dict(false_alarm_rate=1.0), r"VelocityTest\(false_alarm_rate=1.0\)"),
    "no frame": (dict(within_frames=0), r"VelocityTest\(within_frames=0.0\): give at least one frame"),
    "negative noise": (dict(pose_noise=-1), r"VelocityTest\(pose_noise=-1.0\)"),
    "no use": (dict(use_rate=0), r"VelocityTest\(use_rate=0.0\): a share is above 0"),
    "depth known": (dict(inverse_depth_std=0), r"VelocityTest\(inverse_depth_std=0.0\)"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("fields", "message"), BAD.values(), ids=BAD)
def test_bad_tests_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        VelocityTest(**fields)


@pytest.mark.usefixtures("unchecked")
def test_what_cannot_be_predicted_is_refused():
    with pytest.raises(ValueError, match=r"mover_power\(scenario='paper'\): give a Scenario"):
        mover_power("paper", VelocityTest())
    with pytest.raises(ValueError, match=r"mover_power\(test=None\): give a VelocityTest"):
        mover_power(SCENE, None)
    with pytest.raises(ValueError, match=r"Scenario\(pixel_std_px=0.0\): without noise"):
        mover_power(paper(pixel_error_std_px=0.0), VelocityTest())
