"""The `vcjax` command. Its options are made from the configuration classes by tyro."""

import dataclasses
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vcjax.filter.config import FilterConfig
from vcjax.report.figures import write_figures
from vcjax.report.tables import write_tables
from vcjax.simulation.scenarios import Scenario, paper
from vcjax.study.monte_carlo import monte_carlo
from vcjax.study.reproduce import GATES, load_results, reproduce
from vcjax.study.results import save
from vcjax.study.summary import summarise, summary_text

GateName = Literal["RE", "VC"]


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """Run all experiments of the paper's Tables 2-5 and write tables and figures beside the paper's numbers.

    What DIR holds already is not run again: a stopped run continues, and more seeds extend fewer.
    """

    seeds: int = 25
    """Runs per cell (the paper: 25)."""
    tables: tuple[int, ...] = (2, 3, 4, 5)
    """Which tables."""
    out: Path = Path("results/paper")
    """Directory of the results."""
    key: int = 0
    """Number of the base random key."""
    devices: int | None = None
    """CPU devices to share the runs; all cores if not given."""

    def __call__(self, console: Console) -> None:
        """Run, then report."""
        with _progress(console) as bar:
            task = bar.add_task("compiling, first cell", total=None)

            def advance(done, total, cell):
                bar.update(task, completed=done, total=total, description=cell.identifier)

            results = reproduce(
                self.out,
                num_seeds=self.seeds,
                tables=self.tables,
                key=jax.random.key(self.key),
                progress=advance,
            )
        _report(results, self.out, console)


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
    devices: int | None = None
    """CPU devices to share the runs; all cores if not given."""

    def __call__(self, console: Console) -> None:
        """Run, summarise, save."""
        with _progress(console) as bar:
            task = bar.add_task("running", total=None)

            def advance(done, total):
                bar.update(task, completed=done, total=total)

            runs = monte_carlo(
                self.scenario, self.config, num_seeds=self.seeds, key=jax.random.key(self.key), progress=advance
            )
        print(summary_text(summarise(runs)))
        console.print(f"wrote {save(runs, self.out)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the `vcjax` command; returns its exit status.

    Bad input gives one line on standard error and status 1, not a traceback; a wrong command line gives status 2.
    """
    console = Console(stderr=True)
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        command = _parse(arguments)
        _use_cores(getattr(command, "devices", None))
        command(console)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        console.print(f"vcjax: {error}", style="bold red", markup=False, highlight=False, soft_wrap=True)
        return 1
    except KeyboardInterrupt:
        console.print("vcjax: stopped; what is finished is on disk.", markup=False)
        return 130
    return 0


def _parse(arguments: list[str]) -> Reproduce | Report | Run:
    """The command with its options. The gate's own options depend on the gate, so that is looked up first."""
    gate = _gate_name(arguments)
    default = Run(scenario=tyro.MISSING, config=FilterConfig(gate=GATES[gate]()))
    union = (
        Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
        | Annotated[Report, tyro.conf.subcommand("report")]
        | Annotated[Run, tyro.conf.subcommand("run", default=default)]
    )
    return tyro.cli(
        union,  # type: ignore[arg-type]
        args=arguments,
        prog="vcjax",
        description="Which image features belong to moving things, and how should a camera move to find out?",
        config=(tyro.conf.OmitArgPrefixes,),
    )


def _gate_name(arguments: list[str]) -> str:
    """The value of `--gate`; the default where there is none, or one that the parser will refuse."""
    for option, value in zip(arguments, [*arguments[1:], ""], strict=True):
        name = value if option == "--gate" else option.removeprefix("--gate=") if option.startswith("--gate=") else None
        if name in GATES:
            return name
    return "VC"


def _use_cores(num_devices: int | None) -> None:
    """Float64, and as many CPU devices as there are cores: the seeds are shared between them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if num_devices is not None and num_devices < 1:
        raise ValueError(f"--devices {num_devices}: give at least one device.")
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", num_devices or cores)


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def _report(results, directory: Path, console: Console) -> None:
    """Write tables and figures and say where."""
    for path in (*write_tables(results, directory), *write_figures(results, directory)):
        console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
