"""Odometry of real recordings: from a table, from velocities, from poses, or none.

Odometry of a frame is the motion of the robot since the frame before, in the robot frame of then: Δposition (m) and
Δrotation vector (rad), with its covariance. That of the first frame leads from the start to the first image: where
the start is the first image, it is zero and certain.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from vcjax.recording import Recording
from vcjax.sources.table_file import Kind, read_table, write_table

SHIFTS = ("shift_x", "shift_y", "shift_z")
AXES = ("dx", "dy", "dz", "rx", "ry", "rz")

Vector = Float[np.ndarray, "T 3"]


class Odometry(NamedTuple):
    """Increments that lead to each frame."""

    increment: Float[np.ndarray, "T 6"]
    """Δposition (m), Δrotation vector (rad), in the robot frame of the frame before."""
    cov: Float[np.ndarray, "T 6 6"]
    """Their covariance."""
    sensor_shift_m: Float[np.ndarray, "T 3"] | None = None
    """Commanded displacement of the camera in the robot frame since the frame before, m; None: it is fixed."""


def read_odometry(path: str | os.PathLike, frames: Int[np.ndarray, " T"]) -> Odometry:
    """Read an odometry table: one row for each frame, in any order.

    Its columns are `frame`, the increment `dx, dy, dz` (m) and `rx, ry, rz` (rad), and its uncertainty: standard
    deviations `std_dx … std_rz`, or the covariance `cov_dx_dx, cov_dx_dy … cov_rz_rz` (its 21 elements with the first
    name before or equal to the second in that order). Where the camera is moved on the robot, `shift_x, shift_y,
    shift_z` (m) say how far since the frame before.

    Args:
        path: a `.csv` or `.parquet` file.
        frames: numbers of the frames there are, growing.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: as `read_table`; and ValueError for a frame that is there
            twice, lacks, or is none of `frames`, a negative standard deviation, or no uncertainty.
    """
    pairs = [(i, j) for i in range(6) for j in range(i, 6)]
    stds = [f"std_{axis}" for axis in AXES]
    covs = [f"cov_{AXES[i]}_{AXES[j]}" for i, j in pairs]
    kinds: dict[str, Kind] = {"frame": "whole"}
    kinds.update(dict.fromkeys([*AXES, *stds, *covs, *SHIFTS], "real"))
    table = read_table(path, kinds, optional=[*stds, *covs, *SHIFTS])
    given = {"std": [n for n in stds if n in table.columns], "cov": [n for n in covs if n in table.columns]}
    if len(given["std"]) not in (0, 6) or len(given["cov"]) not in (0, 21) or bool(given["std"]) == bool(given["cov"]):
        raise ValueError(
            f"{path}: {len(given['std'])} of 6 standard deviations std_dx … std_rz and {len(given['cov'])} of 21 "
            "elements of a covariance cov_dx_dx … cov_rz_rz; give all of one kind and none of the other."
        )
    shifts = [table[name] for name in SHIFTS if name in table.columns]
    if len(shifts) not in (0, 3):
        raise ValueError(f"{path}: {len(shifts)} of shift_x, shift_y, shift_z; give all three or none.")
    place = np.searchsorted(frames, table["frame"]).clip(max=len(frames) - 1)
    table.refuse_where(frames[place] != table["frame"], "frame", "is no frame of the recording")
    first = np.full(len(frames), table.num_rows)
    np.minimum.at(first, place, np.arange(table.num_rows))
    table.refuse_where(first[place] != np.arange(table.num_rows), "frame", "is there twice; give one row per frame")
    if np.any(lacks := first == table.num_rows):
        raise ValueError(f"{path}: no row for frame {frames[lacks][0]} ({lacks.sum()} such frames)")
    for name in given["std"]:
        table.refuse_where(table[name] < 0, name, "is negative; a standard deviation is at least 0")
    cov = np.zeros((table.num_rows, 6, 6))
    if given["std"]:
        cov[:, range(6), range(6)] = np.column_stack([table[name] for name in stds]) ** 2
    else:
        for (i, j), name in zip(pairs, covs, strict=True):
            cov[:, i, j] = cov[:, j, i] = table[name]
    increment = np.column_stack([table[axis] for axis in AXES])
    return Odometry(increment[first], cov[first], np.column_stack(shifts)[first] if shifts else None)


def write_odometry(path: str | os.PathLike, odometry: Odometry, frames: Int[np.ndarray, " T"] | None = None) -> Path:
    """Write an odometry table, with its covariance; frames count from 0 unless numbered otherwise.

    Raises:
        ValueError: for an ending other than `.csv` and `.parquet`.
        OSError: if the place cannot be written; what was there before stays.
    """
    columns: dict[str, np.ndarray] = {"frame": np.arange(len(odometry.increment)) if frames is None else frames}
    columns |= dict(zip(AXES, np.asarray(odometry.increment).T, strict=True))
    for i in range(6):
        columns |= {f"cov_{AXES[i]}_{AXES[j]}": np.asarray(odometry.cov)[:, i, j] for j in range(i, 6)}
    if odometry.sensor_shift_m is not None:
        columns |= dict(zip(SHIFTS, np.asarray(odometry.sensor_shift_m).T, strict=True))
    return write_table(path, columns)


def from_velocities(
    time_s: Float[np.ndarray, " T"],
    velocity_m_s: Vector,
    rate_rad_s: Vector,
    velocity_std_m_s: float | Float[np.ndarray, "3"],
    rate_std_rad_s: float | Float[np.ndarray, "3"],
) -> Odometry:
    """Odometry from velocities v and rates of turn ω of the robot, in its own frame, measured at each frame.

    Between two frames the mean of their measurements is taken as constant, so that the robot moves on a screw:
    Δθ = ω Δt and Δp = V(Δθ) v Δt, V(θ) = I + (1 - cos θ)/θ² [θ]× + (θ - sin θ)/θ³ [θ]×². To first order in the small
    angle its covariance is diag(σ_v², σ_ω²) Δt². That is the full variance of one measurement and not half of it: each
    measurement counts in two increments, whose errors therefore agree, and so the variance of their sum is right.

    Args:
        time_s: time of each frame, s, growing.
        velocity_m_s: v, m/s.
        rate_rad_s: ω, rad/s.
        velocity_std_m_s: standard deviation of the white noise of v, one number or one for each axis.
        rate_std_rad_s: that of ω.

    Returns:
        Increments; that of the first frame is zero and certain.

    Raises:
        ValueError: for shapes that disagree, times that do not grow, numbers that are not finite, or a negative
            standard deviation.
    """
    time_s, velocity, rate = (np.asarray(x, np.float64) for x in (time_s, velocity_m_s, rate_rad_s))
    for name, values in (("velocity_m_s", velocity), ("rate_rad_s", rate)):
        if values.shape != (len(time_s), 3):
            raise ValueError(f"from_velocities({name}) has shape {values.shape}, but {(len(time_s), 3)} is needed.")
        if len(bad := np.argwhere(~np.isfinite(values))):
            raise ValueError(f"from_velocities({name}{bad[0].tolist()} = {values[tuple(bad[0])]}): must be finite.")
    if len(bad := np.flatnonzero(~(np.diff(time_s) > 0))):
        raise ValueError(f"from_velocities(time_s[{bad[0] + 1}] = {time_s[bad[0] + 1]}): times must grow.")
    std = np.zeros(6)
    for name, value, part in (
        ("velocity_std_m_s", velocity_std_m_s, slice(0, 3)),
        ("rate_std_rad_s", rate_std_rad_s, slice(3, 6)),
    ):
        if not np.all(np.isfinite(value) & (np.asarray(value) >= 0)):
            raise ValueError(f"from_velocities({name}={value}): a standard deviation is at least 0.")
        std[part] = value
    step_s = np.diff(time_s)[:, None]
    turn = 0.5 * (rate[1:] + rate[:-1]) * step_s
    increment = np.zeros((len(time_s), 6))
    increment[1:, :3] = _along_screw(turn, 0.5 * (velocity[1:] + velocity[:-1]) * step_s)
    increment[1:, 3:] = turn
    cov = np.zeros((len(time_s), 6, 6))
    cov[1:, range(6), range(6)] = (std * step_s) ** 2
    return Odometry(increment, cov)


def from_poses(T_w_r: Float[np.ndarray, "T 7"], std: Float[np.ndarray, "6"]) -> Odometry:
    """Odometry from the poses that some other source gives, e.g. wheel odometry: the motion from each to the next.

    Args:
        T_w_r: pose of the robot in each frame, in any world; quaternion (w, x, y, z).
        std: standard deviations of each increment: position (m), rotation (rad).

    Returns:
        Increments; that of the first frame is zero and certain.
    """
    from scipy.spatial.transform import Rotation

    T_w_r = np.array(T_w_r, np.float64)  # SciPy wants it writable
    rotation = Rotation.from_quat(T_w_r[:, 3:], scalar_first=True)
    increment = np.zeros((len(T_w_r), 6))
    increment[1:, :3] = rotation[:-1].apply(np.diff(T_w_r[:, :3], axis=0), inverse=True)
    increment[1:, 3:] = (rotation[:-1].inv() * rotation[1:]).as_rotvec()
    cov = np.zeros((len(T_w_r), 6, 6))
    cov[1:] = np.diag(np.asarray(std, np.float64) ** 2)
    return Odometry(increment, cov)


def unknown_motion(
    time_s: Float[np.ndarray, " T"], velocity_std_m_s: float = 0.5, rate_std_rad_s: float = 0.5
) -> Odometry:
    """Odometry of a robot that has none: no motion, with as much doubt as it may have moved.

    Increments are zero with the covariance diag(σ_v², σ_ω²) Δt²: velocity and rate of turn are unknown and, as the
    filter takes them, new in every frame. A model that carries them from frame to frame knows more.

    Args:
        time_s: time of each frame, s.
        velocity_std_m_s: how fast the robot usually goes along each axis, m/s; the default is a camera in a hand.
        rate_std_rad_s: how fast it turns about each axis, rad/s.
    """
    zero = np.zeros((len(time_s), 3))
    return from_velocities(time_s, zero, zero, velocity_std_m_s, rate_std_rad_s)


def dead_reckoning(recording: Recording) -> Float[np.ndarray, "T 7"]:
    """Pose T_w_r of the robot in each frame by the recording's odometry alone: what a filter is to be better than."""
    from scipy.spatial.transform import Rotation

    start = np.array(recording.robot_start, np.float64)
    place, turn = start[:3], Rotation.from_quat(start[3:], scalar_first=True)
    poses = []
    for increment in np.array(recording.odometry, np.float64):
        place = place + turn.apply(increment[:3])
        turn = turn * Rotation.from_rotvec(increment[3:])
        poses.append([*place, *turn.as_quat(scalar_first=True)])
    return np.array(poses)


def commanded_mounts(recording: Recording) -> Float[np.ndarray, "T 7"]:
    """Pose T_r_s of the camera in the robot in each frame, as it was commanded."""
    mounts = np.tile(np.asarray(recording.sensor_start, np.float64), (recording.num_frames, 1))
    mounts[:, :3] += np.cumsum(np.asarray(recording.sensor_shift_m, np.float64), axis=0)
    return mounts


def _along_screw(turn: Vector, way: Vector) -> Vector:
    """V(θ) p: where the constant motion p (m) ends when the frame turns by θ (rad) on the way."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    is_small = angle < 1e-4  # where the series is exact to rounding
    safe = np.where(is_small, 1.0, angle)
    first = np.where(is_small, 0.5 - angle**2 / 24, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(is_small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    across = np.cross(turn, way)
    return way + first * across + second * np.cross(turn, across)
