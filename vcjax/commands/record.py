"""`vcjax record`: from tables of another front end to a recording."""

import dataclasses
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from vcjax.commands.console import say
from vcjax.sources.overview import summary
from vcjax.sources.recording_file import save_recording
from vcjax.sources.table_recording import record_tables
from vcjax.storage import check_writable


@dataclasses.dataclass(frozen=True)
class Record:
    """Put tables of tracks, odometry, times and labels (CSV, Parquet) and true poses together to a recording."""

    tracks: tyro.conf.Positional[Path]
    """Table with the columns frame, track_id, u, v (px)."""
    calibration: Path
    """Calibration of the camera (JSON)."""
    out: Path = Path("results/recording.npz")
    """File of the recording."""
    odometry: Path | None = None
    """Table with the columns frame, dx, dy, dz (m), rx, ry, rz (rad) and their standard deviations std_dx … std_rz or
    covariance; unknown motion if not given."""
    times: Path | None = None
    """Table with the columns frame and time_s."""
    rate_hz: float | None = None
    """Frames per second, where there is no table of times."""
    truth: Path | None = None
    """True poses in the format of TUM or KITTI."""
    truth_of: Literal["robot", "camera"] = "robot"
    """Whose poses they are."""
    labels: Path | None = None
    """Table with the columns track_id and label: -1 unknown, 0 static, 1 moving, 2 bad."""

    def __call__(self, console: Console) -> None:
        """Read, check, save, say what is in it."""
        tables = self.tracks, self.calibration, self.odometry, self.times, self.truth, self.labels
        check_writable(self.out, tables)
        if (self.times is None) == (self.rate_hz is None):
            raise ValueError("give --times or --rate-hz, one of the two.")
        content = record_tables(
            self.tracks,
            self.calibration,
            self.odometry,
            self.times,
            rate_hz=self.rate_hz,
            truth_file=self.truth,
            truth_of_camera=self.truth_of == "camera",
            labels_file=self.labels,
        )
        path = save_recording(self.out, content)
        print(summary(content))
        say(console, f"wrote {path}")
