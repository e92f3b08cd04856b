"""A recording, filtered frame by frame: what every frame showed, and where each landmark was when it was last held.

The state is stepped from frame to frame on the host, so that memory holds one state however long the recording is, and
the landmarks that leave the map, retired or deleted, stay known by their last mean and covariance.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vcjax.filter.config import FilterConfig, check_arguments
from vcjax.filter.info import FrameInfo
from vcjax.filter.slam import start, step
from vcjax.filter.state import FilterState, landmark_cov
from vcjax.models.landmarks import to_point, to_point_jacobian
from vcjax.recording import Frame, Recording, validate

_FRAMES_AT_ONCE = 64
"""How many frames' infos wait before they are fetched from the device."""


class LastPlaces(NamedTuple):
    """Landmarks as points of the world, as they were at the end of the last frame that the map held them."""

    track_id: Int[np.ndarray, " L"]
    """Identities, growing."""
    place_m: Float[np.ndarray, "L 3"]
    """Place in the world, m."""
    cov: Float[np.ndarray, "L 3 3"]
    """Its covariance to first order, m²."""


class Filtered(NamedTuple):
    """What a filter made of a recording."""

    info: FrameInfo
    """Of every frame, leading axis T, NumPy arrays."""
    landmarks: LastPlaces
    """Every landmark that the map ever held at the end of a frame."""
    compile_s: float
    """How long the first frame and the second took, which is how long they compiled, s."""
    run_s: float
    """How long it took to run, s."""


def filter_recording(
    config: FilterConfig, recording: Recording, progress: Callable[[int, int], None] | None = None
) -> Filtered:
    """Filter a whole recording, however long.

    Args:
        config: filter configuration; births go by id.
        recording: T frames.
        progress: called with (frames done, T), now and then.

    Returns: infos as `vcjax.run` gives them, the map, and the time that it took.

    Raises:
        ValueError: for a recording that no filter can run on, or a configuration that needs a key.
    """
    check_arguments("filter_recording", config, None)
    validate(recording)
    if config.birth_order == "random":
        raise ValueError("filter_recording(birth_order='random'): births of recordings go by id; take 'lowest_id'.")
    num_frames = recording.num_frames
    begin = time.perf_counter()
    # Once round to compile; what is compiled already is not compiled again.
    state, shown = _start(config, recording)
    if num_frames > 1:
        state, shown = _advance(config, state, _frame(recording, 1))
    jax.block_until_ready(shown)
    compiled = time.perf_counter()

    last = _LastPlaces(recording)
    state, shown = _start(config, recording)
    waiting, infos = [shown], []
    for t in range(1, num_frames + 1):
        if len(waiting) == _FRAMES_AT_ONCE or t == num_frames:
            fetched = jax.device_get(waiting)
            for info, places, covs in fetched:
                infos.append(info)
                last.note(info.track_id, places, covs)
            waiting = []
            if progress is not None:
                progress(len(infos), num_frames)
        if t < num_frames:
            state, shown = _advance(config, state, _frame(recording, t))
            waiting.append(shown)
    info = jax.tree.map(lambda *leaves: np.stack(leaves), *infos)
    return Filtered(info, last.known(), compiled - begin, time.perf_counter() - compiled)


def _frame(recording: Recording, t: int) -> Frame:
    """Frame t, cut out on the host where the recording is there."""
    names = [field.name for field in dataclasses.fields(Frame) if field.name != "camera"]
    return Frame(camera=recording.camera, **{name: jnp.asarray(getattr(recording, name)[t]) for name in names})


def _shown(state: FilterState, info: FrameInfo) -> tuple[FrameInfo, Float[Array, "L 3"], Float[Array, "L 3 3"]]:
    """What is kept of a frame: its info, and each slot's landmark as a point with its covariance, J P Jᵀ."""
    J = jax.vmap(to_point_jacobian)(state.landmarks)
    return info, jax.vmap(to_point)(state.landmarks), J @ landmark_cov(state) @ J.mT


@jax.jit
def _start(config: FilterConfig, recording: Recording):
    state, info = start(config, recording)
    return state, _shown(state, info)


def _step(config: FilterConfig, state: FilterState, frame: Frame):
    state, info = step(config, state, frame)
    return state, _shown(state, info)


_advance = jax.jit(_step, donate_argnums=1)


class _LastPlaces:
    """Collects the last places of landmarks, frame by frame."""

    def __init__(self, recording: Recording):
        self.ids = np.unique(np.asarray(recording.track_id)[np.asarray(recording.is_valid)])
        self.place_m, self.cov = np.full((len(self.ids), 3), np.nan), np.full((len(self.ids), 3, 3), np.nan)

    def note(self, track_id: np.ndarray, place_m: np.ndarray, cov: np.ndarray) -> None:
        """Note the landmarks that the slots hold at the end of a frame, those with numbers."""
        is_known = (track_id >= 0) & np.isfinite(place_m).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
        index = np.searchsorted(self.ids, track_id[is_known])
        self.place_m[index], self.cov[index] = place_m[is_known], cov[is_known]

    def known(self) -> LastPlaces:
        """Those that were ever noted."""
        is_known = np.isfinite(self.place_m[:, 0])
        return LastPlaces(self.ids[is_known], self.place_m[is_known], self.cov[is_known])
