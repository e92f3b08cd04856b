"""Scenarios: the paper's Table 1 and experiments, every number a parameter."""

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import is_concrete, number, require, require_count, require_kind, vector
from vcjax.models.camera import Camera
from vcjax.models.motion import Oscillation
from vcjax.simulation.courses import CourseName, drawn_course, named_course
from vcjax.simulation.world import Movers, features_at, features_drawn, features_near, grid, is_feature

RobotMotion = Literal["forward", "curved", "lateral"]
DynamicMotion = Literal["lateral", "inverse_forward", "drawn"]
DynamicSet = Literal["ahead", "near_path", "bus_3", "bus_12", "bus_24", "bus_48"]
Triple = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]

MOUNT: Six = (0.0, 0.0, 0.6, -90.0, 0.0, -90.0)
# Noise of the odometry per frame: x, y, z (m), rotation about x, y, z (deg).
ODOMETRY_STD: dict[str, Six] = {
    "planar": (0.005, 0.005, 0.0, 0.0, 0.0, 0.05),
    "six_axis": (0.005, 0.005, 0.005, 0.05, 0.05, 0.05),
}

# DESIGN of the paper's world: three grid columns × both layers ahead of the robot, and a harder set beside its path.
DYNAMIC_PLACES_M = {
    "ahead": [(4.0, y, z) for y in (-2.0, 0.0, 2.0) for z in (0.0, 1.0)],
    "near_path": [(x, y, 0.0) for x in (0.0, 4.0, 8.0) for y in (-2.0, 2.0)],
}
# A bus: the features nearest to the middle of those ahead. All 48 are in view when the robot starts.
BUSES = {"bus_3": 3, "bus_12": 12, "bus_24": 24, "bus_48": 48}
BUS_CENTRE_M = (4.0, 0.0, 0.5)
DIRECTIONS = {"lateral": (0.0, 1.0, 0.0), "inverse_forward": (-1.0, 0.0, 0.0), "drawn": (1.0, 0.0, 0.0)}
# Start x, y (m) and yaw (deg); increment x, y (m) and yaw (deg) per frame, in the robot frame.
ROBOT_MOTIONS = {
    "forward": ((-8.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "curved": ((-8.0, -8.0, 0.0), (1.0, 0.0, 0.5)),
    "lateral": ((-4.0, -4.0, 0.0), (0.0, 1.0, 0.0)),
}


class Scenario(eqx.Module):
    """A simulated experiment: robot, camera, oscillation, features, movers and noise."""

    landmarks_m: Float[Array | np.ndarray, "F 3"] = eqx.field(converter=vector)
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
    mount: tuple[float, ...] = eqx.field(converter=vector, default=MOUNT)
    """Camera in the robot frame: x, y, z (m), roll, pitch, yaw (deg)."""
    odometry_std: tuple[float, ...] = eqx.field(converter=vector, default=ODOMETRY_STD["planar"])
    """Noise of the odometry per frame: x, y, z (m), rotation about x, y, z (deg). Default: planar, Table 1."""
    pixel_std_px: float = eqx.field(converter=number, default=1.0)
    """Noise of a measured pixel, px."""
    oscillation_std_m: float = eqx.field(converter=number, default=0.0)
    """How far the camera's true sideways displacement is from the commanded one, standard deviation in each frame, m.
    Independent from frame to frame: its change since the last frame has √2 of it, which is what the filter's
    `oscillation_std_m` is about. 0: as commanded."""
    frame_rate_hz: float = eqx.field(converter=number, default=10.0)
    """Frames per second."""
    num_frames: int = eqx.field(static=True, default=160)
    """Frames in a run."""

    def __check_init__(self):
        for name, kind in (("movers", Movers), ("oscillation", Oscillation), ("camera", Camera)):
            require_kind("Scenario", name, getattr(self, name), kind, f"give an object of the class {kind.__name__}.")
        shape = np.shape(self.landmarks_m)
        if len(shape) < 2 or shape[-1] != 3 or shape[-2] == 0:
            raise ValueError(f"Scenario(landmarks_m) has shape {shape}; give at least one feature, (F, 3) m.")
        require(self, "landmarks_m", np.isfinite, "features need finite places.", length=None)
        for name, length in (("start", 3), ("increment", 3), ("mount", 6)):
            require(self, name, np.isfinite, "give finite numbers.", length)
        require(self, "odometry_std", lambda s: np.isfinite(s) & (s >= 0), "standard deviations are at least 0.", 6)
        for name in ("pixel_std_px", "oscillation_std_m"):
            require(self, name, lambda s: np.isfinite(s) & (s >= 0), "a standard deviation is at least 0.")
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
                f"Scenario(oscillation.frequency_hz={np.asarray(frequency).tolist()}) is not below half the frame rate "
                f"of {np.asarray(rate).tolist()} Hz; choose a lower frequency (a steady camera may have 0) "
                "or a higher rate."
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
    *,
    start: Triple | None = None,
    increment: Triple | None = None,
    odometry_std: Six | None = None,
    mount: Six = MOUNT,
    intrinsics_px: tuple[float, float, float, float] = (320.0, 240.0, 320.0, 320.0),
    image_size_px: tuple[float, float] = (640.0, 480.0),
    distortion: Sequence[float] = (),
    dynamic_direction: Triple | None = None,
    dynamic_places_m: Sequence[Triple] = (),
    dynamic_drawn: int | None = None,
    dynamic_seed: int = 0,
    dynamic_course: CourseName | None = None,
    oscillation_error_std_m: float = 0.0,
    grid_low_m: float = -8.0,
    grid_high_m: float = 8.0,
    grid_per_side: int = 9,
    grid_heights_m: Sequence[float] = (0.0, 1.0),
) -> Scenario:
    """One of the paper's experiments (section 4, Table 1), or one like them.

    Args:
        robot: forward along x from (-8, 0); curved by 0.5° per frame from (-8, -8); or lateral along y, looking
            along x, from (-4, -4).
        dynamic: None for a static scene, or how the dynamic features move: lateral (+y), inverse forward (-x), or each
            in a direction and at half to one and a half of the speed as `dynamic_seed` draws them.
        dynamic_speed_m_s: their speed, m/s, at least 0.
        dynamic_set: the six features ahead of the robot, the six near its path, a bus of 3, 12, 24 or 48 side by side
            ahead of it, or feature ids of one's own.
        oscillation_amplitude_m: A of equation (1), m; 0 is the steady camera, the paper's oscillating one has 0.05.
        oscillation_frequency_hz: f of equation (1), Hz, below half the frame rate.
        noise: odometry noise of Table 1 in the plane (x, y, yaw) or on all six axes.
        step_m: length of the robot's step per frame, m.
        pixel_error_std_px: noise of a measured pixel, px (the filter assumes its own).
        frame_rate_hz: frames per second.
        num_frames: frames in a run.
        start: where the robot starts instead: x, y (m) and yaw (deg).
        increment: the robot's motion per frame instead of its step: x, y (m) and yaw (deg) in its own frame.
        odometry_std: noise of the odometry per frame instead: x, y, z (m), rotation about x, y, z (deg).
        mount: camera in the robot frame: x, y, z (m), roll, pitch, yaw (deg).
        intrinsics_px: the camera's principal point u0, v0 and focal lengths αu, αv, px.
        image_size_px: its width and height, px.
        distortion: its radial distortion coefficients d1, d2, …; none by default.
        dynamic_direction: direction of the dynamic features instead of a named motion; its length means nothing.
        dynamic_places_m: the dynamic features by their places x, y, z (m) instead of a set.
        dynamic_drawn: how many dynamic features to draw among all features, instead of a set.
        dynamic_seed: seed of that draw and of drawn directions and speeds, and of nothing else.
        dynamic_course: None for constant velocities; or late (they start after a quarter of the run), stops (half-way),
            stops_and_starts (they stand in the second quarter) or turns (to the left in the second quarter, and back).
        oscillation_error_std_m: how far the camera is from its commanded displacement, standard deviation, m (the
            filter assumes its own).
        grid_low_m: lowest x and y of the square grid of features, m.
        grid_high_m: highest x and y, m.
        grid_per_side: features along each side.
        grid_heights_m: height of each layer of the grid, m.

    Raises:
        ValueError: for an unknown name, a number out of its range, or options that contradict each other.
    """
    for name, value, choices in (
        ("robot", robot, tuple(ROBOT_MOTIONS)),
        ("dynamic", dynamic, (None, *DIRECTIONS)),
        ("noise", noise, ("planar", "six_axis")),
    ):
        if value not in choices:
            raise ValueError(f"paper({name}={value!r}): choose one of {choices}.")
    if dynamic is not None and dynamic_direction is not None:
        raise ValueError(f"paper(dynamic={dynamic!r}, dynamic_direction={dynamic_direction}): give one of the two.")
    is_static = dynamic is None and dynamic_direction is None
    landmarks = grid(grid_low_m, grid_high_m, grid_per_side, grid_heights_m)
    ids = _dynamic_ids(landmarks, dynamic_set, dynamic_places_m, dynamic_drawn, dynamic_seed, is_static)
    course = None if dynamic_course is None else named_course(dynamic_course, num_frames / frame_rate_hz)
    if dynamic == "drawn":
        course = drawn_course(len(ids), dynamic_seed, course)
    place, (x, y, yaw_deg) = ROBOT_MOTIONS[robot]
    return Scenario(
        landmarks_m=landmarks,
        movers=Movers(
            ids=ids,
            direction=DIRECTIONS[dynamic or "lateral"] if dynamic_direction is None else dynamic_direction,
            speed_m_s=0.0 if is_static else dynamic_speed_m_s,
            course=course,
        ),
        oscillation=Oscillation(oscillation_amplitude_m, oscillation_frequency_hz),
        camera=Camera(intrinsics_px, image_size_px, tuple(distortion)),
        start=place if start is None else start,
        increment=(step_m * x, step_m * y, yaw_deg) if increment is None else increment,
        mount=mount,
        odometry_std=ODOMETRY_STD[noise] if odometry_std is None else odometry_std,
        pixel_std_px=pixel_error_std_px,
        oscillation_std_m=oscillation_error_std_m,
        frame_rate_hz=frame_rate_hz,
        num_frames=num_frames,
    )


HarderName = Literal[
    "late",
    "stops",
    "stops_and_starts",
    "turns",
    "drawn",
    "bus_3",
    "bus_12",
    "bus_24",
    "bus_48",
    "jitter_2_mm",
    "jitter_5_mm",
]
HARDER: dict[str, dict[str, Any]] = {
    "late": {"dynamic_course": "late"},
    "stops": {"dynamic_course": "stops"},
    "stops_and_starts": {"dynamic_course": "stops_and_starts"},
    "turns": {"dynamic_course": "turns"},
    "drawn": {"dynamic": "drawn", "dynamic_drawn": 12},
    **{name: {"dynamic_set": name} for name in BUSES},
    "jitter_2_mm": {"oscillation_error_std_m": 0.002},
    "jitter_5_mm": {"oscillation_error_std_m": 0.005},
}
"""Scenes harder than the paper's, by what they change in `paper`."""


def harder(name: str, **options: Any) -> Scenario:
    """A scene harder than the paper's, by its name in `HARDER`.

    The robot moves forward, the camera oscillates by 0.05 m at 3 Hz, and features move sideways at 0.5 m/s.

    Args:
        name: what makes it harder: movers that start late, stop, stop and start, or turn; directions, speeds and places
            drawn at random; 3 to 48 features that move together as a bus; or an oscillation known up to 2 or 5 mm.
        options: of `paper`, instead.

    Raises:
        ValueError: for an unknown name, or as `paper`.
    """
    if name not in HARDER:
        raise ValueError(f"harder({name!r}): choose one of {tuple(HARDER)}.")
    usual = {"dynamic": "lateral", "dynamic_speed_m_s": 0.5, "oscillation_amplitude_m": 0.05}
    return paper(**usual | HARDER[name] | options)


def _dynamic_ids(
    landmarks: Float[np.ndarray, "F 3"],
    dynamic_set: DynamicSet | Sequence[int],
    places_m: Sequence[Triple],
    num_drawn: int | None,
    seed: int,
    is_static: bool,
) -> Sequence[int] | np.ndarray:
    """Feature ids of a preset, of places or of a draw, or the ids given."""
    is_default = isinstance(dynamic_set, str) and dynamic_set == "ahead"
    if (not is_default) + (len(places_m) > 0) + (num_drawn is not None) > 1:
        raise ValueError("paper: give one of dynamic_set, dynamic_places_m and dynamic_drawn.")
    if num_drawn is not None:
        return features_drawn(len(landmarks), num_drawn, seed)
    if len(places_m):
        return features_at(landmarks, places_m)
    if not isinstance(dynamic_set, str):
        return dynamic_set
    if dynamic_set in BUSES:
        return np.sort(features_near(landmarks, BUS_CENTRE_M, BUSES[dynamic_set]))
    if dynamic_set not in DYNAMIC_PLACES_M:
        sets = (*DYNAMIC_PLACES_M, *BUSES)
        raise ValueError(f"paper(dynamic_set={dynamic_set!r}): choose one of {sets}, or give feature ids.")
    preset = np.array(DYNAMIC_PLACES_M[dynamic_set])
    # Where nothing moves, the grid may lack the preset's places.
    return np.sort(features_at(landmarks, preset[is_feature(landmarks, preset)] if is_static else preset))
