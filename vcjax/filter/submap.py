"""The frame's corrections, done exactly on the small part of the state they read: equations (8)–(12).

A frame corrects with K landmarks. Their innovations depend on the vehicle and on these K slots only, n = v + 7 K
coordinates, so the sequential updates run on that submap alone, on an n × n covariance that stays in cache. The rest of
the state follows in one pass. With S = L Lᵀ the innovation covariance of correction j and W = L⁻¹,

    u_j = W H_j P,    P ← P - u_jᵀ u_j,    x ← x + u_jᵀ (W z_j).

With P⁰ the covariance the frame began with, P = P⁰ - U_<jᵀ U_<j in correction j, so that P itself is never formed:

    u_j = W (H_j P⁰ - (H_j U_<jᵀ) U_<j) = t_j H P⁰,    t_j = W (e_j - (H_j U_<jᵀ) T_<j).

Every u_j is a combination t_j, of only 2 K numbers, of the rows of H P⁰. So at the end of the frame

    U = T H P⁰,    P ← P⁰ - Uᵀ D U,    x ← x + Uᵀ w:

the covariance downdate is delayed, gathered in one symmetric rank-2K product, and equals the textbook's sequential full
updates to rounding error. In the hard filter D = I and w = W z. A soft correction of weight g has the gain g K, and
with D = 2 g - g² and w = g W z exactly Joseph's covariance of that gain, P - (2 g - g²) K S Kᵀ, which is positive
definite for 0 ≤ g ≤ 1.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.filter.config import FilterConfig
from vcjax.filter.features import Block
from vcjax.filter.invariant import carry, read_turn, turn_of_landmark, turn_of_vehicle
from vcjax.filter.map_covariance import SLOT, downdate, read_rows, reversible_downdate, reversible_read_rows
from vcjax.filter.reparametrisation import AtCorrection, Slots, settle
from vcjax.filter.state import FilterState
from vcjax.models.frames import unit, unit_jacobian


class Submap(eqx.Module):
    """Vehicle and K chosen slots: the frame's prediction, what the corrections so far did to it, and their record."""

    vehicle: Float[Array, " v"]
    """Predicted mean of the vehicle."""
    landmarks: Float[Array, "K 7"]
    """Predicted means of the chosen landmarks."""
    to_coordinates: Float[Array, "K 7 7"]
    is_euclidean: Bool[Array, " K"]
    shift: Float[Array, " n"]
    """Σ K z of the corrections so far, by which the means have moved."""
    P: Float[Array, "n n"]
    """P⁰, the covariance the frame began with."""
    U: Float[Array, "M n"]
    """Rows u_j of the corrections so far, two for each of C; M = 2 C."""
    g: Float[Array, " M"] | None
    """Their weights; None in the hard filter, where they are 1."""
    H: Float[Array, "C 2 n21"]
    """Their measurement derivatives."""
    T: Float[Array, "M M"]
    """The same rows as combinations of the rows of H P⁰."""
    w: Float[Array, " M"]
    """White innovations, weighted: g W z."""
    at_correction: AtCorrection
    """What was noted of each landmark when it was corrected with (leading axis K)."""
    is_corrected: Bool[Array, " K"]
    """Which were corrected with."""


def first_row(submap: Submap, j: int | Int[Array, "*j"]) -> int | Int[Array, "*j"]:
    """First row of candidate j in the submap."""
    return submap.vehicle.shape[0] + SLOT * j


def vehicle_mean(submap: Submap) -> Float[Array, " v"]:
    """Current mean of the vehicle. Its quaternions may be off unit length until the frame ends."""
    return submap.vehicle + submap.shift[: len(submap.vehicle)]


def landmark_means(submap: Submap) -> Float[Array, "K 7"]:
    """Current means of the chosen landmarks."""
    slots = submap.shift[len(submap.vehicle) :].reshape(-1, SLOT)
    return submap.landmarks + jnp.sum(submap.to_coordinates * slots[:, None], axis=-1)


def block(submap: Submap, j: int | Int[Array, ""]) -> Block:
    """Current mean of the block of candidate j."""
    T = submap.to_coordinates[j]
    slot = jax.lax.dynamic_slice_in_dim(submap.shift, first_row(submap, j), SLOT)
    return Block(vehicle_mean(submap), submap.landmarks[j] + jnp.sum(T * slot, axis=-1), T)


def block_carry(config: FilterConfig, submap: Submap, j: int | Int[Array, ""]) -> Float[Array, "n n"]:
    """M of the block of candidate j: its errors now by those at prediction, where they are invariant."""
    slot = jax.lax.dynamic_slice_in_dim(submap.shift, first_row(submap, j), SLOT)
    vehicle_shift = submap.shift[: len(submap.vehicle)]
    return carry(config.motion, submap.vehicle, vehicle_shift, jnp.sum(submap.to_coordinates[j] * slot, axis=-1))


def block_cov(config: FilterConfig, submap: Submap, j: int | Int[Array, ""]) -> Float[Array, "n n"]:
    """Current covariance of the block of candidate j: vehicle and its slot."""
    U = block_columns(submap, submap.U, j)
    P = block_columns(submap, block_rows(submap, submap.P, j), j) - weighted(submap, U.T) @ U
    if config.errors == "additive":
        return P
    M = block_carry(config, submap, j)
    return M @ P @ M.T


def weighted(submap: Submap, columns: Float[Array, "*n M"]) -> Float[Array, "*n M"]:
    """Columns, one for each row of U, times D = 2 g - g²."""
    return columns if submap.g is None else columns * (2.0 * submap.g - submap.g**2)


def block_columns(
    submap: Submap, matrix: Float[Array, "rows n"], j: int | Int[Array, ""]
) -> Float[Array, "rows block"]:
    """The columns of vehicle and slot of candidate j."""
    own = jax.lax.dynamic_slice_in_dim(matrix, first_row(submap, j), SLOT, axis=-1)
    return jnp.concatenate([matrix[..., : len(submap.vehicle)], own], axis=-1)


def block_rows(
    submap: Submap, matrix: Float[Array, "n columns"], j: int | Int[Array, ""]
) -> Float[Array, "block columns"]:
    """The rows of vehicle and slot of candidate j."""
    own = jax.lax.dynamic_slice_in_dim(matrix, first_row(submap, j), SLOT)
    return jnp.concatenate([matrix[: len(submap.vehicle)], own])


def wide(submap: Submap, j: int | Int[Array, ""], H: Float[Array, "rows block"]) -> Float[Array, "rows n"]:
    """A derivative by the block of candidate j, as one by the whole submap."""
    v = len(submap.vehicle)
    whole = jnp.zeros((H.shape[0], submap.P.shape[0]), H.dtype).at[:, :v].set(H[:, :v])
    return jax.lax.dynamic_update_slice_in_dim(whole, H[:, v:], first_row(submap, j), axis=1)


def gather(
    config: FilterConfig, state: FilterState, slot: Int[Array, " K"]
) -> tuple[FilterState, Submap, Float[Array, "K 7 M"]]:
    """The submap of the chosen slots, and their covariance with all slots; the state as it is, to go on with."""
    num_slots, num_chosen, v = state.track_id.shape[0], slot.shape[0], len(state.vehicle)
    # A soft filter corrects with every candidate twice: as far as it is accepted, and as far as it is recovered.
    num_corrections = num_chosen * (2 if config.smoothing == "soft" else 1)
    P_mm, rows = (reversible_read_rows if config.reverse_mode else read_rows)(state.P_mm, slot)
    state = eqx.tree_at(lambda s: s.P_mm, state, P_mm)
    P_vc = state.P_vm.reshape(v, num_slots, SLOT)[:, slot].reshape(v, -1)
    P_cc = rows.reshape(num_chosen * SLOT, num_slots, SLOT)[:, slot].reshape(num_chosen * SLOT, -1)
    P = jnp.block([[state.P_vv, P_vc], [P_vc.T, P_cc]])
    submap = Submap(
        vehicle=state.vehicle,
        landmarks=state.landmarks[slot],
        to_coordinates=state.to_coordinates[slot],
        is_euclidean=state.is_euclidean[slot],
        shift=jnp.zeros(P.shape[0], P.dtype),
        P=P,
        U=jnp.zeros((2 * num_corrections, P.shape[0]), P.dtype),
        g=None if config.smoothing == "hard" else jnp.zeros(2 * num_corrections, P.dtype),
        H=jnp.zeros((num_corrections, 2, v + SLOT), P.dtype),
        T=jnp.zeros((2 * num_corrections, 2 * num_corrections), P.dtype),
        w=jnp.zeros(2 * num_corrections, P.dtype),
        at_correction=AtCorrection(
            jnp.zeros((num_chosen, SLOT), P.dtype),
            jnp.zeros(num_chosen, P.dtype),
            jnp.zeros((num_chosen, v), P.dtype),
        ),
        is_corrected=jnp.zeros(num_chosen, bool),
    )
    return state, submap, rows


def scatter(
    config: FilterConfig, state: FilterState, submap: Submap, slot: Int[Array, " K"], rows: Float[Array, "K 7 M"]
) -> FilterState:
    """The state after the frame's corrections, from the submap and the rows it was gathered with.

    The rest of the state follows by U = T H P⁰. Landmarks settle (see `reparametrisation`). Then both quaternions are
    brought to unit length, q/|q|, and P ← N P Nᵀ with N the derivative of that.
    """
    v = len(submap.vehicle)
    H_v, H_l = submap.H[..., :v], submap.H[..., v:]
    if len(H_l) > len(rows):  # two corrections with each
        rows = jnp.concatenate([rows, rows])
    HP = H_v.reshape(-1, v) @ state.P_vm + jnp.einsum("kai,kim->kam", H_l, rows).reshape(len(submap.T), -1)
    U = submap.T @ HP
    shift = (U.T @ submap.w).reshape(-1, SLOT)
    landmarks = state.landmarks + jnp.sum(state.to_coordinates * shift[:, None], axis=-1)
    slots = Slots(landmark_means(submap), submap.to_coordinates, submap.is_euclidean)
    slots = settle(config, slots, submap.at_correction, submap.is_corrected)
    U_v, V = submap.U[:, :v].T, weighted(submap, U.T).T
    vehicle, N = normalise(config, vehicle_mean(submap))
    if config.errors == "invariant":
        UD_v = weighted(submap, U_v)
        P_vv, P_vm = state.P_vv - UD_v @ U_v.T, state.P_vm - UD_v @ U
        A_m = turn_of_landmark(landmarks - state.landmarks).at[slot].set(turn_of_chosen(submap, slots))
        A = turn_of_vehicle(config.motion, submap.shift[:v]), A_m.reshape(-1, 3)
        E = read_turn(submap.vehicle)
        EPE = E @ P_vv @ E.T
        B = P_vv @ E.T + 0.5 * A[0] @ EPE, P_vm.T @ E.T + 0.5 * A[1] @ EPE
        P_vv = N @ (P_vv + A[0] @ B[0].T + B[0] @ A[0].T) @ N.T
        P_vm = N @ (P_vm + A[0] @ B[1].T + B[0] @ A[1].T)
        V, U = jnp.concatenate([V, A[1].T, B[1].T]), jnp.concatenate([U, -B[1].T, -A[1].T])
    else:
        NU_v = N @ U_v
        NUD_v = weighted(submap, NU_v)
        P_vv, P_vm = N @ state.P_vv @ N.T - NUD_v @ NU_v.T, N @ state.P_vm - NUD_v @ U
    return eqx.tree_at(
        lambda s: (s.vehicle, s.landmarks, s.to_coordinates, s.is_euclidean, s.P_vv, s.P_vm, s.P_mm),
        state,
        (
            vehicle,
            landmarks.at[slot].set(slots.landmarks),
            state.to_coordinates.at[slot].set(slots.to_coordinates),
            state.is_euclidean.at[slot].set(slots.is_euclidean),
            P_vv,
            P_vm,
            _downdate(config, state, V, U),
        ),
    )


def turn_of_chosen(submap: Submap, slots: Slots) -> Float[Array, "K 7 3"]:
    """A of the chosen slots: N(x⁺) - N(x), and of what has become Euclidean what leads from J N(x) to N(p)."""
    becomes = slots.is_euclidean & ~submap.is_euclidean
    J = slots.to_coordinates[:, :3]
    point = jnp.where(becomes[:, None], slots.landmarks, 0.0)
    anchor = turn_of_landmark(point)[:, :3] - J @ turn_of_landmark(submap.landmarks)
    converted = jnp.concatenate([anchor, jnp.zeros((len(anchor), SLOT - 3, 3), anchor.dtype)], axis=1)
    moved = turn_of_landmark(landmark_means(submap) - submap.landmarks)
    return jnp.where(becomes[:, None, None], converted, moved)


def _downdate(
    config: FilterConfig, state: FilterState, DU: Float[Array, "K2 M"], U: Float[Array, "K2 M"]
) -> Float[Array, "M M"]:
    """P_mm - Uᵀ D U, all of it or the part in use; free slots' rows mean nothing."""
    is_cpu = jax.default_backend() == "cpu"
    if not (is_cpu if config.skip_free_slots is None else config.skip_free_slots):
        return state.P_mm - DU.T @ U
    num_used = jnp.max(jnp.where(state.is_mapped, jnp.arange(1, len(state.is_mapped) + 1), 0))
    return (reversible_downdate if config.reverse_mode else downdate)(state.P_mm, DU, U, num_used)


def normalise(config: FilterConfig, vehicle: Float[Array, " v"]) -> tuple[Float[Array, " v"], Float[Array, "v v"]]:
    """The vehicle with both quaternions of unit length, and the derivative of that."""
    N = jnp.eye(len(vehicle), dtype=vehicle.dtype)
    unit_vehicle = vehicle
    for q in (slice(3, 7), slice(10, 14)):
        unit_vehicle = unit_vehicle.at[q].set(unit(vehicle[q], config.toolbox_parity))
        N = N.at[q, q].set(unit_jacobian(vehicle[q], config.toolbox_parity))
    return unit_vehicle, N
