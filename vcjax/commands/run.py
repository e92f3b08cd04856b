"""`vcjax run`: a recording with one gate and one detector."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console

from vcjax.commands.console import progress_bar, say
from vcjax.commands.simulate import DetectorName, GateName
from vcjax.devices import Cores
from vcjax.filter.config import FilterConfig
from vcjax.recorded import run_folder
from vcjax.recorded.filtered import Filtered, filter_recording
from vcjax.recorded.run_summary import run_summary, run_summary_text
from vcjax.recorded.verdicts import Verdicts, track_verdicts, verdicts
from vcjax.report.feature_pictures import FeaturePictures
from vcjax.report.path_view import path_figure
from vcjax.report.style import write_picture
from vcjax.sources.map_file import LandmarkMap
from vcjax.sources.odometry import dead_reckoning
from vcjax.sources.recording_file import RecordingFile, load_recording
from vcjax.storage import check_writable
from vcjax.study.results import describe


@dataclasses.dataclass(frozen=True)
class Run:
    """Filter a recording with a gate and a detector; write path, landmarks, verdicts, pictures; print a summary."""

    recording: tyro.conf.Positional[Path]
    """Recording file (.npz), as `vcjax track` and `vcjax simulate --recording` write it."""
    config: FilterConfig
    """The filter."""
    gate: GateName = "VC"
    """Update gate: RE (re-projection error), VC (virtual correction) or 1-point RANSAC with rescue."""
    detector: DetectorName = "inlier_ratio"
    """Which landmarks are deleted over time."""
    out: Path | None = None
    """Directory of the results; results/NAME_GATE if not given. Results of an earlier run give way when all is done."""
    table: Literal["csv", "parquet"] = "csv"
    """Format of the tables."""
    pictures: int = 8
    """How many frames are drawn by themselves, spread over the recording."""
    animation: Literal["gif", "mp4", "none"] = "gif"
    """An animation of the frames: a GIF, which is seen everywhere, a video (MPEG-4), which is smaller, or none."""
    animation_frames: int = 100
    """Most frames in it; of a longer recording every so many-th is drawn."""
    devices: Cores = dataclasses.field(default_factory=Cores)
    """Where the run is done."""

    def __call__(self, console: Console) -> None:
        """Read, filter, write, say what came out."""
        if self.pictures < 0:
            raise ValueError(f"--pictures {self.pictures}: give a whole number of at least 0.")
        if self.animation_frames < 1:
            raise ValueError(f"--animation-frames {self.animation_frames}: give at least 1, or --animation none.")
        out = self.out or Path("results") / f"{self.recording.stem}_{self.gate}"
        check_writable(out / "summary.json")
        content = load_recording(self.recording)
        with progress_bar(console, "compiling, filtering") as show:
            filtered = filter_recording(self.config, content.recording, show)
        passed = verdicts(filtered.info)
        tracks = track_verdicts(passed)
        summary: dict[str, Any] = run_summary(self.config, content.recording, filtered, tracks)
        print(run_summary_text(summary), flush=True)
        provenance = {"recording": str(self.recording.absolute()), "config": describe(self.config)}
        with (
            run_folder.new_run(
                out, content.recording, filtered, passed, tracks, summary | provenance, self.table
            ) as new,
            progress_bar(console, "drawing") as show,
        ):
            _draw_path(content, filtered, run_folder.landmark_map(filtered, tracks), new)
            self._draw_features(content, passed, new, console, show)
        say(console, f"wrote {out}")

    def _draw_features(self, content: RecordingFile, passed: Verdicts, new: Path, console: Console, show) -> None:
        """Pictures of some frames, and the animation."""
        drawn = FeaturePictures(content, passed, self.recording.absolute().parent)
        if (missing := drawn.missing_image()) is not None:
            say(console, f"{missing}: no such image; features are drawn on plain axes.")
            drawn.on_plain_axes()
        num_frames = content.recording.num_frames
        alone, moving = _spread(num_frames, self.pictures), range(0)
        if self.animation != "none":
            moving = range(0, num_frames, -(-num_frames // self.animation_frames))
        num = len(alone) + len(moving)
        for done, t in enumerate(alone, 1):
            drawn.write_picture(t, new / "features" / f"{t:06d}.png")
            show(done, num)
        if moving:
            path = new / f"features.{self.animation}"
            drawn.write_animation(moving, path, lambda done, _: show(len(alone) + done, num))


def _draw_path(content: RecordingFile, filtered: Filtered, landmarks: LandmarkMap, new: Path) -> None:
    """The path from above."""
    recording, truth = content.recording, content.truth
    has_odometry = bool(np.any(np.asarray(recording.odometry)))
    figure = path_figure(
        run_folder.robot_poses(filtered.info),
        landmarks,
        dead_reckoning(recording) if has_odometry else None,
        None if truth is None else np.asarray(truth.robot),
    )
    write_picture(figure, new / "path.png")


def _spread(num_frames: int, num: int) -> list[int]:
    """Numbers of `num` frames, as far apart as can be, the last among them."""
    return sorted({int(t) for t in np.linspace(num_frames - 1, 0, num + 1)[:-1].round()})
