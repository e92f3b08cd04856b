"""The methods whose detections are compared: a filter with a gate and a detector each, and what makes it stricter."""

from collections.abc import Mapping
from typing import NamedTuple

from vcjax.filter.config import FilterConfig
from vcjax.gates.cusum import Cusum
from vcjax.gates.gate import AbstractDetector, AbstractGate
from vcjax.gates.immediate import Immediate
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.one_point_ransac import OnePointRansac
from vcjax.gates.reprojection import ReprojectionError
from vcjax.gates.velocity_glr import VelocityGLR
from vcjax.gates.velocity_likelihood_ratio import VelocityLikelihoodRatio
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.gates.windowed_nis import WindowedNIS
from vcjax.simulation.scenarios import Scenario
from vcjax.study.sweep import Experiment, number_at, replace_at


class Method(NamedTuple):
    """A filter, and the threshold along which its operating curve goes."""

    config: FilterConfig
    leaves: tuple[str, ...]
    """Paths of the numeric leaves of an `Experiment` that are its threshold, and share their value."""
    curve: tuple[float, ...]
    """Values of the threshold from which the curve is made, the one that flags most first. The method's own is one."""

    @property
    def threshold(self) -> float:
        """The method's own."""
        return number_at(self, self.leaves[0])

    def experiment(self, scenario: Scenario, threshold: float | None = None) -> Experiment:
        """A scenario with its filter, at another threshold if one is given. Nothing compiles again for that."""
        experiment = Experiment(scenario, self.config)
        return experiment if threshold is None else replace_at(experiment, dict.fromkeys(self.leaves, threshold))


def _with(gate: AbstractGate, detector: AbstractDetector) -> FilterConfig:
    """A filter in which what is flagged never comes back, and what was made too distant stays in view of the test.

    It corrects with up to 20 landmarks in a frame: with 10, those that are known well are hardly ever among them, and
    nothing more is learned of whether they move.
    """
    return FilterConfig(gate=gate, detector=detector, max_updates=20, blacklist_capacity=64, see_beyond_infinity=True)


_TH1, _BOTH = ("config.gate.th1",), ("config.gate.th1", "config.gate.th2")
_GATE_CURVE = (3.0, 6.0, 9.0, 14.0, 22.0, 36.0)
# χ²₃ is above 7.8 in one of twenty tests of a static landmark: cheap to leave out, and a mover does little harm below.
_GLR, _GLR_CURVE = VelocityGLR(threshold=24.0, suspect=7.8), (8.0, 11.0, 16.0, 24.0, 34.0, 50.0)
_GLR_LEAVES = ("config.detector.threshold",)
# A gate that leaves out less keeps tests of the innovations as they come closer to their χ² (see `left_out`).
_WIDE = ReprojectionError(th1=12.0)
METHODS: Mapping[str, Method] = {
    "VC": Method(FilterConfig(gate=VirtualCorrection()), _BOTH, _GATE_CURVE),
    "RE": Method(FilterConfig(gate=ReprojectionError()), _TH1, _GATE_CURVE),
    "one_point_ransac": Method(FilterConfig(gate=OnePointRansac()), _TH1, _GATE_CURVE),
    "VC+blacklist": Method(_with(VirtualCorrection(), InlierRatio()), _BOTH, _GATE_CURVE),
    "RE+blacklist": Method(_with(ReprojectionError(), InlierRatio()), _TH1, _GATE_CURVE),
    "one_point_ransac+blacklist": Method(_with(OnePointRansac(), InlierRatio()), _TH1, _GATE_CURVE),
    "RE+velocity_glr": Method(_with(ReprojectionError(), _GLR), _GLR_LEAVES, _GLR_CURVE),
    "VC+velocity_glr": Method(_with(VirtualCorrection(), _GLR), _GLR_LEAVES, _GLR_CURVE),
    "RE+velocity_likelihood_ratio": Method(
        _with(_WIDE, VelocityLikelihoodRatio()),
        ("config.detector.false_alarm_rate",),
        (0.5, 0.1, 0.01, 1e-3, 1e-5, 1e-8),
    ),
    "RE+windowed_nis": Method(
        _with(_WIDE, WindowedNIS()), ("config.detector.limit",), (34.0, 42.0, 52.4, 65.0, 85.0, 120.0)
    ),
    "RE+cusum": Method(_with(_WIDE, Cusum()), ("config.detector.limit",), (8.0, 13.0, 20.0, 30.0, 50.0, 80.0)),
    "RE+immediate": Method(_with(_WIDE, Immediate()), _TH1, (6.0, 9.0, 12.0, 18.0, 28.0, 45.0)),
}
"""What is compared, by name: one setting each for all scenes. VC and RE are the paper's, with the deletion rule of its
toolbox, and so is the field's 1-point RANSAC. With "+blacklist" they correct with more landmarks and flag for good, as
the others do, which have a detector of their own."""
