"""Landmarks as points of the world, for maps to show: what a slot holds, whichever form it has."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.filter.state import FREE, FilterState, landmark_cov
from vcjax.models.landmarks import to_point, to_point_jacobian


class LandmarkPoints(eqx.Module):
    """Points of the world, one for each of L slots."""

    track_id: Int[Array, "*T L"]
    """Feature; -1 where there is none, and the rest is meaningless."""
    place_m: Float[Array, "*T L 3"]
    """Place in the world, p₀ + m/ρ, m."""
    cov: Float[Array, "*T L 3 3"]
    """Its covariance to first order, m². Of a landmark whose depth is hardly known that is large, and crude."""


def landmark_points(state: FilterState, is_wanted: Bool[Array, " L"] | None = None) -> LandmarkPoints:
    """The landmarks in some slots (all that are mapped, if none are named) as points: p₀ + m/ρ with covariance J P Jᵀ.

    Derivative exact.
    """
    is_wanted = state.is_mapped if is_wanted is None else is_wanted & state.is_mapped
    # A free slot may hold anything: a harmless point takes its place, so that no NaN arises where nothing is.
    harmless = jnp.array([0, 0, 0, 1, 0, 0, 1], state.landmarks.dtype)
    landmarks = jnp.where(is_wanted[:, None], state.landmarks, harmless)
    J = jax.vmap(to_point_jacobian)(landmarks)
    cov = jnp.where(is_wanted[:, None, None], landmark_cov(state), 0.0)
    return LandmarkPoints(
        track_id=jnp.where(is_wanted, state.track_id, FREE),
        place_m=jax.vmap(to_point)(landmarks),
        cov=J @ cov @ J.mT,
    )
