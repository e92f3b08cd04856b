"""What a frame's corrections tell a detector of its candidates (see `gates.gate.Evidence`)."""

from jaxtyping import Array, Bool, Float, Int

from vcjax.filter.frame_corrections import Outcome
from vcjax.gates.gate import Evidence


def evidence_of(
    outcome: Outcome,
    slot: Int[Array, " K"],
    is_searched: Bool[Array, " K"],
    is_measured: Bool[Array, " K"],
    is_suspect: Bool[Array, " K"],
    is_visible: Bool[Array, " L"],
    pixel_cov: Float[Array, "2 2"],
    time_step_s: Float[Array, ""],
) -> Evidence:
    """The frame's evidence. What a detector does not read of it is never computed.

    Args:
        outcome: what became of the candidates.
        slot: of each candidate.
        is_searched: which candidates there are.
        is_measured: which of them were found in the image.
        is_suspect: which of them the detector suspects, found or not.
        is_visible: which slots' landmarks lie inside the image and stay in the map.
        pixel_cov: R of a measured pixel, px².
        time_step_s: since the frame before.
    """
    innovation = outcome.innovation
    return Evidence(
        slot=slot,
        is_searched=is_searched,
        is_measured=is_measured,
        is_corrected=outcome.is_accepted | outcome.is_recovered,
        is_suspect=is_suspect,
        weight=outcome.weight,
        innovation=innovation.z,
        innovation_cov=innovation.S,
        H=innovation.H_l,
        PH=innovation.PH_l,
        pixel_cov=pixel_cov,
        re1=innovation.re1,
        dynamic_margin=outcome.dynamic_margin,
        is_visible=is_visible,
        time_step_s=time_step_s,
    )
