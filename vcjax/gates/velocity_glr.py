"""Velocity GLR: does one constant velocity explain a landmark's innovations better than standing still?

A static landmark's innovations z are white with covariance S. One that moves at the velocity v since its birth leaves
the estimate of its place behind by an error that is linear in v, B v, with B known from the filter's own numbers, and
its innovations have the mean G v. With H the landmark's part of the measurement derivative, K its own rows of the gain
and Δt the time step, in each frame

    B ← B + Δt [I₃; 0],    G = H B,    d ← d + Gᵀ S⁻¹ z,    C ← C + Gᵀ S⁻¹ G,    B ← B - K G.

Then v̂ = C⁻¹ d has the covariance C⁻¹, and twice the log of the generalised likelihood ratio is dᵀ C⁻¹ d: χ² with three
degrees of freedom for a static landmark, non-central with δ = vᵀ C v for one that moves. (A slot's first three error
coordinates are the anchor of an AHP point, which moves as the point does; B keeps them for life.)

The rank of C is what can be observed: a camera that does not swing cannot tell a point that comes towards it from a
static one closer by, and along that direction C stays empty. A weak prior v ~ N(0, σ² I) makes all of it well defined
with no decision about ranks: C + I/σ² in place of C. It leaves the statistic as it is along directions that were
observed (σ² λ ≫ 1, λ an eigenvalue of C), and fades out the others: a static landmark's is Σ χ²₁ σ²λ/(1 + σ²λ), at most
the χ²₃ of the fixed threshold.

The test is made in every frame, and what counts is whether it is ever passed. With the same prior the likelihood ratio
of moving against static is known in closed form,

    Λ = det(I + σ² C)^(-1/2) exp(½ dᵀ (C + I/σ²)⁻¹ d),

and a static landmark's is a martingale of mean one, so that it ever exceeds 1/α with a probability of at most α
(Ville's inequality): for a false-alarm rate α per track the threshold is 2 ln(1/α) + ln det(I + σ² C), which grows with
what is known. It needs no number of frames, and is cautious: of 4000 linear tracks of 60 innovations, with σ = 1 m/s,
0.25 % are ever flagged for α = 1 %, and 2.9 % for α = 10 %. A fixed threshold flags fewer in the first frames and more
in the end: of the same tracks 9.1 % ever pass 12, 1.8 % pass 16 and 0.28 % pass 20, ten to twenty times as many as in
one test.

All measured innovations count, those that the gate leaves out too: it leaves out what is large, and that is the
evidence. They are made white again as `left_out` says, and z, S and K above are the white ones. As they come, they
count an error twice that was left out: in the paper's scene with movers towards the robot at 0.25 m/s, A = 0.10 m, Th₁
= 9 and a threshold of 20, it is 1.8 ± 0.3 % of the static landmarks that are flagged with them, and 0.3 ± 0.1 % with
the white ones, all movers being found either way (24 seeds).

Until it is flagged a mover does harm, and a lower threshold flags more static ones for good. With `suspect`, a second,
lower value, a landmark is only left out while the statistic is above it: its innovations are made white as above, and
who calms down is corrected with again (docs/after_detection.md has what that is worth). With suspects a false-alarm
rate is no bound any more: the lower `suspect`, the more static landmarks are flagged at one threshold. What is left out
would have corrected the vehicle too, of which `left_out` knows nothing.

Two things are neglected. A mover pulls the vehicle along, where other landmarks do not hold it. And what a fast mover
does to the estimate of its place is more than linear: where it mimics a closer point, v̂ comes out too small.

Sources: Willsky & Jones 1976, *A generalized likelihood ratio approach to the detection and estimation of jumps in
linear systems*, IEEE Trans. Automatic Control 21(1); Friedland 1969, *Treatment of bias in recursive filtering*, for B;
Robbins 1970, *Statistical methods related to the law of the iterated logarithm*, for tests at every time.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.ekf import whiten, whitener
from vcjax.fields import is_concrete, number, require
from vcjax.gates.gate import SLOT, AbstractDetector, Evidence, add_at_slots
from vcjax.gates.left_out import LeftOut, nothing_left_out, whiten_innovations

FALSE_ALARM_RATE = 0.01
"""Where neither a rate nor a threshold is given."""


class Motion(NamedTuple):
    """What is known of a landmark's velocity."""

    B: Float[Array, "*L 7 3"]
    """Error of its slot's coordinates by its velocity, s."""
    d: Float[Array, "*L 3"]
    """Σ Gᵀ S⁻¹ z, s/m."""
    C: Float[Array, "*L 3 3"]
    """Σ Gᵀ S⁻¹ G, the information on its velocity, s²/m²."""
    D: Float[Array, "*L 3 3"]
    """Covariance of d, static or not; C unless something is forgotten."""
    left_out: LeftOut
    """What the gate left out (see `left_out`)."""


class VelocityGLR(AbstractDetector):
    """Flag a landmark whose innovations a constant velocity explains: dᵀ C⁻¹ d above a threshold.

    The margin has an exact derivative.
    """

    false_alarm_rate: float | None = eqx.field(converter=number, default=None)
    """Share of the static tracks that are ever flagged, at most; in (0, 1). None: 0.01, or no rate with a threshold."""
    threshold: float | None = eqx.field(converter=number, default=None)
    """A χ²₃ value instead, the same in all frames; positive."""
    suspect: float | None = eqx.field(converter=number, default=None)
    """A smaller χ²₃ value above which a landmark is suspect: measured and tested, but corrected with no more until it
    falls below; positive and finite. The path is better for it, more static landmarks are flagged at one threshold,
    and many after a jump of the odometry (docs/after_detection.md). Its derivative is zero, the decision being hard in
    soft filters too. None: every landmark is corrected with until it is flagged."""
    velocity_std_m_s: float = eqx.field(converter=number, default=0.5)
    """σ of the weak prior on each component of the velocity, m/s; positive."""
    forgetting: float = eqx.field(converter=number, default=1.0)
    """By how much B, d and C shrink in each frame, in (0, 1]; 1: a constant velocity since birth; below, one held over
    the last 1/(1 - forgetting) frames, which has no rate per track and needs a threshold."""

    def __check_init__(self):
        if self.false_alarm_rate is not None and self.threshold is not None:
            raise ValueError(
                f"VelocityGLR(false_alarm_rate={self.false_alarm_rate}, threshold={self.threshold}): one replaces the "
                "other; give one of them, and None for the other."
            )
        if self.false_alarm_rate is not None:
            share = "a share of the static tracks lies in (0, 1)."
            require(self, "false_alarm_rate", lambda a: (a > 0) & (a < 1), share)
        if self.threshold is not None:
            require(self, "threshold", lambda t: t > 0, "give a positive χ²₃ value (16.3 is 99.9 %), or None.")
        if self.suspect is not None:
            positive = "give a positive, finite χ²₃ value (7.8 is 95 %), or None."
            require(self, "suspect", lambda t: (t > 0) & np.isfinite(t), positive)
            suspect, threshold = self.suspect, self.threshold
            is_told = threshold is not None and is_concrete(suspect) and is_concrete(threshold)
            if is_told and np.any(np.asarray(suspect) >= np.asarray(threshold)):
                raise ValueError(
                    f"VelocityGLR(suspect={np.asarray(self.suspect).tolist()}, "
                    f"threshold={np.asarray(self.threshold).tolist()}): who is flagged was suspect before; give a "
                    "smaller value for suspect, or None."
                )
        positive = "a standard deviation of velocities is positive and finite."
        require(self, "velocity_std_m_s", lambda s: (s > 0) & np.isfinite(s), positive)
        require(self, "forgetting", lambda f: (f > 0) & (f <= 1), "a factor lies in (0, 1]; 1 forgets nothing.")
        if self.threshold is None and is_concrete(self.forgetting) and np.any(np.asarray(self.forgetting) < 1):
            raise ValueError(
                f"VelocityGLR(forgetting={np.asarray(self.forgetting).tolist()}) begins anew all the time and has no "
                "false-alarm rate per track: give a threshold, or forgetting=1."
            )

    def born(self) -> Motion:
        """Nothing is known, and nothing has moved."""
        return Motion(jnp.zeros((SLOT, 3)), jnp.zeros(3), jnp.zeros((3, 3)), jnp.zeros((3, 3)), nothing_left_out())

    def observe(self, state: Motion, evidence: Evidence) -> tuple[Motion, Float[Array, " L"]]:
        """The recursion above, and by how much the statistic passes its threshold; NaN where nothing was seen yet."""
        left_out, (z, S, K) = whiten_innovations(state.left_out, evidence)
        (H,) = evidence.found(evidence.H)
        W = jax.vmap(whitener)(S)
        z = jax.vmap(whiten)(W, z)

        f = self.forgetting
        B = f * state.B
        B = B.at[:, jnp.arange(3), jnp.arange(3)].add(evidence.time_step_s)
        G = H @ B[evidence.slot]
        white_G = jax.vmap(whiten)(W, G)
        information = white_G.mT @ white_G
        state = Motion(
            B=add_at_slots(evidence, B, -(K @ G)),
            d=add_at_slots(evidence, f * state.d, jnp.sum(white_G * z[..., None], axis=1)),
            C=add_at_slots(evidence, f * state.C, information),
            D=add_at_slots(evidence, f**2 * state.D, information),
            left_out=left_out,
        )
        is_known = jnp.trace(state.C, axis1=1, axis2=2) > 0
        return state, jnp.where(is_known, self.margin(state), np.nan)

    def margin(self, state: Motion) -> Float[Array, "*L"]:
        """dᵀ (D + I/σ²)⁻¹ d less its threshold."""
        statistic, log_det = self._statistic(state)
        if self.threshold is not None:
            return statistic - self.threshold
        rate = FALSE_ALARM_RATE if self.false_alarm_rate is None else self.false_alarm_rate
        return statistic - log_det + 2.0 * jnp.log(rate)

    def suspicion(self, state: Motion) -> Float[Array, "*L"] | None:
        """The statistic dᵀ (D + I/σ²)⁻¹ d less `suspect`."""
        return None if self.suspect is None else self._statistic(state)[0] - self.suspect

    def velocity(self, state: Motion) -> tuple[Float[Array, "*L 3"], Float[Array, "*L 3 3"]]:
        """v̂ = (C + I/σ²)⁻¹ d, m/s, and its covariance, m²/s²: along what was not observed 0, and that of the prior."""
        variance = self.velocity_std_m_s**2
        inverse = variance * _inverse(self._unit_prior(state.C))
        cov = inverse @ (self._unit_prior(state.D) / variance) @ inverse
        return jnp.sum(inverse * state.d[..., None, :], axis=-1), cov

    def _statistic(self, state: Motion) -> tuple[Float[Array, "*L"], Float[Array, "*L"]]:
        """dᵀ (D + I/σ²)⁻¹ d, and ln det(I + σ² D)."""
        return jnp.vectorize(_square_and_log_det, signature="(3,3),(3)->(),()")(
            self._unit_prior(state.D), self.velocity_std_m_s * state.d
        )

    def _unit_prior(self, information: Float[Array, "*L 3 3"]) -> Float[Array, "*L 3 3"]:
        """I + σ² C."""
        return jnp.eye(3, dtype=information.dtype) + self.velocity_std_m_s**2 * information


def _square_and_log_det(M: Float[Array, "3 3"], d: Float[Array, "3"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """dᵀ M⁻¹ d and ln det M of a positive definite matrix, by its factors L diag(e) Lᵀ written out."""
    e0 = M[0, 0]
    l10, l20 = M[1, 0] / e0, M[2, 0] / e0
    e1 = M[1, 1] - l10 * M[1, 0]
    l21 = (M[2, 1] - l20 * M[1, 0]) / e1
    e2 = M[2, 2] - l20 * M[2, 0] - l21**2 * e1
    y1 = d[1] - l10 * d[0]
    y2 = d[2] - l20 * d[0] - l21 * y1
    return d[0] ** 2 / e0 + y1**2 / e1 + y2**2 / e2, jnp.log(e0) + jnp.log(e1) + jnp.log(e2)


def _inverse(M: Float[Array, "*L 3 3"]) -> Float[Array, "*L 3 3"]:
    """Inverse of a symmetric matrix by cross products of its rows."""
    a, b, c = M[..., 0, :], M[..., 1, :], M[..., 2, :]
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    return adjugate / jnp.sum(a * adjugate[..., 0], axis=-1)[..., None, None]
