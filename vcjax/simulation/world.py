"""Worlds of point features: the paper's grid, and which of its points move."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vcjax.fields import number, require, vector


def grid(
    low_m: float = -8.0, high_m: float = 8.0, num_per_side: int = 9, heights_m: tuple[float, ...] = (0.0, 1.0)
) -> Float[np.ndarray, "F 3"]:
    """Square grid of features in layers, (F, 3) m: the paper's 162 points are 9 × 9 of 2 m pitch at heights 0 and 1 m.

    Feature ids count layer by layer, in a layer by x, and for equal x by y.
    """
    side = np.linspace(low_m, high_m, num_per_side)
    z, x, y = np.meshgrid(heights_m, side, side, indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


class Movers(eqx.Module):
    """Features that move with one constant velocity from the first frame on."""

    ids: Int[Array | np.ndarray, " D"]
    """Which features."""
    direction: tuple[float, float, float] = eqx.field(converter=vector, default=(0.0, 1.0, 0.0))
    """Direction of motion in the world; scaled by the speed, so of unit length."""
    speed_m_s: float = eqx.field(converter=number, default=0.0)
    """Speed, m/s; 0: they stand still and count as static."""

    def __check_init__(self):
        require(self, "direction", np.isfinite, "give finite numbers.", length=3)
        require(
            self,
            "direction",
            lambda d: np.isclose(np.linalg.norm(d, axis=-1), 1.0, atol=1e-6),
            "give a direction of unit length; the speed is a number of its own.",
            length=3,
        )
        require(
            self, "speed_m_s", lambda v: np.isfinite(v) & (v >= 0), "a speed is at least 0; turn the direction round."
        )


def velocities(movers: Movers, num_features: int) -> Float[Array, "F 3"]:
    """Velocity of every feature, m/s."""
    velocity = jnp.asarray(movers.direction) * movers.speed_m_s
    return jnp.zeros((num_features, 3), velocity.dtype).at[jnp.asarray(movers.ids)].set(velocity)
