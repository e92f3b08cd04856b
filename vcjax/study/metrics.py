"""One run against its truth: trajectory errors, consistency, events. Computed inside the batch."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vcjax.ekf import mahalanobis
from vcjax.filter.info import FrameInfo
from vcjax.filter.landmark_points import landmark_points
from vcjax.filter.state import FilterState
from vcjax.models.frames import quaternion_conjugate, quaternion_product, yaw_from_quaternion
from vcjax.recording import Truth
from vcjax.study.detection import detections


def run_metrics(state: FilterState, info: FrameInfo, truth: Truth) -> dict[str, Array]:
    """All that is kept of a run: per frame (T,) or per feature (F,), under the names of the results.

    `state` is the last. Errors are not aligned: estimate and truth start from the same known pose. Derivatives are
    exact where continuous.
    """
    return {
        **trajectory_errors(info, truth),
        "nis_sum": jnp.sum(jnp.where(info.is_accepted, info.re1, 0.0), axis=1),
        "num_updates": jnp.sum(info.is_accepted, axis=1),
        "num_recovered": jnp.sum(info.is_recovered, axis=1),
        "num_dynamic": jnp.sum(info.is_dynamic, axis=1),
        "num_inconsistent": jnp.sum(info.inconsistent_id >= 0, axis=1),
        "num_births": jnp.sum(info.born_id >= 0, axis=1),
        "num_landmarks": jnp.sum(info.track_id >= 0, axis=1),
        "num_coordinates": info.num_coordinates,
        **detections(info, truth),
        "nees_map": map_nees(state, truth),
        "is_finite": jnp.all(info.is_finite),
        "map_full_frames": jnp.sum(info.map_is_full),
        "robot": info.vehicle[:, :7],
    }


def trajectory_errors(info: FrameInfo, truth: Truth) -> dict[str, Float[Array, " T"]]:
    """Errors of the robot pose in each frame and their normalised squares.

    `position_error_m` is √(ex² + ey²); `orientation_error_deg` the angle between the true and the estimated
    orientation; `yaw_error_deg` the absolute error of the yaw angle. `nees_position` = eᵀ P⁻¹ e of (x, y), 2 degrees
    of freedom, and `nees_pose` of (x, y, yaw), 3: in a consistent filter their means are 2 and 3. They are NaN where
    P is singular up to rounding, as without odometry noise: there the error has no size that it could be compared to.
    """
    robot, cov = info.vehicle[:, :7], info.vehicle_cov[:, :7, :7]
    true = jnp.asarray(truth.robot)
    error_xy = robot[:, :2] - true[:, :2]
    relative = jax.vmap(lambda q, p: quaternion_product(quaternion_conjugate(q), p))(true[:, 3:], robot[:, 3:])
    sine = jnp.sqrt(jnp.sum(relative[:, 1:] ** 2, axis=1))
    yaw, yaw_H = jax.vmap(jax.value_and_grad(yaw_from_quaternion))(robot[:, 3:])
    error_yaw = _wrap(yaw - jax.vmap(yaw_from_quaternion)(true[:, 3:]))

    # Pose (x, y, yaw) as a linear function of the error in [x y z qw qx qy qz].
    G = jnp.zeros((robot.shape[0], 3, 7), robot.dtype)
    G = G.at[:, 0, 0].set(1.0).at[:, 1, 1].set(1.0).at[:, 2, 3:].set(yaw_H)
    pose_cov = G @ cov @ G.mT
    error_pose = jnp.concatenate([error_xy, error_yaw[:, None]], axis=1)
    return {
        "position_error_m": jnp.sqrt(jnp.sum(error_xy**2, axis=1)),
        "orientation_error_deg": jnp.rad2deg(2.0 * jnp.arctan2(sine, jnp.abs(relative[:, 0]))),
        "yaw_error_deg": jnp.rad2deg(jnp.abs(error_yaw)),
        "nees_position": _where_defined(jax.vmap(mahalanobis), error_xy, cov[:, :2, :2]),
        "nees_pose": _where_defined(_normalised_square, error_pose, pose_cov),
    }


def map_nees(state: FilterState, truth: Truth) -> Float[Array, ""]:
    """Normalised error squared of a landmark's place in the last frame, 3 degrees of freedom, in the mean over the map.

    eᵀ P⁻¹ e with the error e of its place. Of the static landmarks that have become Euclidean alone: one whose inverse
    depth is badly known has no place with a Gaussian error that a covariance could describe, and the anchor and
    direction of its own parameters have no truth to be compared with. NaN where there is none.
    """
    points = landmark_points(state, state.is_euclidean)
    is_there = (points.track_id >= 0) & ~jnp.asarray(truth.is_moving)[points.track_id]
    error = points.place_m - jnp.asarray(truth.landmarks_m)[-1, points.track_id]
    harmless = jnp.where(is_there[:, None, None], points.cov, jnp.eye(3, dtype=points.cov.dtype))
    num = jnp.sum(is_there)
    total = jnp.sum(jnp.where(is_there, _normalised_square(jnp.where(is_there[:, None], error, 0.0), harmless), 0.0))
    return jnp.where(num > 0, total / jnp.where(num > 0, num, 1), jnp.nan)


def _normalised_square(error: Float[Array, "T n"], cov: Float[Array, "T n n"]) -> Float[Array, " T"]:
    """eᵀ P⁻¹ e of each."""
    return jnp.sum(error * jnp.linalg.solve(cov, error[..., None])[..., 0], axis=1)


def _where_defined(square: Callable, error: Float[Array, "T n"], cov: Float[Array, "T n n"]) -> Float[Array, " T"]:
    """A normalised square where the covariance has an inverse: its correlations' determinant is not rounding (100 ε).

    NaN elsewhere.
    """
    variances = jnp.diagonal(cov, axis1=1, axis2=2)
    scale = jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    correlations = cov / (scale[:, :, None] * scale[:, None, :])
    is_defined = jnp.linalg.det(correlations) > 100 * jnp.finfo(cov.dtype).eps
    harmless = jnp.where(is_defined[:, None, None], cov, jnp.eye(cov.shape[-1], dtype=cov.dtype))
    return jnp.where(is_defined, square(error, harmless), jnp.nan)


def _wrap(angle: Float[Array, " T"]) -> Float[Array, " T"]:
    """An angle (rad) brought to [-π, π)."""
    return (angle + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
