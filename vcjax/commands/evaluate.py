"""`vcjax evaluate`: a trajectory, or all of a run, against the truth."""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console

from vcjax.commands.console import say
from vcjax.recorded.run_folder import RunFolder, read_run, run_files
from vcjax.recorded.track_detection import labels_of, track_detection, track_detection_text
from vcjax.recorded.trajectory_error import Trajectory, trajectory_error, trajectory_error_text
from vcjax.recorded.unfinished import digest
from vcjax.recording import AnyArray
from vcjax.sources.image_sequence import camera_of_robot
from vcjax.sources.odometry import commanded_mounts, dead_reckoning
from vcjax.sources.recording_file import RecordingFile, load_recording
from vcjax.sources.trajectory_file import read_trajectory
from vcjax.storage import check_writable, write_file


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Compare a run or a trajectory with the truth: APE and RPE, every alignment named; and found movers by labels."""

    estimate: tyro.conf.Positional[Path]
    """Directory of `vcjax run`, or a trajectory in the format of TUM or KITTI."""
    truth: Path | None = None
    """Recording with truth (.npz), or true poses in the format of TUM or KITTI; the recording that was run if not
    given."""
    truth_of: Literal["robot", "camera"] = "robot"
    """Whose poses are compared: true poses and a trajectory in files must be of it; a recording and a run know both."""
    out: Path | None = None
    """File for what is printed."""

    def __call__(self, console: Console) -> None:
        """Read, compare, print."""
        run = read_run(self.estimate) if self.estimate.is_dir() else None
        path = self._truth_path(run)
        if self.out is not None:
            check_writable(self.out, (path, self.estimate, *run_files(self.estimate)))
        estimate = _trajectory(self.estimate if run is None else self.estimate / f"{self.truth_of}_tum.txt")
        content = load_recording(path) if path.suffix.lower() == ".npz" else None
        if run is not None and content is not None and self.truth is None:
            _refuse_replaced(path, content, run)
        truth = _trajectory(path) if content is None else self._true_path(content)
        parts = []
        if truth is not None:
            told = trajectory_error_text(trajectory_error(estimate, truth))
            parts.append(f"{'poses of':26s} the {self.truth_of}\n{told}")
        if content is not None and truth is not None and np.any(np.asarray(content.recording.odometry)):
            robot, mounts = dead_reckoning(content.recording), commanded_mounts(content.recording)
            alone = self._path(content, robot, mounts)
            parts.append(f"odometry alone\n{trajectory_error_text(trajectory_error(alone, truth))}")
        labels = None if content is None else labels_of(content)
        if run is not None and labels is not None:
            parts.append(track_detection_text(track_detection(run.tracks, labels)))
        if not parts:
            raise ValueError(f"{path}: holds neither true poses nor labels of tracks; give --truth with another file.")
        text = "\n\n".join(parts)
        print(text)
        if self.out is not None:
            say(console, f"wrote {write_file(self.out, f'{text}{chr(10)}'.encode())}")

    def _true_path(self, content: RecordingFile) -> Trajectory | None:
        """True poses, as far as a recording knows them."""
        return None if content.truth is None else self._path(content, content.truth.robot, content.truth.sensor)

    def _path(
        self, content: RecordingFile, robot: Float[AnyArray, "T 7"], mounts: Float[AnyArray, "T 7"]
    ) -> Trajectory:
        """Poses of whatever is compared, at the times of a recording."""
        poses = robot if self.truth_of == "robot" else camera_of_robot(robot, mounts)
        return Trajectory(np.asarray(poses, np.float64), np.asarray(content.recording.time_s, np.float64))

    def _truth_path(self, run: RunFolder | None) -> Path:
        """The file of the truth."""
        if self.truth is not None:
            return self.truth
        recording = None if run is None else run.summary.get("recording")
        if not isinstance(recording, str):
            raise ValueError(f"{self.estimate}: names no recording; give --truth, a recording or a trajectory.")
        if not Path(recording).is_file():
            raise FileNotFoundError(f"{recording}, which was run: no such file; give --truth.")
        return Path(recording)


def _refuse_replaced(path: Path, content: RecordingFile, run: RunFolder) -> None:
    """Refuse a recording other than the one that was run, though its file has the same name."""
    if run.summary.get("recording_sha256", known := digest(content.recording)) != known:
        raise ValueError(f"{path} is not the recording that was run any more; run it again, or give --truth.")


def _trajectory(path: Path) -> Trajectory:
    """A trajectory from a file."""
    time_s, poses = read_trajectory(path)
    return Trajectory(poses, time_s)
