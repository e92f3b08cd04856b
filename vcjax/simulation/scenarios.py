"""Scenarios: the paper's Table 1 and experiments, every number a parameter."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import is_concrete, number, require, require_count, vector
from vcjax.models.camera import Camera
from vcjax.models.motion import Oscillation
from vcjax.simulation.world import Movers, grid

RobotMotion = Literal["forward", "curved", "lateral"]
DynamicMotion = Literal["lateral", "inverse_forward"]
DynamicSet = Literal["ahead", "near_path"]

# DESIGN of the paper's world: three grid columns × both layers ahead of the robot, and a harder set beside its path.
DYNAMIC_POINTS_M = {
    "ahead": [(4.0, y, z) for y in (-2.0, 0.0, 2.0) for z in (0.0, 1.0)],
    "near_path": [(x, y, 0.0) for x in (0.0, 4.0, 8.0) for y in (-2.0, 2.0)],
}
DIRECTIONS = {"lateral": (0.0, 1.0, 0.0), "inverse_forward": (-1.0, 0.0, 0.0)}
# Start x, y (m) and yaw (deg); increment x, y (m) and yaw (deg) per frame, in the robot frame.
ROBOT_MOTIONS = {
    "forward": ((-8.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "curved": ((-8.0, -8.0, 0.0), (1.0, 0.0, 0.5)),
    "lateral": ((-4.0, -4.0, 0.0), (0.0, 1.0, 0.0)),
}


class Scenario(eqx.Module):
    """A simulated experiment: robot, camera, oscillation, features, movers and noise."""

    landmarks_m: Float[Array | np.ndarray, "F 3"]
    """Features at time 0, m. A feature's number is its track id."""
    movers: Movers
    """Which of them move, and how."""
    oscillation: Oscillation = eqx.field(default_factory=Oscillation)
    """The camera's sideways motion."""
    camera: Camera = eqx.field(default_factory=Camera)
    """Calibration."""
    start: tuple[float, float, float] = eqx.field(converter=vector, default=(-8.0, 0.0, 0.0))
    """Robot's x, y (m) and yaw (deg) before the first frame; its height is 0."""
    increment: tuple[float, float, float] = eqx.field(converter=vector, default=(0.05, 0.0, 0.0))
    """True motion per frame in the robot frame: x, y (m) and yaw (deg)."""
    mount: tuple[float, ...] = eqx.field(converter=vector, default=(0.0, 0.0, 0.6, -90.0, 0.0, -90.0))
    """Camera in the robot frame: x, y, z (m), roll, pitch, yaw (deg)."""
    odometry_std: tuple[float, ...] = eqx.field(converter=vector, default=(0.005, 0.005, 0.0, 0.0, 0.0, 0.05))
    """Noise of the odometry per frame: x, y, z (m), rotation about x, y, z (deg). Default: planar, Table 1."""
    pixel_std_px: float = eqx.field(converter=number, default=1.0)
    """Noise of a measured pixel, px."""
    frame_rate_hz: float = eqx.field(converter=number, default=10.0)
    """Frames per second."""
    num_frames: int = eqx.field(static=True, default=160)
    """Frames in a run."""

    def __check_init__(self):
        shape = np.shape(self.landmarks_m)
        if len(shape) < 2 or shape[-1] != 3 or shape[-2] == 0:
            raise ValueError(f"Scenario(landmarks_m) has shape {shape}; give at least one feature, (F, 3) m.")
        require(self, "landmarks_m", np.isfinite, "features need finite places.", length=None)
        for name, length in (("start", 3), ("increment", 3), ("mount", 6)):
            require(self, name, np.isfinite, "give finite numbers.", length)
        require(self, "odometry_std", lambda s: np.isfinite(s) & (s >= 0), "standard deviations are at least 0.", 6)
        require(self, "pixel_std_px", lambda s: np.isfinite(s) & (s >= 0), "a standard deviation is at least 0.")
        require(self, "frame_rate_hz", lambda r: np.isfinite(r) & (r > 0), "give a positive rate.")
        require_count(self, "num_frames", 1)
        ids, num_features = self.movers.ids, shape[-2]
        if is_concrete(ids) and np.size(ids) and (np.min(ids) < 0 or np.max(ids) >= num_features):
            raise ValueError(
                f"Scenario(movers.ids={np.asarray(ids).tolist()}): there are {num_features} features, numbered from 0."
            )
        rate, frequency = self.frame_rate_hz, self.oscillation.frequency_hz
        if is_concrete(rate) and is_concrete(frequency) and np.any(np.asarray(frequency) >= np.asarray(rate) / 2):
            raise ValueError(
                f"Scenario(oscillation.frequency_hz={np.asarray(frequency).tolist()}) is at or above "
                f"half the frame rate ({np.asarray(rate).tolist()} Hz); choose a lower frequency or a higher rate."
            )


def paper(
    robot: RobotMotion = "forward",
    dynamic: DynamicMotion | None = None,
    dynamic_speed_m_s: float = 1.0,
    dynamic_set: DynamicSet | Sequence[int] = "ahead",
    oscillation_amplitude_m: float = 0.0,
    oscillation_frequency_hz: float = 3.0,
    noise: Literal["planar", "six_axis"] = "planar",
    step_m: float = 0.05,
    pixel_error_std_px: float = 1.0,
    frame_rate_hz: float = 10.0,
    num_frames: int = 160,
) -> Scenario:
    """One of the paper's experiments (section 4, Table 1).

    Args:
        robot: forward along x from (-8, 0); curved by 0.5° per frame from (-8, -8); or lateral along y, looking
            along x, from (-4, -4).
        dynamic: None for a static scene, or how the dynamic features move: lateral (+y) or inverse forward (-x).
        dynamic_speed_m_s: their speed, m/s, at least 0.
        dynamic_set: the six features ahead of the robot, the six near its path, or feature ids of one's own.
        oscillation_amplitude_m: A of equation (1), m; 0 is the steady camera, the paper's oscillating one has 0.05.
        oscillation_frequency_hz: f of equation (1), Hz, below half the frame rate.
        noise: odometry noise of Table 1 in the plane (x, y, yaw) or on all six axes.
        step_m: length of the robot's step per frame, m.
        pixel_error_std_px: noise of a measured pixel, px (the filter assumes its own).
        frame_rate_hz: frames per second.
        num_frames: frames in a run.

    Raises:
        ValueError: for an unknown name, or a number out of its range.
    """
    for name, value, choices in (
        ("robot", robot, tuple(ROBOT_MOTIONS)),
        ("dynamic", dynamic, (None, *DIRECTIONS)),
        ("noise", noise, ("planar", "six_axis")),
    ):
        if value not in choices:
            raise ValueError(f"paper({name}={value!r}): choose one of {choices}.")
    landmarks = grid()
    start, direction = ROBOT_MOTIONS[robot]
    odometry_std = (0.005,) * 3 + (0.05,) * 3 if noise == "six_axis" else (0.005, 0.005, 0.0, 0.0, 0.0, 0.05)
    return Scenario(
        landmarks_m=landmarks,
        movers=Movers(
            ids=_dynamic_ids(dynamic_set, landmarks),
            direction=DIRECTIONS[dynamic or "lateral"],
            speed_m_s=dynamic_speed_m_s if dynamic else 0.0,
        ),
        oscillation=Oscillation(oscillation_amplitude_m, oscillation_frequency_hz),
        start=start,
        increment=(step_m * direction[0], step_m * direction[1], direction[2]),
        odometry_std=odometry_std,
        pixel_std_px=pixel_error_std_px,
        frame_rate_hz=frame_rate_hz,
        num_frames=num_frames,
    )


def _dynamic_ids(dynamic_set: DynamicSet | Sequence[int], landmarks: Float[np.ndarray, "F 3"]) -> np.ndarray:
    """Feature ids of a preset, or the ids given."""
    if not isinstance(dynamic_set, str):
        ids = np.asarray(dynamic_set)
        if ids.size and not np.issubdtype(ids.dtype, np.integer):
            raise ValueError(f"paper(dynamic_set={dynamic_set!r}): feature ids are whole numbers.")
        return ids.astype(np.int32)
    if dynamic_set not in DYNAMIC_POINTS_M:
        raise ValueError(
            f"paper(dynamic_set={dynamic_set!r}): choose one of {tuple(DYNAMIC_POINTS_M)}, or give feature ids."
        )
    points = np.array(DYNAMIC_POINTS_M[dynamic_set])
    distance = np.linalg.norm(landmarks[:, None] - points, axis=-1)
    return np.sort(np.argmin(distance, axis=0)).astype(np.int32)
