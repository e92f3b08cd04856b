"""The frame's corrections in order: with the accepted candidates, the verdict on the others, with the recovered.

What a gate decides becomes the weight g of a correction (see `gates.surrogates`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vcjax.filter.config import FilterConfig
from vcjax.filter.correction import (
    Innovation,
    correct_stacked,
    correct_with,
    innovate,
    innovate_jointly,
    pixel_cov,
)
from vcjax.filter.features import measurement_model
from vcjax.filter.submap import Submap, block, block_cov
from vcjax.gates.gate import AbstractJointGate, Candidates, Verdict
from vcjax.gates.surrogates import decide, straight_through
from vcjax.models.camera import Camera


class Outcome(NamedTuple):
    """What became of the frame's K candidates."""

    innovation: Innovation
    verdict: Verdict
    is_accepted: Bool[Array, " K"]
    is_recovered: Bool[Array, " K"]
    is_dynamic: Bool[Array, " K"]
    is_suspect: Bool[Array, " K"]
    """Measured, and by the detector's word neither corrected with nor judged."""
    dynamic_margin: Float[Array, " K"]
    """By how much a candidate passes what keeps it from being called dynamic, χ²; NaN where not measured or suspect."""
    p_dynamic: Float[Array, " K"]
    """To what degree a candidate is called dynamic; soft, neither accepted nor recovered, if the gate calls any so."""
    weight: Float[Array, " K"]
    """To what degree a candidate was used."""


def correct_frame(
    config: FilterConfig,
    camera: Camera,
    submap: Submap,
    uv_px: Float[Array, "K 2"],
    is_measured: Bool[Array, " K"],
    is_suspect: Bool[Array, " K"] | None = None,
) -> tuple[Submap, Outcome]:
    """Correct with the accepted candidates, judge the isolated ones, correct with the recovered. Paper section 3.

    Args:
        config: gate, order of correction, noises, smoothing.
        camera: calibration.
        submap: vehicle and candidates after prediction.
        uv_px: measured pixels, anything where not measured.
        is_measured: which candidates have a measurement; the others change nothing.
        is_suspect: which have an innovation, but are neither corrected with nor judged (see
            `AbstractDetector.suspicion`); None: nobody.

    Returns: the corrected submap, and the candidates' innovations and verdicts.
    """
    predicted, gate = submap, config.gate
    # An unmeasured candidate's pixel may be anything, NaN included; zero keeps derivatives finite.
    uv_px = jnp.where(is_measured[:, None], uv_px, 0.0)
    is_suspect = jnp.zeros_like(is_measured) if is_suspect is None else is_measured & is_suspect
    is_usable = is_measured & ~is_suspect
    everyone = jnp.arange(is_measured.shape[0])
    innovation = margin = None
    if isinstance(gate, AbstractJointGate):
        innovation, joint = innovate_jointly(config, camera, predicted, uv_px, is_usable)
        margin = gate.margins(joint)
    elif gate.prior == "predicted" or config.update == "stacked":
        at_prediction = jax.vmap(lambda j, y: innovate(config, camera, predicted, j, y)[0])
        innovation = at_prediction(everyone, uv_px)
        margin = gate.margin(innovation.re1)
    if innovation is None or margin is None:
        submap, innovation, margin = _correct_accepted(config, camera, submap, uv_px, is_usable)
    elif config.update == "stacked":
        submap = correct_stacked(config, camera, submap, uv_px, is_usable & (margin > 0))
    else:
        submap, _, _ = _correct_accepted(config, camera, submap, uv_px, is_usable, margin)
    is_accepted = is_usable & (margin > 0)
    is_isolated = is_usable & ~is_accepted
    is_judged = is_isolated if config.smoothing == "hard" else is_usable

    def judge(submap: Submap) -> tuple[Submap, Verdict]:
        prior = predicted if gate.prior == "predicted" else submap
        candidates = Candidates(
            mean=jax.vmap(block, in_axes=(None, 0))(prior, everyone),
            P=jax.vmap(block_cov, in_axes=(None, None, 0))(config, prior, everyone),
            uv_px=uv_px,
            R=pixel_cov(config, uv_px.dtype),
            is_isolated=is_judged,
        )
        verdict = gate.judge(candidates, measurement_model(config, camera))
        return _correct_recovered(config, camera, submap, uv_px, is_isolated, margin, verdict), verdict

    def judge_nobody(submap: Submap) -> tuple[Submap, Verdict]:
        nothing = jnp.full(is_usable.shape, jnp.nan, uv_px.dtype)
        return submap, Verdict(nothing, nothing, nothing)

    # In most frames nobody is isolated.
    submap, verdict = jax.lax.cond(jnp.any(is_judged), judge, judge_nobody, submap)
    is_recovered = is_isolated & verdict.is_recovered
    is_dynamic = is_isolated & verdict.is_dynamic if gate.condemns else jnp.zeros_like(is_isolated)
    submap = eqx.tree_at(lambda s: s.is_corrected, submap, is_accepted | is_recovered)
    # A gate without verdicts has none to add to the margin by which it leaves out.
    dynamic_margin = jnp.where(is_isolated, jnp.fmin(-margin, verdict.margin), -margin)
    dynamic_margin = jnp.where(is_usable, dynamic_margin, jnp.nan)
    weight = (is_accepted | is_recovered).astype(uv_px.dtype)
    p_dynamic = is_dynamic.astype(uv_px.dtype)
    if config.smoothing != "hard":
        soft_weight = jnp.where(is_usable, _soft_weight(config, margin, verdict), 0.0)
        # What a gate leaves out without a verdict, it does not call dynamic.
        may_be_dynamic = is_usable & ~jnp.isnan(verdict.margin) & gate.condemns
        soft_p = jnp.where(may_be_dynamic, 1.0 - soft_weight, 0.0)
        is_soft = config.smoothing == "soft"
        weight = soft_weight if is_soft else straight_through(weight, soft_weight)
        p_dynamic = soft_p if is_soft else straight_through(p_dynamic, soft_p)
    return submap, Outcome(
        innovation, verdict, is_accepted, is_recovered, is_dynamic, is_suspect, dynamic_margin, p_dynamic, weight
    )


def _soft_weight(
    config: FilterConfig, margin: Float[Array, "*b"], verdict: Verdict | None = None
) -> Float[Array, "*b"]:
    """To what degree a candidate corrects the state: a, accepted; with a verdict, a + (1 - a) r, recovered if not."""
    accepted = decide("soft", margin, config.temperature)
    if verdict is None:
        return accepted
    return accepted + (1.0 - accepted) * decide("soft", -verdict.margin, config.temperature)


def _correct_accepted(
    config: FilterConfig,
    camera: Camera,
    submap: Submap,
    uv_px: Float[Array, "K 2"],
    is_measured: Bool[Array, " K"],
    margin: Float[Array, " K"] | None = None,
) -> tuple[Submap, Innovation, Float[Array, " K"]]:
    """Correct with one candidate after another, each re-linearised at the state left by the one before.

    Margins of acceptance that are not given are taken at that state too. Returns submap, innovations and margins.
    """

    def correct_next(submap: Submap, candidate):
        j, y, is_measured, margin = candidate
        innovation, gain = innovate(config, camera, submap, j, y)
        margin = config.gate.margin(innovation.re1) if margin is None else margin
        weight = decide(config.smoothing, margin, config.temperature)
        is_accepted = is_measured & (margin > 0)
        is_used = is_measured if config.smoothing == "soft" else is_accepted
        submap = correct_with(submap, j, j, innovation, gain, jnp.where(is_used, weight, 0.0), is_used, is_accepted)
        return submap, (innovation, margin)

    candidates = (jnp.arange(is_measured.shape[0]), uv_px, is_measured, margin)
    submap, (innovation, margin) = jax.lax.scan(correct_next, submap, candidates)
    return submap, innovation, margin


def _correct_recovered(
    config: FilterConfig,
    camera: Camera,
    submap: Submap,
    uv_px: Float[Array, "K 2"],
    is_isolated: Bool[Array, " K"],
    margin: Float[Array, " K"],
    verdict: Verdict,
) -> Submap:
    """Correct with the recovered candidates in sequence, without gating them again.

    They are few: the loop ends with the last of them. A loop of unknown length has no reverse mode, so in
    `reverse_mode` all K candidates are passed through, those not recovered without effect. A soft filter corrects once
    more with every candidate it has judged, as far as it is recovered and was not accepted.
    """
    num_candidates, first = uv_px.shape[0], 0
    weight, is_judged = verdict.is_recovered.astype(uv_px.dtype), ~jnp.isnan(verdict.margin)
    if config.smoothing == "soft":
        is_used, first = is_judged, num_candidates
        weight = _soft_weight(config, margin, verdict) - _soft_weight(config, margin)
    elif config.smoothing == "straight_through":
        # A weight of zero has a derivative: the dynamic ones are passed through as well.
        is_used, weight = is_isolated & is_judged, straight_through(weight, _soft_weight(config, margin, verdict))
    else:
        is_used = is_isolated & verdict.is_recovered
    weight = jnp.where(is_used, weight, 0.0)

    def correct(submap: Submap, j, is_used):
        innovation, gain = innovate(config, camera, submap, j, uv_px[j])
        return correct_with(submap, j, first + j, innovation, gain, weight[j], is_used, is_used & is_isolated[j])

    if config.reverse_mode or config.smoothing == "soft":
        each = (jnp.arange(num_candidates), is_used)
        return jax.lax.scan(lambda submap, candidate: (correct(submap, *candidate), None), submap, each)[0]

    def correct_next(carry):
        submap, is_left = carry
        j = jnp.argmax(is_left)
        return correct(submap, j, is_left[j]), is_left.at[j].set(False)

    return jax.lax.while_loop(lambda carry: jnp.any(carry[1]), correct_next, (submap, is_used))[0]
