"""Kalman algebra of one two-dimensional measurement: equations (8)–(12) in closed form.

Knows blocks of mean and covariance, nothing of what they stand for. All derivatives are exact. A 2 × 2 covariance is
inverted by its written-out Cholesky factor: a batched LAPACK call costs tens of times more.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def whitener(S: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """W = L⁻¹ of a positive definite S = L Lᵀ (L lower triangular): W z is white, zᵀ S⁻¹ z = |W z|².

    With S = [a b; b c]: W = [1/√a 0; -b/√(a Δ) a/√(a Δ)], Δ = a c - b². An S that is not positive definite gives NaN,
    which the run's flag reports.
    """
    a, b, c = S[0, 0], S[1, 0], S[1, 1]
    first, second = jax.lax.rsqrt(jnp.stack([a, a * (a * c - b * b)]))
    return jnp.stack([jnp.stack([first, jnp.zeros_like(a)]), jnp.stack([-b * second, a * second])])


def whiten(W: Float[Array, "2 2"], rows: Float[Array, "2 ..."]) -> Float[Array, "2 ..."]:
    """W times a vector (2,) or a matrix of two rows (2, n), written out so that it fuses with what comes next."""
    columns = W.T.reshape(2, 2, *(1,) * (rows.ndim - 1))
    return columns[0] * rows[0] + columns[1] * rows[1]


def innovation_cov(H: Float[Array, "2 n"], P: Float[Array, "n n"], R: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Z = H P Hᵀ + R, the covariance of the innovation. Paper equation (9)."""
    return H @ P @ H.T + R


def mahalanobis(z: Float[Array, "2"], S: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Squared Mahalanobis distance zᵀ S⁻¹ z. Paper equations (13) and (14)."""
    return jnp.sum(whiten(whitener(S), z) ** 2)


class Correction(NamedTuple):
    """The effect of one measurement on a Gaussian block."""

    shift: Float[Array, " n"]
    """K z, what the mean moves by. Equation (11)."""
    P: Float[Array, "n n"]
    """P - K Z Kᵀ. Equation (12)."""


def correct(P: Float[Array, "n n"], H: Float[Array, "2 n"], z: Float[Array, "2"], S: Float[Array, "2 2"]) -> Correction:
    """Correct a block by one measurement: K = P Hᵀ S⁻¹, shift K z, covariance P - K S Kᵀ. Equations (10)–(12).

    With U = W H P (W the whitener of S) these are Uᵀ(W z) and P - Uᵀ U: symmetric by construction.
    """
    W = whitener(S)
    U = whiten(W, H @ P)
    return Correction(U.T @ whiten(W, z), P - U.T @ U)
