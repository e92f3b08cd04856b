"""Blocks of settings on disk: what they come from, and whether a directory can be used, known before any work."""

import dataclasses
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import PRNGKeyArray

from vcjax.fields import require_kind
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario
from vcjax.storage import check_writable
from vcjax.study.results import describe, load_attributes, provenance, refuse_other_settings
from vcjax.tuning.losses import Objective

Settings = Mapping[str, Sequence[float] | np.ndarray]
"""Path of a numeric leaf → its value in each setting; all of one length."""
RUNS_PER_BLOCK = 1024
"""Runs between two files, about: a minute of work, and a bound on memory."""
KEPT = ("loss", "camera_motion_m2_s2", "track_score", "is_deleted", "is_moving", "is_finite")
"""What a file of theirs holds at least."""


def check_blocks(
    directory: Path,
    scenarios: Mapping[str, Scenario],
    config: FilterConfig,
    settings: Settings | None,
    num_settings: int,
    *,
    objective: Objective,
    num_seeds: int,
    key: PRNGKeyArray,
) -> None:
    """Refuse a directory that `evaluate` could not use, before the work: not to be written to, or with other blocks.

    Args:
        directory: where blocks are to be kept.
        scenarios: of `evaluate`, like the rest.
        config: the filter.
        settings: numbers of the settings; None where they are not known yet.
        num_settings: how many.
        objective: what a run costs.
        num_seeds: runs of each setting in each scene.
        key: base key.

    Raises:
        ValueError: naming the block and what differs.
        OSError: if the directory cannot be written.
    """
    check_writable(directory / "settings.nc")
    places = {file_name(first, end): (first, end) for first, end in blocks_of(num_settings, len(scenarios) * num_seeds)}
    for path in sorted(directory.glob("settings_*.nc")):
        first, end = places.get(path.name, (0, 0))
        part = {} if settings is None else {name: np.asarray(values)[first:end] for name, values in settings.items()}
        origin = origin_of(scenarios, hard(config), part, objective, num_seeds, key)
        if settings is None or path.name not in places:
            del origin["settings"]
        refuse_other_settings(path, load_attributes(path, KEPT), origin)
        if path.name not in places:
            raise ValueError(
                f"{path} is of another number of settings than {num_settings}; "
                "give another directory, or remove this one."
            )


def as_directory(owner: str, directory: object) -> Path | None:
    """A directory as a path; none where there is none.

    Raises:
        ValueError: if it is no path.
    """
    if directory is None:
        return None
    require_kind(owner, "directory", directory, (str, os.PathLike), "give a path, or None to keep nothing.")
    return Path(directory)  # type: ignore[arg-type]


def hard(config: FilterConfig) -> FilterConfig:
    """The same filter with hard decisions."""
    return dataclasses.replace(config, smoothing="hard", reverse_mode=False)


def file_name(first: int, end: int) -> str:
    """Of the block of some settings."""
    return f"settings_{first:05d}-{end - 1:05d}.nc"


def blocks_of(num_settings: int, runs_each: int) -> Iterator[tuple[int, int]]:
    """First setting and end of each block."""
    size = max(1, RUNS_PER_BLOCK // runs_each)
    yield from ((first, min(first + size, num_settings)) for first in range(0, num_settings, size))


def origin_of(scenarios, config, columns, objective: Objective, num_seeds: int, key) -> dict[str, Any]:
    """What a block comes from, as it is kept beside it."""
    return provenance(key) | {
        "scenarios": json.dumps({name: describe(scenario) for name, scenario in scenarios.items()}),
        "config": json.dumps(describe(config)),
        "settings": json.dumps({path: values.tolist() for path, values in columns.items()}),
        "objective": json.dumps(describe(objective)),
        "num_seeds": num_seeds,
    }
