"""RE: the re-projection error gate of the paper's toolbox, equation (13)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import number, require, require_choice
from vcjax.gates.gate import PRIORS, AbstractGate, Candidates, MeasurementModel, Prior, Verdict


class ReprojectionError(AbstractGate):
    """Accept where RE₁ = zᵀ Z⁻¹ z < Th₁; leave the rest unused. Deletion is the detector's work.

    Its margin has an exact derivative.
    """

    th1: float = eqx.field(converter=number, default=9.0)
    """Th₁, a χ² value with 2 degrees of freedom (9.0 is 98.9 %); positive."""
    prior: Prior = eqx.field(static=True, default="corrected")
    """"corrected" tests at the running state, "predicted" at the state after prediction."""

    def __check_init__(self):
        require(self, "th1", lambda th: th > 0, "a threshold on a squared distance is positive (9.0 is 98.9 %).")
        require_choice(self, "prior", PRIORS)

    def margin(self, re1: Float[Array, "..."]) -> Float[Array, "..."]:
        """Th₁ - RE₁."""
        return self.th1 - re1

    def judge(self, candidates: Candidates, model: MeasurementModel) -> Verdict:
        """No candidate is recovered, none called dynamic."""
        del model
        nothing = jnp.full(candidates.is_isolated.shape, np.nan, candidates.P.dtype)
        return Verdict(margin=nothing, re1=nothing, re2=nothing)
