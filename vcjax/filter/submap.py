"""The frame's corrections, done exactly on the small part of the state they read: equations (8)–(12).

A frame corrects with K landmarks. Their innovations depend on the vehicle and on these K slots only, n = 14 + 7 K
coordinates, so the sequential updates run on that submap alone, textbook-fashion, on an n × n covariance that stays in
cache. The rest of the state follows in one pass. With S = L Lᵀ the innovation covariance of correction j and W = L⁻¹,

    u_j = W H_j P,    P ← P - u_jᵀ u_j,    x ← x + u_jᵀ (W z_j),

and every u_j is a fixed combination of rows of the P the frame began with, u_j = c_j P⁰[submap, :], where
c_j = W (H_j - (H_j u_<jᵀ) c_<j) stays within the submap. So at the end of the frame

    U = C P⁰[submap, :],    P ← P⁰ - Uᵀ U,    x ← x + Uᵀ w:

the covariance downdate is delayed, gathered in one symmetric rank-2K product, and equals the textbook's sequential full
updates to rounding error.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.filter.config import FilterConfig
from vcjax.filter.features import Block
from vcjax.filter.state import SLOT, VEHICLE, FilterState
from vcjax.models.frames import unit, unit_jacobian


def slot_rows(j: int | Int[Array, ""]) -> int | Int[Array, ""]:
    """First row of candidate j in the submap."""
    return VEHICLE + SLOT * j


class Submap(eqx.Module):
    """Vehicle and K chosen slots: their part of x and P, kept current, and the record of what was done."""

    vehicle: Float[Array, "14"]
    landmarks: Float[Array, "K 7"]
    to_coordinates: Float[Array, "K 7 7"]
    is_euclidean: Bool[Array, " K"]
    P: Float[Array, "n n"]
    U: Float[Array, "M n"]
    """Rows u_j of the corrections so far, two for each; M = 2 K."""
    C: Float[Array, "M n"]
    """The same rows as combinations of the rows of P⁰."""
    w: Float[Array, " M"]
    """White innovations W z."""


def block(submap: Submap, j: int | Int[Array, ""]) -> Block:
    """Mean of the block of candidate j."""
    return Block(submap.vehicle, submap.landmarks[j], submap.to_coordinates[j])


def block_cov(submap: Submap, j: int | Int[Array, ""]) -> Float[Array, "21 21"]:
    """Covariance of the block of candidate j: vehicle and its slot."""
    rows = jnp.concatenate([submap.P[:VEHICLE], jax.lax.dynamic_slice_in_dim(submap.P, slot_rows(j), SLOT)])
    return jnp.concatenate([rows[:, :VEHICLE], jax.lax.dynamic_slice_in_dim(rows, slot_rows(j), SLOT, axis=1)], axis=1)


def gather(state: FilterState, slot: Int[Array, " K"]) -> tuple[Submap, Float[Array, "n M"]]:
    """The submap of the chosen slots, and its covariance with all slots, P⁰[submap, slots]."""
    num_slots, num_chosen = state.track_id.shape[0], slot.shape[0]
    chosen = state.P_mm.reshape(num_slots, SLOT, -1)[slot].reshape(num_chosen * SLOT, -1)
    rows = jnp.concatenate([state.P_vm, chosen])
    columns = rows.reshape(-1, num_slots, SLOT)[:, slot].reshape(-1, num_chosen * SLOT)
    P = jnp.concatenate([jnp.concatenate([state.P_vv, columns[:VEHICLE].T]), columns], axis=1)
    empty = jnp.zeros((2 * num_chosen, P.shape[0]), P.dtype)
    submap = Submap(
        vehicle=state.vehicle,
        landmarks=state.landmarks[slot],
        to_coordinates=state.to_coordinates[slot],
        is_euclidean=state.is_euclidean[slot],
        P=P,
        U=empty,
        C=empty,
        w=jnp.zeros(2 * num_chosen, P.dtype),
    )
    return submap, rows


def scatter(
    config: FilterConfig, state: FilterState, submap: Submap, slot: Int[Array, " K"], rows: Float[Array, "n M"]
) -> FilterState:
    """The state after the frame's corrections, from the submap and the rows it was gathered with.

    The rest of the state follows by U = C P⁰[submap, :]. Then both quaternions are brought to unit length, q/|q|, and
    P ← N P Nᵀ with N the derivative of that.
    """
    U = submap.C @ rows
    shift = (U.T @ submap.w).reshape(-1, SLOT)
    landmarks = state.landmarks + jnp.einsum("lij,lj->li", state.to_coordinates, shift)
    vehicle, N = normalise(config, submap.vehicle)
    return eqx.tree_at(
        lambda s: (s.vehicle, s.landmarks, s.to_coordinates, s.is_euclidean, s.P_vv, s.P_vm, s.P_mm),
        state,
        (
            vehicle,
            landmarks.at[slot].set(submap.landmarks),
            state.to_coordinates.at[slot].set(submap.to_coordinates),
            state.is_euclidean.at[slot].set(submap.is_euclidean),
            N @ submap.P[:VEHICLE, :VEHICLE] @ N.T,
            N @ (state.P_vm - submap.U[:, :VEHICLE].T @ U),
            state.P_mm - U.T @ U,
        ),
    )


def normalise(config: FilterConfig, vehicle: Float[Array, "14"]) -> tuple[Float[Array, "14"], Float[Array, "14 14"]]:
    """The vehicle with both quaternions of unit length, and the derivative of that."""
    N = jnp.eye(VEHICLE, dtype=vehicle.dtype)
    unit_vehicle = vehicle
    for q in (slice(3, 7), slice(10, 14)):
        unit_vehicle = unit_vehicle.at[q].set(unit(vehicle[q], config.toolbox_parity))
        N = N.at[q, q].set(unit_jacobian(vehicle[q], config.toolbox_parity))
    return unit_vehicle, N
