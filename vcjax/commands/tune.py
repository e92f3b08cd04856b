"""`vcjax tune`: thresholds and oscillation by gradient, with proof on seeds held out."""

import dataclasses
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from vcjax.commands.console import numbered_key, progress_bar, say
from vcjax.devices import Cores
from vcjax.filter.config import FilterConfig
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.report.tuning import write_tuning
from vcjax.tuning.choice import Seeds
from vcjax.tuning.descent import Schedule
from vcjax.tuning.intervals import OSCILLATION, THRESHOLDS
from vcjax.tuning.landscape import around
from vcjax.tuning.losses import WANTED, Objective
from vcjax.tuning.scenes import Scenes
from vcjax.tuning.tune import tune

What = Literal["thresholds", "oscillation", "joint"]


@dataclasses.dataclass(frozen=True)
class Tune:
    """Tune Th1 and Th2, A and f, or all four by gradient, one setting for all scenes, and prove it on other seeds.

    DIR holds every step and every block of runs: tuning that was stopped goes on there to the same numbers.
    """

    what: tyro.conf.Positional[What]
    """Which numbers."""
    scenes: Scenes = dataclasses.field(default_factory=Scenes)
    """What the setting has to serve."""
    objective: Objective = dataclasses.field(default_factory=lambda: WANTED)
    """What is wanted of it."""
    schedule: Schedule = dataclasses.field(default_factory=Schedule)
    """How long and how fast to go."""
    th1: float = 9.0
    """Th1 before."""
    th2: float = 9.0
    """Th2 before."""
    max_amplitude_m: float = 0.15
    """Largest A allowed, m."""
    frequency_band_hz: tuple[float, float] = (0.5, 4.5)
    """Between which frequencies f may go, Hz; below half of the 10 frames per second."""
    smoothing: Literal["soft", "straight_through"] = "soft"
    """"soft" has a true gradient, "straight_through" the hard filter's numbers."""
    starts: int = 3
    """Descents: from the setting before, and from points spread over what is allowed."""
    choosing_seeds: int = 16
    """Runs of each scene by which the best end of a descent is chosen."""
    held_out_seeds: int = 100
    """Runs of each scene on which it is compared with the setting before."""
    landscape_points: int = 8
    """Points along each axis of the landscape that is drawn, with 4 runs of each scene; 0: none."""
    key: int = 0
    """Number of the base random key."""
    out: Path = Path("results/tune")
    """Directory of the results; for each of the three its own folder in it."""
    devices: Cores = dataclasses.field(default_factory=Cores)
    """Where the runs are done."""

    def __call__(self, console: Console) -> None:
        """Tune, draw, report."""
        if self.landscape_points == 1 or self.landscape_points < 0:
            raise ValueError(f"--landscape-points {self.landscape_points}: give at least 2, or 0 for no landscape.")
        ends = ((0.0, self.max_amplitude_m), self.frequency_band_hz)
        oscillation = {
            path: dataclasses.replace(interval, low=low, high=high)
            for (path, interval), (low, high) in zip(OSCILLATION.items(), ends, strict=True)
        }
        pairs = {"thresholds": THRESHOLDS, "oscillation": oscillation}
        chosen = pairs if self.what == "joint" else {self.what: pairs[self.what]}
        parameters = {path: interval for pair in chosen.values() for path, interval in pair.items()}
        scenarios, directory, key = self.scenes.make(), self.out / self.what, numbered_key(self.key)
        config = FilterConfig(gate=VirtualCorrection(th1=self.th1, th2=self.th2), smoothing=self.smoothing)
        with progress_bar(console, "compiling, first step") as show:
            tuned = tune(
                scenarios,
                config,
                parameters,
                objective=self.objective,
                schedule=self.schedule,
                num_starts=self.starts,
                seeds=Seeds(self.choosing_seeds, self.held_out_seeds),
                key=key,
                directory=directory,
                progress=lambda name, done, total: show(done, total, name),
            )
            landscapes = {
                name: around(
                    scenarios,
                    config,
                    tuned.choice.after,
                    pair,
                    objective=self.objective,
                    num_points=self.landscape_points,
                    num_seeds=4,
                    key=key,
                    directory=directory / f"landscape_{name}",
                    progress=lambda done, total, name=name: show(done, total, f"landscape of {name}"),
                )
                for name, pair in chosen.items()
                if self.landscape_points > 0
            }
        paths = write_tuning(tuned, landscapes, directory)
        print((directory / "tune.md").read_text())
        for path in paths:
            say(console, f"wrote {path}")
