"""The two contracts have room: a new gate and a new detector, each one small class, combine freely with the others."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gates.linear_blocks import MODEL, linear_candidates

from vcjax.fields import number
from vcjax.filter.config import FilterConfig
from vcjax.gates.gate import AbstractDetector, AbstractGate, Evidence, Prior, Verdict
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.reprojection import ReprojectionError
from vcjax.gates.virtual_correction import VirtualCorrection


class PixelDistance(AbstractGate):
    """A gate blind to covariances: dynamic is what lies further off than so many pixels."""

    max_px: float = eqx.field(converter=number, default=5.0)
    prior: Prior = eqx.field(static=True, default="predicted")

    def margin(self, re1):
        return 9.0 - re1

    def judge(self, candidates, model):
        e_hat, _ = jax.vmap(model.observe)(candidates.mean)
        squared = jnp.sum((candidates.uv_px - e_hat) ** 2, axis=1)
        margin, nothing = (
            jnp.where(candidates.is_isolated, squared - self.max_px**2, jnp.nan),
            jnp.full(squared.shape, jnp.nan),
        )
        return Verdict(margin, nothing, nothing)


class Cusum(AbstractDetector):
    """A detector with memory: the cumulative sum of RE₁ above what a static landmark shows on average."""

    drift: float = eqx.field(converter=number, default=4.0)
    limit: float = eqx.field(converter=number, default=20.0)

    def born(self):
        return jnp.zeros(())

    def observe(self, state, evidence):
        is_used = evidence.is_searched & evidence.is_measured
        total = jnp.maximum(state[evidence.slot] + evidence.re1 - self.drift, 0.0)
        state = state.at[evidence.slot].set(jnp.where(is_used, total, state[evidence.slot]))
        return state, evidence.is_visible & (state > self.limit)


def test_new_gate_judges():
    candidates = linear_candidates(0, is_isolated=np.arange(8) < 6)
    x, H = map(np.asarray, candidates.mean)
    distance = np.linalg.norm(np.asarray(candidates.uv_px) - np.einsum("kin,kn->ki", H, x), axis=1)
    gate = PixelDistance(max_px=np.median(distance[:6]))
    verdict = jax.jit(lambda gate, c: gate.judge(c, MODEL))(gate, candidates)
    np.testing.assert_array_equal(verdict.is_dynamic, (distance > gate.max_px) & candidates.is_isolated)
    np.testing.assert_array_equal(verdict.is_recovered, (distance <= gate.max_px) & candidates.is_isolated)


def test_new_detector_remembers_each_slot():
    detector = Cusum()
    evidence = Evidence(
        slot=jnp.array([2, 0, 3]),
        is_searched=jnp.array([True, True, True]),
        is_measured=jnp.array([True, True, False]),
        is_corrected=jnp.array([True, True, False]),
        re1=jnp.array([9.0, 2.0, np.nan]),  # slot 2 fits badly, slot 0 well, slot 3 is not found
        is_visible=jnp.ones(4, bool),
    )
    state, flags = jnp.zeros(4), []
    for _ in range(6):
        state, is_flagged = jax.jit(Cusum.observe)(detector, state, evidence)
        flags.append(is_flagged)
    np.testing.assert_array_equal(state, [0, 0, 30, 0])
    np.testing.assert_array_equal(np.argwhere(flags), [[4, 2], [5, 2]])  # 25 and 30 exceed 20


GATES = [ReprojectionError(), VirtualCorrection(), PixelDistance()]
DETECTORS = [InlierRatio(), Cusum()]


@pytest.mark.parametrize(("gate", "detector"), list(itertools.product(GATES, DETECTORS)))
def test_every_gate_goes_with_every_detector(gate, detector):
    config = FilterConfig(gate=gate, detector=detector)
    assert (config.gate, config.detector) == (gate, detector)


def test_an_unfinished_class_cannot_be_built():
    class NoJudge(AbstractGate):
        prior: Prior = "corrected"

        def margin(self, re1):
            return 9.0 - re1

    class NoMemory(AbstractDetector):
        def observe(self, state, evidence):
            return state, evidence.is_visible

    with pytest.raises(TypeError, match="judge"):
        NoJudge()
    with pytest.raises(TypeError, match="born"):
        NoMemory()
