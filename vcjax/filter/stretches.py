"""Long recordings in stretches: the same numbers as `run`, with memory for one stretch however long the recording is.

`run` keeps the infos of all frames on the device until it ends. Here a recording stays on the host, the device gets a
stretch of frames at a time, and hands back their infos; whoever iterates writes them out, or forgets them. What was
filtered so far is all in the state, so a run can be taken up again after any stretch.
"""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from vcjax.fields import require_kind
from vcjax.filter.config import FilterConfig, check_arguments
from vcjax.filter.info import FrameInfo
from vcjax.filter.known_landmarks import KnownLandmarks, check_known
from vcjax.filter.slam import start, step
from vcjax.filter.state import FilterState
from vcjax.recording import PER_FRAME, Recording, validate

STRETCH = 128
"""Frames in a stretch, unless told otherwise."""


class Stretch(NamedTuple):
    """Some frames of a run."""

    first_frame: int
    """Number of the first of them."""
    state: FilterState
    """State after the last of them, NumPy arrays (but for the key)."""
    info: FrameInfo
    """Their infos, leading axis the frames, NumPy arrays."""

    @property
    def next_frame(self) -> int:
        """Number of the frame after the last."""
        return self.first_frame + len(self.info.is_finite)


def run_in_stretches(
    config: FilterConfig,
    recording: Recording,
    key: PRNGKeyArray | None = None,
    known: KnownLandmarks | None = None,
    *,
    length: int = STRETCH,
    state: FilterState | None = None,
    next_frame: int = 0,
) -> Iterator[Stretch]:
    """Filter a recording stretch by stretch. State and infos are those of `run`, to the bit.

    Two programs are compiled, one for the first frame and one for stretches of any number of frames up to `length`;
    another recording of as many columns uses them again.

    Args:
        config: filter configuration.
        recording: T frames; in NumPy arrays, as files are read, it stays on the host.
        key: for a random order of births, and only then.
        known: landmarks that are in the map from the start.
        length: most frames in a stretch.
        state: to go on with where an earlier run stopped, its last stretch's state; with it
        next_frame: the number of the frame after that stretch.

    Yields: the stretches in order.

    Raises:
        ValueError: for a recording that no filter can run on, a length below 1, or a state without the number of a
            frame to go on with; when the function is called, before anything compiles.
    """
    check_arguments("run_in_stretches", config, key)
    validate(recording)
    if known is not None:
        check_known(config, known)
    if not (isinstance(length, int) and length >= 1):
        raise ValueError(f"run_in_stretches(length={length!r}): give a whole number of frames of at least 1.")
    if state is not None:
        require_kind("run_in_stretches", "state", state, FilterState, "give the state of a Stretch.")
    if (state is None) != (next_frame == 0) or not 0 <= next_frame <= recording.num_frames:
        raise ValueError(
            f"run_in_stretches(next_frame={next_frame}) with {'no state' if state is None else 'a state'} and "
            f"{recording.num_frames} frames: give both state and next_frame of a Stretch, or neither."
        )
    return _stretches(config, recording, key, known, length, state, next_frame)


def _stretches(config, recording, key, known, length, state, next_frame) -> Iterator[Stretch]:
    while next_frame < recording.num_frames:
        first_frame, next_frame = next_frame, min(recording.num_frames, next_frame + length)
        begun = []
        if state is None:
            state, info = _first(config, _cut(recording, 0, 1, 1), key, known)
            begun = [jax.tree.map(lambda leaf: np.asarray(leaf)[None], info)]
        # Frames count from one before the first that is filtered here, from which its time step is taken.
        before = first_frame - 1 + len(begun)
        num = next_frame - before
        if num > 1:
            state, infos = _advance(config, state, _cut(recording, before, next_frame, length + 1), num)
            begun.append(jax.tree.map(lambda leaf, num=num: np.asarray(leaf)[1:num], infos))
        # A copy for whoever keeps it: on a CPU the array of a device may be the very memory it works in.
        kept = jax.tree.map(lambda leaf: leaf if _is_key(leaf) else np.array(leaf), state)
        yield Stretch(first_frame, kept, jax.tree.map(lambda *leaves: np.concatenate(leaves), *begun))


def _cut(recording: Recording, first: int, until: int, length: int) -> Recording:
    """Frames `first` to `until` of a recording, filled up to a length with the last of them."""
    index = np.minimum(np.arange(first, first + length), until - 1)

    def of_frames(recording):
        return [getattr(recording, name) for name in PER_FRAME]

    return eqx.tree_at(of_frames, recording, [np.asarray(leaf)[index] for leaf in of_frames(recording)])


@jax.jit
def _first(config, recording, key, known) -> tuple[FilterState, FrameInfo]:
    return start(config, recording, key, known)


@jax.jit
def _advance(config: FilterConfig, state: FilterState, frames: Recording, num) -> tuple[FilterState, FrameInfo]:
    """Frames 1 to num - 1; the infos of the others are zero."""
    shapes = jax.eval_shape(lambda state: step(config, state, frames.frame(0))[1], state)
    infos = jax.tree.map(lambda leaf: jnp.zeros((frames.num_frames, *leaf.shape), leaf.dtype), shapes)

    def advance(t, carry):
        state, infos = carry
        state, info = step(config, state, frames.frame(t))
        return state, jax.tree.map(lambda all_, one: jax.lax.dynamic_update_index_in_dim(all_, one, t, 0), infos, info)

    return jax.lax.fori_loop(1, num, advance, (state, infos))


def _is_key(leaf) -> bool:
    return isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
