"""VC: the paper's virtual correction, equations (13) and (14).

An isolated candidate corrects a virtual copy of the state. RE₁ is its error before, RE₂ after. If the error falls by
more than Th₂ the feature is called dynamic, else it is recovered. The copy needs only the 21 × 21 block of robot,
sensor and that landmark: nothing else enters the candidate's projection, so the block's correction is the full one's,
exactly.

What the test can and cannot tell: where projection is linear and the prior covariance of the projection is E = H P Hᵀ,
Z = E + R, the virtual correction leaves the residual z⁺ = R Z⁻¹ z and H P⁺ Hᵀ = R - R Z⁻¹ R, so that

    RE₂ = zᵀ (Z + 2 Z R⁻¹ E)⁻¹ z,      RE₁ - RE₂ = Σᵢ (uᵢᵀz)²/sᵢ · (2λᵢ - 2)/(2λᵢ - 1)

for R = r I and Z with eigenvectors uᵢ and eigenvalues sᵢ = λᵢ r. A well-mapped feature (λ → 1) is always recovered,
however large its error; an uncertain one (λ ≫ 1) is called dynamic when RE₁ exceeds max(Th₁, Th₂). At one state VC
deletes a subset of what RE rejects.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from vcjax.ekf import correct, innovation_cov, mahalanobis
from vcjax.fields import number, require, require_choice
from vcjax.gates.gate import PRIORS, AbstractGate, Candidates, MeasurementModel, Prior, Verdict, harmless


class VirtualCorrection(AbstractGate):
    """Accept where RE₁ < Th₁; of the rest, recover where RE₁ - RE₂ ≤ Th₂ and call the others dynamic.

    Its margins are Th₁ - RE₁ and RE₁ - RE₂ - Th₂, with exact derivatives.
    """

    th1: float = eqx.field(converter=number, default=9.0)
    """Th₁, a χ² value with 2 degrees of freedom (9.0 is 98.9 %); positive."""
    th2: float = eqx.field(converter=number, default=9.0)
    """Th₂, on the fall of the squared distance by the virtual correction; at least 0."""
    prior: Prior = eqx.field(static=True, default="corrected")
    """"corrected" judges after the frame's formal corrections, "predicted" gates and judges after prediction."""

    def __check_init__(self):
        require(self, "th1", lambda th: th > 0, "a threshold on a squared distance is positive (9.0 is 98.9 %).")
        require(self, "th2", lambda th: th >= 0, "a threshold on a fall of squared distance is at least 0.")
        require_choice(self, "prior", PRIORS)

    def margin(self, re1: Float[Array, "..."]) -> Float[Array, "..."]:
        """Th₁ - RE₁."""
        return self.th1 - re1

    def judge(self, candidates: Candidates, model: MeasurementModel) -> Verdict:
        """RE₁ and RE₂ of every isolated candidate on its own virtual copy, and what they say."""

        def errors(mean, P, uv_px):
            return virtual_correction(model, mean, P, uv_px, candidates.R)

        is_isolated, candidates = candidates.is_isolated, harmless(candidates)
        re1, re2 = jax.vmap(errors)(candidates.mean, candidates.P, candidates.uv_px)
        margin, re1, re2 = (jnp.where(is_isolated, value, np.nan) for value in (re1 - re2 - self.th2, re1, re2))
        return Verdict(margin, re1, re2)


def virtual_correction(
    model: MeasurementModel, mean: PyTree, P: Float[Array, "n n"], uv_px: Float[Array, "2"], R: Float[Array, "2 2"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """RE₁ before and RE₂ after correcting a copy of a block with its own measurement. Equations (8)–(14).

    W of equation (14) is R + H P⁺ Hᵀ as printed. (The residual's true covariance is R - H P⁺ Hᵀ; with it RE₂ would
    equal RE₁ and the test would be void.) Derivative exact.
    """
    e_hat, H = model.observe(mean)
    z = uv_px - e_hat
    Z = innovation_cov(H, P, R)
    virtual = correct(P, H, z, Z)
    e, H_plus = model.observe(model.retract(mean, virtual.shift))
    W = innovation_cov(H_plus, virtual.P, R)
    return mahalanobis(z, Z), mahalanobis(uv_px - e, W)
