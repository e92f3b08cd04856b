"""The paper's experiments, all cells, with every finished piece on disk.

A directory holds, for each cell of Tables 2–5, blocks of `SEEDS_PER_BLOCK` seeds: `runs/<cell>/seeds_00000-00024.nc`.
What is there is not run again, so a run that was stopped goes on where it was, and a larger number of seeds extends a
smaller one. Several processes share the blocks: each runs and writes its own part, and whoever reads the directory
finds them all.
"""

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from numbers import Integral
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import PRNGKeyArray

from vcjax.devices import together
from vcjax.fields import require_key
from vcjax.filter.config import FilterConfig
from vcjax.gates.cusum import Cusum
from vcjax.gates.gate import AbstractDetector, AbstractGate
from vcjax.gates.immediate import Immediate
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.one_point_ransac import OnePointRansac
from vcjax.gates.reprojection import ReprojectionError
from vcjax.gates.velocity_glr import VelocityGLR
from vcjax.gates.velocity_likelihood_ratio import VelocityLikelihoodRatio
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.gates.windowed_nis import WindowedNIS
from vcjax.simulation.scenarios import paper
from vcjax.storage import remove_leftovers, write_file
from vcjax.study.monte_carlo import monte_carlo
from vcjax.study.paper import TABLES, Cell, cells
from vcjax.study.results import attributes, load, load_attributes, refuse_other_settings, save
from vcjax.study.sweep import Experiment

SEEDS_PER_BLOCK = 25
OSCILLATION_AMPLITUDE_M = 0.05
"""A of the paper's oscillating camera (Table 1)."""
GATES: Mapping[str, Callable[[], AbstractGate]] = {
    "RE": ReprojectionError,
    "VC": VirtualCorrection,
    "one_point_ransac": OnePointRansac,
}
"""The gates by name; the paper has the first two."""
DETECTORS: Mapping[str, Callable[[], AbstractDetector]] = {
    "inlier_ratio": InlierRatio,
    "velocity_glr": VelocityGLR,
    "velocity_likelihood_ratio": VelocityLikelihoodRatio,
    "windowed_nis": WindowedNIS,
    "cusum": Cusum,
    "immediate": Immediate,
}
"""The detectors by name; the paper's toolbox has the first."""

Block = tuple[Cell, int, int]
"""Cell, first seed and end of the seeds."""
_BLOCK_NAME = re.compile(r"seeds_(\d{5,})-(\d{5,})\.nc")


def cell_experiment(cell: Cell) -> Experiment:
    """Scenario and configuration of a cell."""
    scenario = paper(
        robot=cell.robot_motion,  # type: ignore[arg-type]
        dynamic=cell.dynamic_motion,  # type: ignore[arg-type]
        dynamic_speed_m_s=cell.dynamic_speed_m_s or 0.0,
        oscillation_amplitude_m=OSCILLATION_AMPLITUDE_M if cell.oscillating else 0.0,
    )
    return Experiment(scenario, FilterConfig(gate=GATES[cell.gate]()))


def reproduce(
    directory: str | Path,
    *,
    num_seeds: int = 25,
    tables: Collection[int] = TABLES,
    key: PRNGKeyArray | None = None,
    progress: Callable[[int, int, Cell], None] | None = None,
) -> dict[Cell, Any]:
    """Run every cell of the paper's tables, and RE with the oscillating camera, which the paper left out.

    Args:
        directory: where results are kept; made if needed. Blocks that are there already are read, not run. Processes
            that work together (`jax.distributed.initialize`) need one that all of them see.
        num_seeds: runs per cell, at least 1.
        tables: which of 2, 3, 4, 5.
        key: base key; `jax.random.key(0)` if None.
        progress: called with (blocks done, blocks in all, cell) after each block that this process has to run.

    Returns: the runs of each cell, an `xarray.Dataset` as from `monte_carlo`. Of several processes each returns
    them all, when the last has done its part.

    Raises:
        ValueError: for a bad number of seeds or table, or if the directory holds results of other settings (of any
            table: its cells are compared with each other).
        OSError: if the directory cannot be written.
    """
    directory, key = Path(directory), jax.random.key(0) if key is None else key
    with together() as settings:
        blocks = _checked(num_seeds, tables, key)
        _prepare(directory, key)
        settings += [blocks, jax.random.key_data(key).tolist()]
    with together():
        mine = _my_part(blocks, _missing(directory, blocks))
        for done, (cell, first, end) in enumerate(mine, start=1):
            run_block(directory / "runs" / cell.identifier, cell_experiment(cell), first, end, key)
            if progress is not None:
                progress(done, len(mine), cell)
    return load_results(directory, tables=tables, num_seeds=num_seeds)


def load_results(
    directory: str | Path, *, tables: Collection[int] = TABLES, num_seeds: int | None = None
) -> dict[Cell, Any]:
    """Read what a directory holds of the cells, over the seeds that all of them have (at most `num_seeds`).

    Raises:
        FileNotFoundError: if it holds no results.
        ValueError: if a file is not readable.
    """
    results = {}
    for cell in cells(tables):
        blocks = [load(path) for _, _, path in blocks_in(Path(directory) / "runs" / cell.identifier)]
        if blocks:
            results[cell] = joined_blocks(blocks)
    if not results:
        raise FileNotFoundError(f"{directory}: no results of the paper's cells here; run `vcjax reproduce` first.")
    shared = set.intersection(*(set(runs.seed.values.tolist()) for runs in results.values()))
    seeds = sorted(seed for seed in shared if num_seeds is None or seed < num_seeds)
    if not seeds:
        raise ValueError(
            f"{directory}: the cells have no seed in common; run `vcjax reproduce` again to complete them."
        )
    return {cell: runs.sel(seed=seeds) for cell, runs in results.items()}


def _checked(num_seeds: int, tables: Collection[int], key: PRNGKeyArray) -> list[Block]:
    """The blocks of arguments that make sense."""
    if not isinstance(num_seeds, Integral) or num_seeds < 1:
        raise ValueError(f"reproduce(num_seeds={num_seeds!r}): give at least one seed, a whole number.")
    if not isinstance(tables, Collection) or not tables:
        raise ValueError(f"reproduce(tables={tables!r}): give at least one of {TABLES}, in a list.")
    require_key("reproduce", key)
    return _all_blocks(tables, num_seeds)


def _prepare(directory: Path, key: PRNGKeyArray) -> None:
    """Refuse a directory of other settings or that cannot be written, and clear what killed processes left."""
    for cell in cells():
        for _, _, path in blocks_in(directory / "runs" / cell.identifier):
            refuse_other_settings(path, load_attributes(path), attributes(cell_experiment(cell), key))
        remove_leftovers(directory / "runs" / cell.identifier, "seeds_*.nc")
    write_file(directory / "README.txt", _README.encode())  # also tells at once whether the place can be written


def _all_blocks(tables: Collection[int], num_seeds: int) -> list[Block]:
    """The work: gate by gate, since each compiles once; the paper's order within."""
    seeds = [(first, min(first + SEEDS_PER_BLOCK, num_seeds)) for first in range(0, num_seeds, SEEDS_PER_BLOCK)]
    chosen = cells(tables)
    return [(cell, first, end) for gate in GATES for cell in chosen if cell.gate == gate for first, end in seeds]


def _missing(directory: Path, blocks: list[Block]) -> list[Block]:
    """Those of the blocks that a directory lacks."""
    there = {cell: list(blocks_in(directory / "runs" / cell.identifier)) for cell, _, _ in blocks}
    return [
        (cell, first, end)
        for cell, first, end in blocks
        if not any(found_first == first and found_end >= end for found_first, found_end, _ in there[cell])
    ]


def _my_part(blocks: list[Block], missing: list[Block]) -> list[Block]:
    """This process's share of the missing blocks, consecutive ones; process 0 says which are missing."""
    is_missing = multihost_utils.broadcast_one_to_all(np.array([block in missing for block in blocks]))
    parts = np.array_split(np.flatnonzero(is_missing), jax.process_count())
    return [blocks[i] for i in parts[jax.process_index()]]


def run_block(folder: Path, experiment: Experiment, first: int, end: int, key: PRNGKeyArray) -> None:
    """Run one block of seeds on this process's devices; a shorter one of the same first seed is replaced."""
    runs = monte_carlo(
        experiment.scenario,
        experiment.config,
        num_seeds=end - first,
        first_seed=first,
        key=key,
        devices=jax.local_devices(),
    )
    written = save(runs, folder / f"seeds_{first:05d}-{end - 1:05d}.nc")
    for found_first, _, path in list(blocks_in(folder)):
        if found_first == first and path != written:
            path.unlink()


def blocks_in(folder: Path) -> Iterator[tuple[int, int, Path]]:
    """First seed, end and path of the blocks in a folder, in order."""
    for path in sorted(folder.glob("seeds_*.nc")):
        if match := _BLOCK_NAME.fullmatch(path.name):
            yield int(match[1]), int(match[2]) + 1, path


def joined_blocks(blocks: list[Any]) -> Any:
    """Blocks of one cell as one data set; what does not depend on the seed is taken from the first."""
    import xarray as xr

    unique = [block.sel(seed=~block.get_index("seed").duplicated()) for block in blocks]
    joined = xr.concat(unique, "seed", data_vars="minimal", coords="minimal", compat="override", join="override")
    return joined.isel(seed=np.unique(joined.seed.values, return_index=True)[1])


_README = """\
Results of `vcjax reproduce`: the experiments of the paper's Tables 2-5.
runs/        the runs of each cell, NetCDF-4, in blocks of seeds; nothing else is needed to make the rest again
tables.json  every figure of every cell beside the paper's, and differences paired by seed
tables.md    the same for people
figures/     Figures 3-6
Make tables and figures again with `vcjax report` and this directory.
"""
