"""Sweeping any numeric leaf of a scenario or configuration, named by its path, e.g. `config.gate.th1`.

An element of a vector is named by its place: `scenario.odometry_std.0` is the first of its six numbers.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vcjax.fields import is_concrete, require_kind
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario

Sweep = Mapping[str, Sequence[float] | Sequence[int] | np.ndarray]
"""Path of a numeric leaf → the values it takes. Several paths span a grid."""


class Experiment(eqx.Module):
    """What is swept over: the root of all paths."""

    scenario: Scenario
    config: FilterConfig


def replace_at(tree: Any, values: Mapping[str, Any]) -> Any:
    """A copy of nested configuration objects with other leaves at some paths.

    All are replaced together, so that every object on the way is checked once, with its new numbers only.
    """
    below: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        name, _, rest = path.partition(".")
        below.setdefault(name, {})[rest] = value
    return dataclasses.replace(tree, **{name: _replaced(getattr(tree, name), new) for name, new in below.items()})


def _replaced(field: Any, values: Mapping[str, Any]) -> Any:
    """A field with other values at paths below it; the empty path is the field itself."""
    if "" in values:
        return values[""]
    if dataclasses.is_dataclass(field):
        return replace_at(field, values)
    elements = [values.get(str(i), field[i]) for i in range(len(field))]
    if not all(map(is_concrete, elements)):
        return jnp.stack(jnp.broadcast_arrays(*elements), axis=-1)
    stacked = np.stack(np.broadcast_arrays(*elements), axis=-1)
    return (
        stacked if stacked.ndim == 1 else jax.device_put(stacked)
    )  # several vectors are a batch, which JAX arrays are


def numeric_paths(tree: Any) -> Iterator[str]:
    """Paths of all that can be swept: numeric leaves, and elements of numeric vectors."""
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        if dataclasses.is_dataclass(value):
            yield from (f"{field.name}.{path}" for path in numeric_paths(value))
        elif value is None or field.metadata.get("static", False):
            continue
        elif np.ndim(value) == 0:
            yield field.name
        elif np.ndim(value) == 1 and np.issubdtype(np.asarray(value).dtype, np.floating):
            yield from (f"{field.name}.{i}" for i in range(len(value)))


def require_paths(owner: str, tree: Any, paths: Iterable[str]) -> None:
    """Refuse paths of which a tree has no numeric leaf.

    Raises:
        ValueError: naming the first, and those there are.
    """
    known = list(numeric_paths(tree))
    for path in paths:
        if path not in known:
            raise ValueError(f"{owner} has no numeric leaf {path!r}; choose among: {', '.join(known)}.")


def number_at(tree: Any, path: str) -> float:
    """The number at a path that there is."""
    for name in path.split("."):
        tree = tree[int(name)] if name.isdecimal() else getattr(tree, name)
    return float(tree)


def check_sweep(experiment: Experiment, sweep: Sweep) -> dict[str, np.ndarray]:
    """The swept values as arrays.

    Raises:
        ValueError: for an unknown path (the message lists those there are), an empty or nested list of values, or a
            point of the grid that the objects it belongs to refuse.
    """
    require_kind(
        "monte_carlo", "sweep", sweep, Mapping, 'give paths with their values, {"config.gate.th1": [6, 9, 12]}.'
    )
    require_paths("sweep", experiment, sweep)
    values = {}
    for path, listed in sweep.items():
        try:
            values[path] = np.asarray(listed, float)
        except (TypeError, ValueError):
            values[path] = np.empty(0)
        if values[path].ndim != 1 or values[path].size == 0:
            raise ValueError(f"sweep[{path!r}] = {listed!r}: give a list of at least one number.")
    grid = [axis.ravel() for axis in np.meshgrid(*values.values(), indexing="ij")]
    try:
        # As a batch, which only JAX arrays are. In float32 some are rounded, and one by one they are looked at again.
        replace_at(experiment, dict(zip(values, map(jax.device_put, grid), strict=True)))
        return values
    except ValueError:
        pass
    for point in zip(*grid, strict=True):  # one by one, so that the message names the value that is refused
        replace_at(experiment, dict(zip(values, point, strict=True)))
    return values
