"""Candidates whose measurement is linear, pixel = H x, so that the closed form of the gates is exact."""

import jax.numpy as jnp
import numpy as np

from vcjax.gates.gate import Candidates, MeasurementModel

SIZE = 21
# The mean of a block is the pair (x, H).
MODEL = MeasurementModel(
    observe=lambda mean: (mean[1] @ mean[0], mean[1]), retract=lambda mean, shift: (mean[0] + shift, mean[1])
)


def linear_candidates(seed, num=8, R=None, is_isolated=None):
    """Random candidates whose λ, the innovation's covariance over the pixel noise, goes from 1.001 to 1000."""
    rng = np.random.default_rng(seed)
    R = np.eye(2) if R is None else np.asarray(R)
    H, A = rng.normal(size=(num, 2, SIZE)), rng.normal(size=(num, SIZE, SIZE))
    P = 10 ** rng.uniform(-3, 3, (num, 1, 1)) * (A @ A.mT) / SIZE**2
    L = np.linalg.cholesky(H @ P @ H.mT + R)
    # Errors of zero to ten standard deviations.
    z = (L @ (rng.uniform(0, 10, (num, 1, 1)) * rng.normal(size=(num, 2, 1))))[..., 0]
    x = rng.normal(size=(num, SIZE))
    uv_px = np.einsum("kin,kn->ki", H, x) + z
    mask = np.ones(num, bool) if is_isolated is None else is_isolated
    return Candidates((jnp.array(x), jnp.array(H)), *map(jnp.array, (P, uv_px, R, mask)))


def errors_before_correction(candidates):
    """RE₁ = zᵀ (H P Hᵀ + R)⁻¹ z of each candidate, in NumPy."""
    x, H = map(np.asarray, candidates.mean)
    z = np.asarray(candidates.uv_px) - np.einsum("kin,kn->ki", H, x)
    S = H @ np.asarray(candidates.P) @ H.mT + np.asarray(candidates.R)
    return np.einsum("ki,ki->k", z, np.linalg.solve(S, z[..., None])[..., 0])
