"""Quaternions and frames: the algebra they must obey, an independent opinion, exact and finite derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models.derivatives import assert_exact_derivative, assert_finite
from scipy.spatial.transform import Rotation

from vcjax.models import frames

rotation_matrix = jax.jit(frames.rotation_matrix)
product = jax.jit(frames.quaternion_product)
exp = jax.jit(frames.quaternion_from_rotation_vector)
log = jax.jit(frames.rotation_vector_from_quaternion)
from_frame = jax.jit(frames.from_frame)
to_frame = jax.jit(frames.to_frame)
compose = jax.jit(frames.compose)


def arrays(size, low=-10.0, high=10.0):
    """Arrays of so many numbers."""
    return st.lists(st.floats(low, high), min_size=size, max_size=size).map(jnp.array)


def directions(size):
    """Unit vectors, those along the axes included."""
    return arrays(size, -1, 1).filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: v / np.linalg.norm(v))


quaternions = directions(4)
poses = st.builds(lambda t, q: jnp.concatenate([t, q]), arrays(3), quaternions)
# Zero, both sides of the switch to the series, and up to half a turn, where a rotation vector is about to jump.
angles = st.one_of(st.just(0.0), st.floats(1e-12, 1e-5), st.floats(1e-5, 3.1), st.floats(np.pi - 1e-4, np.pi - 1e-9))


def assert_close(ours, theirs, atol=1e-12):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol)


@given(quaternions)
def test_unit_quaternion_gives_a_rotation(q):
    R = rotation_matrix(q)
    assert_close(R @ R.T, np.eye(3))
    assert_close(np.linalg.det(R), 1)


@given(quaternions, quaternions)
def test_product_of_quaternions_is_product_of_rotations(p, q):
    assert_close(rotation_matrix(product(p, q)), rotation_matrix(p) @ rotation_matrix(q))


@given(quaternions)
def test_conjugate_undoes_a_rotation(q):
    assert_close(product(q, frames.quaternion_conjugate(q)), [1, 0, 0, 0])
    assert_close(rotation_matrix(frames.quaternion_conjugate(q)), rotation_matrix(q).T)


@given(directions(3), st.floats(0, 50))
def test_rotation_vector_rotates_by_its_length_about_itself(axis, angle):
    v = angle * axis
    assert_close(jnp.linalg.norm(exp(v)), 1)
    assert_close(rotation_matrix(exp(v)), Rotation.from_rotvec(np.array(v)).as_matrix())


@given(directions(3), angles)
def test_log_undoes_exp(axis, angle):
    v = angle * axis
    assert_close(log(exp(v)), v, atol=1e-15 + 1e-13 * angle)


@given(quaternions)
def test_exp_undoes_log_up_to_the_sign_of_the_quaternion(q):
    v = log(q)
    assert np.linalg.norm(v) <= np.pi + 1e-12
    assert_close(rotation_matrix(exp(v)), rotation_matrix(q))


def test_series_of_small_angles_joins_the_formula():
    axis = jnp.array([0.6, 0.0, 0.8])
    below, above = (exp(frames.SMALL_ANGLE_RAD * factor * axis) for factor in (1 - 1e-9, 1 + 1e-9))
    assert_close(below, above, atol=1e-15)


@given(arrays(3, -7, 7))
def test_euler_angles_turn_by_roll_then_pitch_then_yaw(rpy):
    R = Rotation.from_euler("xyz", np.array(rpy)).as_matrix()
    assert_close(rotation_matrix(frames.quaternion_from_euler(rpy)), R)


@given(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(-3.14, 3.14))
def test_yaw_is_found_again(roll, pitch, yaw):
    q = frames.quaternion_from_euler(jnp.array([roll, pitch, yaw]))
    assert_close(frames.yaw_from_quaternion(q), yaw)


@given(poses, arrays(3))
def test_to_frame_undoes_from_frame(T_a_b, p):
    assert_close(to_frame(T_a_b, from_frame(T_a_b, p)), p)
    assert_close(from_frame(T_a_b, to_frame(T_a_b, p)), p)


@given(poses, poses, poses, arrays(3))
def test_poses_compose(T_a_b, T_b_c, T_c_d, p):
    assert_close(from_frame(compose(T_a_b, T_b_c), p), from_frame(T_a_b, from_frame(T_b_c, p)))
    assert_close(compose(compose(T_a_b, T_b_c), T_c_d), compose(T_a_b, compose(T_b_c, T_c_d)))


rng = np.random.default_rng(1)
q, p, v, pose, other = (jnp.array(rng.normal(size=n)) for n in (4, 4, 3, 7, 7))
FUNCTIONS = {
    "unit": (frames.unit, q),
    "rotation_matrix": (frames.rotation_matrix, q),
    "product": (frames.quaternion_product, p, q),
    "exp": (frames.quaternion_from_rotation_vector, v),
    "exp of a small angle": (frames.quaternion_from_rotation_vector, 1e-8 * v),
    "log": (frames.rotation_vector_from_quaternion, q),
    "euler": (frames.quaternion_from_euler, v),
    "yaw": (frames.yaw_from_quaternion, q),
    "from_frame": (frames.from_frame, pose, v),
    "to_frame": (frames.to_frame, pose, v),
    "compose": (frames.compose, pose, other),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivative_is_exact(name):
    function, *arguments = FUNCTIONS[name]
    assert_exact_derivative(function, *arguments)


@pytest.mark.parametrize("scalar_derivative", [False, True])
def test_written_out_jacobian_of_unit_is_its_derivative(scalar_derivative):
    def unit(v):
        return frames.unit(v, scalar_derivative)

    assert_close(frames.unit_jacobian(q, scalar_derivative), jax.jacfwd(unit)(q))


def test_written_out_jacobian_of_rotating_back_is_its_derivative():
    expected = jax.jacfwd(lambda q: frames.rotation_matrix(q).T @ v)(q)
    assert_close(frames.rotate_back_jacobian(q, v), expected)


def test_log_has_finite_derivatives_at_no_and_at_half_a_turn():
    for turn in ([1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0.6, 0, -0.8]):
        assert_finite(frames.rotation_vector_from_quaternion, jnp.array(turn, float))


def test_exp_has_finite_derivatives_at_zero():
    assert_finite(frames.quaternion_from_rotation_vector, jnp.zeros(3))
    assert_close(jax.jacrev(lambda v: log(exp(v)))(jnp.zeros(3)), np.eye(3))
