"""White innovations although the gate leaves some out: those of a filter that corrects the landmark with every one.

A detector that adds innovations up wants them white. Those that the filter corrects with are; one that the gate leaves
out leaves its error in the state, where it is met again in the next, and counts twice. So the detector keeps, for each
landmark, by how much the estimate with everything that was measured of it differs from the filter's: its offset
o = x' - x and what more is known, D = P - P'. With z, S, H, the landmark's rows P Hᵀ and the weight g of the filter's
correction (0 where it left the candidate out),

    z' = z - H o,    S' = S - H D Hᵀ,    K' = (P Hᵀ - D Hᵀ) S'⁻¹,    K = P Hᵀ S⁻¹,
    o ← o + K' z' - g K z,    D ← D + K' S' K'ᵀ - (2g - g²) K S Kᵀ.

z' is white with covariance S', whatever was left out, and equal to z as long as nothing was. It is exact for a landmark
measured by itself. Neglected is what the left-out innovations say of the vehicle, which they do not move here either,
and, in a stacked update, that the frame's candidates share it. Where the two estimates have drifted so far apart that
S' is no covariance any more (H D Hᵀ beyond S - R/2), they begin anew from the filter's.

Derivatives are exact.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vcjax.ekf import whitener
from vcjax.gates.gate import SLOT, Evidence, set_at_slots


class LeftOut(NamedTuple):
    """What the measurements say of a landmark beyond what the filter has taken of them."""

    offset: Float[Array, "*L 7"]
    """o, by how much the estimate with all of them differs from the filter's, in its slot's error coordinates."""
    cov: Float[Array, "*L 7 7"]
    """D, by how much its covariance is smaller."""


class White(NamedTuple):
    """Innovations of a filter that corrects with everything, of K candidates; 0 with covariance I where not found."""

    z: Float[Array, "K 2"]
    """z', px."""
    S: Float[Array, "K 2 2"]
    """S', px²."""
    gain: Float[Array, "K 7 2"]
    """K', the landmark's rows; 0 where not found."""


def nothing_left_out() -> LeftOut:
    """Of one slot at its landmark's birth."""
    return LeftOut(jnp.zeros(SLOT), jnp.zeros((SLOT, SLOT)))


def whiten_innovations(state: LeftOut, evidence: Evidence) -> tuple[LeftOut, White]:
    """This frame's white innovations, and what is left out after it."""
    z, S, H, PH, g = evidence.found(
        evidence.innovation, evidence.innovation_cov, evidence.H, evidence.PH, evidence.weight
    )
    offset, cov = state.offset[evidence.slot], state.cov[evidence.slot]
    HD = H @ cov
    is_sound = _is_positive(S - HD @ H.mT - 0.5 * evidence.pixel_cov)
    offset, cov, HD = (jnp.where(is_sound.reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0) for x in (offset, cov, HD))
    white_z, white_S = z - _times(H, offset), S - HD @ H.mT
    white_K, K = (PH - HD.mT) @ _inverse(white_S), PH @ _inverse(S)
    offset = offset + _times(white_K, white_z) - g[:, None] * _times(K, z)
    taken = (2.0 * g - g**2)[:, None, None] * K @ S @ K.mT
    cov = cov + white_K @ white_S @ white_K.mT - taken
    state = LeftOut(set_at_slots(evidence, state.offset, offset), set_at_slots(evidence, state.cov, cov))
    return state, White(white_z, white_S, white_K)


def _is_positive(M: Float[Array, "K 2 2"]) -> Array:
    """Which symmetric matrices are positive definite."""
    return (M[:, 0, 0] > 0) & (M[:, 0, 0] * M[:, 1, 1] > M[:, 0, 1] * M[:, 1, 0])


def _inverse(S: Float[Array, "K 2 2"]) -> Float[Array, "K 2 2"]:
    W = jax.vmap(whitener)(S)
    return W.mT @ W


def _times(M: Float[Array, "K n m"], v: Float[Array, "K m"]) -> Float[Array, "K n"]:
    return jnp.sum(M * v[:, None], axis=-1)
