"""`vcjax simulate`: one scenario with one gate and one detector, for some seeds; a seed's recording as a file."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro
from rich.console import Console

from vcjax.commands.console import numbered_key, progress_bar, say
from vcjax.devices import Devices, together
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario, paper
from vcjax.simulation.simulate import simulate
from vcjax.sources.recording_file import RecordingFile, save_recording
from vcjax.storage import check_writable
from vcjax.study.monte_carlo import monte_carlo
from vcjax.study.results import describe, save
from vcjax.study.summary import summarise

GateName = Literal["RE", "VC", "one_point_ransac"]
DetectorName = Literal[
    "inlier_ratio", "velocity_glr", "velocity_likelihood_ratio", "windowed_nis", "cusum", "immediate"
]


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Run one scenario with one gate and one detector for some seeds, print a summary and save the runs."""

    scenario: Annotated[Scenario, tyro.conf.arg(constructor=paper)]
    """The experiment."""
    config: FilterConfig
    """The filter."""
    gate: GateName = "VC"
    """Update gate: RE (re-projection error), VC (virtual correction) or 1-point RANSAC with rescue."""
    detector: DetectorName = "inlier_ratio"
    """Which landmarks are deleted over time."""
    seeds: int = 25
    """Number of runs."""
    key: int = 0
    """Number of the base random key."""
    out: Path = Path("results/simulate.nc")
    """File of the results (NetCDF-4)."""
    recording: Path | None = None
    """File for what the filter reads in the first run, with the truth: a recording, as `vcjax run` takes it (.npz)."""
    devices: Devices = dataclasses.field(default_factory=Devices)
    """Where the runs are done."""

    def __call__(self, console: Console) -> None:
        """Run, summarise, save."""
        with together() as settings:
            check_writable(self.out)
            if self.recording is not None:
                check_writable(self.recording)
            key = numbered_key(self.key)
            settings += [describe(self.scenario), describe(self.config), self.seeds, self.key]
        with progress_bar(console, "running") as show:
            runs = monte_carlo(self.scenario, self.config, num_seeds=self.seeds, key=key, progress=show)
        with together():
            if jax.process_index() == 0:  # every process has all the runs
                print(summarise(runs))
                say(console, f"wrote {save(runs, self.out)}")
                if self.recording is not None:
                    # The first of `monte_carlo`, whose runs fold their number into the key.
                    content = RecordingFile(*jax.jit(simulate)(self.scenario, jax.random.fold_in(key, 0)))
                    say(console, f"wrote {save_recording(self.recording, content)}")
