"""Quaternions and rigid frames.

Quaternions are Hamilton, ordered (w, x, y, z). A frame (or pose) is the 7-vector [t, q] that maps its own coordinates
to its parent's, p_parent = R(q) p + t. A pose named `T_w_r` takes robot coordinates to world coordinates.

`rotation_matrix` is the homogeneous quadratic form of q: it is a rotation only for unit q, and its plain derivative is
a polynomial. Whoever holds a quaternion that may have drifted from unit length passes it through `unit` first.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Quaternion = Float[Array, "4"]
Pose = Float[Array, "7"]
Vector3 = Float[Array, "3"]

# Below this angle (rad) the rotation vector's sine is replaced by its Taylor series: at the switch both agree to 1e-28.
SMALL_ANGLE_RAD = 1e-6


def unit(v: Float[Array, " n"], scalar_derivative: bool = False) -> Float[Array, " n"]:
    """The unit vector v / |v| of a non-zero vector.

    Derivative: exact, (I - v̂ v̂ᵀ) / |v|. With `scalar_derivative` it is the shortcut I / |v| that treats the norm as a
    constant. This is the one place of that shortcut, wanted only to replay toolboxes that use it (`toolbox_parity`).
    """
    norm = jnp.sqrt(jnp.sum(v * v))
    return v / (jax.lax.stop_gradient(norm) if scalar_derivative else norm)


def unit_jacobian(v: Float[Array, " n"], scalar_derivative: bool = False) -> Float[Array, "n n"]:
    """∂`unit`(v)/∂v: (I - v̂ v̂ᵀ) / |v|, or I / |v| with `scalar_derivative`."""
    norm = jnp.sqrt(jnp.sum(v * v))
    eye = jnp.eye(v.shape[0], dtype=v.dtype)
    if scalar_derivative:
        return eye / norm
    return (eye - jnp.outer(v, v) / norm**2) / norm


def rotation_matrix(q: Quaternion) -> Float[Array, "3 3"]:
    """R(q), the matrix that rotates a vector into the parent frame. Quadratic in q; a rotation for |q| = 1."""
    w, x, y, z = q
    return jnp.stack(
        [
            jnp.stack([w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]),
        ]
    )


def cross_matrix(v: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """[v]×, so that [v]× w = v × w."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = jnp.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def rotate_back_jacobian(q: Quaternion, v: Vector3) -> Float[Array, "3 4"]:
    """∂(R(q)ᵀ v)/∂q, rows x y z, columns w x y z. Equals `jax.jacfwd` of the same product."""
    w, x, y, z = q
    a, b, c = v
    s = x * a + y * b + z * c
    d0, d1, d2 = w * a + z * b - y * c, w * b - z * a + x * c, w * c + y * a - x * b
    return 2 * jnp.stack(
        [jnp.stack([d0, s, -d2, d1]), jnp.stack([d1, d2, s, -d0]), jnp.stack([d2, -d1, d0, s])],
    )


def quaternion_product(p: Quaternion, q: Quaternion) -> Quaternion:
    """P ⊗ q: first rotate by q, then by p."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )


def quaternion_conjugate(q: Quaternion) -> Quaternion:
    """q*: the inverse rotation of a unit quaternion."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def quaternion_from_rotation_vector(v: Vector3) -> Quaternion:
    """[cos(|v|/2), v sin(|v|/2)/|v|] of a rotation vector in rad; below 1e-6 rad its series [1 - |v|²/8, v/2]."""
    angle2 = jnp.sum(v * v)
    is_small = angle2 < SMALL_ANGLE_RAD**2
    # The branch not taken is fed a harmless angle: a square root of zero would put NaN into the derivative.
    angle = jnp.sqrt(jnp.where(is_small, 1.0, angle2))
    real = jnp.where(is_small, 1.0 - angle2 / 8.0, jnp.cos(angle / 2.0))
    scale = jnp.where(is_small, 0.5, jnp.sin(angle / 2.0) / angle)
    return jnp.concatenate([real[None], scale * v])


def rotation_vector_from_quaternion(q: Quaternion) -> Vector3:
    """The rotation vector (rad, length at most π) of a unit quaternion."""
    q = jnp.where(q[0] < 0.0, -q, q)
    sine2 = jnp.sum(q[1:] * q[1:])
    is_small = sine2 < (SMALL_ANGLE_RAD / 2.0) ** 2
    sine = jnp.sqrt(jnp.where(is_small, 1.0, sine2))
    scale = jnp.where(is_small, 2.0 / jnp.where(is_small, q[0], 1.0), 2.0 * jnp.arctan2(sine, q[0]) / sine)
    return scale * q[1:]


def quaternion_from_euler(rpy_rad: Vector3) -> Quaternion:
    """Quaternion of roll, pitch, yaw in rad, R = Rz(yaw) Ry(pitch) Rx(roll)."""
    (sr, sp, sy), (cr, cp, cy) = jnp.sin(rpy_rad / 2.0), jnp.cos(rpy_rad / 2.0)
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def yaw_from_quaternion(q: Quaternion) -> Float[Array, ""]:
    """The yaw angle (rad, in [-π, π]) of R = Rz(yaw) Ry(pitch) Rx(roll); undefined at pitch ±90°."""
    w, x, y, z = q
    return jnp.arctan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z)


def from_frame(frame: Pose, p: Vector3) -> Vector3:
    """A point of the frame in parent coordinates: R(q) p + t."""
    return rotation_matrix(frame[3:]) @ p + frame[:3]


def to_frame(frame: Pose, p: Vector3) -> Vector3:
    """A point of the parent in frame coordinates: R(q)ᵀ (p - t)."""
    return rotation_matrix(frame[3:]).T @ (p - frame[:3])


def compose(T_a_b: Pose, T_b_c: Pose) -> Pose:
    """T_a_c = T_a_b T_b_c."""
    return jnp.concatenate([from_frame(T_a_b, T_b_c[:3]), quaternion_product(T_a_b[3:], T_b_c[3:])])
