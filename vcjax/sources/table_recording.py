"""A recording from tables, with all that is known beside it: tracks, calibration, odometry, true poses, labels.

A label table is a CSV or Parquet file with the columns `track_id` and `label`, a number of `TrackLabel`: -1 unknown,
0 static, 1 moving, 2 bad. Tracks that it does not name are unknown.
"""

import os
from typing import Any

import numpy as np

from vcjax.recording import Truth
from vcjax.sources.calibration import read_calibration
from vcjax.sources.image_sequence import PoseTruth, interpolated, robot_of_camera
from vcjax.sources.odometry import commanded_mounts
from vcjax.sources.recording_file import RecordingFile, TrackLabel, TrackLabels
from vcjax.sources.table_file import read_table, write_table
from vcjax.sources.tracks import read_recording
from vcjax.sources.trajectory_file import read_trajectory


def read_labels(path: str | os.PathLike) -> TrackLabels:
    """Read a label table.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: as `read_table`; and ValueError for a number below 0 or of
            more than 31 bits, a label that is none, or a track that is there twice, by file and line.
    """
    table = read_table(path, {"track_id": "whole", "label": "whole"})
    ids, label = table["track_id"], table["label"]
    table.refuse_where((ids < 0) | (ids >= 2**31), "track_id", "is no identity; they are numbered from 0 to 2³¹ - 1")
    known = ", ".join(f"{x:d} {x.name}" for x in TrackLabel)
    table.refuse_where(~np.isin(label, list(TrackLabel)), "label", f"is none; give one of {known}")
    is_first = np.zeros(len(ids), bool)
    is_first[np.unique(ids, return_index=True)[1]] = True
    table.refuse_where(~is_first, "track_id", "is there twice; give each track one label")
    return TrackLabels(ids, label)


def write_labels(path: str | os.PathLike, labels: TrackLabels) -> Any:
    """Write a label table, complete or not at all; the ending tells its format.

    Raises:
        ValueError: for an ending other than `.csv` and `.parquet`.
        OSError: if the place cannot be written; what was there before stays.
    """
    return write_table(path, {"track_id": np.asarray(labels.track_id), "label": np.asarray(labels.label)})


def record_tables(
    tracks_file: str | os.PathLike,
    calibration_file: str | os.PathLike,
    odometry_file: str | os.PathLike | None = None,
    times_file: str | os.PathLike | None = None,
    *,
    rate_hz: float | None = None,
    truth_file: str | os.PathLike | None = None,
    truth_of_camera: bool = False,
    labels_file: str | os.PathLike | None = None,
) -> RecordingFile:
    """A recording from files, with true poses and labels as far as there are.

    True poses are in the world that they are given in, and the robot starts in the origin: nothing is aligned.

    Args:
        tracks_file, calibration_file, odometry_file, times_file, rate_hz: see `tracks.read_recording`.
        truth_file: true poses, of TUM's format, at times of the same clock; or of KITTI's, one for each frame.
        truth_of_camera: whether they are of the camera, whose pose in the robot the calibration states.
        labels_file: see `read_labels`.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: naming file, line, column and value, as the readers do.
    """
    recording = read_recording(tracks_file, calibration_file, odometry_file, times_file, rate_hz=rate_hz)
    calibration = read_calibration(calibration_file)
    labels = None if labels_file is None else read_labels(labels_file)
    if truth_file is None:
        return RecordingFile(recording, None, labels, None, calibration)
    frame_time_s = np.asarray(recording.time_s, np.float64)
    time_s, poses = read_trajectory(truth_file)
    if time_s is not None:
        poses = interpolated(PoseTruth(time_s, poses, of="robot"), frame_time_s)
    elif len(poses) != len(frame_time_s):
        raise ValueError(f"{truth_file}: {len(poses)} poses without times for {len(frame_time_s)} frames.")
    mounts = commanded_mounts(recording)
    if truth_of_camera:
        poses = robot_of_camera(poses, mounts)
    truth = Truth(poses, mounts, np.zeros((len(poses), 0, 3)), np.zeros(0, bool))
    return RecordingFile(recording, truth, labels, None, calibration)
