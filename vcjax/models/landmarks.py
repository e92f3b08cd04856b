"""Point landmarks: anchored homogeneous (AHP) and Euclidean, in one form.

An AHP landmark is the 7-vector [p₀ anchor, m direction, ρ inverse depth] of the point p₀ + m/ρ. Seen from robot pose r
and sensor pose s (camera centre c = R_r t_s + t_r, rotation R_c = R_r R_s) its homogeneous camera coordinates are

    v = R_cᵀ (m + ρ (p₀ - c)).

A Euclidean point p is the AHP [p, 0, 1] of which only the first three coordinates are estimated: the same formula gives
R_cᵀ (p - c). So projection knows one kind of landmark and no branch.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from vcjax.models.camera import Camera, Pixel, back_project, pixel_jacobian
from vcjax.models.frames import Pose, Vector3, from_frame, rotate_back_jacobian, rotation_matrix, unit

Landmark = Float[Array, "7"]

ANCHOR, DIRECTION, INVERSE_DEPTH = slice(0, 3), slice(3, 6), 6


def euclidean(p: Vector3) -> Landmark:
    """A Euclidean point in the common form, [p, 0, 0, 0, 1]."""
    return jnp.concatenate([p, jnp.zeros(3, p.dtype), jnp.ones(1, p.dtype)])


def to_point(landmark: Landmark) -> Vector3:
    """The point itself, p₀ + m/ρ, m. Derivative exact; ρ must not be zero."""
    return landmark[ANCHOR] + landmark[DIRECTION] / landmark[INVERSE_DEPTH]


def to_point_jacobian(landmark: Landmark) -> Float[Array, "3 7"]:
    """∂(p₀ + m/ρ)/∂[p₀, m, ρ] = [I, I/ρ, -m/ρ²]."""
    rho = landmark[INVERSE_DEPTH]
    eye = jnp.eye(3, dtype=landmark.dtype)
    return jnp.concatenate([eye, eye / rho, -landmark[DIRECTION, None] / rho**2], axis=1)


def camera_centre(robot: Pose, sensor: Pose) -> Vector3:
    """The camera's place in the world, R_r t_s + t_r."""
    return from_frame(robot, sensor[:3])


def project_landmark(
    camera: Camera, robot: Pose, sensor: Pose, landmark: Landmark
) -> tuple[Pixel, Float[Array, ""], Float[Array, "2 7"], Float[Array, "2 7"], Float[Array, "2 7"]]:
    """Pixel, depth and the projection's derivatives by robot, sensor and landmark.

    Args:
        camera: calibration.
        robot, sensor: poses T_w_r and T_r_s; R(q) is taken as the quadratic form, so q should be of unit length.
        landmark: AHP or Euclidean point in the common form.

    Returns:
        pixel (2,) px; depth () along the optical axis, v_z/ρ in m, positive in front; ∂pixel/∂robot (2, 7);
        ∂pixel/∂sensor (2, 7); ∂pixel/∂landmark (2, 7). All derivatives are exact and equal `jax.jacfwd` of the pixel.
    """
    R_r, R_s = rotation_matrix(robot[3:]), rotation_matrix(sensor[3:])
    R_cT = R_s.T @ R_r.T
    rho = landmark[INVERSE_DEPTH]
    offset = landmark[ANCHOR] - robot[:3]
    w = landmark[DIRECTION] + rho * offset
    w_r = R_r.T @ w - rho * sensor[:3]
    v = R_s.T @ w_r
    pixel, U_v = pixel_jacobian(camera, v)

    # ∂v by [t_r, q_r, t_s, q_s, p₀, m, ρ], side by side so that one product leads to the pixel.
    by_q_r = R_s.T @ rotate_back_jacobian(robot[3:], w)
    by_q_s = rotate_back_jacobian(sensor[3:], w_r)
    by_rho = R_cT @ offset - R_s.T @ sensor[:3]
    V = jnp.concatenate([-rho * R_cT, by_q_r, -rho * R_s.T, by_q_s, rho * R_cT, R_cT, by_rho[:, None]], axis=1)
    U = U_v @ V
    depth = v[2] / jnp.where(rho == 0.0, 1.0, rho)
    return pixel, depth, U[:, :7], U[:, 7:14], U[:, 14:]


def back_project_landmark(
    camera: Camera,
    robot: Pose,
    sensor: Pose,
    pixel: Pixel,
    inverse_depth: float | Array,
    scalar_derivative: bool = False,
) -> Landmark:
    """A new AHP landmark on the ray of a pixel: anchor the camera centre, unit direction, given inverse depth (1/m).

    Derivative exact; with `scalar_derivative` the toolbox's shortcut for the direction (see `frames.unit`).
    """
    ray_w = rotation_matrix(robot[3:]) @ (rotation_matrix(sensor[3:]) @ back_project(camera, pixel))
    rho = jnp.reshape(jnp.asarray(inverse_depth, ray_w.dtype), (1,))
    return jnp.concatenate([camera_centre(robot, sensor), unit(ray_w, scalar_derivative), rho])


def linearity_index(
    robot: Pose, sensor: Pose, landmark: Landmark, inverse_depth_std: float | Array
) -> Float[Array, ""]:
    """How far from linear the inverse depth still is, L = 4 (σ_d/d₁) |cos α|.

    Below 0.1 a Euclidean point serves as well. σ_d = σ_ρ/ρ² is the depth's standard deviation, d₁ the distance from the
    camera to the point, and α the angle there between the direction of the anchor's ray and the present one. Source:
    Civera, Davison & Montiel 2008, in the form of the paper's toolbox. Derivative exact.
    """
    rho = landmark[INVERSE_DEPTH]
    to_landmark = to_point(landmark) - camera_centre(robot, sensor)
    distance2 = jnp.sum(to_landmark**2)
    direction = landmark[DIRECTION]
    is_at_camera = distance2 == 0.0
    distance = jnp.sqrt(jnp.where(is_at_camera, 1.0, distance2))
    norm2 = jnp.sum(direction**2)
    norm = jnp.sqrt(jnp.where(norm2 == 0.0, 1.0, norm2))
    cosine = jnp.abs(direction @ to_landmark) / (norm * distance)
    return 4.0 * inverse_depth_std / rho**2 / distance * cosine
