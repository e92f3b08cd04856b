"""Feature tracks as a plain table, one row for each sighting, and recordings made from them.

A track table is a CSV or Parquet file with the columns

    frame, track_id, u, v

in any order and among others: frame number, identity of the feature, its pixel in the image as it was taken. Frames
count from 0; a table of times (`frame, time_s`) may number them otherwise, and says which there are.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from vcjax.recording import Recording, last_sightings, validate
from vcjax.sources.calibration import Calibration, read_calibration
from vcjax.sources.distortion import bend, pinhole, straighten
from vcjax.sources.odometry import Odometry, read_odometry, unknown_motion
from vcjax.sources.table_file import Table, read_table, write_table

MAX_BYTES = 2**30
"""Most memory that a recording made here may take: more than an hour of 200 features at 30 Hz."""
_FRAME_BYTES, _ENTRY_BYTES = 400, 26
"""What a frame takes, with its covariance of the odometry, and each of its columns for features."""

ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class Tracks(NamedTuple):
    """Sightings of features, one in each row, in any order."""

    frame: Int[np.ndarray, " N"]
    """Number of the frame, from 0."""
    track_id: Int[np.ndarray, " N"]
    """Identity of the feature, from 0."""
    uv_px: Float[np.ndarray, "N 2"]
    """Pixel in the image as it was taken."""


def read_tracks(path: str | os.PathLike, frames: Int[np.ndarray, " T"] | None = None) -> Tracks:
    """Read a track table.

    Args:
        path: a `.csv` or `.parquet` file with the columns frame, track_id, u, v.
        frames: numbers of the frames there are, growing, as a table of times gives them: frames are then renumbered
            from 0 in their order.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: as `read_table`; and ValueError for a number below 0 or of
            more than 31 bits, a frame that is none of `frames`, or a feature seen twice in a frame, by file and line.
    """
    table = read_table(path, {"frame": "whole", "track_id": "whole", "u": "real", "v": "real"})
    _refuse_bad_numbers(table, ("track_id",) if frames is not None else ("frame", "track_id"))
    frame = table["frame"]
    if frames is not None:
        frame = np.searchsorted(frames, frame).clip(max=len(frames) - 1)
        table.refuse_where(frames[frame] != table["frame"], "frame", "is not in the table of times")
    order = np.lexsort((table["track_id"], frame))
    is_repeated = np.diff(frame[order], prepend=-1) == 0
    is_repeated &= np.diff(table["track_id"][order], prepend=-1) == 0
    if np.any(is_repeated):
        row = int(order[is_repeated].min())
        raise ValueError(
            f"{table.place(row)}: track {table['track_id'][row]} is in frame {table['frame'][row]} already; "
            f"keep one sighting per frame ({is_repeated.sum()} such rows)"
        )
    return Tracks(frame, table["track_id"], np.column_stack([table["u"], table["v"]]))


def write_tracks(path: str | os.PathLike, tracks: Tracks) -> Path:
    """Write a track table, complete or not at all; the ending tells its format.

    Raises:
        ValueError: for an ending other than `.csv` and `.parquet`.
        OSError: if the place cannot be written; what was there before stays.
    """
    u, v = np.asarray(tracks.uv_px, np.float64).T
    return write_table(path, {"frame": tracks.frame, "track_id": tracks.track_id, "u": u, "v": v})


def read_times(path: str | os.PathLike) -> tuple[Int[np.ndarray, " T"], Float[np.ndarray, " T"]]:
    """Read a table of times: the columns frame and time_s (s), both growing from row to row.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: as `read_table`; and ValueError for a negative frame or for
            numbers that do not grow, by file and line.
    """
    table = read_table(path, {"frame": "whole", "time_s": "real"})
    _refuse_bad_numbers(table, ("frame",))
    if table.num_rows == 0:
        raise ValueError(f"{path}: no row; give the time of each frame.")
    for name in ("frame", "time_s"):
        table.refuse_where(np.append(False, np.diff(table[name]) <= 0), name, "is not above the one before")
    return table["frame"], table["time_s"]


def recording_from_tracks(
    tracks: Tracks,
    calibration: Calibration,
    *,
    time_s: Float[np.ndarray, " T"],
    odometry: Odometry,
    robot_start: Float[np.ndarray, "7"] | None = None,
    start_cov: Float[np.ndarray, "14 14"] | None = None,
) -> Recording:
    """A recording of T frames from tracks in them.

    Pixels are straightened into those of the pin-hole camera (see `distortion.py`); where the lens has no inverse they
    are not valid, and NaN.

    Args:
        tracks: sightings, at most one of a track in a frame.
        calibration: of the images.
        time_s: time of each frame, s.
        odometry: increments that lead to each frame, and the commanded displacement of the camera, if it has one.
        robot_start: pose T_w_r before the first frame; the origin.
        start_cov: covariance of robot and sensor pose there; zero.

    Raises:
        ValueError: for a frame beyond the last, for more than `MAX_BYTES`, or what `validate` refuses.
    """
    num_frames = len(time_s)
    frame, track_id = np.asarray(tracks.frame, np.int64), np.asarray(tracks.track_id, np.int64)
    if len(frame) and not (frame.min() >= 0 and frame.max() < num_frames):
        bad = frame[(frame < 0) | (frame >= num_frames)][0]
        raise ValueError(f"recording_from_tracks(tracks): frame {bad}, but there are {num_frames} frames, from 0.")
    uv_px = straighten(calibration, tracks.uv_px)
    order = np.lexsort((track_id, frame))
    frame, track_id, uv_px = frame[order], track_id[order], uv_px[order]

    per_frame = np.bincount(frame, minlength=num_frames)
    num_columns = max(1, int(per_frame.max()))
    _refuse_size("recording_from_tracks(tracks)", num_frames, num_columns)
    column = np.arange(len(frame)) - np.repeat(np.cumsum(per_frame) - per_frame, per_frame)
    shape = (num_frames, num_columns)
    ids, pixels, is_valid = np.zeros(shape, np.int64), np.zeros((*shape, 2)), np.zeros(shape, bool)
    ids[frame, column], pixels[frame, column] = track_id, uv_px
    is_valid[frame, column] = np.isfinite(uv_px[:, 0])
    recording = Recording(
        time_s=np.asarray(time_s, np.float64),
        odometry=odometry.increment,
        odometry_cov=odometry.cov,
        sensor_shift_m=np.zeros((num_frames, 3)) if odometry.sensor_shift_m is None else odometry.sensor_shift_m,
        track_id=ids,
        uv_px=pixels,
        is_valid=is_valid,
        is_last=last_sightings(ids, is_valid),
        camera=pinhole(calibration),
        robot_start=np.array(ORIGIN) if robot_start is None else robot_start,
        sensor_start=np.array(calibration.T_r_s),
        start_cov=np.zeros((14, 14)) if start_cov is None else start_cov,
    )
    validate(recording)
    return recording


def start_covariance(robot_start: Float[np.ndarray, "7"], std_m: float, std_rad: float) -> Float[np.ndarray, "14 14"]:
    """Covariance of a start that is known up to these standard deviations, of robot and sensor pose.

    That of the quaternion is G Gᵀ σ², with G the derivative of ½ (0, θ) ⊗ q by a small turn θ. The sensor's pose is
    certain.
    """
    w, x, y, z = np.asarray(robot_start, np.float64)[3:]
    G = 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])
    cov = np.zeros((14, 14))
    cov[:3, :3] = std_m**2 * np.eye(3)
    cov[3:7, 3:7] = std_rad**2 * G @ G.T
    return cov


def tracks_of(recording: Recording, calibration: Calibration | None = None) -> Tracks:
    """The sightings in a recording, by frame and identity: the inverse of `recording_from_tracks`.

    Args:
        recording: of any origin.
        calibration: of the images, for pixels as they were taken; without it, those of the recording's own camera.
    """
    is_valid, track_id = np.asarray(recording.is_valid), np.asarray(recording.track_id)
    frame, column = np.nonzero(is_valid)
    order = np.lexsort((track_id[frame, column], frame))
    frame, column = frame[order], column[order]
    uv_px = np.asarray(recording.uv_px, np.float64)[frame, column]
    return Tracks(frame, track_id[frame, column], uv_px if calibration is None else bend(calibration, uv_px))


def read_recording(
    tracks_file: str | os.PathLike,
    calibration_file: str | os.PathLike,
    odometry_file: str | os.PathLike | None = None,
    times_file: str | os.PathLike | None = None,
    *,
    rate_hz: float | None = None,
    odometry: Odometry | None = None,
) -> Recording:
    """A recording from files: tracks, calibration, and as far as there are, odometry and times.

    Args:
        tracks_file: see `read_tracks`.
        calibration_file: see `calibration.py`.
        odometry_file: see `odometry.read_odometry`.
        times_file: see `read_times`.
        rate_hz: frames per second, where there is no table of times; frames then go from 0 to the last one named.
        odometry: where there is no table of odometry, e.g. of `odometry.unknown_motion`; without both, the motion is
            taken as unknown.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: naming file, line, column and value, as the readers do.
    """
    if (times_file is None) == (rate_hz is None):
        raise ValueError("read_recording: give times_file or rate_hz, one of the two.")
    if odometry_file is not None and odometry is not None:
        raise ValueError("read_recording: give odometry_file or odometry, one of the two.")
    if rate_hz is not None and not 0 < rate_hz < np.inf:
        raise ValueError(f"read_recording(rate_hz={rate_hz}): give a positive number.")
    calibration = read_calibration(calibration_file)
    if times_file is not None:
        frames, time_s = read_times(times_file)
        tracks = read_tracks(tracks_file, frames)
    else:
        tracks = read_tracks(tracks_file)
        num_frames = int(tracks.frame.max()) + 1 if len(tracks.frame) else 1
        _refuse_size(f"{tracks_file}: frame {num_frames - 1} is the last", num_frames, 1)
        frames = np.arange(num_frames)
        time_s = frames / float(rate_hz or 1.0)
    if odometry_file is not None:
        odometry = read_odometry(odometry_file, frames)
    return recording_from_tracks(tracks, calibration, time_s=time_s, odometry=odometry or unknown_motion(time_s))


def _refuse_bad_numbers(table: Table, names: tuple[str, ...]) -> None:
    """Refuse frames and ids below 0 or of more than 31 bits."""
    for name in names:
        table.refuse_where(table[name] < 0, name, "is below 0")
        table.refuse_where(table[name] >= 2**31, name, "does not fit in 31 bits; number them from 0")


def _refuse_size(what: str, num_frames: int, num_columns: int) -> None:
    """Refuse a recording that would take more than `MAX_BYTES`, before it is made."""
    needed = num_frames * (_FRAME_BYTES + num_columns * _ENTRY_BYTES)
    if needed > MAX_BYTES:
        raise ValueError(
            f"{what}: {num_frames} frames of up to {num_columns} features need {needed / 2**20:.0f} MiB of memory, "
            f"more than {MAX_BYTES / 2**20:.0f}; number frames from 0 without gaps, cut the sequence, or thin its "
            "fullest frames."
        )
