"""Sweeping any numeric leaf of a scenario or configuration, named by its path, e.g. `config.gate.th1`."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario

Sweep = Mapping[str, Sequence[float]]
"""Path of a numeric leaf → the values it takes. Several paths span a grid."""


class Experiment(eqx.Module):
    """What is swept over: the root of all paths."""

    scenario: Scenario
    config: FilterConfig


def replace_at(tree: Any, path: str, value: Any) -> Any:
    """A copy of nested configuration objects with the leaf at `path` replaced; all objects on the way are checked."""
    name, _, rest = path.partition(".")
    return dataclasses.replace(tree, **{name: replace_at(getattr(tree, name), rest, value) if rest else value})


def numeric_paths(tree: Any) -> Iterator[str]:
    """Paths of all scalar numeric leaves, those that can be swept."""
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        if dataclasses.is_dataclass(value):
            yield from (f"{field.name}.{path}" for path in numeric_paths(value))
        elif not field.metadata.get("static", False) and np.ndim(value) == 0 and value is not None:
            yield field.name


def check_sweep(experiment: Experiment, sweep: Sweep) -> dict[str, np.ndarray]:
    """The swept values as arrays.

    Raises:
        ValueError: for an unknown path (the message lists those there are), an empty or nested list of values, or a
        value
            that the object it belongs to refuses.
    """
    known = list(numeric_paths(experiment))
    values = {}
    for path, listed in sweep.items():
        if path not in known:
            raise ValueError(f"sweep has no numeric leaf {path!r}; choose among: {', '.join(known)}.")
        values[path] = np.asarray(listed, float)
        if values[path].ndim != 1 or values[path].size == 0:
            raise ValueError(f"sweep[{path!r}] = {listed!r}: give a list of at least one number.")
        replace_at(experiment, path, values[path])
    return values
