"""FrameInfo: what a person wants to see of a frame, and the next frame does not need."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from vcjax.filter.follower import Followers
from vcjax.filter.landmark_points import LandmarkPoints


class FrameInfo(eqx.Module):
    """What a person wants to see of a frame. K candidates, L slots."""

    vehicle: Float[Array, "14"]
    """Robot and sensor pose at the end of the frame."""
    vehicle_cov: Float[Array, "14 14"]
    """Their covariance."""
    carried: Float[Array, "*T c"]
    """What the motion model carries (see `motion_model`), e.g. a twist: nothing with plain odometry."""
    carried_std: Float[Array, "*T c"]
    """Standard deviation of each."""
    candidate_id: Int[Array, " K"]
    """Feature of each candidate for update, most uncertain first; -1 where there was none."""
    is_measured: Bool[Array, " K"]
    """Found in the image."""
    pixel: Float[Array, "K 2"]
    """Predicted pixel ê at the state it was tested at, px. Meaningless, like all below, where not measured."""
    innovation: Float[Array, "K 2"]
    """z = y - ê, px. Equation (8)."""
    innovation_cov: Float[Array, "K 2 2"]
    """Z = H P Hᵀ + R, px². Equation (9)."""
    re1: Float[Array, " K"]
    """RE₁ as gated. Equation (13)."""
    re1_prior: Float[Array, " K"]
    """RE₁ at the gate's prior, of the isolated (with smoothing of all measured); NaN elsewhere."""
    re2: Float[Array, " K"]
    """RE₂ of the same. Equation (14)."""
    is_accepted: Bool[Array, " K"]
    """Corrected with directly."""
    is_recovered: Bool[Array, " K"]
    """Isolated, then corrected with."""
    is_dynamic: Bool[Array, " K"]
    """Isolated, called dynamic by the gate and deleted."""
    is_suspect: Bool[Array, " K"]
    """Measured, and neither corrected with nor judged by the gate, since the detector suspects it."""
    dynamic_margin: Float[Array, " K"]
    """By how much a measured candidate passes what keeps it from being called dynamic, in χ² units: RE₁ - Th₁, and of
    the isolated the gate's verdict as well, whichever is less. Above 0 where dynamic, or, by a gate without verdicts,
    left out; NaN where not measured or suspect."""
    p_dynamic: Float[Array, " K"]
    """To what degree a measured candidate is called dynamic, in [0, 1]: 1 where it is, else 0; soft, neither accepted
    nor recovered, by a gate that calls any dynamic."""
    watched_id: Int[Array, " L"]
    """Feature held by each slot when the detector looked; -1 where free, or just called dynamic by the gate."""
    detector: PyTree
    """The detector's state of every slot then (leading axis L), before any landmark was deleted or born."""
    detector_margin: Float[Array, " L"]
    """The detector's margin, χ² units: deleted where above 0; NaN where it has nothing to say."""
    p_detector: Float[Array, " L"]
    """To what degree the detector calls it dynamic, in [0, 1]: 1 where it does, else 0; soft in a soft filter."""
    inconsistent_id: Int[Array, " L"]
    """Features deleted by the detector; -1 elsewhere."""
    born_id: Int[Array, " births"]
    """Features initialised; -1 for an attempt without a birth."""
    departed: LandmarkPoints
    """Landmarks that left the map in this frame, as they were after its corrections: deleted by gate or detector (see
    `is_dynamic`, `inconsistent_id`), or else retired, their feature never being seen again. With them and
    `landmark_points` of the last state the map is whole."""
    followers: Followers | None
    """Features followed outside the map at the end of the frame, with velocity, its covariance, and for how long each
    has stood still; None where none are to be (`FilterConfig.following`)."""
    handed_back_id: Int[Array, "*T F"] | None
    """Features that came off the blacklist in this frame, having stood still; -1 elsewhere."""
    track_id: Int[Array, " L"]
    """Feature held by each slot at the end of the frame; -1 where free."""
    num_coordinates: Int[Array, ""]
    """N, the length of the state at the end of the frame: vehicle, and 7 (AHP) or 3 (Euclidean) for each landmark."""
    map_is_full: Bool[Array, ""]
    """Whether a feature waits for a free slot."""
    num_waiting: Int[Array, ""]
    """How many: measured features that could be born but for that."""
    is_finite: Bool[Array, ""]
    """Whether the vehicle's mean and covariance are finite numbers."""

    @property
    def is_blind(self) -> Bool[Array, "*T"]:
        """Whether no pixel corrected the state: it follows its motion alone, and its covariance grows."""
        return ~jnp.any(self.is_accepted | self.is_recovered, axis=-1)
