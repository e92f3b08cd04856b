"""The deletion rule of the paper's toolbox: a landmark that is searched often and fits seldom is inconsistent."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import number, require
from vcjax.gates.gate import AbstractDetector, Evidence


class Counts(NamedTuple):
    """How often a landmark was searched, found in the image, and used in a correction."""

    searched: Float[Array, "..."]
    measured: Float[Array, "..."]
    corrected: Float[Array, "..."]


class InlierRatio(AbstractDetector):
    """Flag a visible landmark, searched at least `min_searches` times, that was found or fitted too seldom.

    Flagged when measured/searched < `min_measured_ratio` or corrected/measured < `min_corrected_ratio`. All counts
    start at one; frames in which another detector suspects the landmark do not count. Its margin is the larger of the
    two ratios' deviances, the χ²₁ statistic of a binomial share k/n held against its bound p, 2 n KL(k/n ‖ p), with
    the sign of p - k/n; its derivative is zero.
    """

    min_searches: float = eqx.field(converter=number, default=10.0)
    """Searches before the rule applies; infinity switches it off."""
    min_measured_ratio: float = eqx.field(converter=number, default=0.1)
    """Smallest share of searches that find the landmark, in [0, 1]."""
    min_corrected_ratio: float = eqx.field(converter=number, default=0.5)
    """Smallest share of finds that are used in a correction, in [0, 1]."""

    def __check_init__(self):
        require(
            self, "min_searches", lambda n: n >= 0, "give a number of searches, or infinity to switch the rule off."
        )
        for ratio in ("min_measured_ratio", "min_corrected_ratio"):
            require(self, ratio, lambda r: (r >= 0) & (r <= 1), "a ratio lies in [0, 1].")

    def born(self) -> Counts:
        """One of each, as if the landmark had been searched, found and fitted once."""
        return Counts(jnp.ones(()), jnp.ones(()), jnp.ones(()))

    def observe(self, state: Counts, evidence: Evidence) -> tuple[Counts, Float[Array, " L"]]:
        """Count this frame's candidates and compare the ratios with their bounds."""

        def count(total, happened):
            counts = evidence.is_searched & ~evidence.is_suspect
            return total.at[evidence.slot].add((happened & counts).astype(total.dtype))

        state = Counts(
            count(state.searched, evidence.is_searched),
            count(state.measured, evidence.is_measured),
            count(state.corrected, evidence.is_corrected),
        )
        margin = jnp.maximum(
            _deviance(state.measured, state.searched, self.min_measured_ratio),
            _deviance(state.corrected, state.measured, self.min_corrected_ratio),
        )
        is_due = evidence.is_visible & (state.searched >= self.min_searches)
        return state, jax.lax.stop_gradient(jnp.where(is_due, margin, np.nan))


def _deviance(hits: Float[Array, " L"], tries: Float[Array, " L"], bound: float | Array) -> Float[Array, " L"]:
    """2 n KL(k/n ‖ p), above 0 exactly where k/n < p and at most 0 elsewhere."""
    share = hits / tries
    log = jax.scipy.special.xlogy
    divergence = log(share, share) - log(share, bound) + log(1 - share, 1 - share) - log(1 - share, 1 - bound)
    size = 2.0 * tries * jnp.maximum(divergence, jnp.finfo(share.dtype).tiny)
    return jnp.where(share < bound, size, -size)
