"""Formal corrections of the frame's candidates, sequential or stacked, and the verdict on those left out."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.ekf import mahalanobis, whiten, whitener
from vcjax.filter.config import FilterConfig
from vcjax.filter.features import measurement_model, observe
from vcjax.filter.reparametrisation import AtCorrection
from vcjax.filter.state import VEHICLE
from vcjax.filter.submap import (
    Submap,
    block,
    block_columns,
    block_cov,
    block_rows,
    first_row,
    landmark_means,
    vehicle_mean,
)
from vcjax.gates.gate import Candidates, Verdict
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


class Outcome(NamedTuple):
    """What became of the frame's K candidates."""

    innovation: Innovation
    is_accepted: Bool[Array, " K"]
    verdict: Verdict


def correct_frame(
    config: FilterConfig, camera: Camera, submap: Submap, uv_px: Float[Array, "K 2"], is_measured: Bool[Array, " K"]
) -> tuple[Submap, Outcome]:
    """Correct with the accepted candidates, judge the isolated ones, correct with the recovered. Paper section 3.

    Args:
        config: gate, order of correction, noises.
        camera: calibration.
        submap: vehicle and candidates after prediction.
        uv_px: measured pixels, anything where not measured.
        is_measured: which candidates have a measurement; the others change nothing.

    Returns: the corrected submap, and the candidates' innovations and verdicts.
    """
    num_candidates = is_measured.shape[0]
    predicted, gate = submap, config.gate
    # An unmeasured candidate's pixel may be anything, NaN included; zero keeps derivatives finite.
    uv_px = jnp.where(is_measured[:, None], uv_px, 0.0)
    if gate.prior == "predicted" or config.update == "stacked":
        at_prediction = jax.vmap(lambda j, y: innovate(config, camera, predicted, j, y)[0])
        innovation = at_prediction(jnp.arange(num_candidates), uv_px)
        is_accepted = is_measured & gate.accepts(innovation.re1)
        if config.update == "stacked":
            submap = _correct_stacked(config, camera, submap, uv_px, is_accepted)
        else:
            submap, _, _ = _correct_sequentially(config, camera, submap, uv_px, is_accepted, is_gated=False)
    else:
        submap, innovation, is_accepted = _correct_sequentially(
            config, camera, submap, uv_px, is_measured, is_gated=True
        )

    is_isolated = is_measured & ~is_accepted

    def judge(submap: Submap) -> tuple[Submap, Verdict]:
        prior = predicted if gate.prior == "predicted" else submap
        everyone = jnp.arange(num_candidates)
        candidates = Candidates(
            mean=jax.vmap(block, in_axes=(None, 0))(prior, everyone),
            P=jax.vmap(block_cov, in_axes=(None, 0))(prior, everyone),
            uv_px=uv_px,
            R=_pixel_cov(config, uv_px.dtype),
            is_isolated=is_isolated,
        )
        verdict = gate.judge(candidates, measurement_model(config, camera))
        return _correct_recovered(config, camera, submap, uv_px, verdict.is_recovered), verdict

    def judge_nobody(submap: Submap) -> tuple[Submap, Verdict]:
        nobody, nothing = jnp.zeros_like(is_isolated), jnp.full(num_candidates, jnp.nan, uv_px.dtype)
        return submap, Verdict(nobody, nobody, nothing, nothing)

    # In most frames nobody is isolated.
    submap, verdict = jax.lax.cond(jnp.any(is_isolated), judge, judge_nobody, submap)
    submap = eqx.tree_at(lambda s: s.is_corrected, submap, is_accepted | verdict.is_recovered)
    return submap, Outcome(innovation, is_accepted, verdict)


class Gain(NamedTuple):
    """What a correction needs beside its innovation."""

    H: Float[Array, "2 21"]
    HP: Float[Array, "2 n"]
    """H P."""
    HU: Float[Array, "2 M"]
    """H Uᵀ, of the rows of the corrections so far."""


def innovate(
    config: FilterConfig, camera: Camera, submap: Submap, j: int | Int[Array, ""], uv_px: Float[Array, "2"]
) -> tuple[Innovation, Gain]:
    """Innovation of candidate j at the submap's present state. Equations (8), (9), (13)."""
    observation = observe(config, camera, block(submap, j))
    H = observation.H
    HU = H @ block_columns(submap.U, j).T
    HP = H @ block_rows(submap.P, j) - HU @ submap.U
    S = block_columns(HP, j) @ H.T + _pixel_cov(config, H.dtype)
    z = uv_px - observation.pixel
    return Innovation(observation.pixel, z, S, mahalanobis(z, S), observation.is_visible), Gain(H, HP, HU)


def _correct_sequentially(
    config: FilterConfig,
    camera: Camera,
    submap: Submap,
    uv_px: Float[Array, "K 2"],
    is_candidate: Bool[Array, " K"],
    is_gated: bool,
) -> tuple[Submap, Innovation, Bool[Array, " K"]]:
    """Correct with one candidate after another, each re-linearised at the state left by the one before."""

    def correct_next(submap: Submap, candidate):
        j, y, is_used = candidate
        innovation, gain = innovate(config, camera, submap, j, y)
        if is_gated:
            is_used = is_used & config.gate.accepts(innovation.re1)
        return _apply(submap, j, innovation, gain, is_used), (innovation, is_used)

    candidates = (jnp.arange(is_candidate.shape[0]), uv_px, is_candidate)
    submap, (innovation, is_accepted) = jax.lax.scan(correct_next, submap, candidates)
    return submap, innovation, is_accepted


def _correct_recovered(
    config: FilterConfig, camera: Camera, submap: Submap, uv_px: Float[Array, "K 2"], is_recovered: Bool[Array, " K"]
) -> Submap:
    """Correct with the recovered candidates in sequence, without gating them again.

    They are few: the loop ends with the last of them. A loop of unknown length has no reverse mode, so in
    `reverse_mode` all K candidates are passed through, those not recovered without effect.
    """
    if config.reverse_mode:
        return _correct_sequentially(config, camera, submap, uv_px, is_recovered, is_gated=False)[0]

    def correct_next(carry):
        submap, is_left = carry
        j = jnp.argmax(is_left)
        innovation, gain = innovate(config, camera, submap, j, uv_px[j])
        return _apply(submap, j, innovation, gain, is_left[j]), is_left.at[j].set(False)

    return jax.lax.while_loop(lambda carry: jnp.any(carry[1]), correct_next, (submap, is_recovered))[0]


def _apply(
    submap: Submap, j: int | Int[Array, ""], innovation: Innovation, gain: Gain, is_used: Bool[Array, ""]
) -> Submap:
    """One correction, u = W H P: P - uᵀu and x + uᵀ(W z); nothing at all where it is not used. Equations (10)–(12)."""
    W = whitener(innovation.S)
    own = jnp.arange(len(submap.T)) == 2 * j + jnp.arange(2)[:, None]
    u = jnp.where(is_used, whiten(W, gain.HP), 0.0)
    t = jnp.where(is_used, whiten(W, own - gain.HU @ submap.T), 0.0)
    w = jnp.where(is_used, whiten(W, innovation.z), 0.0)

    def write(rows, new, index):
        # A correction passed through a second time without being used must not wipe out what was noted at the first.
        old = jax.lax.dynamic_slice_in_dim(rows, index, new.shape[0])
        return jax.lax.dynamic_update_slice_in_dim(rows, jnp.where(is_used, new, old), index, axis=0)

    vehicle_before = vehicle_mean(submap)
    moved = eqx.tree_at(
        lambda s: (s.shift, s.U, s.H, s.T, s.w),
        submap,
        (
            submap.shift + u.T @ w,
            write(submap.U, u, 2 * j),
            write(submap.H, gain.H[None], j),
            write(submap.T, t, 2 * j),
            write(submap.w, w, 2 * j),
        ),
    )
    variance = _inverse_depth_variance(moved, j)
    noted = AtCorrection(block(moved, j).landmark, variance, vehicle_before)
    at_correction = jax.tree.map(lambda rows, new: write(rows, new[None], j), submap.at_correction, noted)
    return eqx.tree_at(lambda s: s.at_correction, moved, at_correction)


def _correct_stacked(
    config: FilterConfig, camera: Camera, submap: Submap, uv_px: Float[Array, "K 2"], is_used: Bool[Array, " K"]
) -> Submap:
    """Correct with all candidates at once, all linearised at the predicted state: Z = H P Hᵀ + R is 2K × 2K."""
    num_candidates, size = is_used.shape[0], submap.P.shape[0]

    def measure(j, y, used):
        observation = observe(config, camera, block(submap, j))
        wide = jnp.zeros((2, size), submap.P.dtype).at[:, :VEHICLE].set(observation.H[:, :VEHICLE])
        wide = jax.lax.dynamic_update_slice_in_dim(wide, observation.H[:, VEHICLE:], first_row(j), axis=1)
        return tuple(jnp.where(used, number, 0.0) for number in (observation.H, wide, y - observation.pixel))

    # A candidate that is not used measures nothing: H = 0, z = 0, and its block of Z is R.
    H, wide, z = jax.vmap(measure)(jnp.arange(num_candidates), uv_px, is_used)
    wide, z = wide.reshape(-1, size), z.reshape(-1)
    HP = wide @ submap.P
    R = jnp.kron(jnp.eye(num_candidates, dtype=HP.dtype), _pixel_cov(config, HP.dtype))
    L = jnp.linalg.cholesky(HP @ wide.T + R)
    T = jax.scipy.linalg.solve_triangular(L, jnp.eye(len(L), dtype=L.dtype), lower=True)
    U, w = T @ HP, T @ z
    vehicle_before = jnp.broadcast_to(vehicle_mean(submap), (num_candidates, VEHICLE))
    moved = eqx.tree_at(lambda s: (s.shift, s.U, s.H, s.T, s.w), submap, (submap.shift + U.T @ w, U, H, T, w))
    variance = _inverse_depth_variance(moved, jnp.arange(num_candidates))
    at_correction = AtCorrection(landmark_means(moved), variance, vehicle_before)
    return eqx.tree_at(lambda s: s.at_correction, moved, at_correction)


def _inverse_depth_variance(submap: Submap, j: int | Int[Array, "*j"]) -> Float[Array, "*j"]:
    """Current variance of the last error coordinate of candidate j."""
    last = first_row(j) + INVERSE_DEPTH
    return submap.P[last, last] - jnp.sum(submap.U[:, last] ** 2, axis=0)


def _pixel_cov(config: FilterConfig, dtype) -> Float[Array, "2 2"]:
    """R, the covariance of a measured pixel."""
    return jnp.asarray(config.pixel_std_px, dtype) ** 2 * jnp.eye(2, dtype=dtype)
