"""`vcjax reproduce` and `vcjax report`: the paper's tables and figures."""

import dataclasses
from pathlib import Path

import jax
import tyro
from rich.console import Console

from vcjax.commands.console import numbered_key, progress_bar, say
from vcjax.devices import Devices, together
from vcjax.report.paper_figures import write_figures
from vcjax.report.paper_tables import write_tables
from vcjax.study.reproduce import load_results, reproduce


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
        with progress_bar(console, "compiling, first cell") as show:
            reproduce(
                self.out,
                num_seeds=self.seeds,
                tables=self.tables,
                key=numbered_key(self.key),
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


def _report(results, directory: Path, console: Console) -> None:
    """Write tables and figures and say where."""
    for path in (*write_tables(results, directory), *write_figures(results, directory)):
        say(console, f"wrote {path}")
