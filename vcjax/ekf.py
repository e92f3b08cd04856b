"""Kalman algebra of one two-dimensional measurement: equations (8)–(12) in closed form.

Knows blocks of mean and covariance, nothing of what they stand for. All derivatives are exact. A 2 × 2 covariance is
inverted by its written-out Cholesky factor: a batched LAPACK call costs tens of times more.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Whitener(NamedTuple):
    """W = L⁻¹ of S = L Lᵀ (2 × 2): W z is white, zᵀS⁻¹z = |W z|². Lower triangular, kept as its three numbers."""

    w11: Float[Array, "..."]
    w21: Float[Array, "..."]
    w22: Float[Array, "..."]

    def __call__(self, a: Float[Array, " 2 *n"]) -> Float[Array, " 2 *n"]:
        """W a, for a vector (2,) or the rows of a matrix (2, n)."""
        return jnp.stack([self.w11 * a[0], self.w21 * a[0] + self.w22 * a[1]])


def whitener(S: Float[Array, "2 2"]) -> Whitener:
    """Inverse Cholesky factor of a positive definite S. An S that is not gives NaN, which the run's flag reports."""
    l11 = jnp.sqrt(S[0, 0])
    l21 = S[1, 0] / l11
    l22 = jnp.sqrt(S[1, 1] - l21 * l21)
    return Whitener(1.0 / l11, -l21 / (l11 * l22), 1.0 / l22)


def innovation_cov(H: Float[Array, "2 n"], P: Float[Array, "n n"], R: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Z = H P Hᵀ + R, the covariance of the innovation. Paper equation (9)."""
    return H @ P @ H.T + R


def mahalanobis(z: Float[Array, "2"], S: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Squared Mahalanobis distance zᵀ S⁻¹ z. Paper equations (13) and (14)."""
    return jnp.sum(whitener(S)(z) ** 2)


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
    U = W(H @ P)
    return Correction(U.T @ W(z), P - U.T @ U)
