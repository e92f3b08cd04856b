"""Immediate: what the gate leaves out is deleted at once.

The simplest answer to a measurement that does not fit, and what VC does with those it calls dynamic. With RE it is a
test of every single innovation, which a static landmark fails in 1.1 % of its frames for Th₁ = 9: together with a
blacklist, so that it does not come back, it soon empties the map.

Source: the paper's RE, equation (13), with the deletion of its VC, section 3.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.gates.gate import AbstractDetector, Evidence


class Immediate(AbstractDetector):
    """Flag a measured candidate that the gate isolated and did not recover.

    Its margin is the gate's, with its derivative; of whom another detector suspects it says nothing.
    """

    def born(self) -> tuple[()]:
        """It remembers nothing."""
        return ()

    def observe(self, state: tuple[()], evidence: Evidence) -> tuple[tuple[()], Float[Array, " L"]]:
        """The gate's margins at their slots."""
        (margin,) = evidence.found(evidence.dynamic_margin)
        nothing = jnp.full(evidence.is_visible.shape, np.nan, margin.dtype)
        return state, nothing.at[evidence.slot].set(jnp.where(evidence.is_found, margin, np.nan))
