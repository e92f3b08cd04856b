"""`vcjax bench`: how long the work takes."""

import dataclasses
import json
from pathlib import Path
from typing import Literal

from rich.console import Console

from vcjax.devices import Devices
from vcjax.storage import check_writable, write_file
from vcjax.study import benchmark

Part = Literal["cell", "seeds", "gradients", "numpy", "reproduce"]


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
            check_writable(self.json, [self.baseline])
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
