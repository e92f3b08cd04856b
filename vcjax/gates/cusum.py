"""CUSUM: have a landmark's innovations become larger than their covariance says, at some time?

    s ← max(0, s + RE₁ - κ)

A static landmark's RE₁ is χ² with 2 degrees of freedom and mean 2; the drift κ above it keeps the sum near 0, and a
landmark that begins to move makes it climb, however long it stood still before.

With θ > 0 such that the mean of exp(θ (RE₁ - κ)) is one, exp(-θ κ) = 1 - 2 θ, a static track of n innovations exceeds h
with a probability of at most n exp(-θ h): for κ = 4 (θ = 0.398) and h = 20 that is 3.5 in ten thousand per innovation.
That holds of white innovations, as they are while the filter corrects the landmark with every one. What the gate leaves
out is met again in the next innovation (see `left_out`), and such tracks exceed the limit more often.

Source: Page 1954, *Continuous inspection schemes*, Biometrika 41.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vcjax.fields import number, require
from vcjax.gates.gate import AbstractDetector, Evidence, set_at_slots


class Cusum(AbstractDetector):
    """Flag a landmark whose cumulative sum of RE₁ above a drift exceeds a limit.

    The margin has an exact derivative.
    """

    drift: float = eqx.field(converter=number, default=4.0)
    """κ, above 2, the mean of a static landmark's RE₁; half way to the mean of a moving one's."""
    limit: float = eqx.field(converter=number, default=20.0)
    """h, χ² units, positive."""

    def __check_init__(self):
        require(self, "drift", lambda k: k > 2, "RE₁ of a static landmark has the mean 2; give more.")
        require(self, "limit", lambda h: h > 0, "a limit on a sum that starts at 0 is positive.")

    def born(self) -> Float[Array, ""]:
        """The sum starts at 0."""
        return jnp.zeros(())

    def observe(self, state: Float[Array, " L"], evidence: Evidence) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
        """Page's recursion, and how far the sums are above the limit."""
        (re1,) = evidence.found(evidence.re1)
        state = set_at_slots(evidence, state, jnp.maximum(state[evidence.slot] + re1 - self.drift, 0.0))
        return state, state - self.limit
