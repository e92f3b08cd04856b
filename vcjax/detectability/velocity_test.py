"""Detectability: which movers can be told from static features, before anything is run.

A feature that is at p when it is first seen, and moves with velocity v, is at p + v τ_k after τ_k seconds. With H_k the
derivative of its pixel by its place and S_k the pixel's covariance, all frames in which it is in view carry the
information

    Σ_k [H_k, τ_k H_k]ᵀ S_k⁻¹ [H_k, τ_k H_k] = [M₀ M₁; M₁ M₂],    M_i = Σ_k τ_kⁱ H_kᵀ S_k⁻¹ H_k

about place and velocity together. The place is not known and has to be found from the same frames. What is left about
the velocity is the Schur complement

    C = M₂ - M₁ (M₀ + Λ)⁻¹ M₁,

where Λ = r rᵀ / (σ_ρ² d⁴) is what a filter assumes of the depth of a new feature: inverse depth ± σ_ρ along its first
ray r, at distance d. C⁻¹ is the covariance of the best estimate v̂, and the test v̂ᵀ C v̂ > q of "it stands still" follows
χ²₃ where that is true and the non-central χ²₃ with δ = vᵀ C v where it is not: P(χ²₃(δ) > q) is its power. An empty
direction of C is one in which a mover mimics a static point at another place, and there the power is the false-alarm
rate: with a steady camera on a straight path that of the path itself.

The recursive test of a filter (Willsky-Jones GLR: B ← B + Δt I at each frame, G = H B, C += Gᵀ S⁻¹ G, B ← B - K G, with
S here the full innovation covariance) sums up the same C, frame by frame, if the camera's path is known, every frame in
view is used, and H_k are the same: it is the Schur complement in the order of time. What is neglected here, then:

- Errors of the robot's pose enter as noise of each frame by itself, `pose_noise` times that of one step of odometry. A
  real pose error drifts: its constant part hides in p, and what grows with time looks like a common velocity of all
  features. The map that the pose is estimated from, and that it is shared with, is not modelled.
- A filter corrects few landmarks per frame, not all in view (`use_rate` of the frames, if they are spread evenly), and
  may delete or isolate a mover before the end. Testing in every frame finds more than one test at the end.
- H_k are those at the true places. A filter takes them where it believes a static point to be.

References:
    Willsky, Jones 1976, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear
    systems". Kay 1998, "Fundamentals of statistical signal processing: detection theory", sections 6.5 and 7.7.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vcjax.detectability.chi_squared import quantile, survival
from vcjax.ekf import whitener
from vcjax.fields import number, require, require_kind, require_single
from vcjax.models.camera import is_inside, pixel_jacobian, project
from vcjax.models.frames import compose, rotation_matrix, to_frame
from vcjax.simulation.scenarios import Scenario
from vcjax.simulation.simulate import true_path
from vcjax.simulation.world import moved

_RIDGE_M2 = 1e-9
"""Information about a place where there is none, 1/m²: it lies within some 30 km."""


class VelocityTest(eqx.Module):
    """A test of whether a feature stands still, and what it has to go by."""

    false_alarm_rate: float = eqx.field(converter=number, default=1e-3)
    """Probability that a static feature is called dynamic; in (0, 1)."""
    within_frames: float = eqx.field(converter=number, default=np.inf)
    """T: frames from the first sight of the feature on that count; at least 1. Infinite: all in view."""
    pose_noise: float = eqx.field(converter=number, default=1.0)
    """Error of the robot's pose in each frame, in standard deviations of one step of odometry; 0: the path is known."""
    use_rate: float = eqx.field(converter=number, default=1.0)
    """Share of the frames in view in which the feature is used; in (0, 1]."""
    inverse_depth_std: float = eqx.field(converter=number, default=0.5)
    """σ_ρ of a new feature, 1/m; infinite: nothing is assumed of its depth."""

    def __check_init__(self):
        require(self, "false_alarm_rate", lambda a: (a > 0) & (a < 1), "a rate is between 0 and 1, both excluded.")
        require(self, "within_frames", lambda n: n >= 1, "give at least one frame.")
        require(self, "pose_noise", lambda s: np.isfinite(s) & (s >= 0), "give a number of at least 0.")
        require(self, "use_rate", lambda r: (r > 0) & (r <= 1), "a share is above 0 and at most 1.")
        require(self, "inverse_depth_std", lambda s: s > 0, "a standard deviation is positive.")


class Evidence(NamedTuple):
    """What the frames in view tell about one feature's velocity."""

    information: Float[Array, "3 3"]
    """C, s²/m²."""
    score: Float[Array, "3"]
    """What its motion adds to the expected score M₂-like sum d of the test; C v for a constant velocity v. s/m."""
    num_frames: Int[Array, ""]
    """Frames that count."""


def evidence(scenario: Scenario, test: VelocityTest, places_m: Float[Array, "T 3"]) -> Evidence:
    """C of the module's docstring for a feature that is at some place in each frame, and what its motion makes of it.

    Pure; the derivative is exact, but for which frames are in view, which have none.

    Args:
        scenario: path, camera, oscillation and noise; its features and movers do not matter.
        test: which frames count, and for how much.
        places_m: where the feature is in every frame.
    """
    path = true_path(scenario)
    sensor = jnp.broadcast_to(path.sensor_start, path.robot.shape).at[:, 1].add(path.displacement_m)
    camera = jax.vmap(compose)(path.robot, sensor)
    point_c = jax.vmap(to_frame)(camera, places_m)
    pixel = jax.vmap(lambda p: project(scenario.camera, p))(point_c)
    is_in_view = (point_c[:, 2] > 0) & is_inside(scenario.camera, pixel)
    first, frame = jnp.argmax(is_in_view), jnp.arange(scenario.num_frames)
    counts = is_in_view & (frame < first + test.within_frames)
    tau = path.time_s - path.time_s[first]

    # A harmless point where the feature is not in view: what is masked must not put NaN into derivatives.
    point_c = jnp.where(counts[:, None], point_c, jnp.array([0.0, 0.0, 1.0]))
    H = jax.vmap(lambda p, pose: pixel_jacobian(scenario.camera, p)[1] @ rotation_matrix(pose[3:]).T)(point_c, camera)
    S = _pixel_covariance(scenario, test, path.robot, places_m, H)
    WH = jax.vmap(lambda S, H: whitener(S) @ H)(S, H)
    each = jnp.where(counts[:, None, None], test.use_rate * WH.mT @ WH, 0.0)

    M0, M1, M2 = (jnp.einsum("t,tij->ij", tau**i, each) for i in range(3))
    M0 = M0 + _depth_information(test, places_m[first] - camera[first, :3]) + _RIDGE_M2 * jnp.eye(3)
    by_place = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(M0), True), M1)  # M₀⁻¹ M₁
    information = M2 - M1 @ by_place
    pull = jnp.einsum("tij,tj->ti", each, places_m - places_m[first])
    score = tau @ pull - by_place.T @ jnp.sum(pull, axis=0)
    return Evidence(0.5 * (information + information.T), score, jnp.sum(counts))


def _pixel_covariance(
    scenario: Scenario, test: VelocityTest, robot: Float[Array, "T 7"], places_m: Float[Array, "T 3"], H
) -> Float[Array, "T 2 2"]:
    """S_k: noise of the pixel, of the robot's pose in that frame, and of the camera's displacement, px²."""
    std = jnp.asarray(scenario.odometry_std) * test.pose_noise
    position = (std[:3] ** 2).at[1].add(scenario.oscillation_std_m**2)  # a jitter is along the robot's y axis, too

    def covariance(robot, place, H):
        by_position = H @ rotation_matrix(robot[3:])  # minus the derivative by the robot's place, in its own frame
        x, y, z = to_frame(robot, place)
        zero = jnp.zeros_like(x)
        cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
        by_rotation = by_position @ cross
        S = by_position * position @ by_position.T + by_rotation * jnp.deg2rad(std[3:]) ** 2 @ by_rotation.T
        return S + scenario.pixel_std_px**2 * jnp.eye(2)

    return jax.vmap(covariance)(robot, places_m, H)


def _depth_information(test: VelocityTest, offset: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Λ, 1/m², from the feature's offset from the camera that sees it first."""
    distance2 = jnp.maximum(jnp.sum(offset**2), 1e-6)
    return jnp.outer(offset, offset) / distance2 / (test.inverse_depth_std * distance2) ** 2


def information(
    scenario: Scenario, test: VelocityTest, place_m: Float[Array, "3"], velocity_m_s: Float[Array, "3"]
) -> Float[Array, "3 3"]:
    """C about the velocity of a feature with a constant one, s²/m². Pure; derivative exact, see `evidence`.

    Args:
        scenario: path, camera, oscillation and noise.
        test: which frames count, and for how much.
        place_m: where the feature is at time 0, as in a scenario.
        velocity_m_s: its velocity.
    """
    return evidence(scenario, test, _line(scenario, place_m, velocity_m_s)).information


def power(
    scenario: Scenario, test: VelocityTest, place_m: Float[Array, "3"], velocity_m_s: Float[Array, "3"]
) -> Float[Array, ""]:
    """Probability that a mover of constant velocity is told from a static feature: P(χ²₃(vᵀ C v) > q).

    Arguments as of `information`. Pure; derivative exact, see `evidence`. To be mapped over places and velocities by
    `jax.vmap`. The false-alarm rate where the mover is never in view, or mimics a static point.
    """
    C = information(scenario, test, place_m, velocity_m_s)
    return survival(quantile(test.false_alarm_rate), velocity_m_s @ C @ velocity_m_s)


def mover_power(scenario: Scenario, test: VelocityTest) -> Float[Array, " D"]:
    """The power of the test against each of a scenario's movers, in the order of `movers.ids`. Pure.

    Of movers on courses the test of a constant velocity sees what is left of their motion in its score: δ = dᵀ C⁻¹ d,
    with d as in `Evidence`.

    Raises:
        ValueError: for what is no scenario or test, or pixels without noise.
    """
    require_test("mover_power", scenario, test)
    path_s = jnp.arange(1, scenario.num_frames + 1) / scenario.frame_rate_hz
    places, _ = moved(scenario.movers, jnp.asarray(scenario.landmarks_m), path_s)
    found = jax.vmap(lambda p: evidence(scenario, test, p), in_axes=1)(places[:, jnp.asarray(scenario.movers.ids)])
    q = quantile(test.false_alarm_rate)
    if scenario.movers.course is None:
        direction = jnp.asarray(scenario.movers.direction)
        velocity = scenario.movers.speed_m_s * direction / jnp.linalg.norm(direction)
        return survival(q, found.score @ velocity)
    # In an empty direction of C there is no score either; the ridge keeps 0/0 out.
    ridge = 1e-12 * jnp.trace(found.information, axis1=1, axis2=2)[:, None, None] * jnp.eye(3) + 1e-12 * jnp.eye(3)
    solved = jnp.linalg.solve(found.information + ridge, found.score[..., None])[..., 0]
    return survival(q, jnp.sum(found.score * solved, axis=-1))


def require_test(owner: str, scenario: object, test: object) -> None:
    """Refuse what cannot be predicted.

    Raises:
        ValueError: for what is no scenario or test, or pixels without noise.
    """
    require_kind(owner, "scenario", scenario, Scenario, "give a Scenario, e.g. vcjax.scenarios.paper().")
    require_kind(owner, "test", test, VelocityTest, "give a VelocityTest.")
    require_single(owner, scenario)
    require_single(owner, test)
    require(
        scenario, "pixel_std_px", lambda s: np.isfinite(s) & (s > 0), "without noise of its pixels everything is seen."
    )


def _line(scenario: Scenario, place_m: Float[Array, "3"], velocity_m_s: Float[Array, "3"]) -> Float[Array, "T 3"]:
    """Where a feature of constant velocity is in every frame."""
    time_s = jnp.arange(1, scenario.num_frames + 1) / scenario.frame_rate_hz
    return place_m + time_s[:, None] * velocity_m_s
