"""P_mm, the covariance of the map's slots: by far the largest block, passed over once in every frame.

P_mm is symmetric, so only half of it needs to be kept. It is divided into square tiles of `SLOTS_PER_BLOCK` slots; the
tiles on and below the diagonal are current, those above hold numbers that nobody may read. A downdate works through
the lower tiles of the slots in use, one small product each that stays in cache, and what reads rows takes the part to
the right of the diagonal tile from the columns instead. What is kept is P_mm - UᵀU, element by element.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

SLOT = 7
"""Error coordinates of a landmark slot."""
SLOTS_PER_BLOCK = 12
"""Slots along the side of a tile."""
TILE = SLOT * SLOTS_PER_BLOCK
"""Rows and columns of a tile."""


def downdate(P_mm: Float[Array, "M M"], U: Float[Array, "K2 M"], num_used: Int[Array, ""]) -> Float[Array, "M M"]:
    """P_mm - Uᵀ U in the lower tiles of the first `num_used` slots; the rows of the others mean nothing.

    The number of tiles depends on the map: a loop of unknown length, without derivative in reverse mode.
    """
    num_blocks = P_mm.shape[0] // TILE
    row, column = (jnp.asarray(index) for index in np.tril_indices(num_blocks))  # row by row
    right = U.reshape(-1, num_blocks, TILE).swapaxes(0, 1)
    left = right.mT

    def downdate_tile(t, P_mm):
        place = (TILE * row[t], TILE * column[t])
        tile = jax.lax.dynamic_slice(P_mm, place, (TILE, TILE)) - left[row[t]] @ right[column[t]]
        return jax.lax.dynamic_update_slice(P_mm, tile, place)

    used = (num_used + SLOTS_PER_BLOCK - 1) // SLOTS_PER_BLOCK
    return jax.lax.fori_loop(0, used * (used + 1) // 2, downdate_tile, P_mm)


def slot_rows(P_mm: Float[Array, "M M"], slot: Int[Array, " K"]) -> Float[Array, "K 7 M"]:
    """The rows of some slots, whole."""
    num_slots = P_mm.shape[0] // SLOT
    rows = P_mm.reshape(num_slots, SLOT, -1)[slot]
    columns = P_mm.reshape(-1, num_slots, SLOT)[:, slot].transpose(1, 2, 0)
    is_kept = jnp.arange(P_mm.shape[0]) // TILE <= slot[:, None] // SLOTS_PER_BLOCK
    return jnp.where(is_kept[:, None], rows, columns)


def slot_blocks(P_mm: Float[Array, "M M"]) -> Float[Array, "L 7 7"]:
    """Covariance of each slot with itself, the diagonal blocks."""
    num_slots = P_mm.shape[0] // SLOT
    blocks = P_mm.reshape(num_slots, SLOT, num_slots, SLOT)
    return blocks[jnp.arange(num_slots), :, jnp.arange(num_slots), :]


def symmetric(P_mm: Float[Array, "M M"]) -> Float[Array, "M M"]:
    """P_mm whole, the tiles above the diagonal from those below."""
    block = jnp.arange(P_mm.shape[0]) // TILE
    return jnp.where(block[:, None] >= block, P_mm, P_mm.T)
