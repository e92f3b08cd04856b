"""`vcjax track`: from images to a recording."""

import dataclasses
import itertools
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console

from vcjax.commands.console import progress_bar, say
from vcjax.sources.front_end import FrontEnd
from vcjax.sources.image_folder import Layout, read_sequence
from vcjax.sources.image_sequence import ImageSequence, record
from vcjax.sources.odometry import unknown_motion
from vcjax.sources.overview import summary
from vcjax.sources.recording_file import save_recording
from vcjax.sources.tracks import ORIGIN, start_covariance
from vcjax.storage import check_writable


@dataclasses.dataclass(frozen=True)
class Track:
    """Follow corners through the images of a folder and save a recording of them.

    The folder has the layout of TUM RGB-D, EuRoC or KITTI odometry, or just images.
    """

    folder: tyro.conf.Positional[Path]
    """Folder of one sequence."""
    out: Path = Path("results/recording.npz")
    """File of the recording."""
    calibration: Path | None = None
    """Calibration of the camera (JSON); not for EuRoC and KITTI, which have their own."""
    layout: Layout | None = None
    """How the folder is laid out; found out if not given."""
    camera: int = 0
    """Which camera, of EuRoC and KITTI."""
    rate_hz: float | None = None
    """Images per second, where a plain folder has no times.csv."""
    first: int = 0
    """Number of the first image that is used."""
    last: int | None = None
    """Number of the first image that is not used any more."""
    step: int = 1
    """Every how many-th image."""
    start: Literal["origin", "truth"] = "origin"
    """Where the robot starts: in the origin, or where the truth has it in the first image."""
    start_std_m: float = 0.0
    """Standard deviation of that place along each axis, m: above 0 where known points are to correct it."""
    start_std_deg: float = 0.0
    """The same of its orientation about each axis, deg."""
    speed_std_m_s: float = 0.5
    """How fast the robot usually goes along each axis, m/s, where there is no odometry."""
    turn_std_rad_s: float = 0.5
    """How fast it turns about each axis, rad/s, where there is none."""
    front_end: FrontEnd = dataclasses.field(default_factory=FrontEnd)
    """How corners are found and followed."""

    def __call__(self, console: Console) -> None:
        """Read, follow, save, say what came out."""
        # Whatever lies in the folder may be read, but for recordings, which people keep there.
        lying = (path for path in self.folder.rglob("*") if path.suffix.lower() != ".npz")
        check_writable(self.out, itertools.chain((self.calibration,), lying))
        for name, least in (("first", 0), ("step", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"--{name} {getattr(self, name)}: give a whole number of at least {least}.")
        for name in ("start_std_m", "start_std_deg"):
            if not 0 <= (value := getattr(self, name)) < np.inf:
                raise ValueError(f"--{name.replace('_', '-')} {value}: a standard deviation is at least 0.")
        if self.last is not None and self.last <= self.first:
            raise ValueError(f"--last {self.last}: give a number above --first {self.first}.")
        sequence = read_sequence(self.folder, self.layout, self.calibration, self.rate_hz, self.camera)
        sequence = sequence.part(self.first, self.last, self.step)
        odometry = sequence.odometry
        if odometry is None:
            odometry = unknown_motion(sequence.time_s, self.speed_std_m_s, self.turn_std_rad_s)
        start = self._start(sequence)
        with progress_bar(console, "following") as show:
            content = record(
                sequence,
                self.front_end,
                odometry,
                progress=lambda done: show(done, len(sequence)),
                robot_start=start,
                start_cov=start_covariance(
                    np.array(ORIGIN) if start is None else start, self.start_std_m, np.deg2rad(self.start_std_deg)
                ),
            )
        path = save_recording(self.out, content)
        print(summary(content))
        say(console, f"wrote {path}")

    def _start(self, sequence: ImageSequence):
        """Pose of the robot before the first image; None: the origin."""
        if self.start == "origin":
            return None
        poses = sequence.true_robot_poses()
        if poses is None or not (poses[0] == poses[0]).all():
            raise ValueError(f"--start truth: {self.folder} has no true pose of the first image; take --start origin.")
        if sequence.odometry is not None and sequence.odometry.increment[0].any():
            raise ValueError("--start truth: the odometry moves before the first image; take --start origin.")
        return poses[0]
