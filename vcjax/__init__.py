"""vcjax: which image features belong to moving things, and how should a camera move to find out?

A differentiable, batched EKF visual-SLAM library in JAX around the virtual correction (VC) gate. Importing it computes
nothing, starts no device and leaves JAX's configuration alone; for the paper's numbers switch float64 on first:
`jax.config.update("jax_enable_x64", True)`.
"""

import typing

from vcjax.filter.config import FilterConfig as FilterConfig
from vcjax.filter.follower import Following as Following
from vcjax.filter.info import FrameInfo as FrameInfo
from vcjax.filter.known_landmarks import KnownLandmarks as KnownLandmarks
from vcjax.filter.motion_model import BiasedOdometry as BiasedOdometry
from vcjax.filter.motion_model import ConstantVelocity as ConstantVelocity
from vcjax.filter.motion_model import Odometry as Odometry
from vcjax.filter.run import run as run
from vcjax.filter.slam import start as start
from vcjax.filter.slam import step as step
from vcjax.filter.state import FilterState as FilterState
from vcjax.filter.stretches import run_in_stretches as run_in_stretches
from vcjax.gates.cusum import Cusum as Cusum
from vcjax.gates.either import Either as Either
from vcjax.gates.immediate import Immediate as Immediate
from vcjax.gates.inlier_ratio import InlierRatio as InlierRatio
from vcjax.gates.one_point_ransac import OnePointRansac as OnePointRansac
from vcjax.gates.reprojection import ReprojectionError as ReprojectionError
from vcjax.gates.velocity_glr import VelocityGLR as VelocityGLR
from vcjax.gates.velocity_likelihood_ratio import VelocityLikelihoodRatio as VelocityLikelihoodRatio
from vcjax.gates.virtual_correction import VirtualCorrection as VirtualCorrection
from vcjax.gates.windowed_nis import WindowedNIS as WindowedNIS
from vcjax.models.camera import Camera as Camera
from vcjax.models.motion import Oscillation as Oscillation
from vcjax.recording import Recording as Recording
from vcjax.recording import Truth as Truth
from vcjax.simulation import scenarios as scenarios
from vcjax.simulation.scenarios import Scenario as Scenario
from vcjax.simulation.simulate import simulate as simulate
from vcjax.study.monte_carlo import monte_carlo as monte_carlo

if typing.TYPE_CHECKING:
    from vcjax.study.summary import summarise as summarise


def __getattr__(name: str) -> typing.Any:
    """`summarise`, imported when it is first asked for: it needs the extra `study`, which importing must not."""
    if name != "summarise":
        raise AttributeError(f"module 'vcjax' has no attribute {name!r}")
    try:
        from vcjax.study.summary import summarise as summarise
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"vcjax.summarise needs {error.name}: pip install 'vcjax[study]'.") from error
    return summarise
