"""A recording, filtered: what every frame showed, and where each landmark was when it was last held.

The recording goes through the filter in stretches, so that the device holds a part of it only, and the landmarks that
leave the map, retired or deleted, stay known by their last mean and covariance. What is kept of a frame is what results
are made of; whoever wants all of it iterates over `run_in_stretches`.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from vcjax.filter.config import FilterConfig, check_arguments
from vcjax.filter.info import FrameInfo
from vcjax.filter.known_landmarks import KnownLandmarks
from vcjax.filter.landmark_points import LandmarkPoints, landmark_points
from vcjax.filter.stretches import STRETCH, run_in_stretches
from vcjax.recorded.unfinished import Unfinished, first_frames
from vcjax.recording import Recording

_LEFT_OUT = (
    "carried", "carried_std", "pixel", "innovation", "innovation_cov", "re1_prior", "p_dynamic", "detector",
    "p_detector", "departed",
)  # fmt: skip


class LastPlaces(NamedTuple):
    """Landmarks as points of the world, as they were when they left the map or the recording ended."""

    track_id: Int[np.ndarray, " L"]
    """Identities, growing."""
    place_m: Float[np.ndarray, "L 3"]
    """Place in the world, m."""
    cov: Float[np.ndarray, "L 3 3"]
    """Its covariance to first order, m²."""


class Filtered(NamedTuple):
    """What a filter made of a recording."""

    info: FrameInfo
    """Of every frame, leading axis T, NumPy arrays; None for what no result is made of: the state of the detector,
    soft verdicts, innovations and pixels (RE₁ is there), what the motion model carries, and the landmarks that left the
    map, which are in `landmarks`."""
    landmarks: LastPlaces
    """Every landmark that was ever born; of one born again its last life."""
    compile_s: float
    """How long the first frame and the second took, which is how long they compiled, s."""
    run_s: float
    """How long it took to run, s."""


def filter_recording(
    config: FilterConfig,
    recording: Recording,
    progress: Callable[[int, int], None] | None = None,
    known: KnownLandmarks | None = None,
    *,
    unfinished: Unfinished | None = None,
    length: int = STRETCH,
) -> Filtered:
    """Filter a whole recording, however long.

    Args:
        config: filter configuration; births go by id.
        recording: T frames.
        progress: called with (frames done, T), now and then.
        known: landmarks that are in the map from the start.
        unfinished: where work is kept that takes long, and where the same run goes on if it was stopped; of this
            configuration and recording. It stays until whoever asked removes it.
        length: most frames in a stretch; work is written between two of them.

    Returns: infos as `vcjax.run` gives them, less what `Filtered` leaves out, the map, and the time that it took.

    Raises:
        ValueError: for a recording that no filter can run on, a configuration that needs a key, or unfinished work of
            another run.
    """
    check_arguments("filter_recording", config, None)
    if config.birth_order == "random":
        raise ValueError("filter_recording(birth_order='random'): births of recordings go by id; take 'lowest_id'.")
    run_in_stretches(config, recording, known=known, length=length)  # refuses what cannot be run
    begun = None if unfinished is None else unfinished.read()
    begin = time.perf_counter()
    for _ in run_in_stretches(config, first_frames(recording, 2), known=known, length=length):
        pass
    compiled = time.perf_counter()

    infos, last, state, next_frame, before_s = _Infos(recording.num_frames), _LastPlaces(), None, 0, 0.0
    if begun is not None:
        next_frame, before_s, state, _ = begun
        for info in begun.infos:
            last.note(info.departed)
            infos.append(info)
    unsaved, saved = [], compiled
    going_on = {"length": length, "state": state, "next_frame": next_frame}
    for stretch in run_in_stretches(config, recording, known=known, **going_on):
        last.note(stretch.info.departed)
        infos.append(stretch.info)
        if progress is not None:
            progress(stretch.next_frame, recording.num_frames)
        state = stretch.state
        if unfinished is not None:
            unsaved.append(stretch)
            now, is_done = time.perf_counter(), stretch.next_frame == recording.num_frames
            if now - (compiled if is_done else saved) >= unfinished.every_s:
                done_s = before_s + now - compiled
                unfinished.write(unsaved[0].first_frame, _joined([s.info for s in unsaved]), state, done_s)
                unsaved, saved = [], time.perf_counter()
    last.note(_points(state))
    return Filtered(infos.whole, last.known(), compiled - begin, before_s + time.perf_counter() - compiled)


def _joined(infos: list[FrameInfo]) -> FrameInfo:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *infos)


@jax.jit
def _points(state) -> LandmarkPoints:
    return landmark_points(state)


class _Infos:
    """Collects what is kept of the infos, in arrays of the whole length."""

    whole: FrameInfo

    def __init__(self, num_frames: int):
        self.num_frames, self.next_frame = num_frames, 0

    def append(self, info: FrameInfo) -> None:
        """Keep those of the frames that follow."""
        kept = eqx.tree_at(lambda info: [getattr(info, name) for name in _LEFT_OUT], info, [None] * len(_LEFT_OUT))
        if self.next_frame == 0:
            self.whole = jax.tree.map(lambda leaf: np.empty((self.num_frames, *leaf.shape[1:]), leaf.dtype), kept)
        frames = slice(self.next_frame, self.next_frame + len(info.is_finite))
        for all_, some in zip(jax.tree.leaves(self.whole), jax.tree.leaves(kept), strict=True):
            all_[frames] = some
        self.next_frame = frames.stop


class _LastPlaces:
    """Collects the last places of landmarks."""

    def __init__(self):
        self.places: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def note(self, points: LandmarkPoints) -> None:
        """Note landmarks, later ones in place of earlier ones, those with numbers."""
        track_id, place_m, cov = (np.asarray(leaf) for leaf in (points.track_id, points.place_m, points.cov))
        is_known = (track_id >= 0) & np.isfinite(place_m).all(axis=-1) & np.isfinite(cov).all(axis=(-2, -1))
        for track, place, spread in zip(track_id[is_known].tolist(), place_m[is_known], cov[is_known], strict=True):
            self.places[track] = (place, spread)

    def known(self) -> LastPlaces:
        """Those that were ever noted."""
        ids = sorted(self.places)
        place_m = np.array([self.places[track][0] for track in ids]).reshape(-1, 3)
        return LastPlaces(
            np.array(ids, int), place_m, np.array([self.places[track][1] for track in ids]).reshape(-1, 3, 3)
        )
