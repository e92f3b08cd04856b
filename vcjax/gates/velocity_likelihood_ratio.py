"""Velocity-prior likelihood ratio: in every frame, does a landmark that has just moved explain its innovation better?

Against the static landmark, z ~ N(0, S), stands one that has moved since the frame before by a velocity drawn anew from
N(0, Q), Q = σ² I: z ~ N(0, S + H Q Δt² Hᵀ) with H the derivative by the landmark's place. Twice the log of their
likelihood ratio (the Bayes factor) is

    zᵀ [S⁻¹ - (S + H Q Δt² Hᵀ)⁻¹] z - ln det(S + H Q Δt² Hᵀ)/det S,

summed along the track. The ratio of a static track, whose innovations are white, is a martingale of mean one, and ever
exceeds 1/α with a probability of at most α (Ville's inequality): the threshold is 2 ln(1/α), whatever the number of
frames. That holds while the filter corrects the landmark with every innovation. One that the gate leaves out stays an
error of the state and is met again in the next, which is then not white (see `left_out`): the more is left out, the
more static tracks are flagged than α says. A wide gate keeps that small.

The velocities of different frames are independent here, so that the sign of an innovation counts for nothing: a slow
mover that gives many small innovations of one direction, which the GLR adds up, looks static to this one.

Sources: Bar-Shalom, Li & Kirubarajan 2001, *Estimation with Applications to Tracking and Navigation*, section 11.6, for
the likelihood of innovations under models with other process noise; Ville 1939 for the bound; Wald 1945 for the sum.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.ekf import whiten, whitener
from vcjax.fields import number, require
from vcjax.gates.gate import AbstractDetector, Evidence, add_at_slots


class VelocityLikelihoodRatio(AbstractDetector):
    """Flag a landmark whose Bayes factor of moving against static, over its track, exceeds 1/α.

    The margin has an exact derivative.
    """

    false_alarm_rate: float = eqx.field(converter=number, default=0.01)
    """α, share of the static tracks that are ever flagged, at most, if the gate leaves nothing out; in (0, 1)."""
    velocity_std_m_s: float = eqx.field(converter=number, default=0.5)
    """σ of each component of the velocity, m/s; positive."""

    def __check_init__(self):
        require(self, "false_alarm_rate", lambda a: (a > 0) & (a < 1), "a share of the static tracks lies in (0, 1).")
        positive = "a standard deviation of velocities is positive and finite."
        require(self, "velocity_std_m_s", lambda s: (s > 0) & np.isfinite(s), positive)

    def born(self) -> Float[Array, ""]:
        """Twice the log ratio of a track without innovations: 0."""
        return jnp.zeros(())

    def observe(self, state: Float[Array, " L"], evidence: Evidence) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
        """Add this frame's log ratios, and subtract 2 ln(1/α)."""
        z, S, H = evidence.found(evidence.innovation, evidence.innovation_cov, evidence.H[..., :3])
        W = jax.vmap(whitener)(S)
        moved = jax.vmap(whiten)(W, H) * (self.velocity_std_m_s * evidence.time_step_s)
        z = jax.vmap(whiten)(W, z)
        # Both are measured in units of S, where the static covariance is I and the other I + moved movedᵀ.
        V = jax.vmap(whitener)(jnp.eye(2, dtype=z.dtype) + moved @ moved.mT)
        log_det = -2.0 * (jnp.log(V[:, 0, 0]) + jnp.log(V[:, 1, 1]))
        ratio = jnp.sum(z**2, axis=1) - jnp.sum(jax.vmap(whiten)(V, z) ** 2, axis=1) - log_det
        state = add_at_slots(evidence, state, ratio)
        return state, state + 2.0 * jnp.log(self.false_alarm_rate)
