"""The scenes that one setting of gate and camera has to serve at once."""

import dataclasses

import numpy as np

from vcjax.fields import require_kind
from vcjax.simulation.scenarios import DynamicMotion, DynamicSet, RobotMotion, Scenario, paper


@dataclasses.dataclass(frozen=True)
class Scenes:
    """The paper's dynamic scenes: every motion of the dynamic features at every speed."""

    motions: tuple[DynamicMotion, ...] = ("lateral", "inverse_forward")
    """How the dynamic features move."""
    speeds_m_s: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Their speeds, m/s."""
    robot: RobotMotion = "forward"
    """How the robot moves."""
    dynamic_set: DynamicSet = "ahead"
    """Which features move: the six ahead of the robot, the six near its path, or a bus."""
    amplitude_m: float = 0.05
    """A of the oscillation, m (the paper: 0.05)."""
    frequency_hz: float = 3.0
    """f of the oscillation, Hz (the paper: 3)."""
    num_frames: int = 160
    """Frames in a run."""

    def make(self) -> dict[str, Scenario]:
        """The scenes by name, e.g. "inverse forward, 0.5 m/s".

        Raises:
            ValueError: if there is none, one comes twice, or for numbers out of range.
        """
        for name, values in (("motions", self.motions), ("speeds_m_s", self.speeds_m_s)):
            remedy = "give at least one, in a tuple, each once."
            require_kind("Scenes", name, values, (tuple, list), remedy)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"Scenes({name}={values!r}): {remedy}")
        scenes = {}
        for motion in self.motions:
            for speed in self.speeds_m_s:
                scenario = paper(
                    robot=self.robot,
                    dynamic=motion,
                    dynamic_speed_m_s=speed,
                    dynamic_set=self.dynamic_set,
                    oscillation_amplitude_m=self.amplitude_m,
                    oscillation_frequency_hz=self.frequency_hz,
                    num_frames=self.num_frames,
                )
                # With all digits that tell numbers apart, which names of scenes do.
                shown = np.format_float_positional(speed, trim="-")
                scenes[f"{motion.replace('_', ' ')}, {shown} m/s"] = scenario
        return scenes
