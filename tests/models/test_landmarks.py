"""Landmarks: one projection for both kinds, back-projection, conversion and the linearity index."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models.derivatives import assert_exact_derivative, assert_finite

from vcjax.models.camera import Camera
from vcjax.models.frames import compose, from_frame, quaternion_from_euler
from vcjax.models.landmarks import (
    back_project_landmark,
    camera_centre,
    euclidean,
    linearity_index,
    project_landmark,
    to_point,
    to_point_jacobian,
)

# Without distortion the golden functions and the camera's own tests say the same.
CAMERA = Camera(distortion=(-0.3, 0.1))
project = jax.jit(project_landmark)
back_project = jax.jit(back_project_landmark, static_argnums=5)


def pose(t, rpy_deg):
    """A pose from its place (m) and Euler angles (deg)."""
    return jnp.concatenate([jnp.array(t), quaternion_from_euler(jnp.deg2rad(jnp.array(rpy_deg)))])


ROBOT = pose([1.0, -2.0, 0.1], [3.0, -4.0, 50.0])
SENSOR = pose([0.1, 0.05, 0.6], [-92.0, 3.0, -88.0])
CENTRE = camera_centre(ROBOT, SENSOR)
# In front of the camera, seen from somewhere else first.
AHP = jnp.array([0.7, -2.2, 0.5, 0.5, 0.8, 0.1, 0.3])


def test_jacobians_of_projection_are_its_derivatives():
    jacobians = jax.jit(jax.jacfwd(lambda *x: project_landmark(CAMERA, *x)[0], (0, 1, 2)))
    for landmark in (AHP, euclidean(to_point(AHP))):
        ours, exact = project(CAMERA, ROBOT, SENSOR, landmark)[2:], jacobians(ROBOT, SENSOR, landmark)
        for a, b in zip(ours, exact, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)


def test_derivatives_of_projection_and_of_its_jacobians_are_exact():
    assert_exact_derivative(lambda *x: project_landmark(CAMERA, *x), ROBOT, SENSOR, AHP)


def test_both_kinds_of_one_point_are_seen_alike():
    *ahp, U_ahp = project(CAMERA, ROBOT, SENSOR, AHP)
    *point, U_point = project(CAMERA, ROBOT, SENSOR, euclidean(to_point(AHP)))
    for a, b in zip([*ahp, U_ahp], [*point, U_point[:, :3] @ to_point_jacobian(AHP)], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("depth", [3.0, -3.0])
def test_depth_is_the_distance_along_the_optical_axis(depth):
    point = from_frame(compose(ROBOT, SENSOR), jnp.array([0.4, -0.2, depth]))
    assert project(CAMERA, ROBOT, SENSOR, euclidean(point))[1] == pytest.approx(depth, abs=1e-12)


@pytest.mark.parametrize("inverse_depth", [0.01, 1.5])
def test_new_landmark_lies_on_the_ray_of_its_pixel(inverse_depth):
    pixel = jnp.array([100.0, 400.0])
    landmark = back_project(CAMERA, ROBOT, SENSOR, pixel, inverse_depth, False)
    np.testing.assert_allclose(landmark[:3], CENTRE, rtol=0, atol=1e-15)
    assert jnp.linalg.norm(landmark[3:6]) == pytest.approx(1.0, abs=1e-14)
    assert landmark[6] == inverse_depth
    assert jnp.linalg.norm(to_point(landmark) - CENTRE) == pytest.approx(1 / inverse_depth, rel=1e-13)
    np.testing.assert_allclose(project(CAMERA, ROBOT, SENSOR, landmark)[0], pixel, rtol=0, atol=1e-10)


def test_derivative_of_back_projection_is_exact():
    def landmark(robot, sensor, pixel, inverse_depth):
        return back_project_landmark(CAMERA, robot, sensor, pixel, inverse_depth)

    assert_exact_derivative(landmark, ROBOT, SENSOR, jnp.array([100.0, 400.0]), jnp.array(0.3))


def test_scalar_derivative_changes_the_derivative_of_the_direction_only():
    def derivative_and_value(scalar_derivative):
        def twice(pixel):
            landmark = back_project_landmark(Camera(), ROBOT, SENSOR, pixel, 0.3, scalar_derivative)
            return landmark, landmark

        return jax.jit(jax.jacfwd(twice, has_aux=True))(jnp.array([100.0, 400.0]))

    (exact, landmark), (scalar, same_landmark) = derivative_and_value(False), derivative_and_value(True)
    np.testing.assert_array_equal(same_landmark, landmark)
    np.testing.assert_array_equal(np.delete(exact, [3, 4, 5], 0), np.delete(scalar, [3, 4, 5], 0))
    # The exact derivative is the scalar one without its part along the direction.
    m = landmark[3:6]
    np.testing.assert_allclose(exact[3:6], (np.eye(3) - np.outer(m, m)) @ scalar[3:6], rtol=0, atol=1e-15)
    assert np.abs(m @ scalar[3:6]).max() > 1e-4


def test_linearity_index_is_the_formula():
    to_landmark = np.asarray(to_point(AHP) - CENTRE)
    distance = np.linalg.norm(to_landmark)
    cosine = to_landmark @ AHP[3:6] / distance / np.linalg.norm(AHP[3:6])
    expected = 4 * (0.02 / 0.3**2) / distance * abs(cosine)
    assert linearity_index(ROBOT, SENSOR, AHP, 0.02) == pytest.approx(float(expected), rel=1e-13)


def test_linearity_index_vanishes_when_the_point_is_seen_from_the_side():
    point = to_point(AHP)
    aside = jnp.cross(AHP[3:6], jnp.array([0.0, 0.0, 1.0]))
    # The pose of a camera at the robot's origin, beside the point.
    robot = ROBOT.at[:3].set(point + aside)
    sensor = SENSOR.at[:3].set(0.0)
    assert linearity_index(robot, sensor, AHP, 0.02) == pytest.approx(0.0, abs=1e-14)


def test_derivative_of_linearity_index_is_exact():
    assert_exact_derivative(linearity_index, ROBOT, SENSOR, AHP, jnp.array(0.02))


def test_projection_is_finite_at_the_edges():
    at_clamp, at_infinity, at_camera = AHP.at[6].set(0.001), AHP.at[6].set(0.0), euclidean(CENTRE)
    for landmark in (at_clamp, at_infinity, at_camera, jnp.concatenate([CENTRE, AHP[3:]])):
        assert_finite(lambda *x: project_landmark(CAMERA, *x), ROBOT, SENSOR, landmark)
    # Unturned poses put points exactly into the camera's plane z = 0.
    origin = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    for landmark in (euclidean(jnp.array([1.0, 2.0, 0.0])), jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.001])):
        assert_finite(lambda *x: project_landmark(CAMERA, *x), origin, origin, landmark)


@pytest.mark.parametrize("landmark", [euclidean(CENTRE), AHP.at[6].set(0.001)], ids=["at the camera", "at the clamp"])
def test_linearity_index_is_finite_at_the_edges(landmark):
    assert_finite(linearity_index, ROBOT, SENSOR, landmark, jnp.array(0.5))


def test_back_projection_to_infinity_is_finite():
    def landmark(pixel, inverse_depth):
        return back_project_landmark(CAMERA, ROBOT, SENSOR, pixel, inverse_depth)

    assert_finite(landmark, jnp.array([320.0, 240.0]), jnp.array(0.0))
