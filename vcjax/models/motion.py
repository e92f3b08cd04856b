"""Motion of robot and sensor: odometry, constant velocity, and the oscillation of equation (1)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import number, require
from vcjax.models.frames import Pose, from_frame, quaternion_from_rotation_vector, quaternion_product

Control = Float[Array, "6"]


def move_by_odometry(pose: Pose, control: Control) -> Pose:
    """The pose after an increment in its own frame: t + R(q) Δt, q ⊗ q(Δθ). Paper equation (6).

    Args:
        pose: T_w_r (7,).
        control: [Δx Δy Δz] in m and the rotation vector Δθ in rad, both in the robot frame.

    Derivative exact. The quaternion keeps its length.
    """
    return jnp.concatenate(
        [from_frame(pose, control[:3]), quaternion_product(pose[3:], quaternion_from_rotation_vector(control[3:]))]
    )


def move_by_constant_velocity(
    pose: Pose, twist: Float[Array, "6"], impulse: Float[Array, "6"], time_step_s: float | Array
) -> tuple[Pose, Float[Array, "6"]]:
    """One step of the constant-velocity model: t + v Δt, q ⊗ q(ω Δt); velocities change by the impulse.

    Args:
        pose: T_w_r (7,).
        twist: linear velocity in the world (m/s) and angular velocity in the robot frame (rad/s).
        impulse: random change of the twist in this step, same units.
        time_step_s: Δt, s.

    Returns: pose and twist at the end of the step. The impulse acts at its end, as in the paper's toolbox. Derivative
    exact.
    """
    q = quaternion_product(pose[3:], quaternion_from_rotation_vector(twist[3:] * time_step_s))
    return jnp.concatenate([pose[:3] + twist[:3] * time_step_s, q]), twist + impulse


class Oscillation(eqx.Module):
    """Sideways oscillation of the camera, X_s = A sin(2πft). Paper equation (1). The default camera is steady."""

    amplitude_m: float = eqx.field(converter=number, default=0.0)
    """A, m; 0 is a steady camera, 0.05 the paper's oscillating one."""
    frequency_hz: float = eqx.field(converter=number, default=3.0)
    """f, Hz; below half the frame rate."""

    def __check_init__(self):
        require(
            self,
            "amplitude_m",
            lambda a: np.isfinite(a) & (a >= 0),
            "the amplitude is a length, 0 for a steady camera.",
        )
        require(self, "frequency_hz", lambda f: np.isfinite(f) & (f >= 0), "the frequency must not be negative.")


def oscillate(oscillation: Oscillation, time_s: Float[Array, "*T"]) -> Float[Array, "*T"]:
    """X_s = A sin(2πft), the camera's sideways displacement in m at times in s. Equation (1). Derivative exact."""
    return oscillation.amplitude_m * jnp.sin(2.0 * jnp.pi * oscillation.frequency_hz * time_s)
