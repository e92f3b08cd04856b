"""1-point RANSAC with rescue: correct with the largest set that one measurement explains, then with what fits after it.

What robust filters of the field do instead of testing each measurement by itself. With z_i the innovations at the
predicted state and S_ij = H_i P H_jᵀ (+ R where i = j) their joint covariance, correcting with candidate i alone would
leave candidate j the innovation

    r_ij = z_j - (S_ji - δ_ij R) S_ii⁻¹ z_i,

which for i = j is R S_ii⁻¹ z_i. No state needs to be corrected to know it. Where rᵀ R⁻¹ r is small, pixel noise alone
explains what is left: j supports i. The largest set of supporters corrects the state (the partial, low-innovation
update). What is uncertain in itself, as new landmarks are, supports nobody, so the others are tested again there,
rᵀ S⁻¹ r against χ²₂ with S of the corrected state, and correct it too where they fit. The rest is not used in this
frame, nor called dynamic: to delete what does so too often is the detector's work.

RANSAC draws its hypotheses because it cannot try them all. Here they are as many as candidates, ten or so, and all of
them cost one small matrix: all are tried, nothing is drawn, and the same frame always gives the same answer. Of equal
sets the one with the smaller residuals is taken.

The source looks for a match only where it expects one, so that what lies outside its search region (RE₁ ≥ Th₁ at the
predicted state) is never found. Here tracks are given: it neither leads nor supports a set, and may be rescued.

Source: Civera, Grasa, Davison & Montiel 2010, *1-Point RANSAC for extended Kalman filtering: application to real-time
structure from motion and visual odometry*, Journal of Field Robotics 27(5). It corrects with each set at once;
`FilterConfig.update` says how here.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.ekf import innovation_cov, mahalanobis, whiten, whitener
from vcjax.fields import number, require
from vcjax.gates.gate import AbstractJointGate, Candidates, Joint, MeasurementModel, Prior, Verdict, harmless


class OnePointRansac(AbstractJointGate):
    """Accept the largest set that one measurement explains; recover of the rest what fits after it.

    Its margins are th_consensus - rᵀ R⁻¹ r, or Th₁ - RE₁ where that is less, and RE₁ - th_rescue at the corrected
    state, with exact derivatives; which candidate leads the set has none.
    """

    th1: float = eqx.field(converter=number, default=9.0)
    """Th₁, the search region at the predicted state, a χ² value with 2 degrees of freedom (9.0 is 98.9 %); positive."""
    th_consensus: float = eqx.field(converter=number, default=5.99)
    """What a supporter's residual may be in units of pixel noise, a χ² value with 2 degrees of freedom (5.99 is 95 %,
    2.4 px for pixels of 1 px); positive."""
    th_rescue: float = eqx.field(converter=number, default=5.99)
    """What RE₁ may be after the partial update, a χ² value with 2 degrees of freedom (5.99 is 95 %); positive."""
    prior: Prior = eqx.field(static=True, default="corrected", init=False)
    """The rescue is at the corrected state."""
    condemns: ClassVar[bool] = False

    def __check_init__(self):
        for name in ("th1", "th_consensus", "th_rescue"):
            require(self, name, lambda th: th > 0, "a threshold on a squared distance is positive (5.99 is 95 %).")

    def margin(self, re1: Float[Array, "..."]) -> Float[Array, "..."]:
        """Th₁ - RE₁, of the search region."""
        return self.th1 - re1

    def margins(self, joint: Joint) -> Float[Array, " K"]:
        """Each candidate's margin in the largest set."""
        W = jax.vmap(whitener)(jnp.diagonal(joint.S).transpose(2, 0, 1))
        white_z = jax.vmap(whiten)(W, joint.z)
        in_region = self.margin(jnp.sum(white_z**2, axis=-1))
        E = joint.S - jnp.eye(len(joint.z), dtype=joint.z.dtype)[:, :, None, None] * joint.R
        residual = joint.z - jnp.einsum("ijab,ica,ic->ijb", E, W, white_z)
        squared = jnp.sum(jnp.einsum("ab,ijb->ija", whitener(joint.R), residual) ** 2, axis=-1)
        margin = jnp.minimum(in_region, self.th_consensus - squared)
        # The largest set, and of equal ones the better: what its misfits add up to is less than one supporter.
        misfit = squared / (self.th_consensus * (len(squared) + 1))
        score = jnp.sum(jnp.where(joint.is_measured & (margin > 0), 1.0 - misfit, 0.0), axis=-1)
        score = jnp.where(joint.is_measured & (in_region > 0), score, -1.0)
        return margin[jnp.argmax(jax.lax.stop_gradient(score))]

    def judge(self, candidates: Candidates, model: MeasurementModel) -> Verdict:
        """RE₁ - th_rescue at the corrected state."""

        def error(mean, P, uv_px):
            e_hat, H = model.observe(mean)
            return mahalanobis(uv_px - e_hat, innovation_cov(H, P, candidates.R))

        is_isolated, candidates = candidates.is_isolated, harmless(candidates)
        re1 = jax.vmap(error)(candidates.mean, candidates.P, candidates.uv_px)
        re1 = jnp.where(is_isolated, re1, np.nan)
        return Verdict(margin=re1 - self.th_rescue, re1=re1, re2=jnp.full_like(re1, np.nan))
