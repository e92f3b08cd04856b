"""Simulate: a scenario and a key give a Recording and its Truth.

The true path is free of noise; the odometry that the filter is given has it, and so have the pixels, and, where the
oscillation is not known exactly, the camera's true displacement. Every random number is drawn for every frame and every
feature, seen or not, in a fixed order: the same key gives the same draws whatever gate, camera motion or mover is
compared (common random numbers).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vcjax.fields import require_key, require_kind, require_single
from vcjax.models.camera import is_inside, project
from vcjax.models.frames import Pose, compose, quaternion_from_euler, to_frame
from vcjax.models.motion import move_by_odometry, oscillate
from vcjax.recording import Recording, Truth
from vcjax.simulation.scenarios import Scenario
from vcjax.simulation.world import moved

_JITTER_FOLD = 4
"""Fold of a run's key from which the oscillation's error is drawn. Its folds 0 and 1 are those of odometry and pixels,
2 and 3 are taken by the order of births and by descents."""


class Path(NamedTuple):
    """The path of robot and camera without any noise."""

    time_s: Float[Array, " T"]
    control: Float[Array, "6"]
    """The robot's increment per frame."""
    robot_start: Pose
    robot: Float[Array, "T 7"]
    sensor_start: Pose
    displacement_m: Float[Array, " T"]
    """Commanded displacement of the camera, X_s of equation (1)."""


def true_path(scenario: Scenario) -> Path:
    """Where robot and camera are in every frame. Derivative exact."""
    num_frames = scenario.num_frames
    time_s = jnp.arange(1, num_frames + 1) / scenario.frame_rate_hz
    increment, start = jnp.asarray(scenario.increment), jnp.asarray(scenario.start)
    zero = jnp.zeros(())
    control = jnp.stack([increment[0], increment[1], zero, zero, zero, jnp.deg2rad(increment[2])])
    robot_start = jnp.concatenate(
        [start[:2], zero[None], quaternion_from_euler(jnp.stack([zero, zero, jnp.deg2rad(start[2])]))]
    )

    def advance(pose, _):
        pose = move_by_odometry(pose, control)
        return pose, pose

    _, robot = jax.lax.scan(advance, robot_start, None, length=num_frames)
    mount = jnp.asarray(scenario.mount)
    sensor_start = jnp.concatenate([mount[:3], quaternion_from_euler(jnp.deg2rad(mount[3:]))])
    return Path(time_s, control, robot_start, robot, sensor_start, oscillate(scenario.oscillation, time_s))


def simulate(scenario: Scenario, key: PRNGKeyArray) -> tuple[Recording, Truth]:
    """One run of a scenario.

    Frame t = 1 … T is taken at time t/rate, after t increments of the robot; the camera's displacement starts from
    zero at time 0, and movers start from their places at time 0. A feature is observed when its noisy pixel is inside
    the image and it lies in front of the camera.

    Args:
        scenario: the experiment; any of its numbers may be traced or differentiated (what is observed has zero
            derivative).
        key: of the run's noise.

    Returns: the recording, with one column for each feature of the world, and the truth.

    Raises:
        ValueError: for a scenario that is none, or what is not one random key.
    """
    require_kind("simulate", "scenario", scenario, Scenario, "give a Scenario, e.g. vcjax.scenarios.paper().")
    require_single("simulate", scenario)
    require_key("simulate", key)
    key_odometry, key_pixels = jax.random.split(key)
    num_frames, num_features = scenario.num_frames, scenario.landmarks_m.shape[-2]
    time_s, control, robot_start, robot, sensor_start, displacement = true_path(scenario)
    std = jnp.asarray(scenario.odometry_std)
    std = jnp.concatenate([std[:3], jnp.deg2rad(std[3:])])
    odometry = control + std * jax.random.normal(key_odometry, (num_frames, 6), std.dtype)

    shift = jnp.zeros((num_frames, 3), time_s.dtype).at[:, 1].set(jnp.diff(displacement, prepend=0.0))
    jitter = jax.random.normal(jax.random.fold_in(key, _JITTER_FOLD), (num_frames,), time_s.dtype)
    true_displacement = displacement + scenario.oscillation_std_m * jitter
    sensor = jnp.broadcast_to(sensor_start, (num_frames, 7)).at[:, 1].add(true_displacement)

    landmarks, is_moving = moved(scenario.movers, jnp.asarray(scenario.landmarks_m), time_s)

    def see(robot, sensor, landmarks):
        camera_pose = compose(robot, sensor)
        point_c = jax.vmap(lambda p: to_frame(camera_pose, p))(landmarks)
        return jax.vmap(lambda p: project(scenario.camera, p))(point_c), point_c[:, 2] > 0

    pixel, is_in_front = jax.vmap(see)(robot, sensor, landmarks)
    uv_px = pixel + scenario.pixel_std_px * jax.random.normal(key_pixels, pixel.shape, pixel.dtype)
    is_valid = is_in_front & is_inside(scenario.camera, uv_px)
    t = jnp.arange(num_frames)[:, None]
    last_sighting = jnp.max(jnp.where(is_valid, t, -1), axis=0)
    recording = Recording(
        time_s=time_s,
        odometry=odometry,
        odometry_cov=jnp.broadcast_to(jnp.diag(std**2), (num_frames, 6, 6)),
        sensor_shift_m=shift,
        track_id=jnp.broadcast_to(jnp.arange(num_features, dtype=jnp.int32), (num_frames, num_features)),
        uv_px=uv_px,
        is_valid=is_valid,
        is_last=t == last_sighting,
        camera=scenario.camera,
        robot_start=robot_start,
        sensor_start=sensor_start,
        start_cov=jnp.zeros((14, 14), time_s.dtype),
    )
    truth = Truth(robot=robot, sensor=sensor, landmarks_m=landmarks, is_moving=is_moving)
    return recording, truth
