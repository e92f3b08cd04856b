"""Windowed NIS: are a landmark's last innovations together larger than their covariance allows?

The normalised innovation squared of a static landmark, RE₁, is χ² with 2 degrees of freedom, and white; the sum of the
last W is χ² with 2 W. The test the field uses for the consistency of a filter, and here of one landmark.

Source: Bar-Shalom, Li & Kirubarajan 2001, *Estimation with Applications to Tracking and Navigation*, section 5.4.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import number, require, require_count
from vcjax.gates.gate import AbstractDetector, Evidence, add_at_slots, set_at_slots


class Window(NamedTuple):
    """A landmark's last innovations."""

    re1: Float[Array, "*L W"]
    """Their RE₁, newest first; 0 where there were not so many yet."""
    num: Float[Array, "*L"]
    """How many there ever were."""


class WindowedNIS(AbstractDetector):
    """Flag a landmark when the sum of the RE₁ of its last W innovations exceeds a limit.

    Nothing is said of it before it has had so many. The margin has an exact derivative.
    """

    window: int = eqx.field(static=True, default=10)
    """W, number of innovations, at least 1."""
    limit: float = eqx.field(converter=number, default=52.4)
    """χ² value with 2 W degrees of freedom, positive. The default is 99.99 % of 20: the test is made in every frame."""

    def __check_init__(self):
        require_count(self, "window", 1)
        require(self, "limit", lambda t: t > 0, "give a positive χ² value with 2 * window degrees of freedom.")

    def born(self) -> Window:
        """No innovation yet."""
        return Window(jnp.zeros(self.window), jnp.zeros(()))

    def observe(self, state: Window, evidence: Evidence) -> tuple[Window, Float[Array, " L"]]:
        """Take this frame's innovations into the windows, and compare their sums with the limit."""
        (re1,) = evidence.found(evidence.re1)
        newest_first = jnp.concatenate([re1[:, None], state.re1[evidence.slot, :-1]], axis=1)
        state = Window(
            set_at_slots(evidence, state.re1, newest_first), add_at_slots(evidence, state.num, jnp.ones_like(re1))
        )
        margin = jnp.sum(state.re1, axis=1) - self.limit
        return state, jnp.where(state.num >= self.window, margin, np.nan)
