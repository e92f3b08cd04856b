"""P_mm in tiles, of which the lower are current: the numbers and derivatives of the whole matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import QUICK

from vcjax.filter.map_covariance import (
    SLOT,
    TILE,
    downdate,
    read_rows,
    reversible_downdate,
    reversible_read_rows,
    symmetric,
)

SIZE = 3 * TILE
NUM_USED = jnp.array(20)  # in two of the three blocks
SLOTS = jnp.array([19, 3, 12])  # in either block, out of order
RNG = np.random.default_rng(0)
U = jnp.asarray(RNG.standard_normal((4, SIZE)))
V = jnp.array([1.0, 0.5, 0.0, 0.9])[:, None] * U  # Vᵀ U is symmetric
WEIGHTS = jnp.asarray(RNG.standard_normal((2, 3, SLOT, 2 * TILE)))


def covariance() -> jax.Array:
    """A covariance whose upper tiles hold what nobody may read."""
    root = RNG.standard_normal((SIZE, SIZE))
    P = root @ root.T
    block = np.arange(SIZE) // TILE
    return jnp.asarray(np.where(block[:, None] >= block, P, np.nan))


@pytest.mark.parametrize("functions", [(downdate, read_rows), (reversible_downdate, reversible_read_rows)])
def test_tiles_hold_the_whole_matrix(functions):
    downdate, read_rows = functions
    P = covariance()
    whole = symmetric(P) - V.T @ U
    P = downdate(P, V, U, NUM_USED)
    used = slice(0, SLOT * int(NUM_USED))
    np.testing.assert_allclose(symmetric(P)[used, used], whole[used, used], rtol=1e-12, atol=1e-12)
    same, rows = read_rows(P, SLOTS)
    np.testing.assert_array_equal(same, P)
    expected = whole.reshape(-1, SLOT, SIZE)[SLOTS]
    np.testing.assert_allclose(rows[..., used], expected[..., used], rtol=1e-12, atol=1e-12)


def test_derivative_in_reverse_mode_is_that_of_the_whole_matrix():
    """A scalar of rows read before and after a downdate, by P, by U and by the weights D of its rows."""
    used = slice(0, 2 * TILE)

    def value(first, second):
        return jnp.sum(WEIGHTS[0] * first[..., used]) + jnp.sum(WEIGHTS[1] * second[..., used] ** 2)

    def by_tiles(P, U, D):
        P, first = reversible_read_rows(P, SLOTS)
        P = reversible_downdate(P, D[:, None] * U, U, NUM_USED)
        return value(first, reversible_read_rows(P, SLOTS)[1])

    def whole(P, U, D):
        P = symmetric(P)
        return value(P.reshape(-1, SLOT, SIZE)[SLOTS], (P - (U.T * D) @ U).reshape(-1, SLOT, SIZE)[SLOTS])

    P, D = jnp.nan_to_num(covariance()), jnp.array([1.0, 0.5, 0.0, 0.9])
    found, expected = (jax.jit(jax.grad(f, (0, 1, 2)), compiler_options=QUICK)(P, U, D) for f in (by_tiles, whole))
    for name, a, b in zip("PUD", found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-8, err_msg=name)
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(lambda U: reversible_downdate(P, U, U, NUM_USED), (U,), (U,))
