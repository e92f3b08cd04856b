"""The two contracts have room: a new gate and a new detector, each one small class, combine freely with the others."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gates.evidence import born, evidence
from gates.linear_blocks import MODEL, linear_candidates

from vcjax.fields import number
from vcjax.filter.config import FilterConfig
from vcjax.gates.gate import AbstractDetector, AbstractGate, Prior, Verdict
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.one_point_ransac import OnePointRansac
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


class Largest(AbstractDetector):
    """A detector with memory: the largest RE₁ that a landmark ever had."""

    limit: float = eqx.field(converter=number, default=20.0)

    def born(self):
        return jnp.zeros(())

    def observe(self, state, evidence):
        state = state.at[evidence.slot].max(jnp.where(evidence.is_found, evidence.re1, 0.0))
        return state, state - self.limit


def test_new_gate_judges():
    candidates = linear_candidates(0, is_isolated=np.arange(8) < 6)
    x, H = map(np.asarray, candidates.mean)
    distance = np.linalg.norm(np.asarray(candidates.uv_px) - np.einsum("kin,kn->ki", H, x), axis=1)
    gate = PixelDistance(max_px=np.median(distance[:6]))
    verdict = jax.jit(lambda gate, c: gate.judge(c, MODEL))(gate, candidates)
    np.testing.assert_array_equal(verdict.is_dynamic, (distance > gate.max_px) & candidates.is_isolated)
    np.testing.assert_array_equal(verdict.is_recovered, (distance <= gate.max_px) & candidates.is_isolated)


def test_new_detector_remembers_each_slot():
    detector, is_measured = Largest(), np.array([True, True, False])
    state, margins = born(detector, 4), []
    for re1 in ([9.0, 2.0, np.nan], [25.0, 1.0, np.nan], [3.0, 1.0, np.nan]):  # slot 3 is not found
        frame = evidence([2, 0, 3], 4, is_measured=is_measured, re1=np.array(re1))
        state, margin = jax.jit(Largest.observe)(detector, state, frame)
        margins.append(margin)
    np.testing.assert_array_equal(state, [2, 0, 25, 0])
    np.testing.assert_array_equal(np.argwhere(np.array(margins) > 0), [[1, 2], [2, 2]])


GATES = [ReprojectionError(), VirtualCorrection(), OnePointRansac(), PixelDistance()]
DETECTORS = [InlierRatio(), Largest()]


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
