"""A whole recording in one compiled program: `start`, then a scan of `step`, with every frame's info at the end."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from vcjax.filter.config import FilterConfig, check_arguments
from vcjax.filter.info import FrameInfo
from vcjax.filter.known_landmarks import KnownLandmarks, check_known
from vcjax.filter.slam import start, step
from vcjax.filter.state import FilterState
from vcjax.recording import Recording, validate


def run(
    config: FilterConfig,
    recording: Recording,
    key: PRNGKeyArray | None = None,
    known: KnownLandmarks | None = None,
) -> tuple[FilterState, FrameInfo]:
    """Filter a whole recording.

    Args:
        config: filter configuration.
        recording: T frames.
        key: for a random order of births, and only then.
        known: landmarks that are in the map from the start.

    Returns: the final state, and the info of every frame (leading axis T).

    Raises:
        ValueError: for a recording that no filter can run on (see `recording.validate`), or known landmarks that make
            no map, before anything compiles.
    """
    check_arguments("run", config, key)
    validate(recording)
    if known is not None:
        check_known(config, known)
    return _run(config, recording, key, known)


@jax.jit
def _run(config, recording, key, known):
    state, first = start(config, recording, key, known)

    def advance(state, t):
        return step(config, state, recording.frame(t))

    if config.reverse_mode:
        state, rest = _scan_in_stretches(advance, state, recording.num_frames)
    else:
        state, rest = jax.lax.scan(advance, state, jnp.arange(1, recording.num_frames))
    return state, jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)


def _scan_in_stretches(advance, state, num_frames: int):
    """Scan of frames 1 … T - 1 that keeps about √T states for the way back, and passes through each stretch again."""
    length = math.isqrt(num_frames - 1) + 1
    num = -(-(num_frames - 1) // length)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(advance, state, 0)[1])

    def advance_or_stay(state, t):  # the last stretch may be longer than what is left
        return jax.lax.cond(t < num_frames, advance, lambda state, t: (state, nothing), state, t)

    def stretch(state, frames):
        return jax.lax.scan(advance_or_stay, state, frames)

    frames = jnp.arange(1, 1 + num * length).reshape(num, length)
    state, infos = jax.lax.scan(jax.checkpoint(stretch), state, frames)
    return state, jax.tree.map(lambda a: a.reshape(num * length, *a.shape[2:])[: num_frames - 1], infos)
