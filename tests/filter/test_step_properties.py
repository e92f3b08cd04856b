"""What every frame keeps: one compilation, a covariance that is one, unit quaternions, no favourite slots, no crash."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from filter_runs import (
    CAPACITY,
    filtered,
    frame_of,
    head,
    ids,
    joint,
    landmarks,
    predict,
    quick_jit,
    recorded,
    simulate_once,
    start,
    step,
)

from vcjax.filter import slam
from vcjax.filter.config import FilterConfig
from vcjax.filter.map_covariance import symmetric
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.simulation.scenarios import paper

VC = FilterConfig(max_landmarks=CAPACITY, retire=False)
MOVING = dict(dynamic="lateral", oscillation_amplitude_m=0.05)


@pytest.fixture(scope="module")
def recording():
    return head(recorded(seed=6, **MOVING), 40)


@pytest.fixture(scope="module")
def states(recording):
    """State after every frame."""
    return [state for state, _ in filtered(VC, recording)]


def test_other_numbers_do_not_compile_again(states, recording):
    other = FilterConfig(
        gate=VirtualCorrection(th1=4.0, th2=6.5),
        detector=InlierRatio(min_searches=5, min_measured_ratio=0.2, min_corrected_ratio=0.6),
        max_landmarks=CAPACITY,
        retire=False,
        pixel_std_px=0.8,
        oscillation_std_m=0.002,
        inverse_depth_mean=0.1,
        inverse_depth_std=0.3,
        inverse_depth_min=0.01,
        linearity_max=0.05,
        birth_margin_px=40.0,
    )
    recorded(seed=4711, **MOVING)  # so that its program is there, even if that of `recording` was dropped since
    compiled = simulate_once, start, step
    num_compiled = [function._cache_size() for function in compiled]
    scenario = dict(
        robot="curved", dynamic="inverse_forward", oscillation_amplitude_m=0.08, oscillation_frequency_hz=2.0
    )
    *_, (state, info) = filtered(other, head(recorded(seed=7, **scenario), 5))
    assert [function._cache_size() for function in compiled] == num_compiled
    assert info.is_finite
    assert not np.array_equal(state.vehicle, states[4].vehicle)


def test_covariance_is_symmetric_and_positive_semidefinite(states):
    """To rounding. With exact derivatives the direction along a unit quaternion has no variance at all: zero counts."""
    for state in (states[10], states[-1]):
        _, P = joint(state, ids(state.track_id))
        scale = np.abs(P).max()
        np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-15 * scale)
        assert np.linalg.eigvalsh(P)[0] > -1e-14 * scale
        for q in (slice(3, 7), slice(10, 14)):
            np.testing.assert_allclose(state.P_vv[:, q] @ state.vehicle[q], 0, rtol=0, atol=1e-17)


def test_quaternions_are_of_unit_length_after_every_frame(states):
    for state in states:
        for pose in (state.robot, state.sensor):
            assert np.linalg.norm(pose[3:]) == pytest.approx(1.0, abs=1e-15)


def test_a_measurement_never_adds_uncertainty(states, recording):
    """The variance of what a frame corrects is at most what its prediction left."""
    for t in (5, 20, 39):
        predicted = predict(VC, states[t - 1], frame_of(recording, t))
        reduction = np.asarray(predicted.P_vv - states[t].P_vv)[:3, :3]
        assert np.linalg.eigvalsh(reduction)[0] > -1e-15


def test_slots_have_no_meaning(states, recording):
    """The same landmarks in other slots give the same frame, to rounding of re-ordered sums."""
    state, frame = jax.device_get(states[30]), frame_of(recording, 31)
    order = np.arange(len(state.track_id))
    order[:CAPACITY] = np.random.default_rng(1).permutation(CAPACITY)  # the slots behind are spare, always free
    rows = (7 * order[:, None] + np.arange(7)).ravel()
    moved = jax.tree.map(lambda leaf: leaf[order], (state.landmarks, state.to_coordinates, state.track_id))
    shuffled = eqx.tree_at(
        lambda s: (s.landmarks, s.to_coordinates, s.track_id, s.is_euclidean, s.detector, s.P_vm, s.P_mm),
        state,
        (
            *moved,
            state.is_euclidean[order],
            jax.tree.map(lambda leaf: leaf[order], state.detector),
            state.P_vm[:, rows],
            symmetric(states[30].P_mm)[np.ix_(rows, rows)],
        ),
    )
    (state, info), (shuffled, shuffled_info) = step(VC, state, frame), step(VC, shuffled, frame)
    for name in ("candidate_id", "is_accepted", "is_recovered", "is_dynamic", "born_id"):
        np.testing.assert_array_equal(getattr(info, name), getattr(shuffled_info, name))
    order = ids(state.track_id)
    assert sorted(ids(shuffled.track_id)) == sorted(order)
    for ours, theirs in zip(joint(state, order), joint(shuffled, order), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


def hide(recording, is_hidden):
    """The recording without any feature in some frames; what is not valid holds NaN."""
    is_valid = recording.is_valid & ~is_hidden[:, None]
    uv_px = np.where(is_valid[..., None], recording.uv_px, np.nan)
    return dataclasses.replace(recording, is_valid=is_valid, uv_px=uv_px)


def test_frames_without_a_feature_are_predictions(states, recording):
    dark = hide(head(recording, 20), np.isin(np.arange(20), (10, 11)))
    before = None
    for t, (state, info) in enumerate(filtered(VC, dark)):
        assert info.is_finite
        if t in (10, 11):
            assert ids(info.candidate_id)  # searched
            assert not info.is_measured.any()
            assert not ids(info.born_id)
            predicted = predict(VC, before, frame_of(dark, t))
            np.testing.assert_allclose(state.vehicle, predicted.vehicle, rtol=0, atol=1e-14)
            np.testing.assert_allclose(state.P_vv, predicted.P_vv, rtol=0, atol=1e-16)
            for i, (_, mean, _) in landmarks(state).items():
                np.testing.assert_array_equal(mean, landmarks(before)[i][1])
        before = state
    assert info.is_measured.sum() >= 8  # and the filter goes on


def test_a_recording_without_any_feature_is_dead_reckoning(recording):
    dark = hide(head(recording, 12), np.ones(12, bool))
    *_, (state, info) = filtered(VC, dark)
    assert not state.is_mapped.any()
    assert info.is_finite
    assert info.vehicle[0] == pytest.approx(-8.0 + dark.odometry[:, 0].sum(), abs=1e-3)  # the yaw stays below 0.3°
    assert info.vehicle_cov[0, 0] == pytest.approx(12 * 0.005**2, rel=1e-3)


def test_a_seed_that_is_not_finite_is_flagged_and_spoils_no_other(states, recording):
    """A batch of two, one with NaN in its odometry: the other's numbers are the same bit for bit."""
    batched = quick_jit(jax.vmap(slam.step, in_axes=(None, 0, 0)))

    def run(odometry_of_first):
        pair = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), jax.device_get(states[20]))
        for t in range(21, 25):
            frame = jax.device_get(frame_of(recording, t))
            first = eqx.tree_at(lambda f: f.odometry, frame, odometry_of_first(frame.odometry))
            pair, info = batched(VC, pair, jax.tree.map(lambda *leaves: np.stack(leaves), first, frame))
        return jax.device_get((pair, info))

    (clean, clean_info), (spoilt, spoilt_info) = run(lambda u: u), run(lambda u: u * np.nan)
    assert clean_info.is_finite.tolist() == [True, True]
    assert spoilt_info.is_finite.tolist() == [False, True]
    for ours, theirs in ((clean, spoilt), (clean_info, spoilt_info)):
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[1], b[1]), ours, theirs)


def test_without_noise_the_error_stays_at_zero():
    """Noise-free data, almost no assumed noise. The linearised first updates of far landmarks leave 5e-6 m, no more."""
    scenario = paper()
    silent = eqx.tree_at(lambda s: (s.odometry_std, s.pixel_std_px), scenario, (np.zeros(6), np.float64(0)))
    recording = head(jax.device_get(simulate_once(silent, jax.random.key(0))[0]), 50)
    tiny = np.diag([1e-5, 1e-5, 0, 0, 0, 1e-5]) ** 2
    recording = dataclasses.replace(recording, odometry_cov=np.broadcast_to(tiny, (50, 6, 6)))
    config = FilterConfig(max_landmarks=CAPACITY, retire=False, pixel_std_px=0.01)
    frames = list(filtered(config, recording))
    for t, (_, info) in enumerate(frames):
        truth = [-8.0 + 0.05 * (t + 1), 0, 0, 1, 0, 0, 0]
        np.testing.assert_allclose(info.vehicle[:7], truth, rtol=0, atol=1e-5)
    points = {i: m[:3] + m[3:6] / m[6] if kind == "ahp" else m for i, (kind, m, _) in landmarks(frames[-1][0]).items()}
    errors = [np.linalg.norm(point - scenario.landmarks_m[i]) for i, point in points.items()]
    assert np.median(errors) < 2e-3  # m, of landmarks born at 100 m
