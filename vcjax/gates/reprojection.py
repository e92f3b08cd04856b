"""RE: the re-projection error gate of the paper's toolbox, equation (13)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vcjax.fields import number, require, require_choice
from vcjax.gates.gate import PRIORS, AbstractGate, Candidates, MeasurementModel, Prior, Verdict


class ReprojectionError(AbstractGate):
    """Accept where RE₁ = zᵀ Z⁻¹ z < Th₁; leave the rest unused. Deletion is the detector's work.

    Its decisions have zero derivative by everything, Th₁ included.
    """

    th1: float = eqx.field(converter=number, default=9.0)
    """Th₁, a χ² value with 2 degrees of freedom (9.0 is 98.9 %); positive."""
    prior: Prior = eqx.field(static=True, default="corrected")
    """"corrected" tests at the running state, "predicted" at the state after prediction."""

    def __check_init__(self):
        require(self, "th1", lambda th: th > 0, "a threshold on a squared distance is positive (9.0 is 98.9 %).")
        require_choice(self, "prior", PRIORS)

    def accepts(self, re1: Float[Array, "..."]) -> Bool[Array, "..."]:
        """RE₁ < Th₁."""
        return re1 < self.th1

    def judge(self, candidates: Candidates, model: MeasurementModel) -> Verdict:
        """No candidate is recovered, none called dynamic."""
        del model
        nobody = jnp.zeros_like(candidates.is_isolated)
        nothing = jnp.full(nobody.shape, np.nan, candidates.P.dtype)
        return Verdict(is_recovered=nobody, is_dynamic=nobody, re1=nothing, re2=nothing)
