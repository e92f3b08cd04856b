"""The frame's corrections, done exactly on the small part of the state they read: equations (8)–(12).

A frame corrects with K landmarks. Their innovations depend on the vehicle and on these K slots only, n = 14 + 7 K
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
from vcjax.filter.map_covariance import SLOT, downdate, read_rows, reversible_downdate, reversible_read_rows
from vcjax.filter.reparametrisation import AtCorrection, Slots, settle
from vcjax.filter.state import VEHICLE, FilterState
from vcjax.models.frames import unit, unit_jacobian


class Submap(eqx.Module):
    """Vehicle and K chosen slots: the frame's prediction, what the corrections so far did to it, and their record."""

    vehicle: Float[Array, "14"]
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
    H: Float[Array, "C 2 21"]
    """Their measurement derivatives."""
    T: Float[Array, "M M"]
    """The same rows as combinations of the rows of H P⁰."""
    w: Float[Array, " M"]
    """White innovations, weighted: g W z."""
    at_correction: AtCorrection
    """What was noted of each landmark when it was corrected with (leading axis K)."""
    is_corrected: Bool[Array, " K"]
    """Which were corrected with."""


def first_row(j: int | Int[Array, "*j"]) -> int | Int[Array, "*j"]:
    """First row of candidate j in the submap."""
    return VEHICLE + SLOT * j


def vehicle_mean(submap: Submap) -> Float[Array, "14"]:
    """Current mean of the vehicle. Its quaternions may be off unit length until the frame ends."""
    return submap.vehicle + submap.shift[:VEHICLE]


def landmark_means(submap: Submap) -> Float[Array, "K 7"]:
    """Current means of the chosen landmarks."""
    slots = submap.shift[VEHICLE:].reshape(-1, SLOT)
    return submap.landmarks + jnp.sum(submap.to_coordinates * slots[:, None], axis=-1)


def block(submap: Submap, j: int | Int[Array, ""]) -> Block:
    """Current mean of the block of candidate j."""
    T = submap.to_coordinates[j]
    slot = jax.lax.dynamic_slice_in_dim(submap.shift, first_row(j), SLOT)
    return Block(vehicle_mean(submap), submap.landmarks[j] + jnp.sum(T * slot, axis=-1), T)


def block_cov(submap: Submap, j: int | Int[Array, ""]) -> Float[Array, "21 21"]:
    """Current covariance of the block of candidate j: vehicle and its slot."""
    U = block_columns(submap.U, j)
    return block_columns(block_rows(submap.P, j), j) - weighted(submap, U.T) @ U


def weighted(submap: Submap, columns: Float[Array, "*n M"]) -> Float[Array, "*n M"]:
    """Columns, one for each row of U, times D = 2 g - g²."""
    return columns if submap.g is None else columns * (2.0 * submap.g - submap.g**2)


def block_columns(matrix: Float[Array, "rows n"], j: int | Int[Array, ""]) -> Float[Array, "rows 21"]:
    """The columns of vehicle and slot of candidate j."""
    own = jax.lax.dynamic_slice_in_dim(matrix, first_row(j), SLOT, axis=-1)
    return jnp.concatenate([matrix[..., :VEHICLE], own], axis=-1)


def block_rows(matrix: Float[Array, "n columns"], j: int | Int[Array, ""]) -> Float[Array, "21 columns"]:
    """The rows of vehicle and slot of candidate j."""
    return jnp.concatenate([matrix[:VEHICLE], jax.lax.dynamic_slice_in_dim(matrix, first_row(j), SLOT)])


def gather(
    config: FilterConfig, state: FilterState, slot: Int[Array, " K"]
) -> tuple[FilterState, Submap, Float[Array, "K 7 M"]]:
    """The submap of the chosen slots, and their covariance with all slots; the state as it is, to go on with."""
    num_slots, num_chosen = state.track_id.shape[0], slot.shape[0]
    # A soft filter corrects with every candidate twice: as far as it is accepted, and as far as it is recovered.
    num_corrections = num_chosen * (2 if config.smoothing == "soft" else 1)
    P_mm, rows = (reversible_read_rows if config.reverse_mode else read_rows)(state.P_mm, slot)
    state = eqx.tree_at(lambda s: s.P_mm, state, P_mm)
    P_vc = state.P_vm.reshape(VEHICLE, num_slots, SLOT)[:, slot].reshape(VEHICLE, -1)
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
        H=jnp.zeros((num_corrections, 2, VEHICLE + SLOT), P.dtype),
        T=jnp.zeros((2 * num_corrections, 2 * num_corrections), P.dtype),
        w=jnp.zeros(2 * num_corrections, P.dtype),
        at_correction=AtCorrection(
            jnp.zeros((num_chosen, SLOT), P.dtype),
            jnp.zeros(num_chosen, P.dtype),
            jnp.zeros((num_chosen, VEHICLE), P.dtype),
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
    H_v, H_l = submap.H[..., :VEHICLE], submap.H[..., VEHICLE:]
    if len(H_l) > len(rows):  # two corrections with each
        rows = jnp.concatenate([rows, rows])
    HP = H_v.reshape(-1, VEHICLE) @ state.P_vm + jnp.einsum("kai,kim->kam", H_l, rows).reshape(len(submap.T), -1)
    U = submap.T @ HP
    shift = (U.T @ submap.w).reshape(-1, SLOT)
    landmarks = state.landmarks + jnp.sum(state.to_coordinates * shift[:, None], axis=-1)
    slots = Slots(landmark_means(submap), submap.to_coordinates, submap.is_euclidean)
    slots = settle(config, slots, submap.at_correction, submap.is_corrected)
    vehicle, N = normalise(config, vehicle_mean(submap))
    NU_v = N @ submap.U[:, :VEHICLE].T
    NU_vD, UD = weighted(submap, NU_v), weighted(submap, U.T)
    return eqx.tree_at(
        lambda s: (s.vehicle, s.landmarks, s.to_coordinates, s.is_euclidean, s.P_vv, s.P_vm, s.P_mm),
        state,
        (
            vehicle,
            landmarks.at[slot].set(slots.landmarks),
            state.to_coordinates.at[slot].set(slots.to_coordinates),
            state.is_euclidean.at[slot].set(slots.is_euclidean),
            N @ state.P_vv @ N.T - NU_vD @ NU_v.T,
            N @ state.P_vm - NU_vD @ U,
            _downdate(config, state, UD.T, U),
        ),
    )


def _downdate(
    config: FilterConfig, state: FilterState, DU: Float[Array, "K2 M"], U: Float[Array, "K2 M"]
) -> Float[Array, "M M"]:
    """P_mm - Uᵀ D U, all of it or the part in use; free slots' rows mean nothing."""
    is_cpu = jax.default_backend() == "cpu"
    if not (is_cpu if config.skip_free_slots is None else config.skip_free_slots):
        return state.P_mm - DU.T @ U
    num_used = jnp.max(jnp.where(state.is_mapped, jnp.arange(1, len(state.is_mapped) + 1), 0))
    return (reversible_downdate if config.reverse_mode else downdate)(state.P_mm, DU, U, num_used)


def normalise(config: FilterConfig, vehicle: Float[Array, "14"]) -> tuple[Float[Array, "14"], Float[Array, "14 14"]]:
    """The vehicle with both quaternions of unit length, and the derivative of that."""
    N = jnp.eye(VEHICLE, dtype=vehicle.dtype)
    unit_vehicle = vehicle
    for q in (slice(3, 7), slice(10, 14)):
        unit_vehicle = unit_vehicle.at[q].set(unit(vehicle[q], config.toolbox_parity))
        N = N.at[q, q].set(unit_jacobian(vehicle[q], config.toolbox_parity))
    return unit_vehicle, N
