"""The rendered sequence as a recording file, filtered with a small map; what several tests share of it."""

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import jax
import numpy as np
from quick import QUICK
from rendered import rendered, tracked

import vcjax as vc
from vcjax.filter import stretches as module
from vcjax.recorded.filtered import Filtered, filter_recording
from vcjax.sources.recording_file import RecordingFile, load_recording, save_recording
from vcjax.sources.tracks import recording_from_tracks

# The filter as it is, but compiled quickly.
module._first = jax.jit(module._first.__wrapped__, compiler_options=QUICK)
module._advance = jax.jit(module._advance.__wrapped__, compiler_options=QUICK)

OPTIONS = ["--max-landmarks", "40", "--choose-among", "measured", "--births-per-frame", "3", "--pixel-std-px", "0.5"]


def config(**options) -> vc.FilterConfig:
    """The configuration of `OPTIONS`."""
    given = {"max_landmarks": 40, "choose_among": "measured", "births_per_frame": 3, "pixel_std_px": 0.5}
    return vc.FilterConfig(**given | options)


@cache
def content() -> RecordingFile:
    """The recording of the rendered sequence, with true poses, labels and images."""
    world = rendered()
    sequence = world.sequence
    recording = recording_from_tracks(
        tracked(), sequence.calibration, time_s=sequence.time_s, odometry=sequence.odometry
    )
    paths = tuple(str(path) for path in sequence.paths)
    truth = vc.Truth(world.truth.robot, world.truth.sensor, np.zeros((30, 0, 3)), np.zeros(0, bool))
    return RecordingFile(recording, truth, world.followed(tracked()).labels, paths, sequence.calibration)


@cache
def recording_path() -> Path:
    """Its file."""
    return save_recording(Path(mkdtemp()) / "rendered.npz", content())


@cache
def run() -> Filtered:
    """It, filtered by the VC gate."""
    return filter_recording(config(), load_recording(recording_path()).recording)


def position_rms(path: np.ndarray) -> float:
    """RMS distance of a path of the robot from the true one, m."""
    return float(np.sqrt(np.mean(np.sum((path[:, :3] - rendered().truth.robot[:, :3]) ** 2, axis=1))))


def contents(folder) -> dict[str, bytes]:
    """Every file in a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
