"""What a frame's corrections tell a detector of its candidates (see `gates.gate.Evidence`)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.filter.frame_corrections import Outcome
from vcjax.filter.map_covariance import SLOT
from vcjax.filter.submap import Submap
from vcjax.gates.gate import Evidence


def evidence_of(
    submap: Submap,
    outcome: Outcome,
    slot: Int[Array, " K"],
    is_searched: Bool[Array, " K"],
    is_measured: Bool[Array, " K"],
    is_visible: Bool[Array, " L"],
    time_step_s: Float[Array, ""],
) -> Evidence:
    """The frame's evidence. What a detector does not read of it is never computed.

    Args:
        submap: after the frame's corrections.
        outcome: what became of the candidates.
        slot: of each candidate.
        is_searched: which candidates there are.
        is_measured: which of them were found in the image.
        is_visible: which slots' landmarks lie inside the image and stay in the map.
        time_step_s: since the frame before.
    """
    innovation = outcome.innovation
    return Evidence(
        slot=slot,
        is_searched=is_searched,
        is_measured=is_measured,
        is_corrected=outcome.is_accepted | outcome.is_recovered,
        weight=outcome.weight,
        innovation=innovation.z,
        innovation_cov=innovation.S,
        H=innovation.H_l,
        gain=landmark_gains(submap, len(slot)),
        re1=innovation.re1,
        dynamic_margin=outcome.dynamic_margin,
        is_visible=is_visible,
        time_step_s=time_step_s,
    )


def landmark_gains(submap: Submap, num_candidates: int) -> Float[Array, "K 7 2"]:
    """The own rows of each chosen slot in the gain of its own innovation, over all corrections of the frame.

    In all, the corrections move the state by Uᵀ G T z with z the innovations at the frame's prediction and G the
    corrections' weights (see `submap`): of that the landmark's rows and its innovation's columns. Exact in the hard
    filter; in a soft one, which corrects with each candidate twice, between the two up to g - g² of either.
    """
    T = submap.T if submap.g is None else submap.g[:, None] * submap.T
    T = jnp.sum(T.reshape(len(T), -1, num_candidates, 2), axis=1)
    own = submap.U[:, -SLOT * num_candidates :].reshape(len(T), num_candidates, SLOT)
    return jnp.einsum("ckl,cka->kla", own, T)
