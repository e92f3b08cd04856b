"""`vcjax sweep`: a grid over any two numbers, judged by hard decisions."""

import dataclasses
from pathlib import Path

import numpy as np
from rich.console import Console

from vcjax.commands.console import numbered_key, progress_bar, say
from vcjax.devices import Cores
from vcjax.filter.config import FilterConfig
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.report.tuning import check_places, write_search
from vcjax.tuning.choice import Seeds, setting_of
from vcjax.tuning.landscape import search
from vcjax.tuning.losses import WANTED, Objective
from vcjax.tuning.scenes import Scenes

_RANGES = {"config.gate.th1": (2.0, 64.0), "config.gate.th2": (0.5, 64.0)}
"""From where to where, unless it is said."""
_MAX_POINTS = 200
"""Along one axis: a grid of twice as many each way takes days, and its heat map shows no more."""


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Run a grid over any two numbers of scenario and filter; draw what each point does; compare the best with before.

    The directory `--out` holds every finished block of runs: a sweep that was stopped goes on there.
    """

    x: str = "config.gate.th1"
    """First number, by its path, e.g. config.gate.th1, config.pixel_std_px, scenario.oscillation.amplitude_m."""
    x_range: tuple[float, float] | None = None
    """From where to where; of Th1 and Th2 2 to 64 and 0.5 to 64 if it is not said, of others it has to be."""
    x_points: int = 12
    """How many values."""
    x_log: bool = True
    """Equal factors between them instead of equal steps."""
    y: str = "config.gate.th2"
    """Second number."""
    y_range: tuple[float, float] | None = None
    """The same for the second."""
    y_points: int = 12
    """How many values."""
    y_log: bool = True
    """Equal factors between them instead of equal steps."""
    scenes: Scenes = dataclasses.field(default_factory=Scenes)
    """What every point is run in."""
    objective: Objective = dataclasses.field(default_factory=lambda: WANTED)
    """What the best point is the best by."""
    th1: float = 9.0
    """Th1 before."""
    th2: float = 9.0
    """Th2 before."""
    seeds: int = 10
    """Runs of each scene at every point."""
    held_out_seeds: int = 100
    """Runs of each scene on which the best point is compared with the setting before."""
    key: int = 0
    """Number of the base random key."""
    out: Path = Path("results/sweep")
    """Directory of the results."""
    devices: Cores = dataclasses.field(default_factory=Cores)
    """Where the runs are done."""

    def __call__(self, console: Console) -> None:
        """Run, draw, report."""
        if self.x == self.y:
            raise ValueError(f"--x {self.x} --y {self.y}: give two numbers.")
        scenarios, key = self.scenes.make(), numbered_key(self.key)
        config = FilterConfig(gate=VirtualCorrection(th1=self.th1, th2=self.th2))
        setting_of(scenarios, config, (self.x, self.y))  # there are such numbers
        axes = {
            self.x: _values("x", self.x, self.x_range, self.x_points, self.x_log),
            self.y: _values("y", self.y, self.y_range, self.y_points, self.y_log),
        }
        check_places(self.out, "sweep")
        with progress_bar(console, "compiling, first block") as show:
            choice = search(
                scenarios,
                config,
                axes,
                objective=self.objective,
                seeds=Seeds(self.seeds, self.held_out_seeds),
                key=key,
                directory=self.out,
                progress=lambda name, done, total: show(done, total, name),
            )
        paths = write_search(choice, self.out)
        print((self.out / "sweep.md").read_text("utf-8"))
        for path in paths:
            say(console, f"wrote {path}")


def _values(axis: str, path: str, ends: tuple[float, float] | None, num: int, is_log: bool) -> np.ndarray:
    """The values along an axis.

    Raises:
        ValueError: for ends or a number of points that give none.
    """
    ends = _RANGES.get(path) if ends is None else ends
    if ends is None:
        raise ValueError(f"--{axis} {path}: give --{axis}-range, from where to where.")
    low, high = ends
    if not (np.isfinite(low) and np.isfinite(high) and low < high and (low > 0 or not is_log)):
        raise ValueError(f"--{axis}-range {low:g} {high:g}: give two rising numbers, positive ones with --{axis}-log.")
    if not 2 <= num <= _MAX_POINTS:
        raise ValueError(f"--{axis}-points {num}: give at least two, and at most {_MAX_POINTS}.")
    return np.geomspace(low, high, num) if is_log else np.linspace(low, high, num)
