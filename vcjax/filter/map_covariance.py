"""P_mm, the covariance of the map's slots: by far the largest block, passed over once in every frame.

P_mm is symmetric, so only half of it needs to be kept. It is divided into square tiles of `SLOTS_PER_BLOCK` slots; the
tiles on and below the diagonal are current, those above hold numbers that nobody may read. A downdate works through
the lower tiles of the slots in use, one small product each that stays in cache, and what reads rows takes the part to
the right of the diagonal tile from the columns instead. What is kept is P_mm - UᵀU, element by element.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vcjax.gates.gate import SLOT as SLOT

SLOTS_PER_BLOCK = 12
"""Slots along the side of a tile."""
TILE = SLOT * SLOTS_PER_BLOCK
"""Rows and columns of a tile."""


def downdate(
    P_mm: Float[Array, "M M"], V: Float[Array, "K2 M"], U: Float[Array, "K2 M"], num_used: Int[Array, ""]
) -> Float[Array, "M M"]:
    """P_mm - Vᵀ U, symmetric, in the lower tiles of the first `num_used` slots; the rows of the others mean nothing.

    The number of tiles depends on the map: a loop of unknown length, without derivative in reverse mode.
    """
    row, column = _lower_tiles(P_mm)
    left, right = _columns_of_blocks(V).mT, _columns_of_blocks(U)

    def downdate_tile(t, P_mm):
        place = (TILE * row[t], TILE * column[t])
        tile = jax.lax.dynamic_slice(P_mm, place, (TILE, TILE)) - left[row[t]] @ right[column[t]]
        return jax.lax.dynamic_update_slice(P_mm, tile, place)

    return jax.lax.fori_loop(0, _num_tiles(num_used), downdate_tile, P_mm)


def read_rows(P_mm: Float[Array, "M M"], slot: Int[Array, " K"]) -> tuple[Float[Array, "M M"], Float[Array, "K 7 M"]]:
    """P_mm as it is, and the rows of some slots, all different, whole."""
    num_slots = P_mm.shape[0] // SLOT
    rows = P_mm.reshape(num_slots, SLOT, -1)[slot]
    columns = P_mm.reshape(-1, num_slots, SLOT)[:, slot].transpose(1, 2, 0)
    return P_mm, jnp.where(_is_current(P_mm, slot)[:, None], rows, columns)


def slot_blocks(P_mm: Float[Array, "M M"]) -> Float[Array, "L 7 7"]:
    """Covariance of each slot with itself, the diagonal blocks."""
    num_slots = P_mm.shape[0] // SLOT
    blocks = jnp.asarray(P_mm).reshape(num_slots, SLOT, num_slots, SLOT)
    return blocks[jnp.arange(num_slots), :, jnp.arange(num_slots), :]


def symmetric(P_mm: Float[Array, "M M"]) -> Float[Array, "M M"]:
    """P_mm whole, the tiles above the diagonal from those below."""
    block = jnp.arange(P_mm.shape[0]) // TILE
    return jnp.where(block[:, None] >= block, P_mm, P_mm.T)


# The same two operations with derivatives in reverse mode (and in no other) that are as cheap as they are: the downdate
# needs U and V and not P_mm for its way back, and the derivative by the rows is added to that by P_mm in place, for
# which whoever reads rows goes on with the P_mm that was handed back.
reversible_downdate = jax.custom_vjp(downdate)
reversible_read_rows = jax.custom_vjp(read_rows)


def _downdate_backward(residuals, P_bar):
    """Tile (r, c) is P - V_rᵀ U_c: the derivative by P stays, V̄_r = -U_c P̄ᵀ and Ū_c = -V_r P̄."""
    V, U, num_used = residuals
    row, column = _lower_tiles(P_bar)
    left, right = _columns_of_blocks(V), _columns_of_blocks(U)

    def add_tile(t, bars):
        V_bar, U_bar = bars
        r, c = row[t], column[t]
        tile = jax.lax.dynamic_slice(P_bar, (TILE * r, TILE * c), (TILE, TILE))
        return V_bar.at[r].add(-right[c] @ tile.T), U_bar.at[c].add(-left[r] @ tile)

    bars = jax.lax.fori_loop(0, _num_tiles(num_used), add_tile, (jnp.zeros_like(left), jnp.zeros_like(right)))
    V_bar, U_bar = (bar.swapaxes(0, 1).reshape(U.shape) for bar in bars)
    return P_bar, V_bar, U_bar, None


def _read_rows_backward(slot, given):
    P_bar, rows_bar = given
    is_current = _is_current(P_bar, slot)

    def add_slot(k, P_bar):
        first, rows = SLOT * slot[k], rows_bar[k]
        own = jax.lax.dynamic_slice_in_dim(P_bar, first, SLOT) + jnp.where(is_current[k], rows, 0.0)
        P_bar = jax.lax.dynamic_update_slice_in_dim(P_bar, own, first, axis=0)
        own = jax.lax.dynamic_slice_in_dim(P_bar, first, SLOT, axis=1) + jnp.where(is_current[k], 0.0, rows).T
        return jax.lax.dynamic_update_slice_in_dim(P_bar, own, first, axis=1)

    return jax.lax.fori_loop(0, len(slot), add_slot, P_bar), None


reversible_downdate.defvjp(
    lambda P_mm, V, U, num_used: (downdate(P_mm, V, U, num_used), (V, U, num_used)), _downdate_backward
)
reversible_read_rows.defvjp(lambda P_mm, slot: (read_rows(P_mm, slot), slot), _read_rows_backward)


def _lower_tiles(P_mm: Float[Array, "M M"]) -> tuple[Int[Array, " tiles"], Int[Array, " tiles"]]:
    """Row and column, in blocks, of the tiles on and below the diagonal, row by row."""
    row, column = np.tril_indices(P_mm.shape[0] // TILE)
    return jnp.asarray(row), jnp.asarray(column)


def _num_tiles(num_used: Int[Array, ""]) -> Int[Array, ""]:
    """How many of them hold the slots in use."""
    used = (num_used + SLOTS_PER_BLOCK - 1) // SLOTS_PER_BLOCK
    return used * (used + 1) // 2


def _columns_of_blocks(U: Float[Array, "K2 M"]) -> Float[Array, "blocks K2 tile"]:
    return U.reshape(U.shape[0], -1, TILE).swapaxes(0, 1)


def _is_current(P_mm: Float[Array, "M M"], slot: Int[Array, " K"]) -> Bool[Array, "K M"]:
    """Which elements of the rows of some slots are current; the others are in their columns."""
    return jnp.arange(P_mm.shape[0]) // TILE <= slot[:, None] // SLOTS_PER_BLOCK
