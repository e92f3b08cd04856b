"""`vcjax detectability`: which movers can be told from static features, with nothing run."""

import dataclasses
from pathlib import Path

import numpy as np
from rich.console import Console

from vcjax.commands.console import say
from vcjax.detectability.best_oscillation import best_oscillation, require_price
from vcjax.detectability.survey import predict_movers, require_power, survey
from vcjax.detectability.velocity_test import VelocityTest
from vcjax.devices import Cores
from vcjax.report.detectability import Detectability as Found
from vcjax.report.detectability import write_detectability
from vcjax.simulation.scenarios import DynamicSet, RobotMotion, paper
from vcjax.simulation.simulate import true_path
from vcjax.storage import check_writable
from vcjax.tuning.scenes import Scenes


@dataclasses.dataclass(frozen=True)
class Detectability:
    """Predict which places, directions and speeds can be told from static features, steady and oscillating.

    No filter is run: maps over the scene, the smallest speed found, the movers of the paper's scenes, and the
    oscillation with the largest power for its motion.
    """

    robot: RobotMotion = "forward"
    """How the robot moves."""
    amplitudes_m: tuple[float, ...] = (0.0, 0.05, 0.1)
    """Amplitudes of the camera to compare, m; 0: steady."""
    frequency_hz: float = 3.0
    """f of the oscillation, Hz."""
    num_frames: int = 160
    """Frames in a run."""
    test: VelocityTest = dataclasses.field(default_factory=lambda: VelocityTest(within_frames=60.0))
    """What the test has to go by."""
    power: float = 0.9
    """Probability with which a mover is to be found; above the false-alarm rate and below 1."""
    speeds_m_s: tuple[float, ...] = (0.25, 0.5, 1.0)
    """Speeds of movers, m/s."""
    headings_deg: tuple[float, ...] = (90.0, 180.0)
    """Their directions on the maps, deg: 0 forward, 90 left, 180 towards the robot."""
    height_m: float = 1.0
    """Height of the maps, m."""
    spacing_m: float = 1.0
    """Distance between places on the maps, m."""
    dynamic_set: DynamicSet = "ahead"
    """The movers of the scenes, which go sideways and towards the robot."""
    price: float = 0.02
    """What a mean square speed of the camera of 1 m²/s² costs in movers missed, when the best oscillation is chosen."""
    out: Path = Path("results/detectability")
    """Directory of the results."""
    devices: Cores = dataclasses.field(default_factory=Cores)
    """Where the work is done."""

    def __call__(self, console: Console) -> None:
        """Predict, draw, report."""
        require_power(self.test, self.power)
        require_price(self.price)
        if not 0.05 <= self.spacing_m <= 8:
            raise ValueError(f"--spacing-m {self.spacing_m:g}: give a distance from 0.05 to 8 m.")
        check_writable(self.out / "detectability.json")
        scenes = {
            float(a): Scenes(
                speeds_m_s=self.speeds_m_s,
                robot=self.robot,
                dynamic_set=self.dynamic_set,
                amplitude_m=a,
                frequency_hz=self.frequency_hz,
                num_frames=self.num_frames,
            ).make()
            for a in self.amplitudes_m
        }
        if not scenes:
            raise ValueError("--amplitudes-m: give at least one.")
        scenario = paper(self.robot, num_frames=self.num_frames, oscillation_frequency_hz=self.frequency_hz)
        side = np.arange(-8.0, 8.0 + 1e-9, self.spacing_m)
        x, y = np.meshgrid(side, side, indexing="ij")
        places = np.stack([x, y, np.full_like(x, self.height_m)], axis=-1).reshape(-1, 3)
        one = next(iter(next(iter(scenes.values())).values()))
        movers = np.asarray(one.landmarks_m)[np.asarray(one.movers.ids)]
        around = np.arange(0.0, 361.0, 15.0)
        options = {"amplitudes_m": self.amplitudes_m, "speeds_m_s": self.speeds_m_s, "power": self.power}
        with console.status("predicting"):
            found = Found(
                settings={
                    "robot": self.robot,
                    "frequency_hz": self.frequency_hz,
                    "num_frames": self.num_frames,
                    **{name: float(value) for name, value in vars(self.test).items()},
                    "power": self.power,
                    "height_m": self.height_m,
                    "price": self.price,
                },
                amplitudes_m=self.amplitudes_m,
                headings_deg=self.headings_deg,
                speeds_m_s=self.speeds_m_s,
                side_m=side,
                path_m=np.asarray(true_path(scenario).robot)[:, :2],
                area=survey(scenario, self.test, places, headings_deg=self.headings_deg, **options),
                movers_m=movers,
                around_deg=around,
                around=survey(scenario, self.test, movers, headings_deg=tuple(around), **options),
                scenes={a: predict_movers(named, self.test, self.power) for a, named in scenes.items()},
                best=best_oscillation(next(iter(scenes.values())), self.test, price=self.price),
            )
        paths = write_detectability(found, self.out)
        print((self.out / "detectability.md").read_text("utf-8"))
        for path in paths:
            say(console, f"wrote {path}")
