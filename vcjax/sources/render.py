"""A small renderer: textured rectangles that stand or move, seen from known places, and the exact truth of every pixel.

The whole way from images to detections can so be tested without a camera. A pixel's ray d = (a, b, 1) meets the
rectangle with corner o and edges e_u, e_v (in camera coordinates) where [e_u e_v o] (s, t, 1)ᵀ = z d: solved for
(s, t, 1)/z this gives the place in the texture and the inverse depth at once, for all pixels by one 3 × 3 matrix; the
nearest rectangle is seen. Each pixel is the mean of several rays, so that edges are smooth and tracks can be finer than
a pixel. Rays are those of the calibrated lens, bent or not.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from vcjax.recording import Truth
from vcjax.simulation.scenarios import Scenario
from vcjax.sources.calibration import Calibration
from vcjax.sources.distortion import denormalise, normalise

Image = UInt8[np.ndarray, "height width"]

_NEAREST_M = 1e-3


class Surface(NamedTuple):
    """A textured rectangle, or parallelogram, that moves with a constant velocity from time 0 on."""

    corner_m: Float[np.ndarray, "3"]
    """Where the texture's first corner is at time 0, m."""
    edge_u_m: Float[np.ndarray, "3"]
    """From there along the texture's rows, m."""
    edge_v_m: Float[np.ndarray, "3"]
    """From there along its columns, m."""
    texture: Image
    """Grey values."""
    velocity_m_s: Float[np.ndarray, "3"] = np.zeros(3)
    """In the world, m/s."""


def rough_texture(seed: int, num_cells: int = 6, size_px: int = 96) -> Image:
    """A texture full of corners: cells of random grey, and smaller ones on them, with soft edges."""
    import cv2

    # Of NumPy's generators the one whose numbers are promised never to change.
    draws = np.random.RandomState(seed)
    texture = np.zeros((size_px, size_px), np.float32)
    for cells, contrast in ((num_cells, 90.0), (2 * num_cells, 35.0)):
        grey = draws.uniform(-contrast, contrast, (cells, cells)).astype(np.float32)
        texture += cv2.resize(grey, (size_px, size_px), interpolation=cv2.INTER_NEAREST)
    soft = cv2.GaussianBlur(texture, (0, 0), size_px / num_cells / 16)
    return np.clip(128.0 + soft, 0, 255).astype(np.uint8)


def surfaces_of(
    scenario: Scenario, truth: Truth, patch_m: float = 0.3, room_margin_m: float | None = 4.0, seed: int = 0
) -> tuple[Surface, ...]:
    """The world of a scenario as surfaces: a square patch for each feature, in its order, in a room of four walls.

    A patch stands upright, turned towards the middle of the robot's path, and moves as its feature does.

    Args:
        scenario: whose features and camera.
        truth: of a simulation of it, for the path and the motion of the features.
        patch_m: side of a patch, m.
        room_margin_m: how far the walls are beyond the outermost features, m; None: no room.
        seed: of the textures.
    """
    features = np.asarray(scenario.landmarks_m, np.float64)
    landmarks, rate = np.asarray(truth.landmarks_m, np.float64), float(scenario.frame_rate_hz)
    velocity = (landmarks[0] - features) * rate
    middle = np.mean(np.asarray(truth.robot, np.float64)[:, :3], axis=0)
    up = np.array([0.0, 0.0, 1.0])
    surfaces = []
    for i, (place, speed) in enumerate(zip(features, velocity, strict=True)):
        towards = (middle - place) * [1, 1, 0]
        norm = np.linalg.norm(towards)
        right = np.cross(up, towards / norm if norm > 0 else np.array([-1.0, 0, 0])) * patch_m
        corner = place - right / 2 + up * patch_m / 2
        surfaces.append(Surface(corner, right, -up * patch_m, rough_texture(seed + i), speed))
    if room_margin_m is not None:
        low, high = landmarks.min(axis=(0, 1)) - room_margin_m, landmarks.max(axis=(0, 1)) + room_margin_m
        floor, height = low[2] - room_margin_m, high[2] - low[2] + 2 * room_margin_m
        corners = [(low[0], low[1]), (low[0], high[1]), (high[0], high[1]), (high[0], low[1])]
        for i, (a, b) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True)):
            edge = np.array([b[0] - a[0], b[1] - a[1], 0.0])
            # Twelve cells in the height of the wall, and as large ones along it.
            texture = rough_texture(seed + 10_000 + i, max(12, round(12 * np.linalg.norm(edge) / height)), 1024)
            texture = texture[: max(1, round(1024 * min(1.0, height / float(np.linalg.norm(edge)))))]
            surfaces.append(Surface(np.array([*a, floor + height]), edge, -up * height, texture))
    return tuple(surfaces)


def render(
    surfaces: Sequence[Surface],
    calibration: Calibration,
    T_w_c: Float[np.ndarray, "7"],
    time_s: float = 0.0,
    background: int = 128,
    rays_per_side: int = 3,
) -> Image:
    """The image of some surfaces from a place at a time.

    Args:
        surfaces: what there is.
        calibration: of the camera.
        T_w_c: pose of the camera in the world, quaternion (w, x, y, z).
        time_s: since the moment for which the surfaces' places are given, s.
        background: grey value where there is nothing.
        rays_per_side: rays along each side of a pixel, whose mean it is; the time taken grows with its square.
    """
    import cv2

    rays = _rays(calibration, rays_per_side)
    height, width = rays.shape[:2]
    grey = np.full((height, width), background, np.float32)
    nearest = np.zeros((height, width))  # inverse depth
    for _, surface, frame in _frames(surfaces, T_w_c, time_s):
        box = _box(frame, calibration, rays_per_side, (height, width))
        if box is None:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            place = rays[box] @ np.linalg.inv(frame).T
            s, t = place[..., 0] / place[..., 2], place[..., 1] / place[..., 2]
        is_seen = (place[..., 2] > nearest[box]) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        if not np.any(is_seen):
            continue
        texture = _texture(surface.texture, s, t, is_seen)
        u, v = ((x * n - 0.5).astype(np.float32) for x, n in ((s, texture.shape[1]), (t, texture.shape[0])))
        seen = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        grey[box][is_seen] = seen[is_seen]
        nearest[box][is_seen] = place[..., 2][is_seen]
    pixels = grey.reshape(calibration.height, rays_per_side, calibration.width, rays_per_side).mean(axis=(1, 3))
    return np.rint(pixels).astype(np.uint8)


def cast(
    surfaces: Sequence[Surface],
    calibration: Calibration,
    T_w_c: Float[np.ndarray, "7"],
    time_s: float,
    uv_px: Float[np.ndarray, "N 2"],
) -> Int[np.ndarray, " N"]:
    """Which surface is seen at some pixels, by its number; -1 where there is none."""
    rays = np.column_stack([normalise(calibration, uv_px), np.ones(len(uv_px))])
    nearest, number = np.zeros(len(uv_px)), np.full(len(uv_px), -1)
    for i, _, frame in _frames(surfaces, T_w_c, time_s):
        with np.errstate(invalid="ignore", divide="ignore"):
            place = rays @ np.linalg.inv(frame).T
            st = place[:, :2] / place[:, 2:]
            is_seen = (place[:, 2] > nearest) & np.all((st >= 0) & (st <= 1), axis=1)
        nearest[is_seen], number[is_seen] = place[is_seen, 2], i
    return number


def _frames(
    surfaces: Sequence[Surface], T_w_c: Float[np.ndarray, "7"], time_s: float
) -> Iterator[tuple[int, Surface, Float[np.ndarray, "3 3"]]]:
    """Each surface that is not seen edge-on, with its number and its [e_u e_v o] in camera coordinates at a time."""
    from scipy.spatial.transform import Rotation

    R_c_w = Rotation.from_quat(np.array(T_w_c)[3:], scalar_first=True).as_matrix().T
    for i, surface in enumerate(surfaces):
        corner = surface.corner_m + surface.velocity_m_s * time_s - np.asarray(T_w_c)[:3]
        frame = R_c_w @ np.column_stack([surface.edge_u_m, surface.edge_v_m, corner])
        if abs(np.linalg.det(frame)) > 1e-12:
            yield i, surface, frame


@functools.lru_cache(maxsize=4)
def _rays(calibration: Calibration, rays_per_side: int) -> Float[np.ndarray, "h w 3"]:
    """Rays (a, b, 1) through the parts of all pixels; NaN where the lens has none."""
    u, v = (
        (np.arange(size * rays_per_side) + 0.5) / rays_per_side - 0.5
        for size in (calibration.width, calibration.height)
    )
    points = normalise(calibration, np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    return np.column_stack([points, np.ones(len(points))]).reshape(len(v), len(u), 3)


def _box(
    frame: Float[np.ndarray, "3 3"], calibration: Calibration, rays_per_side: int, shape: tuple[int, int]
) -> tuple[slice, slice] | None:
    """The part of the image that a surface can be in: all of it where the surface reaches behind the camera."""
    side = np.linspace(0.0, 1.0, 9)
    ends, zero, one = np.ones(9), np.zeros(9), np.ones(9)
    st = np.concatenate([np.column_stack(pair) for pair in ((side, zero), (side, one), (zero, side), (one, side))])
    border = np.column_stack([st, np.tile(ends, 4)]) @ frame.T
    if np.all(border[:, 2] < _NEAREST_M):
        return None
    if np.any(border[:, 2] < _NEAREST_M):
        return slice(0, shape[0]), slice(0, shape[1])
    uv = denormalise(calibration, border[:, :2] / border[:, 2:])
    # Two pixels more: between the samples the border of a surface is curved where the lens is.
    low = np.floor((uv.min(axis=0) - 2) * rays_per_side).clip(0, [shape[1], shape[0]]).astype(int)
    high = np.ceil((uv.max(axis=0) + 3) * rays_per_side).clip(0, [shape[1], shape[0]]).astype(int)
    return (slice(low[1], high[1]), slice(low[0], high[0])) if np.all(high > low) else None


def _texture(texture: Image, s: np.ndarray, t: np.ndarray, is_seen: np.ndarray) -> UInt8[np.ndarray, "rows columns"]:
    """The texture, halved until its pixels are about as far apart as the rays that fall on it."""
    import cv2

    rows, columns = np.nonzero(is_seen)
    span = max(int(np.ptp(columns)), 1), max(int(np.ptp(rows)), 1)
    steps = np.ptp(s[is_seen]) * texture.shape[1] / span[0], np.ptp(t[is_seen]) * texture.shape[0] / span[1]
    for _ in range(int(max(0.0, np.log2(max(min(steps), 1e-9))))):
        if min(texture.shape) < 4:
            break
        texture = cv2.resize(texture, (texture.shape[1] // 2, texture.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return texture
