"""`vcjax run`: a recording with one gate and one detector."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import numpy as np
import tyro
from rich.console import Console

from vcjax.commands.console import progress_bar, say
from vcjax.commands.simulate import DetectorName, GateName
from vcjax.devices import Cores
from vcjax.filter.config import FilterConfig
from vcjax.filter.known_landmarks import KnownLandmarks
from vcjax.recorded import run_folder
from vcjax.recorded.filtered import Filtered, filter_recording
from vcjax.recorded.run_summary import run_summary, run_summary_text
from vcjax.recorded.scale import KnownDistance, check_known_distance, found_distance, scale_source, scaled
from vcjax.recorded.unfinished import Unfinished, digest
from vcjax.recorded.verdicts import Verdicts, track_verdicts, verdicts
from vcjax.report.feature_pictures import FeaturePictures
from vcjax.report.path_view import path_figure
from vcjax.report.style import write_picture
from vcjax.sources.known_points import read_known_points
from vcjax.sources.map_file import LandmarkMap
from vcjax.sources.odometry import dead_reckoning
from vcjax.sources.recording_file import RecordingFile, load_recording
from vcjax.sources.repeats import CutRecording, cut_recording
from vcjax.sources.warnings import NO_ODOMETRY
from vcjax.study.results import describe

MotionName = Literal["odometry", "biased_odometry", "constant_velocity"]


@dataclasses.dataclass(frozen=True)
class Lengths:
    """What is known of lengths in the world, where odometry does not give the scale."""

    known: Path | None = None
    """Table (CSV, Parquet) of points of known place: x, y, z (m, in the world of the start), and track_id, or u, v (px)
    in the first image. They are in the map from the start."""
    known_std_m: float = 0.005
    """Standard deviation of these places along each axis, m."""
    known_distance: tuple[int, int, float] | None = None
    """Two tracks and the distance between them, m: what comes out is multiplied to fit it."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Filter a recording with a gate and a detector; write path, landmarks, verdicts, pictures; print a summary.

    If it is stopped, the same command goes on where it was.
    """

    recording: tyro.conf.Positional[Path]
    """Recording file (.npz), as `vcjax track` and `vcjax simulate --recording` write it."""
    config: FilterConfig
    """The filter."""
    gate: GateName = "VC"
    """Update gate: RE (re-projection error), VC (virtual correction) or 1-point RANSAC with rescue."""
    detector: DetectorName = "inlier_ratio"
    """Which landmarks are deleted over time."""
    motion: MotionName = "odometry"
    """What leads the robot: the recording's odometry, the same less a bias that is estimated, or its velocity, which
    needs none."""
    cut_repeats: bool = False
    """Cut tracks where they repeat a pixel to the last bit; see `vcjax inspect`."""
    lengths: Lengths = dataclasses.field(default_factory=Lengths)
    """What is known of lengths."""
    out: Path | None = None
    """Directory of the results; results/NAME_GATE if not given. Results of an earlier run give way when all is done;
    where other files lie in their way nothing is run."""
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
        run_folder.check_place(out, [self.recording, self.lengths.known])
        content = load_recording(self.recording)
        cut = cut_recording(content.recording) if self.cut_repeats else None
        known, distance = self._known(content, cut)
        source = scale_source(self.config.motion, content.recording, known)
        if distance is not None:
            check_known_distance(distance, content.recording, source)
        if self.config.motion.gives_scale and not np.any(np.asarray(content.recording.odometry)):
            say(console, NO_ODOMETRY)
        recording = content.recording if cut is None else cut.recording
        unfinished = Unfinished(out / run_folder.UNFINISHED, self.config, recording, known)
        with progress_bar(console, "compiling, filtering") as show:
            filtered = filter_recording(self.config, recording, show, known, unfinished=unfinished)
        if cut is not None:
            filtered = _by_tracks(filtered, cut)
        scale = {"scale": "free" if source is None else f"known from {source}", "scale_factor": 1.0}
        if distance is not None:
            factor = distance.distance_m / found_distance(distance, filtered.landmarks)
            filtered = scaled(filtered, factor)
            tracks = " and ".join(map(str, distance.track_id))
            scale = {"scale": f"known from {distance.distance_m:g} m between tracks {tracks}", "scale_factor": factor}
        passed = verdicts(filtered.info)
        tracks = track_verdicts(passed, filtered.info)
        cuts = {"tracks_cut": None if cut is None else cut.num_cuts}
        summary: dict[str, Any] = run_summary(self.config, content.recording, filtered, tracks) | scale | cuts
        print(run_summary_text(summary), flush=True)
        provenance = {
            "recording": str(self.recording.absolute()),
            "recording_sha256": digest(content.recording),
            "config": describe(self.config),
        }
        with (
            run_folder.new_run(
                out, content.recording, filtered, passed, tracks, summary | provenance, self.table
            ) as new,
            progress_bar(console, "drawing") as show,
        ):
            _draw_path(content, filtered, run_folder.landmark_map(filtered, tracks), new)
            self._draw_features(content, passed, new, console, show)
        unfinished.remove()
        say(console, f"wrote {out}")

    def _known(
        self, content: RecordingFile, cut: CutRecording | None
    ) -> tuple[KnownLandmarks | None, KnownDistance | None]:
        """What is known of lengths, in the filter's terms: known points are what their tracks followed at first."""
        known = distance = None
        if not 0 < self.lengths.known_std_m < np.inf:
            raise ValueError(f"--known-std-m {self.lengths.known_std_m}: give a positive number of metres.")
        if self.lengths.known is not None:
            track_id, place_m = read_known_points(self.lengths.known, content)
            track_id = track_id if cut is None else cut.first_piece_of(track_id)
            known = KnownLandmarks(track_id, place_m, self.lengths.known_std_m)
        if self.lengths.known_distance is not None:
            first, second, distance_m = self.lengths.known_distance
            distance = KnownDistance((first, second), distance_m)
        return known, distance

    def _draw_features(self, content: RecordingFile, passed: Verdicts, new: Path, console: Console, show) -> None:
        """Pictures of some frames, and the animation."""
        drawn = FeaturePictures(content, passed, self.recording.absolute().parent)
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
        if drawn.unread:
            t, why = min(drawn.unread.items())
            counted = f"{len(drawn.unread)} frames, first " if len(drawn.unread) > 1 else ""
            say(console, f"drawn on plain axes: {counted}frame {t}: {why}")


def _by_tracks(filtered: Filtered, cut: CutRecording) -> Filtered:
    """What the filter says of pieces of tracks, said of the tracks of the file."""

    def ids(info):
        found = info.candidate_id, info.watched_id, info.inconsistent_id, info.born_id, info.track_id
        return found if info.followers is None else (*found, info.followers.track_id, info.handed_back_id)

    info = eqx.tree_at(ids, filtered.info, jax.tree.map(cut.track_of, ids(filtered.info)))
    landmarks = filtered.landmarks
    track_id = cut.track_of(landmarks.track_id)
    last = len(track_id) - 1 - np.unique(track_id[::-1], return_index=True)[1]  # pieces are numbered in order of time
    return filtered._replace(info=info, landmarks=type(landmarks)(track_id[last], *(x[last] for x in landmarks[1:])))


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
