"""Filter runs for the tests, frame by frame: one compilation for each static configuration, shared by all files."""

import dataclasses
from collections.abc import Iterator
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from quick import QUICK

from vcjax.filter import slam
from vcjax.filter.config import FilterConfig
from vcjax.filter.info import FrameInfo
from vcjax.filter.state import SLOT, VEHICLE, FilterState, full_cov, landmark_cov
from vcjax.recording import Frame, Recording
from vcjax.simulation.scenarios import paper
from vcjax.simulation.simulate import simulate

CAPACITY = 112
"""Slots enough for every landmark that 160 frames of the paper's scenarios give birth to."""


quick_jit = partial(jax.jit, compiler_options=QUICK)
start, step, predict = quick_jit(slam.start), quick_jit(slam.step), quick_jit(slam.predict)
simulate_once = quick_jit(simulate)


def zero_tangent(tree):
    """A tangent of zeros, None where a leaf is no real number."""
    is_real = partial(jnp.issubdtype, arg2=jnp.inexact)
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype) if is_real(x.dtype) else None, tree)


def derivative(function, primals: tuple, tangents: tuple):
    """function(*primals) and its derivative, a tangent with a zero for every real number that has none."""
    out, d_out = eqx.filter_jvp(function, primals, tangents)
    return out, eqx.combine(d_out, zero_tangent(out))


start_jvp = quick_jit(partial(derivative, slam.start))
step_jvp = quick_jit(partial(derivative, slam.step))


@cache
def recorded(seed: int, **scenario) -> Recording:
    """A recording of one of the paper's scenarios, kept in NumPy."""
    recording, _ = simulate_once(paper(**scenario), jax.random.key(seed))
    return jax.device_get(recording)


def part(recording: Recording, first: int, end: int) -> Recording:
    """Frames first ≤ t < end of a recording. (`is_last` still tells of the whole.)"""
    once = ("camera", "robot_start", "sensor_start", "start_cov")
    fields = {k: v if k in once else v[first:end] for k, v in vars(recording).items()}
    return dataclasses.replace(recording, **fields)


def head(recording: Recording, num_frames: int) -> Recording:
    """The first frames of a recording."""
    return part(recording, 0, num_frames)


def frame_of(recording: Recording, t: int) -> Frame:
    """Frame t. Cut out before it goes to the device, so that recordings of all lengths share what that compiles."""
    frame = part(recording, t, t + 1).frame(0)
    step_s = recording.time_s[t] - recording.time_s[t - 1] if t else 0.0
    return dataclasses.replace(frame, time_step_s=jnp.asarray(step_s, frame.time_step_s.dtype))


def filtered(
    config: FilterConfig, recording: Recording, key=None, start=start, step=step
) -> Iterator[tuple[FilterState, FrameInfo]]:
    """State and info (in NumPy) of every frame, as `run` has them; runs of all lengths share their compilation."""
    state, info = start(config, head(recording, 1), key)
    yield state, jax.device_get(info)
    for t in range(1, recording.num_frames):
        state, info = step(config, state, frame_of(recording, t))
        yield state, jax.device_get(info)


def ids(track_id) -> list[int]:
    """The ids in an array where -1 stands for none."""
    return [int(i) for i in track_id if i >= 0]


def landmarks(state: FilterState) -> dict[int, tuple[str, np.ndarray, np.ndarray]]:
    """The map by id: kind, and mean and covariance in the landmark's own 3 or 7 coordinates."""
    track_id, is_euclidean, means, covs = jax.device_get(
        (state.track_id, state.is_euclidean, state.landmarks, landmark_cov(state))
    )
    found = {}
    for slot in np.flatnonzero(track_id >= 0):
        kind, n = ("euclidean", 3) if is_euclidean[slot] else ("ahp", 7)
        found[int(track_id[slot])] = kind, means[slot, :n], covs[slot, :n, :n]
    return found


def joint(state: FilterState, order: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of vehicle and landmarks, these in the given order, each in its own 3 or 7 coordinates."""
    vehicle, track_id, is_euclidean, means = jax.device_get(
        (state.vehicle, state.track_id, state.is_euclidean, state.landmarks)
    )
    rows, mean = [np.arange(VEHICLE)], [vehicle]
    for i in order:
        (slot,) = np.flatnonzero(track_id == i)
        n = 3 if is_euclidean[slot] else 7
        rows.append(VEHICLE + SLOT * slot + np.arange(n))
        mean.append(means[slot, :n])
    rows = np.concatenate(rows)
    return np.concatenate(mean), np.asarray(full_cov(state))[np.ix_(rows, rows)]
