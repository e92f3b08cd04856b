"""Formal corrections of the frame's candidates, sequential or stacked, and the verdict on those left out."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.ekf import mahalanobis, whitener
from vcjax.filter.config import FilterConfig
from vcjax.filter.features import measurement_model, observe
from vcjax.filter.state import SLOT, VEHICLE
from vcjax.filter.submap import Submap, block, block_cov, slot_rows
from vcjax.gates.gate import Candidates, Verdict
from vcjax.models.camera import Camera
from vcjax.models.frames import unit
from vcjax.models.landmarks import INVERSE_DEPTH, euclidean, linearity_index, to_point, to_point_jacobian


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

    prior = predicted if gate.prior == "predicted" else submap
    everyone = jnp.arange(num_candidates)
    candidates = Candidates(
        mean=jax.vmap(block, in_axes=(None, 0))(prior, everyone),
        P=jax.vmap(block_cov, in_axes=(None, 0))(prior, everyone),
        uv_px=uv_px,
        R=_pixel_cov(config, uv_px.dtype),
        is_isolated=is_measured & ~is_accepted,
    )
    verdict = gate.judge(candidates, measurement_model(config, camera))
    submap = _correct_recovered(config, camera, submap, uv_px, verdict.is_recovered)
    return submap, Outcome(innovation, is_accepted, verdict)


def innovate(
    config: FilterConfig, camera: Camera, submap: Submap, j: int | Int[Array, ""], uv_px: Float[Array, "2"]
) -> tuple[Innovation, Float[Array, "2 21"], Float[Array, "2 n"]]:
    """Innovation of candidate j at the submap's present state, with H and H P. Equations (8), (9), (13)."""
    observation = observe(config, camera, block(submap, j))
    H_v, H_l = observation.H[:, :VEHICLE], observation.H[:, VEHICLE:]
    HP = H_v @ submap.P[:VEHICLE] + H_l @ jax.lax.dynamic_slice_in_dim(submap.P, slot_rows(j), SLOT)
    own = jax.lax.dynamic_slice_in_dim(HP, slot_rows(j), SLOT, axis=1)
    S = HP[:, :VEHICLE] @ H_v.T + own @ H_l.T + _pixel_cov(config, HP.dtype)
    z = uv_px - observation.pixel
    return Innovation(observation.pixel, z, S, mahalanobis(z, S), observation.is_visible), observation.H, HP


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
        innovation, H, HP = innovate(config, camera, submap, j, y)
        if is_gated:
            is_used = is_used & config.gate.accepts(innovation.re1)
        return _apply(config, submap, j, innovation, H, HP, is_used), (innovation, is_used)

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
        innovation, H, HP = innovate(config, camera, submap, j, uv_px[j])
        return _apply(config, submap, j, innovation, H, HP, is_left[j]), is_left.at[j].set(False)

    return jax.lax.while_loop(lambda carry: jnp.any(carry[1]), correct_next, (submap, is_recovered))[0]


def _apply(
    config: FilterConfig,
    submap: Submap,
    j: int | Int[Array, ""],
    innovation: Innovation,
    H: Float[Array, "2 21"],
    HP: Float[Array, "2 n"],
    is_used: Bool[Array, ""],
) -> Submap:
    """One correction, u = W H P: P - uᵀu and x + uᵀ(W z); nothing at all where it is not used. Equations (10)–(12)."""
    W = whitener(innovation.S)
    u = jnp.where(is_used, W(HP), 0.0)
    w = jnp.where(is_used, W(innovation.z), 0.0)
    own = jax.lax.dynamic_slice_in_dim(submap.U, slot_rows(j), SLOT, axis=1)
    H_u = submap.U[:, :VEHICLE] @ H[:, :VEHICLE].T + own @ H[:, VEHICLE:].T
    H_wide = jnp.zeros_like(HP).at[:, :VEHICLE].set(H[:, :VEHICLE])
    H_wide = jax.lax.dynamic_update_slice_in_dim(H_wide, H[:, VEHICLE:], slot_rows(j), axis=1)
    c = jnp.where(is_used, W(H_wide - H_u.T @ submap.C), 0.0)

    moved = _move(config, submap, u.T @ w)
    moved = eqx.tree_at(
        lambda m: (m.P, m.U, m.C, m.w),
        moved,
        (
            submap.P - u.T @ u,
            jax.lax.dynamic_update_slice_in_dim(submap.U, u, 2 * j, axis=0),
            jax.lax.dynamic_update_slice_in_dim(submap.C, c, 2 * j, axis=0),
            jax.lax.dynamic_update_slice_in_dim(submap.w, w, 2 * j, axis=0),
        ),
    )
    return _settle(config, submap.vehicle, moved, j, is_used)


def _correct_stacked(
    config: FilterConfig, camera: Camera, submap: Submap, uv_px: Float[Array, "K 2"], is_used: Bool[Array, " K"]
) -> Submap:
    """Correct with all candidates at once, all linearised at the predicted state: Z = H P Hᵀ + R is 2K × 2K."""
    num_candidates, size = is_used.shape[0], submap.P.shape[0]

    def wide(j, y, used):
        observation = observe(config, camera, block(submap, j))
        H = jnp.zeros((2, size), submap.P.dtype).at[:, :VEHICLE].set(observation.H[:, :VEHICLE])
        H = jax.lax.dynamic_update_slice_in_dim(H, observation.H[:, VEHICLE:], slot_rows(j), axis=1)
        return jnp.where(used, H, 0.0), jnp.where(used, y - observation.pixel, 0.0)

    # A candidate that is not used measures nothing: H = 0, z = 0, and its block of Z is R.
    H, z = jax.vmap(wide)(jnp.arange(num_candidates), uv_px, is_used)
    H, z = H.reshape(-1, size), z.reshape(-1)
    HP = H @ submap.P
    R = jnp.kron(jnp.eye(num_candidates, dtype=HP.dtype), _pixel_cov(config, HP.dtype))
    L = jnp.linalg.cholesky(HP @ H.T + R)
    U, C = (jax.scipy.linalg.solve_triangular(L, rows, lower=True) for rows in (HP, H))
    w = jax.scipy.linalg.solve_triangular(L, z, lower=True)
    moved = _move(config, submap, U.T @ w)
    moved = eqx.tree_at(lambda m: (m.P, m.U, m.C, m.w), moved, (submap.P - U.T @ U, U, C, w))
    for j in range(num_candidates):
        moved = _settle(config, submap.vehicle, moved, j, is_used[j])
    return moved


def _move(config: FilterConfig, submap: Submap, shift: Float[Array, " n"]) -> Submap:
    """Move the submap's means by K z. Equation (11)."""
    slots = shift[VEHICLE:].reshape(-1, SLOT)
    landmarks = submap.landmarks + jnp.einsum("kij,kj->ki", submap.to_coordinates, slots)
    return eqx.tree_at(lambda s: (s.vehicle, s.landmarks), submap, (submap.vehicle + shift[:VEHICLE], landmarks))


def _settle(
    config: FilterConfig,
    vehicle_before: Float[Array, "14"],
    submap: Submap,
    j: int | Int[Array, ""],
    is_used: Bool[Array, ""],
) -> Submap:
    """After its correction: keep landmark j's inverse depth positive, and make it Euclidean once it is near linear.

    The linearity index is taken with the landmark after its correction and the camera pose from before it, as the
    paper's toolbox does. The conversion leaves P alone (see `filter.state`).
    """
    landmark, T = submap.landmarks[j], submap.to_coordinates[j]
    rho = landmark[INVERSE_DEPTH]
    landmark = landmark.at[INVERSE_DEPTH].set(jnp.where(is_used & ~(rho > 0), config.inverse_depth_min, rho))

    last = slot_rows(j) + INVERSE_DEPTH
    variance = submap.P[last, last]
    std = jnp.sqrt(jnp.where(variance > 0, variance, 1.0))
    robot, sensor = (
        jnp.concatenate([pose[:3], unit(pose[3:], config.toolbox_parity)])
        for pose in (vehicle_before[:7], vehicle_before[7:])
    )
    is_linear = linearity_index(robot, sensor, landmark, std) < config.linearity_max
    becomes = is_used & is_linear & (variance > 0) & ~submap.is_euclidean[j]

    J = to_point_jacobian(landmark)
    T_euclidean = jnp.concatenate([J, jnp.zeros((SLOT - 3, SLOT), J.dtype)])
    return eqx.tree_at(
        lambda s: (s.landmarks, s.to_coordinates, s.is_euclidean),
        submap,
        (
            submap.landmarks.at[j].set(jnp.where(becomes, euclidean(to_point(landmark)), landmark)),
            submap.to_coordinates.at[j].set(jnp.where(becomes, T_euclidean, T)),
            submap.is_euclidean.at[j].set(submap.is_euclidean[j] | becomes),
        ),
    )


def _pixel_cov(config: FilterConfig, dtype) -> Float[Array, "2 2"]:
    """R, the covariance of a measured pixel."""
    return jnp.asarray(config.pixel_std_px, dtype) ** 2 * jnp.eye(2, dtype=dtype)
