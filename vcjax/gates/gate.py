"""The two contracts of feature rejection: an update gate and a detector.

A **gate** says within one frame which measurements correct the state: it accepts a candidate by its RE₁, and passes a
verdict on those it did not accept, each with its own 21-block of robot, sensor and landmark. A **detector** watches
landmark slots over many frames, keeps a state for each, and flags the ones to delete. Both say so by margins, how far a
number lies from its threshold, which `gates.surrogates` turns into decisions, hard or soft. The two combine freely, and
so do detectors (see `either`).

A new gate or detector is one new file with one small class. All methods are pure, masked and batched; what is not a
candidate must neither change a result nor a gradient.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

SLOT = 7
"""Error coordinates of a landmark slot."""
Prior = Literal["corrected", "predicted"]
PRIORS = ("corrected", "predicted")


class MeasurementModel(NamedTuple):
    """How a landmark's block is measured and moved."""

    observe: Callable[[PyTree], tuple[Float[Array, "2"], Float[Array, "2 n"]]]
    """Block mean to predicted pixel ê and its derivative H by the block's errors. Equation (8)."""
    retract: Callable[[PyTree, Float[Array, " n"]], PyTree]
    """Block mean moved by a correction K z. Equation (11)."""


class Candidates(eqx.Module):
    """The frame's K candidates, each with the block of the state it touches (robot, sensor, its landmark: n = 21)."""

    mean: PyTree
    """Block means, leading axis K; understood by the measurement model."""
    P: Float[Array, "K n n"]
    """Block covariances."""
    uv_px: Float[Array, "K 2"]
    """Measured pixels y."""
    R: Float[Array, "2 2"]
    """Pixel noise covariance W, px²."""
    is_isolated: Bool[Array, " K"]
    """Measured but not accepted: the candidates to judge. The others' numbers mean nothing. With smoothing all that are
    measured are isolated to a degree, and are judged."""


def harmless(candidates: Candidates) -> Candidates:
    """The candidates, with those that are not to be judged replaced by numbers without effect: mean 1, P 0, pixel 0.

    A masked candidate may hold anything, NaN included. Replaced before anything is computed, it leaves the derivatives
    by what all candidates share finite. The mean is of ones because zeros are neither a quaternion nor a depth.
    """

    def replace(leaf, number):
        is_isolated = candidates.is_isolated.reshape(-1, *(1,) * (leaf.ndim - 1))
        return jnp.where(is_isolated, leaf, jnp.asarray(number, leaf.dtype))

    return eqx.tree_at(
        lambda c: (c.mean, c.P, c.uv_px),
        candidates,
        (
            jax.tree.map(lambda leaf: replace(leaf, 1), candidates.mean),
            replace(candidates.P, 0),
            replace(candidates.uv_px, 0),
        ),
    )


class Verdict(eqx.Module):
    """What a gate says of the isolated candidates."""

    margin: Float[Array, " K"]
    """By how much a candidate is dynamic, in χ² units: recovered where at most 0, dynamic where above; NaN, neither,
    where not judged or where nothing can be said."""
    re1: Float[Array, " K"]
    """RE₁ at the gate's prior (13); NaN where not judged."""
    re2: Float[Array, " K"]
    """RE₂ after the virtual correction (14); NaN where not judged."""

    @property
    def is_recovered(self) -> Bool[Array, " K"]:
        """To be corrected with after all."""
        return self.margin <= 0

    @property
    def is_dynamic(self) -> Bool[Array, " K"]:
        """Moving: its landmark is deleted at once."""
        return self.margin > 0


class AbstractGate(eqx.Module):
    """Update gate: accept, recover or call dynamic."""

    prior: eqx.AbstractVar[Prior]
    """Where isolated candidates are judged: "corrected", after all formal corrections of the frame, with RE₁ < Th₁
    tested at the running state; or "predicted", with both at the state after prediction, as equation (13) is
    printed."""
    condemns: ClassVar[bool] = True
    """Whether what it judges and does not recover is dynamic, its landmark deleted at once; or only left out."""

    @abstractmethod
    def margin(self, re1: Float[Array, "..."]) -> Float[Array, "..."]:
        """By how much a measurement with this squared Mahalanobis distance is accepted, in χ² units: where above 0."""

    def accepts(self, re1: Float[Array, "..."]) -> Bool[Array, "..."]:
        """Whether a measurement with this squared Mahalanobis distance corrects the state directly."""
        return self.margin(re1) > 0

    @abstractmethod
    def judge(self, candidates: Candidates, model: MeasurementModel) -> Verdict:
        """The verdict on each isolated candidate; NaN elsewhere.

        Not called in frames where nobody is isolated. A candidate of which nothing can be said, its errors being NaN,
        is neither recovered nor dynamic. Margins have exact derivatives; what they decide is smoothed, or not, by
        `gates.surrogates`.
        """


class Joint(NamedTuple):
    """The innovations of a frame's K candidates at the predicted state, and their joint covariance."""

    z: Float[Array, "K 2"]
    """y - ê, px (8); 0 where not measured."""
    S: Float[Array, "K K 2 2"]
    """S_ij = H_i P H_jᵀ, and R where i = j (9), px². What is not measured has R, and depends on nothing."""
    R: Float[Array, "2 2"]
    """Pixel noise covariance, px²."""
    is_measured: Bool[Array, " K"]
    """Which candidates were found in the image."""


class AbstractJointGate(AbstractGate):
    """Update gate that accepts by all innovations of a frame together, at the predicted state.

    Its `margin` says of one measurement alone whether it may be accepted at all.
    """

    @abstractmethod
    def margins(self, joint: Joint) -> Float[Array, " K"]:
        """By how much each candidate is accepted, in χ² units: where above 0. Anything where not measured."""


class Evidence(eqx.Module):
    """What a frame showed of the landmarks: K candidates, L slots."""

    slot: Int[Array, " K"]
    """Slot of each candidate; no slot comes twice."""
    is_searched: Bool[Array, " K"]
    """Chosen for update in this frame. The rest is false or meaningless where this is false."""
    is_measured: Bool[Array, " K"]
    """Found in the image. The numbers below are meaningless where this is false, but for the weight, zero."""
    is_corrected: Bool[Array, " K"]
    """Used in a formal correction, accepted or recovered."""
    is_suspect: Bool[Array, " K"]
    """Suspected by a detector: found or not, it is neither corrected with nor judged by the gate."""
    weight: Float[Array, " K"]
    """To what degree it was used, in [0, 1]: 0 or 1 unless the filter is soft (see `surrogates`)."""
    innovation: Float[Array, "K 2"]
    """z as gated, px. Equation (8)."""
    innovation_cov: Float[Array, "K 2 2"]
    """S, its covariance, px². Equation (9)."""
    H: Float[Array, "K 2 7"]
    """Derivative of the pixel by the landmark's part of the state, in its slot's error coordinates."""
    PH: Float[Array, "K 7 2"]
    """The landmark's own rows of P Hᵀ as gated, whether it was used or not: times S⁻¹ its own rows of the gain."""
    pixel_cov: Float[Array, "2 2"]
    """R, of the noise of a pixel, px²."""
    re1: Float[Array, " K"]
    """RE₁ as gated (13)."""
    dynamic_margin: Float[Array, " K"]
    """By how much it passes what keeps the gate from calling it dynamic or leaving it out, χ² units; NaN where
    suspect."""
    is_visible: Bool[Array, " L"]
    """Mapped and inside the image by its last projection."""
    time_step_s: Float[Array, ""]
    """Time since the frame before, s."""

    @property
    def is_found(self) -> Bool[Array, " K"]:
        """Searched and found: the candidates with an innovation."""
        return self.is_searched & self.is_measured

    def found(self, *values: Array) -> tuple[Array, ...]:
        """Some of the arrays above (K, …), with 0 for candidates that were not found, I for their covariance.

        What means nothing, NaN included, then has no effect on what is computed, and leaves derivatives finite.
        """
        instead = (jnp.eye(2, dtype=v.dtype) if v is self.innovation_cov else jnp.zeros((), v.dtype) for v in values)
        return tuple(jnp.where(_like(self.is_found, v), v, i) for v, i in zip(values, instead, strict=True))


def add_at_slots(evidence: Evidence, total: Array, values: Array) -> Array:
    """A per-slot array (L, …) with values (K, …) of the candidates that were found added at their slots."""
    return total.at[evidence.slot].add(jnp.where(_like(evidence.is_found, values), values, 0).astype(total.dtype))


def set_at_slots(evidence: Evidence, before: Array, values: Array) -> Array:
    """A per-slot array (L, …) with values (K, …) of the candidates that were found in place of what was there."""
    values = jnp.where(_like(evidence.is_found, values), values, before[evidence.slot])
    return before.at[evidence.slot].set(values)


def _like(mask: Bool[Array, " K"], values: Array) -> Array:
    """A mask with as many axes as what it masks."""
    return mask.reshape(-1, *(1,) * (values.ndim - 1))


class AbstractDetector(eqx.Module):
    """Detector with a state for each landmark slot.

    The state begins anew at every birth; of a free slot it is that of a birth. A slot keeps the seven AHP error
    coordinates it was born with for life (see `filter.state`), and `Evidence` speaks of a landmark in these: at a
    reparametrisation nothing changes for a detector, and no state needs to be transformed.
    """

    @abstractmethod
    def born(self) -> PyTree:
        """State of one slot at its landmark's birth. Slots are reset to it; its structure is that of all states."""

    @abstractmethod
    def observe(self, state: PyTree, evidence: Evidence) -> tuple[PyTree, Float[Array, " L"]]:
        """New state (leading axis L) and each slot's margin: its landmark is deleted where above 0.

        A margin says by how much, in χ² units, what was seen exceeds what a static landmark may show; NaN where nothing
        can be said. What it decides is smoothed, or not, by `surrogates`.
        """

    def suspicion(self, state: PyTree) -> Float[Array, "*L"] | None:
        """By how much each slot's landmark is suspect, χ² units; None: nobody ever is.

        Where above 0 it is measured and watched, and corrects nothing, until it is flagged or found harmless: a hard
        decision in all filters, soft ones too.
        """
        return None

    def velocity(self, state: PyTree) -> tuple[Float[Array, "*L 3"], Float[Array, "*L 3 3"]] | None:
        """Estimated velocity of each slot's landmark, m/s, and its covariance, m²/s²; None: it estimates none."""
        return None
