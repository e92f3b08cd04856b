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
from vcjax.report.tuning import check_places, write_tuning
from vcjax.tuning.blocks import check_blocks
from vcjax.tuning.choice import Seeds
from vcjax.tuning.descent import Schedule
from vcjax.tuning.intervals import OSCILLATION, THRESHOLDS, Interval
from vcjax.tuning.landscape import around
from vcjax.tuning.losses import WANTED, Objective
from vcjax.tuning.problem import MAX_AMPLITUDE_M
from vcjax.tuning.scenes import Scenes
from vcjax.tuning.tune import choice_of, tune

What = Literal["thresholds", "oscillation", "joint"]
_LANDSCAPE_SEEDS = 4


@dataclasses.dataclass(frozen=True)
class Tune:
    """Tune Th1 and Th2, A and f, or all four by gradient, one setting for all scenes, and prove it on other seeds.

    The directory `--out` holds every step and every block of runs: tuning that was stopped goes on there to the same
    numbers.
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
    """Descents: from the setting before, and from points spread over what is allowed. Of more than two, the better half
    of the ends by smoothed loss are candidates."""
    near: int = 0
    """Candidates more, from around the end of the smallest smoothed loss: runs may ripple with a number, as with f."""
    choosing_seeds: int = 48
    """Runs of each scene by which the best of the candidates is chosen."""
    held_out_seeds: int = 100
    """Runs of each scene on which it is compared with the setting before."""
    landscape_points: int = 8
    """Points along each axis of the landscape that is drawn, with 4 runs of each scene, at least 3; 0: none."""
    key: int = 0
    """Number of the base random key."""
    out: Path = Path("results/tune")
    """Directory of the results; for each of the three its own folder in it."""
    devices: Cores = dataclasses.field(default_factory=Cores)
    """Where the runs are done."""

    def __call__(self, console: Console) -> None:
        """Tune, draw, report."""
        if self.landscape_points in (1, 2) or self.landscape_points < 0:
            raise ValueError(f"--landscape-points {self.landscape_points}: give at least 3, or 0 for no landscape.")
        if self.what == "thresholds":
            self._refuse_what_has_no_effect()
        scenarios, directory, key = self.scenes.make(), self.out / self.what, numbered_key(self.key)
        config = FilterConfig(gate=VirtualCorrection(th1=self.th1, th2=self.th2), smoothing=self.smoothing)
        pairs = {"thresholds": self._thresholds, "oscillation": self._oscillation}
        chosen = {name: intervals() for name, intervals in pairs.items() if self.what in (name, "joint")}
        parameters = {path: interval for pair in chosen.values() for path, interval in pair.items()}
        seeds = Seeds(self.choosing_seeds, self.held_out_seeds)
        check_places(directory, "tune")
        for name in chosen if self.landscape_points else ():
            given = {"objective": self.objective, "num_seeds": _LANDSCAPE_SEEDS, "key": key}
            num_settings = self.landscape_points**2
            place = _landscape_in(choice_of(directory, self.starts, self.near), name)
            check_blocks(place, scenarios, config, None, num_settings, **given)
        with progress_bar(console, "compiling, first step") as show:
            tuned = tune(
                scenarios,
                config,
                parameters,
                objective=self.objective,
                schedule=self.schedule,
                num_starts=self.starts,
                num_near=self.near,
                seeds=seeds,
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
                    num_seeds=_LANDSCAPE_SEEDS,
                    key=key,
                    directory=_landscape_in(choice_of(directory, len(tuned.descents), self.near), name),
                    progress=lambda done, total, name=name: show(done, total, f"landscape of {name}"),
                )
                for name, pair in chosen.items()
                if self.landscape_points > 0
            }
        paths = write_tuning(tuned, landscapes, directory)
        print((directory / "tune.md").read_text("utf-8"))
        for path in paths:
            say(console, f"wrote {path}")

    def _refuse_what_has_no_effect(self) -> None:
        """Where A and f stay as they are, bounds of theirs were meant for something else.

        Raises:
            ValueError: naming the option.
        """
        for field in dataclasses.fields(self):
            if field.name in ("max_amplitude_m", "frequency_band_hz") and getattr(self, field.name) != field.default:
                option = f"--{field.name.replace('_', '-')}"
                raise ValueError(f"{option}: of A and f; with `thresholds` these stay. Leave it out, or tune `joint`.")

    def _thresholds(self) -> dict[str, Interval]:
        """Where the thresholds may go.

        Raises:
            ValueError: naming the option, if one is not inside.
        """
        for option, value, interval in zip(("--th1", "--th2"), (self.th1, self.th2), THRESHOLDS.values(), strict=True):
            _require_inside(option, value, interval)
        return THRESHOLDS

    def _oscillation(self) -> dict[str, Interval]:
        """Where A and f may go.

        Raises:
            ValueError: naming the option, for ends out of range, or if a number is not inside.
        """
        (low, high), top = self.frequency_band_hz, self.max_amplitude_m
        if not 0 < top <= MAX_AMPLITUDE_M:
            raise ValueError(f"--max-amplitude-m {top:g}: give a length above 0 and up to {MAX_AMPLITUDE_M} m.")
        half_rate = min(float(scenario.frame_rate_hz) for scenario in self.scenes.make().values()) / 2
        if not 0 <= low < high < half_rate:
            raise ValueError(
                f"--frequency-band-hz {low:g} {high:g}: give two rising numbers, from 0 to below half the frame rate, "
                f"{half_rate:g} Hz."
            )
        (path_A, amplitude), (path_f, frequency) = OSCILLATION.items()
        amplitude = dataclasses.replace(amplitude, low=0.0, high=top)
        frequency = dataclasses.replace(frequency, low=low, high=high)
        _require_inside("--amplitude-m", self.scenes.amplitude_m, amplitude, "--max-amplitude-m")
        _require_inside("--frequency-hz", self.scenes.frequency_hz, frequency, "--frequency-band-hz")
        return {path_A: amplitude, path_f: frequency}


def _landscape_in(choice: Path, name: str) -> Path:
    """Where a landscape is kept: with the choice, on which its other numbers depend."""
    return choice / f"landscape_{name}"


def _require_inside(option: str, value: float, interval: Interval, bounds: str | None = None) -> None:
    """Refuse a number to begin with that is not inside its interval, at whose ends there is no way on.

    Raises:
        ValueError: naming the option, and the one with the bounds where there is one.
    """
    if not interval.low < value < interval.high:
        raise ValueError(
            f"{option} {value:g}: the first descent begins there; give a number above {interval.low:g} and below "
            f"{interval.high:g}{f', or other bounds by {bounds}' if bounds else ''}."
        )
