"""One correction of the submap, by one candidate or by all of them stacked. Equations (8)–(13).

A correction has a weight g: 0 or 1 in the hard filter, in between in a soft one (see `submap`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.ekf import mahalanobis, whiten, whitener
from vcjax.filter.config import FilterConfig
from vcjax.filter.features import observe
from vcjax.filter.map_covariance import SLOT
from vcjax.filter.reparametrisation import AtCorrection
from vcjax.filter.submap import (
    Submap,
    block,
    block_carry,
    block_columns,
    block_rows,
    first_row,
    landmark_means,
    vehicle_mean,
    weighted,
    wide,
)
from vcjax.gates.gate import Joint
from vcjax.models.camera import Camera
from vcjax.models.landmarks import INVERSE_DEPTH


class Innovation(NamedTuple):
    """One candidate's innovation, at the state it was tested at."""

    pixel: Float[Array, "*b 2"]
    """Predicted pixel ê."""
    z: Float[Array, "*b 2"]
    """y - ê. Equation (8)."""
    S: Float[Array, "*b 2 2"]
    """H P Hᵀ + R. Equation (9)."""
    re1: Float[Array, "*b"]
    """zᵀ S⁻¹ z. Equation (13)."""
    is_visible: Bool[Array, "*b"]
    """Predicted inside the image."""
    H_l: Float[Array, "*b 2 7"]
    """The landmark's part of H, by the errors of its slot."""
    PH_l: Float[Array, "*b 7 2"]
    """Its rows of P Hᵀ."""


class Gain(NamedTuple):
    """What a correction needs beside its innovation."""

    H: Float[Array, "2 block"]
    HP: Float[Array, "2 n"]
    """H P."""
    HU: Float[Array, "2 M"]
    """H Uᵀ D, of the rows of the corrections so far."""


def innovate(
    config: FilterConfig, camera: Camera, submap: Submap, j: int | Int[Array, ""], uv_px: Float[Array, "2"]
) -> tuple[Innovation, Gain]:
    """Innovation of candidate j at the submap's present state. Equations (8), (9), (13)."""
    observation = observe(config, camera, block(submap, j))
    H = observation.H if config.errors == "additive" else observation.H @ block_carry(config, submap, j)
    HU = weighted(submap, H @ block_columns(submap, submap.U, j).T)
    HP = H @ block_rows(submap, submap.P, j) - HU @ submap.U
    S = block_columns(submap, HP, j) @ H.T + pixel_cov(config, H.dtype)
    z, is_visible = uv_px - observation.pixel, observation.is_visible
    PH_l = block_columns(submap, HP, j)[:, -SLOT:].T
    return Innovation(observation.pixel, z, S, mahalanobis(z, S), is_visible, H[:, -SLOT:], PH_l), Gain(H, HP, HU)


def innovate_jointly(
    config: FilterConfig, camera: Camera, submap: Submap, uv_px: Float[Array, "K 2"], is_measured: Bool[Array, " K"]
) -> tuple[Innovation, Joint]:
    """All candidates' innovations at the submap's present state, and how they depend on each other."""
    everyone = jnp.arange(is_measured.shape[0])
    innovation, gain = jax.vmap(lambda j, y: innovate(config, camera, submap, j, y))(everyone, uv_px)
    H = jax.vmap(wide, in_axes=(None, 0, 0))(submap, everyone, gain.H)
    R = pixel_cov(config, H.dtype)
    is_pair = (is_measured[:, None] & is_measured)[..., None, None]
    S = jnp.where(is_pair, jnp.einsum("ian,jbn->ijab", gain.HP, H), 0.0)
    S = S.at[everyone, everyone].add(R)
    return innovation, Joint(jnp.where(is_measured[:, None], innovation.z, 0.0), S, R, is_measured)


def correct_with(
    submap: Submap,
    j: int | Int[Array, ""],
    c: int | Int[Array, ""],
    innovation: Innovation,
    gain: Gain,
    g: Float[Array, ""],
    is_used: Bool[Array, ""],
    is_noted: Bool[Array, ""],
) -> Submap:
    """Correction c, with candidate j and weight g: u = W H P, P - (2 g - g²) uᵀu, x + g uᵀ(W z). Equations (10)–(12).

    Where it is not used nothing changes; where it is not noted its landmark does not settle by it.
    """
    W = whitener(innovation.S)
    own = jnp.arange(len(submap.T)) == 2 * c + jnp.arange(2)[:, None]
    u = jnp.where(is_used, whiten(W, gain.HP), 0.0)
    t = jnp.where(is_used, whiten(W, own - gain.HU @ submap.T), 0.0)
    w = jnp.where(is_used, g * whiten(W, innovation.z), 0.0)

    def write(rows, new, index, is_used=is_used):
        # A correction passed through a second time without being used must not wipe out what was noted at the first.
        old = jax.lax.dynamic_slice_in_dim(rows, index, new.shape[0])
        return jax.lax.dynamic_update_slice_in_dim(rows, jnp.where(is_used, new, old), index, axis=0)

    vehicle_before = vehicle_mean(submap)
    moved = eqx.tree_at(
        lambda s: (s.shift, s.U, s.H, s.T, s.w),
        submap,
        (
            submap.shift + u.T @ w,
            write(submap.U, u, 2 * c),
            write(submap.H, gain.H[None], c),
            write(submap.T, t, 2 * c),
            write(submap.w, w, 2 * c),
        ),
    )
    if submap.g is not None:
        moved = eqx.tree_at(lambda s: s.g, moved, write(submap.g, jnp.broadcast_to(g, 2), 2 * c))
    variance = _inverse_depth_variance(moved, j)
    noted = AtCorrection(block(moved, j).landmark, variance, vehicle_before)
    at_correction = jax.tree.map(lambda rows, new: write(rows, new[None], j, is_noted), submap.at_correction, noted)
    return eqx.tree_at(lambda s: s.at_correction, moved, at_correction)


def correct_stacked(
    config: FilterConfig, camera: Camera, submap: Submap, uv_px: Float[Array, "K 2"], is_used: Bool[Array, " K"]
) -> Submap:
    """Correct with all candidates at once, all linearised at the predicted state: Z = H P Hᵀ + R is 2K × 2K."""
    num_candidates, size = is_used.shape[0], submap.P.shape[0]

    def measure(j, y, used):
        observation = observe(config, camera, block(submap, j))
        numbers = (observation.H, wide(submap, j, observation.H), y - observation.pixel)
        return tuple(jnp.where(used, number, 0.0) for number in numbers)

    # A candidate that is not used measures nothing: H = 0, z = 0, and its block of Z is R.
    H, H_wide, z = jax.vmap(measure)(jnp.arange(num_candidates), uv_px, is_used)
    H_wide, z = H_wide.reshape(-1, size), z.reshape(-1)
    HP = H_wide @ submap.P
    R = jnp.kron(jnp.eye(num_candidates, dtype=HP.dtype), pixel_cov(config, HP.dtype))
    L = jnp.linalg.cholesky(HP @ H_wide.T + R)
    T = jax.scipy.linalg.solve_triangular(L, jnp.eye(len(L), dtype=L.dtype), lower=True)
    U, w = T @ HP, T @ z
    vehicle_before = jnp.broadcast_to(vehicle_mean(submap), (num_candidates, *submap.vehicle.shape))
    moved = eqx.tree_at(lambda s: (s.shift, s.U, s.H, s.T, s.w), submap, (submap.shift + U.T @ w, U, H, T, w))
    variance = _inverse_depth_variance(moved, jnp.arange(num_candidates))
    at_correction = AtCorrection(landmark_means(moved), variance, vehicle_before)
    return eqx.tree_at(lambda s: s.at_correction, moved, at_correction)


def _inverse_depth_variance(submap: Submap, j: int | Int[Array, "*j"]) -> Float[Array, "*j"]:
    """Current variance of the last error coordinate of candidate j."""
    last = first_row(submap, j) + INVERSE_DEPTH
    return submap.P[last, last] - jnp.sum(weighted(submap, submap.U[:, last].T ** 2), axis=-1)


def pixel_cov(config: FilterConfig, dtype) -> Float[Array, "2 2"]:
    """R, the covariance of a measured pixel."""
    return jnp.asarray(config.pixel_std_px, dtype) ** 2 * jnp.eye(2, dtype=dtype)
