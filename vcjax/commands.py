"""The commands of `vcjax`: each a class whose fields are its options, and whose call does the work."""

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro
from jaxtyping import PRNGKeyArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vcjax.devices import Devices, together
from vcjax.filter.config import FilterConfig
from vcjax.report.figures import write_figures
from vcjax.report.tables import write_tables
from vcjax.simulation.scenarios import Scenario, paper
from vcjax.storage import check_writable, write_file
from vcjax.study import benchmark
from vcjax.study.monte_carlo import monte_carlo
from vcjax.study.reproduce import load_results, reproduce
from vcjax.study.results import describe, save
from vcjax.study.summary import summarise

GateName = Literal["RE", "VC"]
Part = Literal["cell", "seeds", "gradients", "numpy", "reproduce"]


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """Run all experiments of the paper's Tables 2-5 and write tables and figures beside the paper's numbers.

    What DIR holds already is not run again: a stopped run continues, more seeds extend fewer, and tables run before are
    reported with the others.
    """

    seeds: int = 25
    """Runs per cell (the paper: 25)."""
    tables: tuple[int, ...] = (2, 3, 4, 5)
    """Which tables."""
    out: Path = Path("results/paper")
    """Directory of the results."""
    key: int = 0
    """Number of the base random key."""
    devices: Devices = dataclasses.field(default_factory=Devices)
    """Where the runs are done."""

    def __call__(self, console: Console) -> None:
        """Run, then report."""
        with _progress(console, "compiling, first cell") as show:
            reproduce(
                self.out,
                num_seeds=self.seeds,
                tables=self.tables,
                key=_key(self.key),
                progress=lambda done, total, cell: show(done, total, f"table {cell.table}, {cell.case}, {cell.method}"),
            )
        with together():
            if jax.process_index() == 0:  # every process has all the runs
                _report(load_results(self.out), self.out, console)


@dataclasses.dataclass(frozen=True)
class Report:
    """Make tables and figures again from the results in a directory, without running anything."""

    directory: tyro.conf.Positional[Path]
    """Directory of an earlier `vcjax reproduce`."""

    def __call__(self, console: Console) -> None:
        """Read and report."""
        _report(load_results(self.directory), self.directory, console)


@dataclasses.dataclass(frozen=True)
class Run:
    """Run one scenario with one gate for some seeds, print a summary and save the runs."""

    scenario: Annotated[Scenario, tyro.conf.arg(constructor=paper)]
    """The experiment."""
    config: FilterConfig
    """The filter."""
    gate: GateName = "VC"
    """Update gate: RE (re-projection error) or VC (virtual correction)."""
    seeds: int = 25
    """Number of runs."""
    key: int = 0
    """Number of the base random key."""
    out: Path = Path("results/run.nc")
    """File of the results (NetCDF-4)."""
    devices: Devices = dataclasses.field(default_factory=Devices)
    """Where the runs are done."""

    def __call__(self, console: Console) -> None:
        """Run, summarise, save."""
        with together() as settings:
            check_writable(self.out)
            key = _key(self.key)
            settings += [describe(self.scenario), describe(self.config), self.seeds, self.key]
        with _progress(console, "running") as show:
            runs = monte_carlo(self.scenario, self.config, num_seeds=self.seeds, key=key, progress=show)
        with together():
            if jax.process_index() == 0:  # every process has all the runs
                print(summarise(runs))
                say(console, f"wrote {save(runs, self.out)}")


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure how long the work takes: the paper's forward VC cell, more seeds, gradients, the whole `reproduce`.

    Some minutes, on an otherwise idle machine. Run in a checkout, it times the tests' plain NumPy filter beside it.
    """

    only: tuple[Part, ...] = ("cell", "seeds", "gradients", "numpy", "reproduce")
    """Which parts."""
    json: Path | None = None
    """File for the numbers."""
    baseline: Path | None = None
    """Accepted ratios to compare with, e.g. docs/benchmark.json; exit status 1 where one has become worse."""
    devices: Devices = dataclasses.field(default_factory=Devices)
    """Where the runs are done."""

    def __call__(self, console: Console) -> None:
        """Measure, print, save, compare."""
        accepted = None if self.baseline is None else benchmark.read_ratios(self.baseline)
        if self.json is not None:
            check_writable(self.json)
        measured = benchmark.where()
        for part in self.only:
            with console.status(f"measuring: {part}"):
                new = benchmark.PARTS[part]()
            measured |= new
            for name, value in new.items():
                print(f"{name:28s} {f'{value:.4g}' if isinstance(value, float) else value}", flush=True)
            if self.json is not None:
                write_file(self.json, f"{json.dumps(measured, indent=1)}\n".encode())
        if accepted is not None and (worse := benchmark.compare(measured, accepted)):
            raise ValueError("; ".join(worse))


def _key(number: int) -> PRNGKeyArray:
    """The random key of a number.

    Raises:
        ValueError: if it has more than 64 bits.
    """
    if not -(2**63) <= number < 2**63:
        raise ValueError(f"--key {number}: give a whole number of at most 64 bits.")
    return jax.random.key(number)


@contextlib.contextmanager
def _progress(console: Console, description: str) -> Iterator[Callable[..., None]]:
    """A progress bar; gives a function of (done, total) or (done, total, description) that moves it.

    When the work is refused, the bar goes, so that what is wrong stands alone.
    """
    columns = (BarColumn(16), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    bar = Progress(TextColumn("{task.description}"), *columns, console=console)
    task = bar.add_task(description, total=None)

    def show(done: int, total: int, description: str | None = None) -> None:
        bar.update(task, completed=done, total=total, description=description)

    bar.start()
    try:
        yield show
    except Exception:
        bar.live.transient = True
        bar.live.stop()
        raise
    except BaseException:
        bar.stop()
        raise
    bar.stop()


def say(console: Console, text: str, style: str | None = None) -> None:
    """Print a line as it is, without markup and never broken."""
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _report(results, directory: Path, console: Console) -> None:
    """Write tables and figures and say where."""
    for path in (*write_tables(results, directory), *write_figures(results, directory)):
        say(console, f"wrote {path}")
