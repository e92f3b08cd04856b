"""The folder of a filtered recording: files for other tools, and for `vcjax evaluate`.

| file | |
|---|---|
| `robot_tum.txt`, `robot_kitti.txt` | poses T_w_r of the robot in each frame, in the formats of TUM and KITTI |
| `camera_tum.txt`, `camera_kitti.txt` | poses T_w_c of the camera |
| `landmarks.ply`, `landmarks.csv` | every landmark's last place, class and covariance; see `map_file.py` |
| `verdicts.csv` | frame, track_id, re1, re2, margin, verdict: a row for each measured candidate and each deletion |
| `tracks.csv` | how often each verdict was passed on each track, its largest margin and the detector's |
| `followers.csv` | frame, track_id, x, y, z (m), vx, vy, vz (m/s) and their covariance, of what is followed |
| `summary.json` | the numbers of `run_summary`, and what they come from; written last |

Tables are CSV or Parquet. In columns re1, re2 and of margins nan stands where there was no such number.
"""

import contextlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from vcjax.filter.info import FrameInfo
from vcjax.recorded.filtered import Filtered
from vcjax.recorded.followed import Followed, followed
from vcjax.recorded.verdicts import VERDICTS, TrackVerdicts, Verdicts, classes
from vcjax.recording import Recording
from vcjax.sources.image_sequence import camera_of_robot
from vcjax.sources.map_file import LandmarkMap, write_map
from vcjax.sources.table_file import Kind, read_table, write_table
from vcjax.sources.trajectory_file import read_tum, write_kitti, write_tum
from vcjax.storage import check_writable, filling, write_json

TableFormat = Literal["csv", "parquet"]
TABLES, ENDINGS = ("landmarks", "verdicts", "tracks", "followers"), ("csv", "parquet")
_MARGINS = ("margin", "detector_margin")
_VELOCITY_COV = ("cov_vx_vx", "cov_vx_vy", "cov_vx_vz", "cov_vy_vy", "cov_vy_vz", "cov_vz_vz")
_MAX_JSON_BYTES = 2**24
_SUMMARY = "summary.json"
UNFINISHED = "unfinished"
"""Folder within it, for a run that is not done; see `unfinished.py`."""
_PATHS = ("robot_tum.txt", "robot_kitti.txt", "camera_tum.txt", "camera_kitti.txt")
_FILES = (*_PATHS, "landmarks.ply", "path.png", _SUMMARY)
_STALE = (f"features/{'[0-9]' * 6}.png", "features.gif", "features.mp4", *(f"{t}.{e}" for t in TABLES for e in ENDINGS))


class RunFolder(NamedTuple):
    """What is read back of a folder."""

    time_s: Float[np.ndarray, " T"]
    """Time of each frame, s."""
    robot: Float[np.ndarray, "T 7"]
    """Estimated pose of the robot."""
    tracks: TrackVerdicts
    """What became of each track."""
    summary: dict[str, Any]
    """Numbers of the run; "recording" is the file that it read, "recording_sha256" the `digest` of what it held."""


def landmark_map(filtered: Filtered, tracks: TrackVerdicts) -> LandmarkMap:
    """Every landmark that was ever mapped, with its class."""
    return LandmarkMap(*filtered.landmarks, classes(filtered.landmarks.track_id, tracks))


def robot_poses(info: FrameInfo) -> Float[np.ndarray, "T 7"]:
    """Estimated poses T_w_r of the robot in each frame."""
    return np.asarray(info.vehicle, np.float64)[:, :7]


def camera_poses(info: FrameInfo) -> Float[np.ndarray, "T 7"]:
    """Estimated poses T_w_c = T_w_r T_r_s of the camera in each frame."""
    return camera_of_robot(*np.split(np.asarray(info.vehicle), 2, axis=1))


def run_files(folder: Path) -> list[Path]:
    """What lies in a folder under the names of a run's files, in order; a run that is written there replaces it."""
    return sorted({path for pattern in (*_FILES, *_STALE) for path in folder.glob(pattern)})


def check_place(folder: Path, read: Iterable[Path | None] = ()) -> None:
    """Refuse a folder that a run cannot be written to, or in which it would replace what no run has written.

    Args:
        folder: for the run; there may be a run already, done or not.
        read: files that the run is made of.

    Raises:
        OSError: naming the file that is in the way, and the remedy.
    """
    read = [*read]
    lying = run_files(folder)
    for path in (folder / _SUMMARY, folder / "features" / "000000.png", folder / UNFINISHED / "state.npz", *lying):
        check_writable(path, read)
    is_begun = (folder / UNFINISHED / "state.npz").is_file() or any(folder.glob(".filling.*.tmp"))
    if lying and not is_begun and not _is_run(folder):
        raise FileExistsError(
            f"{lying[0]} is in the way of the run's, and no run has written it: {folder} holds no {_SUMMARY} of one. "
            f"Give another directory, or move it away ({len(lying)} such files)."
        )


@contextlib.contextmanager
def new_run(
    folder: Path,
    recording: Recording,
    filtered: Filtered,
    passed: Verdicts,
    tracks: TrackVerdicts,
    summary: dict[str, Any],
    table: TableFormat = "csv",
) -> Iterator[Path]:
    """Write the files of a run into a folder, with those that the block writes into the one that it is given.

    They get to `folder` when the block ends, the summary last. If anything fails what is there stays. Files of an
    earlier run give way; others stay (see `check_place`).

    Raises:
        ValueError: if the run has numbers that are not finite.
        OSError: if the place cannot be written.
    """
    if summary["first_failure"] is not None:
        raise ValueError(
            f"the run is not finite from frame {summary['first_failure']} on; nothing is written to {folder}. Look at "
            "that frame's odometry and times, or give larger noises."
        )
    time_s = np.asarray(recording.time_s, np.float64)
    poses = {"robot": robot_poses(filtered.info), "camera": camera_poses(filtered.info)}
    with filling(folder, last=_SUMMARY, stale=_STALE) as new:
        for name, T_w_x in poses.items():
            write_tum(new / f"{name}_tum.txt", time_s, T_w_x)
            write_kitti(new / f"{name}_kitti.txt", T_w_x)
        landmarks = landmark_map(filtered, tracks)
        for ending in ("ply", table):
            write_map(new / f"landmarks.{ending}", landmarks)
        columns: dict[str, Any] = passed._asdict() | {"verdict": np.array(VERDICTS)[passed.verdict]}
        write_table(new / f"verdicts.{table}", columns)
        columns = {"track_id": tracks.track_id} | dict(zip(VERDICTS, tracks.counts.T, strict=True))
        margins = {name: getattr(tracks, name) for name in _MARGINS}
        write_table(new / f"tracks.{table}", columns | margins)
        if (moving := followed(filtered.info)) is not None:
            write_table(new / f"followers.{table}", _columns(moving))
        yield new
        write_json(new / _SUMMARY, summary)


def _columns(moving: Followed) -> dict[str, np.ndarray]:
    columns = {"frame": moving.frame, "track_id": moving.track_id}
    columns |= dict(zip("xyz", moving.place_m.T, strict=True))
    columns |= dict(zip(("vx", "vy", "vz"), moving.velocity_m_s.T, strict=True))
    return columns | dict(zip(_VELOCITY_COV, moving.velocity_cov[:, *np.triu_indices(3)].T, strict=True))


def read_run(folder: str | os.PathLike) -> RunFolder:
    """Read the folder of a run back.

    Raises:
        FileNotFoundError: if it holds no complete run.
        ValueError: naming file and place of what cannot be read.
    """
    folder = Path(folder)
    summary = _read_summary(folder)
    time_s, robot = read_tum(folder / "robot_tum.txt")
    kinds: dict[str, Kind] = {
        "track_id": "whole",
        **dict.fromkeys(VERDICTS, "whole"),
        **dict.fromkeys(_MARGINS, "real"),
    }
    paths = [folder / f"tracks.{ending}" for ending in ENDINGS]
    found = read_table(next((path for path in paths if path.is_file()), paths[0]), kinds, undefined=_MARGINS)
    for name in ("track_id", *VERDICTS):
        found.refuse_where(found[name] < 0, name, "is below 0")
    found.refuse_where(np.diff(found["track_id"], prepend=-1) <= 0, "track_id", "is not above the one before")
    counts = np.column_stack([found[name] for name in VERDICTS])
    return RunFolder(time_s, robot, TrackVerdicts(found["track_id"], counts, *(found[n] for n in _MARGINS)), summary)


def _read_summary(folder: Path) -> dict[str, Any]:
    path = folder / _SUMMARY
    if not path.is_file():
        raise FileNotFoundError(f"{folder}: no complete run here ({_SUMMARY} lacks); run `vcjax run` first.")
    try:
        if path.stat().st_size > _MAX_JSON_BYTES:
            raise ValueError("too large")
        summary = json.loads(path.read_text("utf-8"))
        if not isinstance(summary, dict):
            raise ValueError("no JSON object")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: no summary of a run ({error}).") from error
    return summary


def _is_run(folder: Path) -> bool:
    """Whether the summary in a folder is a run's, by what every one of them holds."""
    try:
        return {"recording", "frames", "first_failure"} <= {*_read_summary(folder)}
    except (ValueError, OSError):
        return False
