"""Decisions: hard, hard with a smooth derivative, or soft. The one place where a threshold becomes a number in [0, 1].

A gate says by how much its thresholds are passed, a *margin* m in χ² units; the weight of a measurement is decided
here:

    hard               1 where m > 0, else 0               derivative zero
    straight_through   1 where m > 0, else 0               derivative that of σ(m/τ), declared
    soft               σ(m/τ)                              derivative exact

σ is the logistic function and τ the temperature, in the unit of the margin. For τ → 0 soft becomes hard.
Straight-through keeps the hard filter's numbers, verdicts and losses of them included, and says which way a threshold
should go, but its derivative is that of no function, and what a gate passes no verdict on, as RE on what it leaves out,
has none. Soft changes the numbers and has a true gradient, which finite differences confirm.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Smoothing = Literal["hard", "straight_through", "soft"]
SMOOTHINGS = ("hard", "straight_through", "soft")


def decide(
    smoothing: Smoothing, margin: Float[Array, "*b"], temperature: float | Float[Array, ""]
) -> Float[Array, "*b"]:
    """The weight in [0, 1] that a margin gives. A margin of NaN, of which nothing can be said, has weight 0.

    Args:
        smoothing: which of the three.
        margin: by how much a threshold is passed.
        temperature: τ, positive.

    Returns: the weight; derivative as the module says, by margin and (soft) temperature.
    """
    is_known = ~jnp.isnan(margin)
    margin = jnp.where(is_known, margin, 0.0)
    hard, soft = (margin > 0).astype(margin.dtype), jax.nn.sigmoid(margin / temperature)
    weight = {"hard": hard, "soft": soft, "straight_through": straight_through(hard, soft)}[smoothing]
    return jnp.where(is_known, weight, 0.0)


def straight_through(hard: Float[Array, "*b"], soft: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The value of one with the derivative of another, in forward and reverse mode."""
    return hard + (soft - jax.lax.stop_gradient(soft))
