"""Lenses that bend: from the pixels of a real image to those of the pin-hole camera that the filter uses, and back.

With the normalised point (a, b) = (x/z, y/z) in camera coordinates and r² = a² + b²:

- `radial_tangential` (k1, k2, p1, p2[, k3[, k4, k5, k6]]): OpenCV's `projectPoints`; "plumb bob", "radtan".
- `equidistant` (k1 … k4): OpenCV's `fisheye`, θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) with θ = atan r; Kannala &
  Brandt, PAMI 2006.
- `wide_angle` (κ in px⁻²): the one of MonoSLAM, r_d = r_u / √(1 + 2 κ r_u²) with both radii in px from the principal
  point; Davison et al., PAMI 2007. Its inverse is r_u = r_d / √(1 - 2 κ r_d²).

The pin-hole camera keeps the focal lengths; its image is as large as the straightened one, so that whatever was seen
has its place in it. Straightening stretches the borders of a wide image, and the noise of a pixel there with it.
"""

import functools
import math

import numpy as np
from jaxtyping import Float

from vcjax.models.camera import Camera
from vcjax.sources.calibration import Calibration

MAX_ANGLE_DEG = 75.0
"""Farthest from the optical axis that a pin-hole image is made to reach: tan 75° is 3.7 focal lengths."""
_TOLERANCE_PX = 1e-2
"""How far a straightened pixel, bent again, may lie from where it was: more means that the inverse was not found."""
_STEPS = 100

Points = Float[np.ndarray, "N 2"]


def normalise(calibration: Calibration, uv_px: Points) -> Points:
    """Normalised points (a, b) of pixels of the real image; NaN where the lens model has no inverse there.

    That is so beyond `MAX_ANGLE_DEG`, and where a point, bent again, does not come back to its pixel.
    """
    centre, focal = _centre_and_focal(calibration)
    uv_px = np.asarray(uv_px, np.float64)
    points = (uv_px - centre) / focal
    match calibration.distortion_model:
        case "radial_tangential":
            import cv2

            if len(points):
                rough = cv2.undistortPoints(uv_px[:, None], calibration.matrix, np.array(calibration.distortion))[:, 0]
                points = _polished(calibration, uv_px, rough)
        case "equidistant":
            import cv2

            if len(points):
                criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _STEPS, 1e-12)
                bent = (uv_px[:, None], calibration.matrix, np.array(calibration.distortion))
                points = cv2.fisheye.undistortPoints(*bent, criteria=criteria)[:, 0]
        case "wide_angle":
            radius2 = np.sum((uv_px - centre) ** 2, axis=1, keepdims=True)
            with np.errstate(invalid="ignore", divide="ignore"):
                points = points / np.sqrt(1.0 - 2.0 * calibration.distortion[0] * radius2)
    with np.errstate(invalid="ignore", over="ignore"):
        is_good = np.hypot(*points.T) <= math.tan(math.radians(MAX_ANGLE_DEG))
        points = np.where(is_good[:, None], points, np.nan)
        is_back = np.hypot(*(denormalise(calibration, points) - uv_px).T) <= _TOLERANCE_PX
    return np.where(is_back[:, None], points, np.nan)


def denormalise(calibration: Calibration, points: Points) -> Points:
    """Pixels of the real image of normalised points (a, b): the lens model itself. NaN stays NaN."""
    centre, focal = _centre_and_focal(calibration)
    points = np.asarray(points, np.float64)
    match calibration.distortion_model:
        case "radial_tangential":
            import cv2

            if len(points):
                places = np.column_stack([points, np.ones(len(points))])
                zero, lens = np.zeros(3), np.array(calibration.distortion)
                return cv2.projectPoints(places, zero, zero, calibration.matrix, lens)[0][:, 0]
        case "equidistant":
            import cv2

            if len(points):
                # At the very centre OpenCV would divide by zero.
                bent = cv2.fisheye.distortPoints(points[:, None], calibration.matrix, np.array(calibration.distortion))
                return np.where(np.hypot(*points.T)[:, None] < 1e-9, points * focal + centre, bent[:, 0])
        case "wide_angle":
            radius2 = np.sum((points * focal) ** 2, axis=1, keepdims=True)
            points = points / np.sqrt(1.0 + 2.0 * calibration.distortion[0] * radius2)
    return points * focal + centre


@functools.lru_cache(maxsize=64)
def pinhole(calibration: Calibration) -> Camera:
    """The pin-hole camera of the filter: the same focal lengths, and an image that holds the straightened one.

    Raises:
        ValueError: if no pixel of the image's border and middle can be straightened.
    """
    if calibration.distortion_model == "none":
        u0, v0 = calibration.cx, calibration.cy
        return Camera((u0, v0, calibration.fx, calibration.fy), (float(calibration.width), float(calibration.height)))
    u, v = (np.linspace(0.0, size, 257) for size in (calibration.width, calibration.height))
    points = normalise(calibration, np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    points = points[np.isfinite(points[:, 0])]
    if not len(points):
        raise ValueError(f"Calibration(distortion={calibration.distortion}): no pixel has an inverse; check the units.")
    focal = (calibration.fx, calibration.fy)
    low, high = np.floor(points.min(axis=0) * focal), np.ceil(points.max(axis=0) * focal)
    return Camera((*(-low).tolist(), *focal), tuple((high - low).tolist()))


def straighten(calibration: Calibration, uv_px: Points) -> Points:
    """Pixels of the pin-hole camera (see `pinhole`) of pixels of the real image; NaN where there is none."""
    if calibration.distortion_model == "none":
        return np.asarray(uv_px, np.float64)
    intrinsics = np.asarray(pinhole(calibration).intrinsics_px)
    return normalise(calibration, uv_px) * intrinsics[2:] + intrinsics[:2]


def bend(calibration: Calibration, uv_px: Points) -> Points:
    """Pixels of the real image of pixels of the pin-hole camera: the inverse of `straighten`."""
    if calibration.distortion_model == "none":
        return np.asarray(uv_px, np.float64)
    intrinsics = np.asarray(pinhole(calibration).intrinsics_px)
    return denormalise(calibration, (np.asarray(uv_px, np.float64) - intrinsics[:2]) / intrinsics[2:])


def _centre_and_focal(calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    return np.array([calibration.cx, calibration.cy]), np.array([calibration.fx, calibration.fy])


def _polished(calibration: Calibration, uv_px: Points, points: Points) -> Points:
    """The inverse of radial-tangential distortion by Newton's method from OpenCV's few fixed-point steps."""
    import cv2

    zero, lens = np.zeros(3), np.array(calibration.distortion)
    _, focal = _centre_and_focal(calibration)
    places = np.zeros((len(points), 3))
    for _ in range(4):
        places[:, :2], places[:, 2] = points, 1.0
        bent, jacobian = cv2.projectPoints(places, zero, zero, calibration.matrix, lens)
        # By the translation: at depth 1 the derivative by the normalised point.
        J = jacobian[:, 3:5].reshape(-1, 2, 2)
        with np.errstate(all="ignore"):
            # Beyond the fold of a lens model the image is mirrored: what is found there is another point.
            is_regular = np.linalg.det(J) > 1e-9 * np.prod(focal)
            inverse = np.linalg.inv(np.where(is_regular[:, None, None], J, np.eye(2)))
            points = points - np.einsum("nij,nj->ni", inverse, bent[:, 0] - uv_px)
            points[~is_regular] = np.nan
    return points
