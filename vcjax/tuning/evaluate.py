"""Settings by what they do: runs with hard decisions of every setting in every scene for every seed.

A setting is a choice of some numbers of scenario and configuration, named by their paths as in a sweep. All see the
same seeds, so that their differences are paired. With a directory, every finished block of settings is kept there, and
work that was stopped goes on with the next.
"""

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, PRNGKeyArray

from vcjax.fields import require_key, require_kind
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario
from vcjax.storage import remove_leftovers
from vcjax.study.monte_carlo import metrics_of, run_lanes, simulate_and_filter
from vcjax.study.results import (
    PER_FEATURE,
    PER_FRAME,
    PER_RUN,
    describe,
    import_xarray,
    load,
    provenance,
    refuse_other_settings,
    save,
)
from vcjax.study.sweep import Experiment, replace_at, require_paths
from vcjax.tuning.losses import Objective, camera_motion_m2_s2

Settings = Mapping[str, Sequence[float] | np.ndarray]
"""Path of a numeric leaf → its value in each setting; all of one length."""
RUNS_PER_BLOCK = 1024
"""Runs between two files, about: a minute of work, and a bound on memory."""
_KEPT = ("loss", "camera_motion_m2_s2", "dynamic_margin", "is_deleted", "is_moving", "is_finite")
"""What a file of theirs holds at least."""


def evaluate(
    scenarios: Mapping[str, Scenario],
    config: FilterConfig,
    settings: Settings,
    *,
    objective: Objective | None = None,
    num_seeds: int = 25,
    key: PRNGKeyArray,
    directory: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Any:
    """Run every setting in every scene for every seed, with hard decisions whatever `config.smoothing` says.

    Args:
        scenarios: scenes by name, which differ in numbers only.
        config: the filter.
        settings: the numbers that the settings are made of.
        objective: what a run costs; soft F1 of the tracks if None, which of hard decisions is 1 - F1.
        num_seeds: runs of each setting in each scene, at least 1.
        key: base key.
        directory: where finished blocks are kept, and looked for.
        progress: called with (settings done, settings in all).

    Returns: xarray.Dataset with the dimensions (setting, scene, seed): the figures of `summary.per_run`, the `loss`
        and `camera_motion_m2_s2`; by feature as well `dynamic_margin`, `is_deleted` and `is_moving` (see `detection`).
        The paths are coordinates.

    Raises:
        ValueError: for arguments that make no sense, before anything compiles; or if the directory holds blocks of
            other settings.
        OSError: if the directory cannot be written.
        ModuleNotFoundError: if xarray is not installed.
    """
    xr = import_xarray()
    objective = objective or Objective()
    columns = _columns(scenarios, config, settings, num_seeds, key)
    config = dataclasses.replace(config, smoothing="hard", reverse_mode=False)
    if directory is not None:
        remove_leftovers(Path(directory), "settings_*.nc")
    blocks, num_settings = [], len(next(iter(columns.values())))
    for first, end in _blocks(num_settings, len(scenarios) * num_seeds):
        part = {path: values[first:end] for path, values in columns.items()}
        origin = _origin(scenarios, config, part, objective, num_seeds, key)
        path = None if directory is None else Path(directory) / f"settings_{first:05d}-{end - 1:05d}.nc"
        if path is not None and path.is_file():
            block = load(path, _KEPT)
            refuse_other_settings(path, block.attrs, origin)
        else:
            block = _run_block(scenarios, config, part, objective, num_seeds, key)
            block = block.assign_coords(setting=np.arange(first, end)).assign_attrs(origin)
            if path is not None:
                save(block, path)
        blocks.append(block)
        if progress is not None:
            progress(end, num_settings)
    return xr.concat(blocks, "setting", data_vars="minimal", coords="minimal", compat="override", combine_attrs="drop")


def stacked(scenarios: Mapping[str, Scenario]) -> Scenario:
    """Scenes as one, with a leading axis.

    Raises:
        ValueError: if there is none, or if they differ in more than numbers.
    """
    if not isinstance(scenarios, Mapping) or not scenarios:
        raise ValueError(f"scenarios={scenarios!r}: give at least one scene by its name, a mapping.")
    for name, scenario in scenarios.items():
        require_kind("scenarios", repr(name), scenario, Scenario, "give a Scenario, e.g. vcjax.scenarios.paper().")
    shapes = {(jax.tree.structure(s), tuple(np.shape(leaf) for leaf in jax.tree.leaves(s))) for s in scenarios.values()}
    if len(shapes) > 1:
        raise ValueError("scenarios differ in more than numbers; give all as many frames and features.")
    return jax.tree.map(lambda *leaves: np.stack(leaves), *scenarios.values())


def scene(scenes: Scenario, number: Array) -> Scenario:
    """One of stacked scenes."""
    return jax.tree.map(lambda leaves: jnp.asarray(leaves)[number], scenes)


def _columns(scenarios, config, settings: Settings, num_seeds: int, key) -> dict[str, np.ndarray]:
    """The settings as arrays; each is tried, so that one out of range is refused here."""
    require_key("evaluate", key)
    require_kind("evaluate", "config", config, FilterConfig, "give a FilterConfig.")
    stacked(scenarios)
    if not isinstance(num_seeds, int | np.integer) or num_seeds < 1:
        raise ValueError(f"evaluate(num_seeds={num_seeds!r}): give at least one seed, a whole number.")
    if not isinstance(settings, Mapping) or not settings:
        raise ValueError(f"evaluate(settings={settings!r}): give at least one path with its values.")
    columns = {path: np.asarray(values, float) for path, values in settings.items()}
    lengths = {values.shape for values in columns.values()}
    if len(lengths) > 1 or any(len(shape) != 1 or shape[0] == 0 for shape in lengths):
        raise ValueError("evaluate(settings): give every path a list of values, all of one length, at least 1.")
    for scenario in scenarios.values():
        experiment = Experiment(scenario, config)
        require_paths("evaluate", experiment, columns)
        for values in zip(*columns.values(), strict=True):
            replace_at(experiment, dict(zip(columns, values, strict=True)))
    return columns


def _blocks(num_settings: int, runs_each: int) -> Iterator[tuple[int, int]]:
    """First setting and end of each block."""
    size = max(1, RUNS_PER_BLOCK // runs_each)
    yield from ((first, min(first + size, num_settings)) for first in range(0, num_settings, size))


def _run_block(scenarios, config, columns, objective: Objective, num_seeds: int, key) -> Any:
    """The runs of some settings, as figures."""
    import xarray as xr

    from vcjax.study.summary import per_run

    num_settings = len(next(iter(columns.values())))
    shape = (num_settings, len(scenarios), num_seeds)
    setting, number, seed = (axis.ravel() for axis in np.indices(shape))
    lanes = {path: values[setting] for path, values in columns.items()} | {"scene": number}
    found = run_lanes(Partial(_run_lane, stacked(scenarios), config, objective), lanes, seed, key)
    found = {name: value.reshape(*shape, *value.shape[1:]) for name, value in found.items()}
    outer = ("setting", "scene", "seed")
    kinds = ((PER_FRAME, "frame"), (PER_FEATURE, "feature"), (PER_RUN, None))
    dims = {name: (*outer, axis) if axis else outer for names, axis in kinds for name in names}
    dims |= {"is_moving": (*outer, "feature"), "loss": outer, "camera_motion_m2_s2": outer}
    runs = xr.Dataset({name: (dims[name], found[name]) for name in dims})
    figures = per_run(runs).assign(
        loss=runs.loss.where(runs.is_finite),
        camera_motion_m2_s2=runs.camera_motion_m2_s2,
        map_full_frames=runs.map_full_frames,
        dynamic_margin=runs.dynamic_margin.where(runs.is_finite),
        is_deleted=(runs.first_deleted > 0) & runs.is_finite,
        is_moving=runs.is_moving.isel(setting=0, seed=0),
    )
    coordinates: dict[str, Any] = {path: ("setting", values) for path, values in columns.items()}
    return figures.assign_coords(coordinates | {"scene": list(scenarios), "seed": np.arange(num_seeds)})


def _run_lane(scenes: Scenario, config: FilterConfig, objective: Objective, lane: dict[str, Array], key) -> dict:
    """One run of one setting in one scene."""
    values = {path: value for path, value in lane.items() if path != "scene"}
    experiment = replace_at(Experiment(scene(scenes, lane["scene"]), config), values)
    info, truth = simulate_and_filter(experiment, key)
    scenario = experiment.scenario
    costs = {"loss": objective(scenario, info, truth), "camera_motion_m2_s2": camera_motion_m2_s2(scenario)}
    return metrics_of(experiment, info, truth) | costs


def _origin(scenarios, config, columns, objective: Objective, num_seeds: int, key) -> dict[str, Any]:
    """What a block comes from, as it is kept beside it."""
    return provenance(key) | {
        "scenarios": json.dumps({name: describe(scenario) for name, scenario in scenarios.items()}),
        "config": json.dumps(describe(config)),
        "settings": json.dumps({path: values.tolist() for path, values in columns.items()}),
        "objective": json.dumps(describe(objective)),
        "num_seeds": num_seeds,
    }
