"""Errors that turn robot and map together, so that what cannot be observed stays unobserved.

Turn the whole world, robot and map, by a small rotation δθ: no pixel changes, so the measurement's derivative must be
blind to the direction N(x) δθ in which the state moves,

    t: δθ × t,    q: ½ (0, δθ) ⊗ q,    anchor: δθ × p₀,    direction: δθ × m,    Euclidean point: δθ × p.

N depends on the state. A filter whose errors are plain differences keeps its uncertainty along N at the old mean while
it measures at the new one, sees what nobody can see, and grows certain of its heading and position without reason; the
more so the less certain it was (Huang, Mourikis & Roumeliotis 2010). With right-invariant errors (Barrau & Bonnabel
2015) N is constant. To change over to them is to carry P along whenever the mean moves, from x to x⁺:

    P ← M P Mᵀ,    M = I + A E,    A = N(x⁺) - N(x),    E N(x) = I (E reads the turn off the robot's quaternion),

and M N(x) = N(x⁺). A and Eᵀ have three columns, so M P Mᵀ = P + A Bᵀ + B Aᵀ with B = P Eᵀ + ½ A E P Eᵀ: six rows more
in the frame's downdate. Within a frame, errors stay those at its prediction, and H M takes the place of H. Translations
have a constant N, and prediction and birth lead from N to N of their own accord.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from vcjax.filter.motion_model import AbstractMotion
from vcjax.models.frames import Quaternion, cross_matrix


def _turned_quaternion(q: Quaternion) -> Float[Array, "4 3"]:
    """The matrix of δθ ↦ (0, δθ) ⊗ q."""
    w, x, y, z = q
    return jnp.stack(
        [jnp.stack([-x, -y, -z]), jnp.stack([w, z, -y]), jnp.stack([-z, w, x]), jnp.stack([y, -x, w])],
    )


def turn_of_vehicle(motion: AbstractMotion, vehicle: Float[Array, " v"]) -> Float[Array, "v 3"]:
    """N of the vehicle, linear in its mean; the sensor's pose in the robot does not turn."""
    N = jnp.zeros((vehicle.shape[0], 3), vehicle.dtype)
    N = N.at[:3].set(-cross_matrix(vehicle[:3]))
    N = N.at[3:7].set(0.5 * _turned_quaternion(vehicle[3:7]))
    return N.at[14:].set(motion.turn(vehicle[14:])) if len(vehicle) > 14 else N


def turn_of_landmark(landmark: Float[Array, "*b 7"]) -> Float[Array, "*b 7 3"]:
    """N of a landmark's slot, linear in its mean. A Euclidean point's slot turns by its anchor's coordinates alone."""
    inverse_depth = jnp.zeros((*landmark.shape[:-1], 1, 3), landmark.dtype)
    anchor, direction = -cross_matrix(landmark[..., :3]), -cross_matrix(landmark[..., 3:6])
    return jnp.concatenate([anchor, direction, inverse_depth], axis=-2)


def read_turn(vehicle: Float[Array, " v"]) -> Float[Array, "3 v"]:
    """E: the turn of an error, read off the robot's quaternion: E N = I where that is of unit length."""
    E = jnp.zeros((3, vehicle.shape[0]), vehicle.dtype)
    return E.at[:, 3:7].set(2.0 * _turned_quaternion(vehicle[3:7]).T)


def carry(
    motion: AbstractMotion,
    vehicle: Float[Array, " v"],
    vehicle_shift: Float[Array, " v"],
    landmark_shift: Float[Array, "7"],
) -> Float[Array, "n n"]:
    """M of a block of vehicle and landmark whose means have moved by these shifts. N is linear: A = N(x⁺ - x)."""
    A = jnp.concatenate([turn_of_vehicle(motion, vehicle_shift), turn_of_landmark(landmark_shift)])
    M = jnp.eye(A.shape[0], dtype=A.dtype)
    return M.at[:, : vehicle.shape[0]].add(A @ read_turn(vehicle))
