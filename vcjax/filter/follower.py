"""Followers: features that were flagged, each with a small Kalman filter of its own outside the map.

Two models watch a follower's pixels. One moves: place p and velocity v in the world, the velocity a first-order
Gauss-Markov process with standard deviation σ and correlation time τ, which forgets what it was and can stop and turn,

    p ← p + Δt v,    v ← e^(-Δt/τ) v + w,    w ~ N(0, σ² (1 - e^(-2 Δt/τ)) I).

The other stands still: a place alone, with no process noise. A pixel corrects both, with the innovation covariance

    S = H_p P H_pᵀ + N,    N = H_m P_mm H_mᵀ + R,

m the vehicle: the robot's own uncertainty makes a follower's pixels noisier, and the robot is never corrected by them.
Twice the log of how much better the one that moves predicted a pixel than the one that stands still,

    λ = z_0ᵀS_0⁻¹z_0 + ln det S_0 - z_1ᵀS_1⁻¹z_1 - ln det S_1,

is added up as Page does, s ← max(0, s + λ). Above a limit h the feature moves, and the model that stands still begins
anew, at the place of the other. A feature has stood still for as many pixels as were taken since. That one which does
is taken to move within n pixels has a probability of at most n exp(-h/2): from any pixel on the likelihood ratio is a
martingale of mean one. A mover that mimics a standing one, as far as the camera can tell, is handed back; the detector,
whose threshold is the sharper, finds it again.

Sources: Bar-Shalom, Li & Kirubarajan 2001, *Estimation with Applications to Tracking and Navigation*, section 6.2, for
the motion; Page 1954, *Continuous inspection schemes*, Biometrika 41, and Ville 1939, for the test.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vcjax.ekf import correct, innovation_cov, mahalanobis
from vcjax.fields import number, require, require_count


class Following(eqx.Module):
    """How flagged features are followed, and when they are handed back."""

    max_followed: int = eqx.field(static=True, default=0)
    """How many are followed at once, the newest taking the places of the oldest; 0: none, at no cost."""
    rest_frames: int = eqx.field(static=True, default=20)
    """For how many of its pixels a feature must have stood still to be handed back, at least 1."""
    rest_limit: float = eqx.field(converter=number, default=12.0)
    """h, Page's sum above which it did not; positive. One that stands still is taken to move in at most one of twenty
    windows of 20 pixels, and then has to wait for another."""
    follower_velocity_std_m_s: float = eqx.field(converter=number, default=0.5)
    """σ of each component of the velocity, m/s; positive."""
    velocity_memory_s: float = eqx.field(converter=number, default=5.0)
    """τ, for how long a velocity is kept, s; positive."""
    relative_place_std: float = eqx.field(converter=number, default=0.3)
    """Standard deviation of a new follower's place on each axis, as a share of its distance from the camera; positive.
    It is added to what the map knows: the place that a mover has in the map is not where it is."""

    def __check_init__(self):
        require_count(self, "max_followed", 0)
        require_count(self, "rest_frames", 1)
        for name in ("rest_limit", "follower_velocity_std_m_s", "velocity_memory_s", "relative_place_std"):
            require(self, name, lambda v: np.isfinite(v) & (v > 0), "give a positive number.")


class Followers(NamedTuple):
    """Features that are followed."""

    track_id: Int[Array, "*T F"]
    """Feature; -1 where nothing is followed, and the rest is meaningless."""
    place_m: Float[Array, "*T F 3"]
    """Place in the world, m."""
    velocity_m_s: Float[Array, "*T F 3"]
    """Velocity, m/s."""
    cov: Float[Array, "*T F 6 6"]
    """Covariance of place and velocity."""
    rest_place_m: Float[Array, "*T F 3"]
    """Place of the model that stands still, m."""
    rest_cov: Float[Array, "*T F 3 3"]
    """Its covariance, m²."""
    misfit: Float[Array, "*T F"]
    """Page's sum: by how much the model that moves was the better."""
    at_rest: Float[Array, "*T F"]
    """For how many pixels the feature has stood still."""


def nobody(following: Following, dtype) -> Followers:
    """No follower in any place."""
    num = following.max_followed
    return begin(
        following,
        jnp.full(num, -1, jnp.int32),
        jnp.zeros((num, 3), dtype),
        jnp.zeros((num, 3, 3), dtype),
        jnp.ones(num, dtype),
    )


def begin(
    following: Following,
    track_id: Int[Array, " F"],
    place_m: Float[Array, "F 3"],
    cov: Float[Array, "F 3 3"],
    distance_m: Float[Array, " F"],
) -> Followers:
    """New followers at places that a map had them at, with covariances, and distances from the camera."""
    eye, zero = jnp.eye(3, dtype=cov.dtype), jnp.zeros(cov.shape, cov.dtype)
    cov = cov + ((following.relative_place_std * distance_m) ** 2)[:, None, None] * eye
    velocity_cov = jnp.broadcast_to(following.follower_velocity_std_m_s**2 * eye, cov.shape)
    none = jnp.zeros(track_id.shape, cov.dtype)
    whole = jnp.block([[cov, zero], [zero, velocity_cov]])
    return Followers(track_id, place_m, jnp.zeros_like(place_m), whole, place_m, cov, none, none)


def advance(following: Following, followers: Followers, time_step_s: Float[Array, ""]) -> Followers:
    """All that moves, moved by a frame."""
    keep = jnp.exp(-time_step_s / following.velocity_memory_s)
    F = jnp.eye(6, dtype=followers.cov.dtype).at[jnp.arange(3), jnp.arange(3, 6)].set(time_step_s)
    F = F.at[jnp.arange(3, 6), jnp.arange(3, 6)].set(keep)
    Q = jnp.diag(
        jnp.repeat(jnp.stack([jnp.zeros_like(keep), following.follower_velocity_std_m_s**2 * (1 - keep**2)]), 3)
    )
    return followers._replace(
        place_m=followers.place_m + time_step_s * followers.velocity_m_s,
        velocity_m_s=keep * followers.velocity_m_s,
        cov=F @ followers.cov @ F.T + Q,
    )


class Sight(NamedTuple):
    """What is measured of followers."""

    is_measured: Bool[Array, " F"]
    uv_px: Float[Array, "F 2"]
    """Anything where not measured."""


def watch(following: Following, followers: Followers, sight: Sight, measure) -> tuple[Followers, Bool[Array, " F"]]:
    """Correct both models with this frame's pixels.

    Args:
        following: settings.
        followers: after `advance`.
        sight: the pixels.
        measure: a place (3,) → predicted pixel (2,), its derivative (2, 3), and N (2, 2).

    Returns: the followers, and which of them are lost: their pixel has nothing to do with what was predicted.
    """
    uv_px = jnp.where(sight.is_measured[:, None], sight.uv_px, 0.0)
    watched, is_lost = jax.vmap(lambda one, y: _watch_one(following, one, y, measure))(followers, uv_px)
    is_seen = sight.is_measured & (followers.track_id >= 0)
    watched = jax.tree.map(
        lambda new, old: jnp.where(is_seen.reshape(-1, *(1,) * (new.ndim - 1)), new, old), watched, followers
    )
    return watched, is_seen & is_lost


_LOST = 1e3
"""A squared Mahalanobis distance that no pixel of the feature has."""


def _watch_one(following: Following, one: Followers, uv_px, measure):
    pixel, H_p, N = measure(one.place_m)
    H = jnp.concatenate([H_p, jnp.zeros_like(H_p)], axis=1)
    z, S = uv_px - pixel, innovation_cov(H, one.cov, N)
    moving = correct(one.cov, H, z, S)
    distance, log_det = mahalanobis(z, S), _log_det(S)
    place, velocity = one.place_m + moving.shift[:3], one.velocity_m_s + moving.shift[3:]
    is_lost = ~(distance < _LOST)

    pixel, H_p, N = measure(one.rest_place_m)
    z, S = uv_px - pixel, innovation_cov(H_p, one.rest_cov, N)
    standing = correct(one.rest_cov, H_p, z, S)
    evidence = mahalanobis(z, S) + _log_det(S) - distance - log_det
    misfit = jnp.maximum(one.misfit + evidence, 0.0)
    is_moving = ~(misfit < following.rest_limit)
    watched = Followers(
        track_id=one.track_id,
        place_m=place,
        velocity_m_s=velocity,
        cov=moving.P,
        rest_place_m=jnp.where(is_moving, place, one.rest_place_m + standing.shift),
        rest_cov=jnp.where(is_moving, moving.P[:3, :3], standing.P),
        misfit=jnp.where(is_moving, 0.0, misfit),
        at_rest=jnp.where(is_moving, 0.0, one.at_rest + 1.0),
    )
    return watched, is_lost


def _log_det(S: Float[Array, "2 2"]) -> Float[Array, ""]:
    return jnp.log(S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0])
