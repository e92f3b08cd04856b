"""Motion models of the filter: what leads the robot from one frame to the next, and what of it is estimated.

A model may carry coordinates of its own behind the poses of robot and sensor, as a part of the vehicle that no pixel
depends on: a camera in a hand has a velocity, odometry a bias. Its numbers are traced, its choice is static.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import number, require
from vcjax.models.frames import Pose, cross_matrix, quaternion_from_rotation_vector, quaternion_product
from vcjax.models.motion import move_by_constant_velocity, move_by_odometry
from vcjax.recording import Frame


class AbstractMotion(eqx.Module):
    """How the robot moves between frames."""

    gives_scale: ClassVar[bool]
    """Whether lengths are known from it; where not, the map's scale is free unless known landmarks give it."""

    @abstractmethod
    def start(self) -> tuple[Float[np.ndarray, " c"], Float[Array | np.ndarray, "c c"]]:
        """Mean and covariance of the coordinates it carries, before the first frame."""

    @abstractmethod
    def input(self, frame: Frame) -> tuple[Float[Array, " u"], Float[Array, "u u"]]:
        """Mean and covariance of what drives the robot in the step that leads to a frame."""

    @abstractmethod
    def move(
        self, robot: Pose, carried: Float[Array, " c"], given: Float[Array, " u"], time_step_s: Float[Array, ""]
    ) -> tuple[Pose, Float[Array, " c"]]:
        """Pose and carried coordinates after the step. Its derivatives are the filter's F and F_n."""

    def turn(self, carried: Float[Array, " c"]) -> Float[Array, "c 3"]:
        """How the carried coordinates change when the whole world turns by a small rotation; linear.

        Not at all, where they belong to the robot. See `invariant`.
        """
        return jnp.zeros((carried.shape[0], 3), carried.dtype)


class Odometry(AbstractMotion):
    """The recording's odometry, with its covariance. Paper equation (6). Carries nothing."""

    gives_scale: ClassVar[bool] = True

    def start(self):
        """Nothing."""
        return np.zeros(0), np.zeros((0, 0))

    def input(self, frame: Frame):
        """The increment and its covariance."""
        return frame.odometry, frame.odometry_cov

    def move(self, robot, carried, given, time_step_s):
        """T + R(q) Δt, q ⊗ q(Δθ)."""
        return move_by_odometry(robot, given), carried


class BiasedOdometry(AbstractMotion):
    """The recording's odometry less a bias b that is estimated: increment u - b Δt, b a random walk from zero.

    Carries b: velocity (m/s) and rate of turn (rad/s) in the robot frame. Constant errors, of a gyro for one, add up to
    what no white noise does, and a filter that does not know of them is sure of a path that bends.
    """

    gives_scale: ClassVar[bool] = True

    velocity_bias_std_m_s: float = eqx.field(converter=number, default=0.0)
    """Standard deviation of the bias of the velocity at the start, along each axis, m/s; 0: there is none."""
    rate_bias_std_rad_s: float = eqx.field(converter=number, default=0.01)
    """That of the rate of turn, rad/s."""
    velocity_bias_walk: float = eqx.field(converter=number, default=0.0)
    """How fast it wanders: its standard deviation grows by this in one second, m/s/√s; 0: not at all."""
    rate_bias_walk: float = eqx.field(converter=number, default=0.0)
    """The same of the rate of turn, rad/s/√s."""

    def __check_init__(self):
        for name in ("velocity_bias_std_m_s", "rate_bias_std_rad_s", "velocity_bias_walk", "rate_bias_walk"):
            require(self, name, lambda v: np.isfinite(v) & (v >= 0), "give a number of at least 0.")

    def start(self):
        """No bias, with doubt."""
        return np.zeros(6), _of_both(self.velocity_bias_std_m_s, self.rate_bias_std_rad_s)

    def input(self, frame: Frame):
        """The increment and the steps of the walk."""
        walk = _of_both(self.velocity_bias_walk, self.rate_bias_walk) * frame.time_step_s
        return jnp.concatenate([frame.odometry, jnp.zeros(6, frame.odometry.dtype)]), _beside(frame.odometry_cov, walk)

    def move(self, robot, carried, given, time_step_s):
        """The step by u - b Δt; then b walks."""
        return move_by_odometry(robot, given[:6] - carried * time_step_s), carried + given[6:]


class ConstantVelocity(AbstractMotion):
    """Constant velocity, for recordings without odometry; the recording's own is not looked at.

    Carries the twist: velocity in the world (m/s) and rate of turn in the robot (rad/s). Accelerations are white noise
    of density σ², so that after Δt s velocity has the variance σ² Δt more, place σ² Δt³/3, and both the covariance
    σ² Δt²/2, whatever the time between two frames: a dropped frame or a jump in time widens the doubt as it should.
    """

    gives_scale: ClassVar[bool] = False

    acceleration: float = eqx.field(converter=number, default=1.0)
    """σ along each axis, m/s²/√Hz: in one second the velocity changes by about this much, m/s."""
    angular_acceleration: float = eqx.field(converter=number, default=1.0)
    """σ about each axis, rad/s²/√Hz."""
    start_velocity_std_m_s: float = eqx.field(converter=number, default=0.2)
    """Standard deviation of the velocity at the start, of mean zero, m/s."""
    start_rate_std_rad_s: float = eqx.field(converter=number, default=0.2)
    """That of the rate of turn, rad/s."""

    def __check_init__(self):
        for name in ("acceleration", "angular_acceleration", "start_velocity_std_m_s", "start_rate_std_rad_s"):
            require(self, name, lambda v: np.isfinite(v) & (v >= 0), "give a number of at least 0.")

    def start(self):
        """At rest, with doubt."""
        return np.zeros(6), _of_both(self.start_velocity_std_m_s, self.start_rate_std_rad_s)

    def input(self, frame: Frame):
        """No motion of its own; the noise of pose and twist."""
        dt, q = frame.time_step_s, _of_both(self.acceleration, self.angular_acceleration)
        cov = jnp.kron(jnp.stack([jnp.stack([dt**3 / 3, dt**2 / 2]), jnp.stack([dt**2 / 2, dt])]), q)
        return jnp.zeros(12, cov.dtype), cov

    def move(self, robot, carried, given, time_step_s):
        """T + v Δt, q ⊗ q(ω Δt), and then the noise: of the place in the world, of the rotation in the robot."""
        robot, carried = move_by_constant_velocity(robot, carried, given[6:], time_step_s)
        turned = quaternion_product(robot[3:], quaternion_from_rotation_vector(given[3:6]))
        return jnp.concatenate([robot[:3] + given[:3], turned]), carried

    def turn(self, carried):
        """The velocity, δθ × v."""
        return jnp.concatenate([-cross_matrix(carried[:3]), jnp.zeros((3, 3), carried.dtype)])


MOTIONS: Mapping[str, type[AbstractMotion]] = {
    "odometry": Odometry,
    "biased_odometry": BiasedOdometry,
    "constant_velocity": ConstantVelocity,
}
"""The models by name."""


def _of_both(linear, angular) -> Float[Array, "6 6"]:
    """Covariance of three linear and three angular coordinates with these standard deviations."""
    return jnp.diag(jnp.repeat(jnp.stack([jnp.asarray(linear), jnp.asarray(angular)]) ** 2, 3))


def _beside(a: Float[Array, "n n"], b: Float[Array, "m m"]) -> Float[Array, "k k"]:
    """Block-diagonal."""
    n = a.shape[0]
    whole = jnp.zeros((n + b.shape[0], n + b.shape[0]), a.dtype)
    return whole.at[:n, :n].set(a).at[n:, n:].set(b)
