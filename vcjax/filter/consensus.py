"""Consensus: in which order to correct with a frame's candidates, so that a wrong one does not lead the others astray.

Corrections in sequence trust the first: where odometry is poor, a candidate that moves or was mismatched passes its
gate easily, drags the camera along, and the static ones then fail theirs. So each candidate j is asked, as a
hypothesis, how many others agree with it. All is in the joint covariance of the innovations at prediction, C = H P Hᵀ
with 2 × 2 blocks C_ij and S_j = C_jj + R: given that j is right, candidate i has

    z_i|j = z_i - C_ij S_j⁻¹ z_j,    S_i|j = S_i - C_ij S_j⁻¹ C_ji,    RE_i|j = z_i|jᵀ S_i|j⁻¹ z_i|j,

and it agrees where the gate would accept RE_i|j. The hypothesis with the most that agree goes first, then they, the
best predicted first, then the rest. Each is still gated at the running state as ever.

This is the one-point RANSAC of Civera, Grasa, Davison & Montiel (2010), with every hypothesis tried instead of some at
random, and with the covariance that a hypothesis leaves instead of a fixed number of pixels.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.ekf import mahalanobis, whiten, whitener
from vcjax.filter.config import FilterConfig
from vcjax.filter.correction import pixel_cov
from vcjax.filter.features import observe
from vcjax.filter.submap import Submap, block, wide
from vcjax.models.camera import Camera


def consensus_order(
    config: FilterConfig, camera: Camera, submap: Submap, uv_px: Float[Array, "K 2"], is_measured: Bool[Array, " K"]
) -> Int[Array, " K"]:
    """Candidates in the order to correct with, a permutation; constant under differentiation."""
    submap, uv_px = jax.lax.stop_gradient((submap, uv_px))
    num = is_measured.shape[0]
    everyone = jnp.arange(num)
    observation = jax.vmap(lambda j: observe(config, camera, block(submap, j)))(everyone)
    H = jax.vmap(lambda j, H: wide(submap, j, H))(everyone, observation.H).reshape(2 * num, -1)
    C = (H @ submap.P @ H.T).reshape(num, 2, num, 2).transpose(0, 2, 1, 3)
    S = C[everyone, everyone] + pixel_cov(config, C.dtype)
    z = uv_px - observation.pixel
    W = jax.vmap(whitener)(S)

    def given(j):
        """RE and spread of all candidates, given that j is right."""
        U = jax.vmap(lambda C_ji: whiten(W[j], C_ji))(C[j])  # W C_ji
        z_given = z - jnp.einsum("kai,a->ki", U, whiten(W[j], z[j]))
        S_given = S - jnp.einsum("kai,kaj->kij", U, U)
        re = jax.vmap(mahalanobis)(z_given, S_given)
        return re, S_given[:, 0, 0] * S_given[:, 1, 1] - S_given[:, 0, 1] ** 2

    re, spread = jax.vmap(given)(everyone)
    agrees = config.gate.accepts(re) & is_measured & is_measured[:, None]
    best = jnp.argmax(jnp.sum(agrees, axis=1))
    rank = jnp.where(agrees[best], spread[best], jnp.inf).at[best].set(-jnp.inf)
    return jnp.argsort(jnp.where(is_measured, rank, jnp.nan), stable=True)
