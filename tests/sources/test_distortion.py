"""Lenses: against their formulas, against OpenCV, and there and back."""

import math

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcjax.models.camera import back_project, is_inside, project
from vcjax.sources.calibration import Calibration
from vcjax.sources.distortion import bend, denormalise, normalise, pinhole, straighten

LENSES = {
    "pin-hole": Calibration(640, 480, 520.0, 518.0, 318.6, 255.3),
    "radial, 4": Calibration(
        752, 480, 458.654, 457.296, 367.215, 248.375, "radial_tangential", (-0.28340811, 0.07395907, 1.9e-4, 1.8e-5)
    ),
    "radial, 5": Calibration(
        640, 480, 517.3, 516.5, 318.6, 255.3, "radial_tangential", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "fish eye": Calibration(512, 512, 190.98, 190.97, 254.9, 256.9, "equidistant", (0.0035, 0.0007, -0.0020, 0.0002)),
    "wide angle": Calibration(320, 240, 195.0, 195.0, 162.0, 125.0, "wide_angle", (9e-6,)),
}


@pytest.fixture(params=LENSES.values(), ids=list(LENSES))
def lens(request):
    return request.param


def pixels(lens, num=2000, seed=0):
    return np.random.default_rng(seed).uniform(0, 1, (num, 2)) * [lens.width, lens.height]


def test_there_and_back(lens):
    uv = pixels(lens)
    straight = straighten(lens, uv)
    is_good = np.isfinite(straight[:, 0])
    assert np.mean(is_good) > (0.7 if lens.distortion_model == "equidistant" else 0.999)
    np.testing.assert_allclose(bend(lens, straight[is_good]), uv[is_good], atol=1e-8)


def test_straightened_pixels_have_their_place_in_the_image(lens):
    straight = straighten(lens, pixels(lens))
    assert np.all(is_inside(pinhole(lens), jnp.asarray(straight[np.isfinite(straight[:, 0])]), margin_px=-2.0))


def test_pinhole_sees_what_the_lens_sees(lens):
    """A point in space, its real pixel straightened, is where the pin-hole camera projects it."""
    rng = np.random.default_rng(1)
    for point in np.column_stack([rng.uniform(-0.4, 0.4, (20, 2)), np.ones(20)]) * rng.uniform(0.5, 20, (20, 1)):
        uv = denormalise(lens, point[None, :2] / point[2])
        np.testing.assert_allclose(straighten(lens, uv)[0], project(pinhole(lens), jnp.asarray(point)), atol=1e-7)
        ray = back_project(pinhole(lens), jnp.asarray(straighten(lens, uv)[0]))
        np.testing.assert_allclose(ray, point / point[2], atol=1e-9)


def test_no_lens_changes_nothing():
    lens = LENSES["pin-hole"]
    uv = pixels(lens)
    assert straighten(lens, uv).tobytes() == uv.tobytes() == bend(lens, uv).tobytes()
    camera = pinhole(lens)
    np.testing.assert_array_equal(camera.intrinsics_px, [318.6, 255.3, 520.0, 518.0])
    np.testing.assert_array_equal(camera.image_size_px, [640, 480])


def test_formulas_by_hand():
    """One point of each model, r = 0.5 along x."""
    point = np.array([[0.5, 0.0]])
    k1, k2, p1, p2 = 0.1, -0.2, 0.01, 0.02
    radial = Calibration(640, 480, 100.0, 100.0, 320.0, 240.0, "radial_tangential", (k1, k2, p1, p2))
    scale = 1 + k1 * 0.25 + k2 * 0.0625
    by_hand = [320 + 100 * (0.5 * scale + p2 * (0.25 + 2 * 0.25)), 240 + 100 * (p1 * 0.25)]
    np.testing.assert_allclose(denormalise(radial, point)[0], by_hand, atol=1e-10)
    fish = Calibration(640, 480, 100.0, 100.0, 320.0, 240.0, "equidistant", (k1, k2, p1, p2))
    t = math.atan(0.5)
    by_hand = [320 + 100 * t * (1 + k1 * t**2 + k2 * t**4 + p1 * t**6 + p2 * t**8), 240]
    np.testing.assert_allclose(denormalise(fish, point)[0], by_hand, atol=1e-10)
    wide = Calibration(640, 480, 100.0, 100.0, 320.0, 240.0, "wide_angle", (1e-4,))
    by_hand = [320 + 50 / math.sqrt(1 + 2 * 1e-4 * 50**2), 240]
    np.testing.assert_allclose(denormalise(wide, point)[0], by_hand, atol=1e-10)
    centre = np.array([[320.0, 240.0]])
    for lens in (radial, fish, wide):
        np.testing.assert_allclose(normalise(lens, centre), 0.0, atol=1e-12)
        assert denormalise(lens, np.zeros((1, 2))).tolist() == centre.tolist()


@given(st.floats(-0.15, 0.35), st.floats(-0.03, 0.1), st.floats(-0.005, 0.005), st.integers(0, 2**32 - 1))
def test_inverse_of_a_lens_is_that_of_opencv_only_finer(k1, k2, p, seed):
    lens = Calibration(640, 480, 500.0, 490.0, 310.0, 250.0, "radial_tangential", (k1, k2, p, -p))
    uv = pixels(lens, 50, seed)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    expected = cv2.undistortPointsIter(uv, lens.matrix, np.array(lens.distortion), None, None, criteria)[:, 0]
    np.testing.assert_allclose(normalise(lens, uv), expected, atol=1e-9)


def test_pixels_without_an_inverse_are_told():
    """Barrel distortion folds: r (1 - 0.4 r²) is at most 0.609, at r = 0.913, and no point has a pixel beyond 304.3."""
    lens = Calibration(1000, 1000, 500.0, 500.0, 500.0, 500.0, "radial_tangential", (-0.4, 0.0, 0.0, 0.0))
    largest = 500 * 2 / 3 / math.sqrt(3 * 0.4)
    uv = 500.0 + np.array([[0.0, 0.0], [largest - 1.0, 0.0], [largest + 1.0, 0.0], [499.0, 499.0], [np.nan, 0.0]])
    assert np.isfinite(normalise(lens, uv)).all(axis=1).tolist() == [True, True, False, False, False]
    wide = LENSES["wide angle"]
    limit = 1 / math.sqrt(2 * 9e-6)  # 235.7 px
    uv = np.array([162.0, 125.0]) + np.array([[limit * 0.9, 0.0], [limit + 1, 0.0]])
    assert np.isfinite(normalise(wide, uv)).all(axis=1).tolist() == [True, False]
    fish = Calibration(2000, 2000, 300.0, 300.0, 1000.0, 1000.0, "equidistant", (0.0, 0.0, 0.0, 0.0))
    uv = 1000.0 + np.array([[300 * math.radians(74.0), 0.0], [300 * math.radians(76.0), 0.0], [900.0, 0.0]])
    assert np.isfinite(normalise(fish, uv)).all(axis=1).tolist() == [True, False, False]


def test_no_pixels_are_no_pixels(lens):
    none = np.zeros((0, 2))
    for function in (normalise, denormalise, straighten, bend):
        assert function(lens, none).shape == (0, 2)


def test_lens_that_sees_nothing_is_refused():
    lens = Calibration(640, 480, 500.0, 500.0, -9000.0, 9000.0, "wide_angle", (1.0,))
    with pytest.raises(ValueError, match=r"Calibration\(distortion=\(1.0,\)\): no pixel has an inverse"):
        pinhole(lens)
