"""Camera: distortion and its inverse, exact Jacobians, finite numbers at the edges, bad calibrations refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models.derivatives import assert_exact_derivative, assert_finite

from vcjax.models.camera import Camera, back_project, distort, is_inside, pixel_jacobian, project, undistort

# All monotonic over their whole image: only there is the inverse defined.
CAMERAS = {
    "none": Camera(),
    "barrel": Camera(distortion=(-0.05,)),
    "pincushion": Camera(distortion=(0.2,)),
    "two terms": Camera(distortion=(-0.3, 0.1)),
    "three terms": Camera(distortion=(-0.25, 0.08, -0.005)),
    "real": Camera((367.2, 248.4, 458.7, 457.3), (752.0, 480.0), (-0.2834, 0.0740)),
}
every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
both_kinds = pytest.mark.parametrize("camera", [CAMERAS["none"], CAMERAS["two terms"]], ids=["plain", "distorted"])

project_all = jax.jit(jax.vmap(project, in_axes=(None, 0)))
back_project_all = jax.jit(jax.vmap(back_project, in_axes=(None, 0)))
distort_undistorted = jax.jit(jax.vmap(lambda camera, p: distort(camera, undistort(camera, p)), in_axes=(None, 0)))
derivative_of_projection = jax.jit(jax.jacfwd(project, argnums=1))
derivative_of_back_projection = jax.jit(jax.jacfwd(back_project, argnums=1))


def pixels_over(camera):
    """A grid of pixels over the image, its borders and the principal point included."""
    u, v = (np.linspace(0, size, 9) for size in camera.image_size_px)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return jnp.array([*grid, camera.intrinsics_px[:2]])


@every_camera
def test_projection_undoes_back_projection_over_the_image(camera):
    pixel = pixels_over(camera)
    ray = back_project_all(camera, pixel)
    np.testing.assert_allclose(project_all(camera, ray), pixel, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(ray[:, 2], 1)


@every_camera
def test_undistortion_undoes_distortion(camera):
    pixel = pixels_over(camera)
    point = (pixel - camera.intrinsics_px[:2]) / camera.intrinsics_px[2:]
    np.testing.assert_allclose(distort_undistorted(camera, point), point, rtol=0, atol=1e-13)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 20), st.sampled_from(list(CAMERAS)))
def test_projection_is_the_formula_and_blind_to_distance(a, b, depth, name):
    camera = CAMERAS[name]
    u0, v0, au, av = camera.intrinsics_px
    r2 = a * a + b * b
    scale = 1 + sum(d * r2 ** (k + 1) for k, d in enumerate(camera.distortion))
    expected = [u0 + au * a * scale, v0 + av * b * scale]
    pixel = project_all(camera, jnp.array([[z * a, z * b, z] for z in (1.0, depth, -depth)]))
    np.testing.assert_allclose(pixel, [expected] * 3, rtol=1e-12, atol=1e-9)


@every_camera
def test_jacobian_of_projection_is_its_derivative(camera):
    point = jnp.array([0.4, -0.3, 1.7])
    pixel, jacobian = pixel_jacobian(camera, point)
    np.testing.assert_allclose(pixel, project(camera, point), rtol=0, atol=1e-12)
    np.testing.assert_allclose(jacobian, derivative_of_projection(camera, point), rtol=0, atol=1e-11)


@every_camera
def test_derivative_of_back_projection_inverts_that_of_projection(camera):
    pixel = jnp.array([150.0, 400.0])
    jacobian = pixel_jacobian(camera, back_project(camera, pixel))[1]
    round_trip = jacobian @ derivative_of_back_projection(camera, pixel)
    np.testing.assert_allclose(round_trip, np.eye(2), rtol=0, atol=1e-12)


@both_kinds
def test_derivatives_by_points_pixels_and_calibration_are_exact(camera):
    def there_and_back(intrinsics_px, distortion, point_c, pixel):
        calibrated = Camera(intrinsics_px, distortion=distortion)
        return project(calibrated, point_c), back_project(calibrated, pixel)

    calibration = jnp.asarray(camera.intrinsics_px), jnp.asarray(camera.distortion)
    assert_exact_derivative(there_and_back, *calibration, jnp.array([0.4, -0.3, 1.7]), jnp.array([150.0, 400.0]))


@both_kinds
def test_projection_is_finite_in_the_cameras_plane_at_its_centre_and_on_its_axis(camera):
    for point in ([1.0, -2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]):
        assert_finite(lambda p: pixel_jacobian(camera, p), jnp.array(point))


@both_kinds
def test_back_projection_is_finite_at_the_principal_point(camera):
    assert_finite(lambda y: back_project(camera, y), jnp.asarray(camera.intrinsics_px[:2]))


def test_inside_counts_the_borders_and_keeps_its_margin():
    pixel = jnp.array([[0.0, 0.0], [640.0, 480.0], [30.0, 25.0], [-1e-9, 9.0], [9.0, 480.1], [np.nan, 9.0]])
    np.testing.assert_array_equal(is_inside(Camera(), pixel), [1, 1, 1, 0, 0, 0])
    np.testing.assert_array_equal(is_inside(Camera(), pixel, 25.0), [0, 0, 1, 0, 0, 0])
    assert not is_inside(Camera(), jnp.array([30.0, 25.0]), 25.6)


BAD_CAMERAS = {
    "too few intrinsics": (dict(intrinsics_px=(320, 240, 320)), "intrinsics_px", "(3,)"),
    "no focal length": (dict(intrinsics_px=(320, 240, 0, 320)), "intrinsics_px", "0.0"),
    "infinite centre": (dict(intrinsics_px=(np.inf, 240, 320, 320)), "intrinsics_px", "inf"),
    "words": (dict(intrinsics_px="wide"), "intrinsics_px", "wide"),
    "flat image": (dict(image_size_px=(640, 0)), "image_size_px", "0.0"),
    "one size": (dict(image_size_px=640), "image_size_px", "()"),
    "missing distortion": (dict(distortion=(0.1, np.nan)), "distortion", "nan"),
    "wrong JAX array": (dict(intrinsics_px=np.ones((4, 2))), "intrinsics_px", "(4, 2)"),
}


@pytest.mark.parametrize(("fields", "name", "value"), BAD_CAMERAS.values(), ids=BAD_CAMERAS)
def test_bad_calibration_is_refused_by_name_and_value(fields, name, value):
    with pytest.raises(ValueError, match=rf"Camera\({name}") as refused:
        Camera(**fields)
    assert value in str(refused.value)
