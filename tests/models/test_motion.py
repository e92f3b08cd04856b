"""Motion: paths of known end, the oscillation of equation (1), exact derivatives, bad input refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models.derivatives import assert_exact_derivative, assert_finite

from vcjax.models.frames import quaternion_from_rotation_vector, yaw_from_quaternion
from vcjax.models.motion import Oscillation, move_by_constant_velocity, move_by_odometry, oscillate

rng = np.random.default_rng(3)
ORIGIN = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
POSE = jnp.concatenate([jnp.array(rng.normal(size=3)), quaternion_from_rotation_vector(jnp.array(rng.normal(size=3)))])
FRAMES_S = np.arange(1, 161) / 10


def test_odometry_closes_a_circle():
    step = jnp.array([0.3, 0.0, 0.0, 0.0, 0.0, 2 * jnp.pi / 36])
    poses, move = [POSE], jax.jit(move_by_odometry)
    for _ in range(36):
        poses.append(move(poses[-1], step))
    np.testing.assert_allclose(poses[-1][:3], POSE[:3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(poses[-1][3:], -POSE[3:], rtol=0, atol=1e-14)  # a full turn flips the sign
    # Half-way round it is as far away as the circle's diameter, in the plane of the turn.
    assert jnp.linalg.norm(poses[18][:3] - POSE[:3]) == pytest.approx(0.3 / np.sin(np.pi / 36), rel=1e-13)


def test_constant_velocity_follows_its_twist():
    pose, twist = ORIGIN, jnp.array([0.5, -0.2, 0.1, 0.0, 0.0, 0.3])
    for _ in range(20):
        pose, twist = move_by_constant_velocity(pose, twist, jnp.zeros(6), 0.1)
    np.testing.assert_allclose(pose[:3], [1.0, -0.4, 0.2], rtol=0, atol=1e-14)
    assert yaw_from_quaternion(pose[3:]) == pytest.approx(0.6, abs=1e-14)
    np.testing.assert_array_equal(twist, [0.5, -0.2, 0.1, 0.0, 0.0, 0.3])


def test_impulse_acts_at_the_end_of_its_step():
    impulse = jnp.arange(1.0, 7.0)
    pose, twist = move_by_constant_velocity(ORIGIN, jnp.zeros(6), impulse, 0.1)
    np.testing.assert_array_equal(pose, ORIGIN)
    np.testing.assert_array_equal(twist, impulse)
    pose, _ = move_by_constant_velocity(pose, twist, jnp.zeros(6), 0.1)
    np.testing.assert_allclose(pose[:3], 0.1 * impulse[:3], rtol=1e-15)
    np.testing.assert_allclose(pose[3:], quaternion_from_rotation_vector(0.1 * impulse[3:]), rtol=1e-15)


def test_both_models_agree_on_one_step():
    twist = jnp.array(rng.normal(size=6))
    by_velocity, _ = move_by_constant_velocity(ORIGIN, twist, jnp.zeros(6), 0.1)
    np.testing.assert_allclose(by_velocity, move_by_odometry(ORIGIN, 0.1 * twist), rtol=0, atol=1e-15)


@pytest.mark.parametrize("function", [move_by_odometry, lambda *x: move_by_constant_velocity(*x, jnp.ones(6), 0.1)])
def test_derivatives_are_exact_and_finite_at_rest(function):
    move = jnp.array(rng.normal(size=6))
    assert_exact_derivative(function, POSE, move)
    for small in (0.0, 1e-9):
        assert_finite(function, POSE, small * move)


def test_standing_still_changes_nothing():
    np.testing.assert_array_equal(move_by_odometry(POSE, jnp.zeros(6)), POSE)


def test_oscillation_is_equation_1():
    displacement = oscillate(Oscillation(0.05, 3.0), jnp.array([0.0, 1 / 12, 1 / 6, 0.25, 0.1]))
    expected = [0.0, 0.05, 0.0, -0.05, 0.05 * np.sin(0.6 * np.pi)]
    np.testing.assert_allclose(displacement, expected, rtol=0, atol=1e-16)


def test_three_hertz_repeats_every_ten_frames_and_steps_by_up_to_1_54_amplitudes():
    displacement = np.asarray(oscillate(Oscillation(0.05, 3.0), jnp.array(FRAMES_S)))
    np.testing.assert_allclose(displacement[10:], displacement[:-10], rtol=0, atol=1e-14)
    assert np.abs(np.diff(displacement)).max() == pytest.approx(1.539 * 0.05, rel=1e-3)
    for shorter in range(1, 10):
        assert np.abs(displacement[shorter:] - displacement[:-shorter]).max() > 0.01


@given(st.floats(0, 5), st.floats(0, 1))
def test_frequencies_f_and_10_minus_f_are_mirror_images(f, A):
    a, b = (oscillate(Oscillation(A, frequency), jnp.array(FRAMES_S)) for frequency in (f, 10 - f))
    np.testing.assert_allclose(a, -b, rtol=0, atol=1e-12)


@pytest.mark.parametrize("frequency", [0.0, 5.0, 10.0])
def test_some_frequencies_excite_nothing(frequency):
    np.testing.assert_allclose(oscillate(Oscillation(0.05, frequency), jnp.array(FRAMES_S)), 0, atol=1e-14)


def test_default_camera_is_steady():
    np.testing.assert_array_equal(oscillate(Oscillation(), jnp.array(FRAMES_S)), 0)


def test_derivative_of_the_oscillation_is_exact():
    def displacement(A, f):
        return oscillate(Oscillation(A, f), jnp.array([0.1, 0.7]))

    assert_exact_derivative(displacement, jnp.array(0.05), jnp.array(3.0))


def test_another_oscillation_compiles_nothing_new():
    num_traces = 0

    @jax.jit
    def displacement(oscillation):
        nonlocal num_traces
        num_traces += 1
        return oscillate(oscillation, jnp.array([0.1]))

    a, b = displacement(Oscillation(0.05, 3.0)), displacement(Oscillation(0.07, 2.0))
    assert a != b
    assert num_traces == 1


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(amplitude_m=-0.05), r"Oscillation\(amplitude_m=-0.05\)"),
        (dict(amplitude_m=np.inf), r"Oscillation\(amplitude_m=inf\)"),
        (dict(frequency_hz=-3), r"Oscillation\(frequency_hz=-3.0\)"),
        (dict(frequency_hz=np.nan), r"Oscillation\(frequency_hz=nan\)"),
        (dict(frequency_hz="fast"), r"Oscillation\(frequency_hz='fast'\)"),
    ],
)
def test_bad_oscillation_is_refused_by_name_and_value(fields, message):
    with pytest.raises(ValueError, match=message):
        Oscillation(**fields)
