"""The `vcjax` command. Its options are made from the configuration classes by tyro."""

import contextlib
import dataclasses
import io
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro
from jaxtyping import PRNGKeyArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vcjax.filter.config import FilterConfig
from vcjax.report.figures import write_figures
from vcjax.report.tables import write_tables
from vcjax.simulation.scenarios import Scenario, paper
from vcjax.study.monte_carlo import monte_carlo
from vcjax.study.reproduce import GATES, load_results, reproduce
from vcjax.study.results import save
from vcjax.study.storage import check_writable
from vcjax.study.summary import summarise

GateName = Literal["RE", "VC"]


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
    devices: int | None = None
    """CPU devices to share the runs; all cores if not given."""

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
    devices: int | None = None
    """CPU devices to share the runs; all cores if not given."""

    def __call__(self, console: Console) -> None:
        """Run, summarise, save."""
        check_writable(self.out)
        with _progress(console, "running") as show:
            runs = monte_carlo(self.scenario, self.config, num_seeds=self.seeds, key=_key(self.key), progress=show)
        print(summarise(runs))
        _say(console, f"wrote {save(runs, self.out)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the `vcjax` command; returns its exit status.

    Bad input gives one line on standard error and status 1, not a traceback. What is wrong with the command line itself
    the parser says, in a box, and exits with status 2.
    """
    console = Console(stderr=True)
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        command = _parse(arguments)
        _use_cores(getattr(command, "devices", None))
        command(console)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        _say(console, f"vcjax: {error}", style="bold red")
        return 1
    except KeyboardInterrupt:
        _say(console, "vcjax: stopped; what `vcjax reproduce` has finished is on disk, and it will go on from there.")
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
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(
                union,  # type: ignore[arg-type]
                args=arguments,
                prog="vcjax",
                description="Which image features belong to moving things, and how should a camera move to find out?",
                config=(tyro.conf.OmitArgPrefixes,),
            )
    except SystemExit as stop:
        if refusal := _refusal(stop):
            raise refusal from None
        sys.stderr.write(told.getvalue())
        raise


def _refusal(stop: BaseException) -> ValueError | None:
    """What this package refused while the parser built a scenario or configuration, if that is why it stopped.

    The parser would put it into its box behind a name of its own making.
    """
    error = stop.__context__
    while error is not None:
        places = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
        if isinstance(error, ValueError) and places and places[-1].startswith("vcjax."):
            return error
        error = error.__context__
    return None


def _gate_name(arguments: list[str]) -> str:
    """The last value of `--gate`; the default where there is none, or one that the parser will refuse."""
    gate = "VC"
    for option, value in zip(arguments, [*arguments, ""][1:], strict=True):
        name = value if option == "--gate" else option.removeprefix("--gate=") if option.startswith("--gate=") else ""
        gate = name if name in GATES else gate
    return gate


def _use_cores(num_devices: int | None) -> None:
    """Float64, and as many CPU devices as there are cores: the seeds are shared between them.

    Raises:
        ValueError: for a number of devices that cannot be had.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if num_devices is not None and num_devices < 1:
        raise ValueError(f"--devices {num_devices}: give at least one device.")
    jax.config.update("jax_enable_x64", True)
    try:
        jax.config.update("jax_num_cpu_devices", num_devices or cores)
    except RuntimeError:  # called from a program in which JAX is at work already: its devices are what there is
        present = jax.local_device_count()
        if num_devices not in (None, present):
            raise ValueError(f"--devices {num_devices}: JAX already runs in this process, with {present}.") from None


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


def _say(console: Console, text: str, style: str | None = None) -> None:
    """Print a line as it is, without markup and never broken."""
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _report(results, directory: Path, console: Console) -> None:
    """Write tables and figures and say where."""
    for path in (*write_tables(results, directory), *write_figures(results, directory)):
        _say(console, f"wrote {path}")
