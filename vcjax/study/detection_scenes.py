"""The scenes in which detectors are compared: with movers and without, the paper's and harder ones."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vcjax.simulation.scenarios import HARDER, DynamicMotion, DynamicSet, RobotMotion, Scenario, harder, paper


class Scene(NamedTuple):
    """Where a method is run: what moves, how fast, and how the camera swings."""

    amplitude_m: float
    """A of the oscillation, m; 0: steady."""
    dynamic_motion: DynamicMotion | None = None
    """None: nothing moves."""
    dynamic_speed_m_s: float | None = None
    robot: RobotMotion = "forward"
    dynamic_set: DynamicSet = "ahead"
    """Which features move."""
    harder: str | None = None
    """Name of a scene of `scenarios.HARDER` instead, which says what moves, and how."""
    oscillation_error_std_m: float = 0.0
    """How far the camera is from where it should be in a static scene, m."""

    @property
    def is_static(self) -> bool:
        """Whether nothing moves."""
        return self.dynamic_motion is None and self.harder is None

    @property
    def label(self) -> str:
        """In words, without the amplitude: e.g. "inverse forward, 0.5 m/s"."""
        if self.harder is not None:
            return self.harder.replace("_", " ")
        if self.dynamic_motion is None:
            error = self.oscillation_error_std_m
            return f"static, robot {self.robot}" + (f", oscillation ± {1000 * error:g} mm" if error else "")
        near = "" if self.dynamic_set == "ahead" else f", {self.dynamic_set.replace('_', ' ')}"
        return f"{self.dynamic_motion.replace('_', ' ')}, {self.dynamic_speed_m_s:g} m/s{near}"

    @property
    def identifier(self) -> str:
        """As a file name."""
        parts = [f"A_{self.amplitude_m!r}", self.robot, self.harder or self.dynamic_motion or "static"]
        if self.dynamic_speed_m_s is not None:
            parts.append(f"{self.dynamic_speed_m_s!r}_m_s")
        if self.dynamic_set != "ahead":
            parts.append(self.dynamic_set)
        if self.oscillation_error_std_m:
            parts.append(f"error_{self.oscillation_error_std_m!r}")
        return "_".join(parts)

    @property
    def static(self) -> "Scene":
        """The same without movers."""
        error = HARDER.get(self.harder or "", {}).get("oscillation_error_std_m", self.oscillation_error_std_m)
        return Scene(self.amplitude_m, robot=self.robot, oscillation_error_std_m=error)

    def scenario(self, num_frames: int) -> Scenario:
        """The scenario, as `scenarios` makes and checks it."""
        if self.harder is not None:
            return harder(self.harder, oscillation_amplitude_m=self.amplitude_m, num_frames=num_frames)
        return paper(
            robot=self.robot,
            dynamic=self.dynamic_motion,
            dynamic_speed_m_s=self.dynamic_speed_m_s or 0.0,
            dynamic_set=self.dynamic_set,
            oscillation_amplitude_m=self.amplitude_m,
            oscillation_error_std_m=self.oscillation_error_std_m,
            num_frames=num_frames,
        )


def scenes_of(
    amplitudes_m: Sequence[float],
    motions: Sequence[DynamicMotion],
    speeds_m_s: Sequence[float],
    dynamic_sets: Sequence[DynamicSet],
    harder_scenes: Sequence[str],
) -> list[Scene]:
    """All scenes, amplitude by amplitude, static ones last; arguments as of `study.detect.detect`.

    Raises:
        ValueError: for what is missing, given twice, unknown or out of range.
    """
    given = {"amplitudes_m": amplitudes_m, "motions": motions, "speeds_m_s": speeds_m_s, "dynamic_sets": dynamic_sets}
    for name, values in given.items():
        if isinstance(values, str) or not values or len(set(values)) < len(values):
            raise ValueError(f"detect({name}={values!r}): give at least one, each once, in a list.")
    if (
        isinstance(harder_scenes, str)
        or len(set(harder_scenes)) < len(harder_scenes)
        or set(harder_scenes) - set(HARDER)
    ):
        raise ValueError(f"detect(harder_scenes={harder_scenes!r}): give some of {', '.join(HARDER)}, each once.")
    if not all(np.isfinite(v) and v > 0 for v in speeds_m_s):
        raise ValueError(f"detect(speeds_m_s={tuple(speeds_m_s)}): give positive speeds; the static scenes come along.")
    robots: tuple[RobotMotion, ...] = ("forward", "curved", "lateral")
    scenes = [
        scene
        for a in map(float, amplitudes_m)
        for scene in (
            *(
                Scene(a, motion, float(v), dynamic_set=s)
                for s in dynamic_sets
                for motion in motions
                for v in speeds_m_s
            ),
            *(Scene(a, harder=name) for name in harder_scenes),
            *(Scene(a, robot=robot) for robot in robots),
            *(Scene(a, harder=name).static for name in harder_scenes),
        )
    ]
    return list(dict.fromkeys(scenes))
