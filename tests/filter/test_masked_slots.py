"""What is masked does nothing, in value and in derivative: free slots, invalid features.

Free slots are filled with huge finite numbers, invalid features with NaN and with ids of landmarks in the map.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from filter_runs import CAPACITY, filtered, frame_of, head, ids, joint, recorded, step, step_jvp, zero_tangent

from vcjax.filter.config import FilterConfig
from vcjax.filter.state import VEHICLE
from vcjax.gates.either import Either
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.velocity_glr import VelocityGLR

VC = FilterConfig(max_landmarks=CAPACITY, retire=False, detector=Either(VelocityGLR(), InlierRatio()))
FROM, TO = 24, 30
HUGE = 1e30


@pytest.fixture(scope="module")
def recording():
    return head(recorded(seed=9, dynamic="lateral", oscillation_amplitude_m=0.05), TO)


@pytest.fixture(scope="module")
def state(recording):
    *_, (state, _) = filtered(VC, head(recording, FROM))
    return jax.device_get(state)


@pytest.fixture(scope="module")
def cluttered(state):
    """The same state with huge numbers in all free slots."""
    rng = np.random.default_rng(2)
    is_free = state.track_id < 0
    rows = np.repeat(is_free, 7)

    def fill(leaf, is_filled):
        if leaf.dtype == bool:
            return np.where(is_filled, rng.random(leaf.shape) < 0.5, leaf)
        return np.where(is_filled, HUGE * rng.standard_normal(leaf.shape), leaf)

    assert is_free.sum() > 50
    return eqx.tree_at(
        lambda s: (s.landmarks, s.to_coordinates, s.is_euclidean, s.detector, s.P_vm, s.P_mm),
        state,
        (
            fill(state.landmarks, is_free[:, None]),
            fill(state.to_coordinates, is_free[:, None, None]),
            fill(state.is_euclidean, is_free),
            jax.tree.map(lambda leaf: fill(leaf, is_free.reshape(-1, *(1,) * (leaf.ndim - 1))), state.detector),
            fill(state.P_vm, rows),
            fill(state.P_mm, rows | rows[:, None]),
        ),
    )


@pytest.fixture(scope="module")
def littered(recording):
    """The same recording with NaN pixels and ids of features in the map where nothing is valid."""
    is_invalid = ~recording.is_valid
    track_id = recording.track_id.copy()
    for row, invalid in zip(track_id, is_invalid, strict=True):
        row[invalid] = np.resize(row[~invalid], invalid.sum())
    return dataclasses.replace(
        recording,
        track_id=track_id,
        uv_px=np.where(is_invalid[..., None], np.nan, recording.uv_px),
        is_last=recording.is_last | is_invalid,
    )


def assert_identical(ours, theirs):
    """Equal bit for bit, NaN at the same places."""
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(ours), jax.device_get(theirs))


def visible_part(state):
    """All of a state that a person can see: the vehicle and the map, jointly."""
    return joint(state, ids(state.track_id))


def test_the_state_has_landmarks_and_the_frames_have_events(state, recording):
    """Otherwise the tests below would show nothing."""
    births, isolated = 0, 0
    for t in range(FROM, TO):
        state, info = step(VC, state, frame_of(recording, t))
        births += len(ids(info.born_id))
        isolated += np.isfinite(info.re2).sum()
    assert births == TO - FROM
    assert isolated > 0


def test_values_are_the_same_bit_for_bit(state, cluttered, recording, littered):
    dirty = cluttered
    for t in range(FROM, TO):
        state, info = step(VC, state, frame_of(recording, t))
        dirty, dirty_info = step(VC, dirty, frame_of(littered, t))
        assert_identical(dirty_info, info)
        assert_identical(visible_part(dirty), visible_part(state))
    assert np.abs(dirty.landmarks).max() > 1e20  # the clutter is still there


DIRECTIONS = {
    "pixel_std_px": lambda config, frame: (
        eqx.tree_at(lambda c: c.pixel_std_px, config, np.float64(1)),
        frame,
    ),
    "th1": lambda config, frame: (
        eqx.tree_at(lambda c: c.gate.th1, config, np.float64(1)),
        frame,
    ),
    "odometry": lambda config, frame: (
        config,
        eqx.tree_at(lambda f: f.odometry, frame, np.array([1.0, 0.5, 0, 0, 0, 0.1])),
    ),
}


def with_tangents(name, state, recording):
    """State, info and their derivatives through the frames, in one direction."""
    d_state = zero_tangent(state)
    for t in range(FROM, FROM + 3):
        frame = frame_of(recording, t)
        d_config, d_frame = DIRECTIONS[name](zero_tangent(VC), zero_tangent(frame))
        (state, info), (d_state, d_info) = step_jvp((VC, state, frame), (d_config, d_state, d_frame))
    return state, info, d_state, d_info


@pytest.mark.parametrize("name", DIRECTIONS)
def test_derivatives_are_the_same_bit_for_bit(name, state, cluttered, recording, littered):
    state, info, d_state, d_info = with_tangents(name, state, recording)
    dirty, dirty_info, d_dirty, d_dirty_info = with_tangents(name, cluttered, littered)
    assert_identical(dirty_info, info)
    assert_identical(d_dirty_info, d_info)
    mapped = np.flatnonzero(np.asarray(state.track_id) >= 0)
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(dirty.track_id) >= 0), mapped)
    for name_of_field in ("vehicle", "P_vv"):
        assert_identical(getattr(d_dirty, name_of_field), getattr(d_state, name_of_field))
    assert_identical(d_dirty.landmarks[mapped], d_state.landmarks[mapped])
    rows = (7 * mapped[:, None] + np.arange(7)).ravel()
    assert_identical(d_dirty.P_vm[:, rows], d_state.P_vm[:, rows])
    assert_identical(d_dirty.P_mm[np.ix_(rows, rows)], d_state.P_mm[np.ix_(rows, rows)])
    assert np.isfinite(d_info.vehicle).all()
    # A verdict has no derivative, so that th1 has none at all; the others move the vehicle.
    assert (np.abs(d_info.vehicle).max() > 1e-6) == (name != "th1")
    assert d_info.vehicle.shape == (VEHICLE,)
