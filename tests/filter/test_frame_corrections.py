"""A frame's corrections on the submap, spread by one delayed downdate, against dense textbook updates of the whole P.

Both are exact, so that they differ by rounding only: 1e-12 beside a covariance of up to 1 and pixels of up to 640.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filter_runs import CAPACITY, filtered, head, quick_jit, recorded

from vcjax.fields import number
from vcjax.filter.config import FilterConfig
from vcjax.filter.features import Block, observe, predict_features
from vcjax.filter.frame_corrections import correct_frame
from vcjax.filter.map_covariance import symmetric
from vcjax.filter.state import SLOT, VEHICLE
from vcjax.filter.submap import gather, scatter
from vcjax.gates.gate import AbstractGate, Prior, Verdict
from vcjax.gates.one_point_ransac import OnePointRansac
from vcjax.gates.reprojection import ReprojectionError
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.models.camera import Camera

# No gate and no conversion: what is left is the Kalman filter's algebra.
CHOICES = dict(
    gate=ReprojectionError(np.inf), max_landmarks=CAPACITY, retire=False, linearity_max=0.0, pixel_std_px=0.7
)
SEQUENTIAL, STACKED = FilterConfig(**CHOICES), FilterConfig(update="stacked", **CHOICES)
K = SEQUENTIAL.max_updates
QUATERNIONS = slice(3, 7), slice(10, 14)


@quick_jit
def correct(config, state, slot, uv_px, is_measured):
    """The frame's corrections on the whole state."""
    state, submap, rows = gather(config, state, slot)
    submap, _ = correct_frame(config, Camera(), submap, uv_px, is_measured)
    return scatter(config, state, submap, slot, rows)


@quick_jit
def measure(state, slot):
    """Predicted pixel and its derivative of one slot."""
    block = Block(state.vehicle, state.landmarks[slot], state.to_coordinates[slot])
    observation = observe(SEQUENTIAL, Camera(), block)
    return observation.pixel, observation.H


@pytest.fixture(scope="module")
def problem():
    """A state in the middle of a run with a random P added, ten of its slots, and their pixels.

    The inverse depths are so large that no correction makes one negative, which the filter would not let stand.
    """
    rng = np.random.default_rng(0)
    recording = head(recorded(seed=5), 40)
    *_, (state, _) = filtered(FilterConfig(**CHOICES | dict(linearity_max=0.2)), recording)
    size = VEHICLE + SLOT * state.track_id.shape[0]
    root = 1e-3 * rng.standard_normal((size, 60))
    state = with_cov(state, dense_cov(state) + root @ root.T)
    is_near = state.is_mapped & (state.landmarks[:, -1] > 0.1)
    slot = rng.permutation(np.flatnonzero(is_near & predict_features(SEQUENTIAL, state, Camera()).is_visible))[:K]
    assert 0 < state.is_euclidean[slot].sum() < K
    uv_px = np.stack([measure(state, j)[0] for j in slot]) + rng.standard_normal((K, 2))
    return state, slot, uv_px


def dense_cov(state):
    """P of vehicle and all slots' error coordinates."""
    return np.block([[state.P_vv, state.P_vm], [state.P_vm.T, symmetric(state.P_mm)]])


def with_cov(state, P):
    """The state with another P."""
    blocks = P[:VEHICLE, :VEHICLE], P[:VEHICLE, VEHICLE:], P[VEHICLE:, VEHICLE:]
    return eqx.tree_at(lambda s: (s.P_vv, s.P_vm, s.P_mm), state, tuple(jnp.asarray(b) for b in blocks))


def dense_innovation(state, slot, uv_px):
    """z (2,) and H (2, N) of one slot."""
    pixel, block_H = measure(state, slot)
    H = np.zeros((2, VEHICLE + SLOT * state.track_id.shape[0]))
    first = VEHICLE + SLOT * slot
    H[:, :VEHICLE], H[:, first : first + SLOT] = block_H[:, :VEHICLE], block_H[:, VEHICLE:]
    return uv_px - pixel, H


def dense_update(state, z, H):
    """K = P Hᵀ (H P Hᵀ + R)⁻¹, x + K z, P - K Z Kᵀ on everything, for any number of rows. Equations (9)–(12)."""
    P = dense_cov(state)
    Z = H @ P @ H.T + SEQUENTIAL.pixel_std_px**2 * np.eye(len(z))
    gain = P @ H.T @ np.linalg.inv(Z)
    shift = gain @ z
    moved = np.einsum("lij,lj->li", state.to_coordinates, shift[VEHICLE:].reshape(-1, SLOT))
    state = eqx.tree_at(
        lambda s: (s.vehicle, s.landmarks), state, (state.vehicle + shift[:VEHICLE], state.landmarks + moved)
    )
    return with_cov(state, P - gain @ Z @ gain.T)


class FixedWeight(AbstractGate):
    """Accepts everything to the same degree, whatever its error, and recovers nothing."""

    weight: float = eqx.field(converter=number)
    prior: Prior = eqx.field(static=True, default="corrected")

    def margin(self, re1):
        return jnp.log(self.weight / (1.0 - self.weight)) + 0.0 * re1

    def judge(self, candidates, model):
        nothing = jnp.full(candidates.is_isolated.shape, jnp.nan)
        return Verdict(nothing, nothing, nothing)


def dense_soft_update(state, z, H, g):
    """x + g K z and Joseph's covariance of the gain g K, (I - g K H) P (I - g K H)ᵀ + g² K R Kᵀ."""
    P, R = dense_cov(state), SEQUENTIAL.pixel_std_px**2 * np.eye(len(z))
    gain = g * P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    shift, left = gain @ z, np.eye(len(P)) - gain @ H
    moved = np.einsum("lij,lj->li", state.to_coordinates, shift[VEHICLE:].reshape(-1, SLOT))
    state = eqx.tree_at(
        lambda s: (s.vehicle, s.landmarks), state, (state.vehicle + shift[:VEHICLE], state.landmarks + moved)
    )
    return with_cov(state, left @ P @ left.T + gain @ R @ gain.T)


def dense_normalise(state):
    """Both quaternions q/|q|, with P by the derivative of that."""
    vehicle, P = np.array(state.vehicle), dense_cov(state)
    N = np.eye(len(P))
    for q in QUATERNIONS:
        length = np.linalg.norm(vehicle[q])
        vehicle[q] /= length
        N[q, q] = (np.eye(4) - np.outer(vehicle[q], vehicle[q])) / length
    return with_cov(eqx.tree_at(lambda s: s.vehicle, state, jnp.asarray(vehicle)), N @ P @ N.T)


def assert_same(state, other, tolerance=1e-12):
    """Equal but for free slots, which mean nothing."""
    mapped = np.flatnonzero(state.is_mapped)
    rows = np.concatenate([np.arange(VEHICLE), (VEHICLE + SLOT * mapped[:, None] + np.arange(SLOT)).ravel()])
    for ours, theirs in (
        (state.vehicle, other.vehicle),
        (state.landmarks[mapped], other.landmarks[mapped]),
        (dense_cov(state)[np.ix_(rows, rows)], dense_cov(other)[np.ix_(rows, rows)]),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance)


def test_sequential_corrections_are_dense_updates_one_after_another(problem):
    state, slot, uv_px = problem
    is_measured = np.arange(K) % 4 != 3
    expected = state
    for j in np.flatnonzero(is_measured):
        expected = dense_update(expected, *dense_innovation(expected, slot[j], uv_px[j]))
    corrected = correct(SEQUENTIAL, state, slot, uv_px, is_measured)
    assert_same(corrected, dense_normalise(expected))
    assert np.abs(corrected.vehicle - state.vehicle).max() > 1e-4  # something happened


@pytest.mark.parametrize("weight", [1e-9, 0.02, 0.5, 0.98])
def test_soft_corrections_are_joseph_updates_of_a_smaller_gain(problem, weight):
    """Whatever the gain, Joseph's form is positive semi-definite, and so is P - (2 g - g²) K S Kᵀ."""
    state, slot, uv_px = problem
    is_measured = np.arange(K) % 4 != 3
    expected = state
    for j in np.flatnonzero(is_measured):
        expected = dense_soft_update(expected, *dense_innovation(expected, slot[j], uv_px[j]), weight)
    config = FilterConfig(**CHOICES | dict(gate=FixedWeight(weight), smoothing="soft"))
    assert_same(correct(config, state, slot, uv_px, is_measured), dense_normalise(expected))


def test_a_landmark_s_own_rows_are_those_of_the_covariance_as_it_was_gated(problem):
    """P Hᵀ after the corrections before it, whether it is used itself or not."""
    state, slot, uv_px = problem
    is_measured = np.arange(K) % 4 != 3
    found = np.asarray(innovations(SEQUENTIAL, state, slot, uv_px, is_measured).PH_l)
    now = state
    for j in range(K):
        z, H = dense_innovation(now, slot[j], uv_px[j])
        rows = VEHICLE + SLOT * slot[j] + np.arange(SLOT)
        np.testing.assert_allclose(found[j], (dense_cov(now) @ H.T)[rows], rtol=0, atol=1e-11)
        now = dense_update(now, z, H) if is_measured[j] else now
    assert np.abs(found).max() > 1e-3


@quick_jit
def innovations(config, state, slot, uv_px, is_measured):
    """Those of the candidates as they were gated."""
    _, submap, _ = gather(config, state, slot)
    return correct_frame(config, Camera(), submap, uv_px, is_measured)[1].innovation


def test_skipping_free_slots_changes_nothing(problem):
    everyone = np.ones(K, bool)
    all_slots = FilterConfig(skip_free_slots=False, **CHOICES)
    assert_same(correct(SEQUENTIAL, *problem, everyone), correct(all_slots, *problem, everyone), tolerance=1e-13)


def test_stacked_correction_is_the_batch_formula(problem):
    state, slot, uv_px = problem
    is_measured = np.arange(K) % 4 != 3
    parts = [dense_innovation(state, slot[j], uv_px[j]) for j in np.flatnonzero(is_measured)]
    z, H = (np.concatenate(part) for part in zip(*parts, strict=True))
    expected = dense_normalise(dense_update(state, z, H))
    assert_same(correct(STACKED, state, slot, uv_px, is_measured), expected)


@pytest.mark.parametrize("j", [0, 7])
def test_stacked_and_sequential_are_one_for_a_single_candidate(problem, j):
    state, slot, uv_px = problem
    only = np.arange(K) == j
    assert_same(correct(STACKED, state, slot, uv_px, only), correct(SEQUENTIAL, state, slot, uv_px, only))


def test_stacked_and_sequential_meet_in_the_linear_limit(problem):
    """All uncertainty and innovations scaled by ε: shifts are of order ε, what re-linearisation changes of order ε²."""
    state, slot, uv_px = problem
    predicted = np.stack([measure(state, j)[0] for j in slot])
    everyone = np.ones(K, bool)

    def relative_difference(scale):
        small = with_cov(state, scale**2 * dense_cov(state))
        pixel_std = np.float64(scale * SEQUENTIAL.pixel_std_px)
        shifts = []
        for config in (SEQUENTIAL, STACKED):
            config = eqx.tree_at(lambda c: c.pixel_std_px, config, pixel_std)
            after = correct(config, small, slot, predicted + scale * (uv_px - predicted), everyone)
            shifts.append(after.landmarks[slot] - state.landmarks[slot])
        return np.linalg.norm(shifts[0] - shifts[1]) / np.linalg.norm(shifts[0])

    far, near = relative_difference(1.0), relative_difference(1e-3)
    assert far > 1e-3
    assert near < 5e-3 * far


def test_an_unmeasured_candidate_changes_nothing_whatever_its_pixel(problem):
    state, slot, uv_px = problem
    is_measured = np.arange(K) % 2 == 0
    hidden = np.where(is_measured[:, None], uv_px, np.nan)
    for config in (SEQUENTIAL, STACKED):
        clean, dirty = (correct(config, state, slot, pixels, is_measured) for pixels in (uv_px, hidden))
        jax.tree.map(np.testing.assert_array_equal, dirty, clean)
    nobody = correct(SEQUENTIAL, state, slot, uv_px, np.zeros(K, bool))
    assert_same(nobody, dense_normalise(state), tolerance=1e-15)


@pytest.mark.parametrize("gate", [ReprojectionError(9.0), VirtualCorrection(), OnePointRansac()])
@pytest.mark.parametrize(
    "choice", [{}, {"update": "stacked"}, {"smoothing": "soft"}, {"smoothing": "straight_through"}]
)
def test_a_suspect_has_an_innovation_and_changes_nothing(problem, gate, choice):
    """The state is that of a frame in which suspects were not found; of theirs nothing is decided."""
    (state, slot, uv_px), is_measured = problem, np.ones(K, bool)
    uv_px = uv_px + 40.0 * (np.arange(K) % 4 == 1)[:, None]  # some are left out, suspect or not
    is_suspect = np.isin(np.arange(K), [0, 1, 2])
    config = FilterConfig(**CHOICES | {"gate": gate} | choice)
    expected, without = submap_and_outcome(config, state, slot, uv_px, is_measured & ~is_suspect, np.zeros(K, bool))
    submap, outcome = submap_and_outcome(config, state, slot, uv_px, is_measured, is_suspect)
    jax.tree.map(np.testing.assert_array_equal, submap, expected)
    for name in ("is_accepted", "is_recovered", "is_dynamic", "weight", "p_dynamic"):
        found = getattr(outcome, name)
        assert not found[is_suspect].any()
        np.testing.assert_array_equal(found, getattr(without, name))
    assert np.isfinite(outcome.innovation.z[is_suspect]).all() and (outcome.innovation.z[is_suspect] != 0).any()
    np.testing.assert_array_equal(outcome.is_suspect, is_suspect)
    np.testing.assert_array_equal(outcome.dynamic_margin, np.where(is_suspect, np.nan, without.dynamic_margin))
    assert np.isfinite(without.dynamic_margin[~is_suspect]).all() and outcome.is_accepted.any()


def supporters_of_the_best(state, slot, uv_px, is_measured, gate):
    """Each measured candidate corrects a copy of the whole state, means alone; whom it leaves within pixel noise."""
    best = np.zeros(K, bool), 0.0
    for i in np.flatnonzero(is_measured):
        z, H = dense_innovation(state, slot[i], uv_px[i])
        S = H @ dense_cov(state) @ H.T + SEQUENTIAL.pixel_std_px**2 * np.eye(2)
        if z @ np.linalg.solve(S, z) >= gate.th1:
            continue
        shift = dense_cov(state) @ H.T @ np.linalg.solve(S, z)
        parts = [dense_innovation(state, slot[j], uv_px[j]) for j in range(K)]
        squared = np.array([np.sum((z - H @ shift) ** 2) / SEQUENTIAL.pixel_std_px**2 for z, H in parts])
        in_region = np.array(
            [
                z @ np.linalg.solve(H @ dense_cov(state) @ H.T + SEQUENTIAL.pixel_std_px**2 * np.eye(2), z) < gate.th1
                for z, H in parts
            ]
        )
        supports = is_measured & in_region & (squared < gate.th_consensus)
        score = supports.sum() - squared[supports].sum() / (gate.th_consensus * (K + 1))
        if score > best[1]:
            best = supports, score
    return best[0]


@pytest.mark.parametrize("update", ["sequential", "stacked"])
def test_ransac_corrects_with_the_best_set_and_then_with_the_rescued(problem, update):
    """As dense updates; the pixels of two candidates are moved, by little and by much."""
    state, slot, uv_px = problem
    gate = OnePointRansac(th_consensus=4.0)
    is_measured = np.arange(K) % 7 != 3
    moved = uv_px + np.where(np.arange(K) == 1, 4.0, np.where(np.arange(K) == 5, 400.0, 0.0))[:, None]
    hidden = np.where(is_measured[:, None], moved, np.nan)
    config = FilterConfig(**CHOICES | dict(gate=gate, update=update))

    accepted = supporters_of_the_best(state, slot, moved, is_measured, gate)
    expected = state
    if update == "stacked":
        parts = [dense_innovation(state, slot[j], moved[j]) for j in np.flatnonzero(accepted)]
        expected = dense_update(state, *(np.concatenate(part) for part in zip(*parts, strict=True)))
    else:
        for j in np.flatnonzero(accepted):
            expected = dense_update(expected, *dense_innovation(expected, slot[j], moved[j]))
    rescued = np.zeros(K, bool)
    for j in np.flatnonzero(is_measured & ~accepted):
        z, H = dense_innovation(expected, slot[j], moved[j])
        S = H @ dense_cov(expected) @ H.T + config.pixel_std_px**2 * np.eye(2)
        rescued[j] = z @ np.linalg.solve(S, z) < gate.th_rescue
    for j in np.flatnonzero(rescued):
        expected = dense_update(expected, *dense_innovation(expected, slot[j], moved[j]))

    outcome = outcome_of(config, state, slot, hidden, is_measured)
    np.testing.assert_array_equal(outcome.is_accepted, accepted)
    np.testing.assert_array_equal(outcome.is_recovered, rescued)
    assert not outcome.is_dynamic.any() and (outcome.dynamic_margin[5] > 0) and outcome.weight[5] == 0
    assert accepted.sum() > 2 and rescued.any() and not (accepted | rescued)[[3, 5]].any()
    assert_same(correct(config, state, slot, hidden, is_measured), dense_normalise(expected))


@quick_jit
def submap_and_outcome(config, state, slot, uv_px, is_measured, is_suspect):
    """The corrected submap, and what becomes of the candidates, some of them suspect."""
    _, submap, _ = gather(config, state, slot)
    return correct_frame(config, Camera(), submap, uv_px, is_measured, is_suspect)


@quick_jit
def outcome_of(config, state, slot, uv_px, is_measured):
    """What becomes of the candidates."""
    _, submap, _ = gather(config, state, slot)
    return correct_frame(config, Camera(), submap, uv_px, is_measured)[1]
