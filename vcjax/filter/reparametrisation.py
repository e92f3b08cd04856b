"""After a correction: an inverse depth stays positive, and a landmark that has become near linear turns Euclidean.

Both happen to a landmark at its own correction, and later corrections of the frame move it further. No other landmark's
correction reads it, and what moves it later is linear, so both can be done for all K candidates together when the
frame's corrections are over, from what was noted at each correction: with x_j the landmark then and x its mean now,

    x_j → clamped x_j + (x - x_j),      x_j → p(x_j) + J (x - x_j) where it turns Euclidean, J = ∂p/∂x at x_j.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vcjax.filter.config import FilterConfig
from vcjax.filter.map_covariance import SLOT
from vcjax.models.frames import unit
from vcjax.models.landmarks import INVERSE_DEPTH, Landmark, euclidean, linearity_index, to_point, to_point_jacobian


class AtCorrection(NamedTuple):
    """What was noted of a landmark when it was corrected with."""

    landmark: Landmark
    """Its mean right after."""
    variance: Float[Array, ""]
    """Variance of its inverse depth right after."""
    vehicle: Float[Array, " v"]
    """The vehicle right before."""


class Slots(NamedTuple):
    """Landmarks, the derivative of their coordinates by their slot's errors, and whether they are Euclidean."""

    landmarks: Float[Array, "K 7"]
    to_coordinates: Float[Array, "K 7 7"]
    is_euclidean: Bool[Array, " K"]


def settle(config: FilterConfig, slots: Slots, at_correction: AtCorrection, is_corrected: Bool[Array, " K"]) -> Slots:
    """Keep inverse depths positive and turn near-linear landmarks Euclidean, those that were corrected with.

    The linearity index is taken with the landmark right after its correction and the camera pose right before, as the
    paper's toolbox does. The conversion leaves P alone (see `filter.state`). All arguments have K as leading axis.
    """

    def settle_one(slots: Slots, noted: AtCorrection, is_corrected):
        mean, T, is_euclidean = slots
        # What was not corrected has nothing noted; ones keep its numbers finite.
        at, vehicle = (jnp.where(is_corrected, value, 1.0) for value in (noted.landmark, noted.vehicle))
        has_variance = is_corrected & (noted.variance > 0)
        std = jnp.sqrt(jnp.where(has_variance, noted.variance, 1.0))
        rho = at[INVERSE_DEPTH]
        clamped = at.at[INVERSE_DEPTH].set(jnp.where(rho > 0, rho, config.inverse_depth_min))
        moved_since = mean - at

        is_linear = linearity_index(*_unit_poses(config, vehicle), clamped, std) < config.linearity_max
        becomes = has_variance & is_linear & ~is_euclidean
        J = to_point_jacobian(clamped)
        settled = jnp.where(becomes, euclidean(to_point(clamped) + J @ moved_since), clamped + moved_since)
        T_euclidean = jnp.concatenate([J, jnp.zeros((SLOT - 3, SLOT), J.dtype)])
        return Slots(jnp.where(is_corrected, settled, mean), jnp.where(becomes, T_euclidean, T), is_euclidean | becomes)

    return jax.vmap(settle_one)(slots, at_correction, is_corrected)


def _unit_poses(config: FilterConfig, vehicle: Float[Array, " v"]) -> tuple[Float[Array, "7"], Float[Array, "7"]]:
    """Robot and sensor pose with unit quaternions."""
    robot, sensor = (
        jnp.concatenate([pose[:3], unit(pose[3:], config.toolbox_parity)]) for pose in (vehicle[:7], vehicle[7:14])
    )
    return robot, sensor
