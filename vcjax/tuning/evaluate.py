"""Settings by what they do: runs with hard decisions of every setting in every scene for every seed.

A setting is a choice of some numbers of scenario and configuration, named by their paths as in a sweep. All see the
same seeds, so that their differences are paired. With a directory, every finished block of settings is kept there, and
work that was stopped goes on with the next.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, PRNGKeyArray

from vcjax.fields import require_key, require_kind, require_single, require_whole
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario
from vcjax.storage import remove_leftovers
from vcjax.study import roc
from vcjax.study.monte_carlo import metrics_of, run_lanes, simulate_and_filter
from vcjax.study.results import (
    PER_FEATURE,
    PER_FRAME,
    PER_RUN,
    import_xarray,
    load,
    save,
)
from vcjax.study.sweep import Experiment, replace_at, require_paths
from vcjax.tuning.blocks import (
    KEPT,
    Settings,
    as_directory,
    blocks_of,
    check_blocks,
    file_name,
    hard,
    origin_of,
)
from vcjax.tuning.losses import Objective, camera_motion_m2_s2

ALL = "all scenes"
"""What the scenes are called together; none of them may be called so."""


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
        and `camera_motion_m2_s2`; by feature as well `track_score` (see `roc.track_scores`), `is_deleted` and
        `is_moving`. The paths are coordinates.

    Raises:
        ValueError: for arguments that make no sense, before anything compiles; or if the directory holds blocks of
            other settings.
        OSError: if the directory cannot be written.
        ModuleNotFoundError: if xarray is not installed.
    """
    xr = import_xarray()
    directory = as_directory("evaluate", directory)
    objective = Objective() if objective is None else objective
    columns = _columns(scenarios, config, settings, num_seeds, key)
    require_kind("evaluate", "objective", objective, Objective, "give an Objective, e.g. Objective(position=2.0).")
    require_single("evaluate", objective)
    config = hard(config)
    blocks, num_settings = [], len(next(iter(columns.values())))
    if directory is not None:
        check_blocks(
            directory, scenarios, config, columns, num_settings, objective=objective, num_seeds=num_seeds, key=key
        )
        remove_leftovers(directory, "settings_*.nc")
    for first, end in blocks_of(num_settings, len(scenarios) * num_seeds):
        part = {path: values[first:end] for path, values in columns.items()}
        origin = origin_of(scenarios, config, part, objective, num_seeds, key)
        path = None if directory is None else directory / file_name(first, end)
        if path is not None and path.is_file():
            block = load(path, KEPT)
        else:
            block = _run_block(scenarios, config, part, objective, num_seeds, key)
            block = block.assign_coords(setting=np.arange(first, end)).assign_attrs(origin)
            if path is not None:
                save(block, path)
        blocks.append(block)
        if progress is not None:
            progress(end, num_settings)
    return xr.concat(blocks, "setting", data_vars="minimal", coords="minimal", compat="override", combine_attrs="drop")


def stacked(scenarios: Mapping[str, Scenario], owner: str = "evaluate") -> Scenario:
    """Scenes as one, with a leading axis.

    Raises:
        ValueError: naming the owner; if there is none, one is a batch or has no name of its own, or they differ in more
            than numbers.
    """
    remedy = "give at least one scene by its name, a mapping."
    require_kind(owner, "scenarios", scenarios, Mapping, remedy)
    if not scenarios:
        raise ValueError(f"{owner}(scenarios={{}}): {remedy}")
    for name, scenario in scenarios.items():
        label = f"scenarios[{name!r}]"
        if not isinstance(name, str) or name == ALL:
            raise ValueError(f"{owner}, {label}: give each scene a name, a text other than {ALL!r}.")
        require_kind(owner, label, scenario, Scenario, "give a Scenario, e.g. vcjax.scenarios.paper().")
        require_single(f"{owner}, {label}", scenario)
    shapes = {(jax.tree.structure(s), tuple(np.shape(leaf) for leaf in jax.tree.leaves(s))) for s in scenarios.values()}
    if len(shapes) > 1:
        raise ValueError(
            "scenarios differ in more than numbers; give all as many frames, features and movers, and all a course of "
            "as many legs or none."
        )
    return jax.tree.map(lambda *leaves: np.stack(leaves), *scenarios.values())


def scene(scenes: Scenario, number: Array) -> Scenario:
    """One of stacked scenes."""
    return jax.tree.map(lambda leaves: jnp.asarray(leaves)[number], scenes)


def _columns(scenarios, config, settings: Settings, num_seeds: int, key) -> dict[str, np.ndarray]:
    """The settings as arrays; each is tried, so that one out of range is refused here."""
    require_key("evaluate", key)
    require_kind("evaluate", "config", config, FilterConfig, "give a FilterConfig.")
    require_single("evaluate", config)
    stacked(scenarios)
    require_whole("evaluate", "num_seeds", num_seeds, 1)
    remedy = "give at least one path with its values, a mapping."
    require_kind("evaluate", "settings", settings, Mapping, remedy)
    if not settings:
        raise ValueError(f"evaluate(settings={{}}): {remedy}")
    if "config.temperature" in settings:
        raise ValueError("evaluate(settings): config.temperature smooths, and has no effect on hard decisions.")
    columns = {path: as_numbers(values) for path, values in settings.items()}
    lengths = {values.shape for values in columns.values()}
    if len(lengths) > 1 or any(len(shape) != 1 or shape[0] == 0 for shape in lengths):
        raise ValueError("evaluate(settings): give every path a list of values, all of one length, at least 1.")
    for scenario in scenarios.values():
        experiment = Experiment(scenario, config)
        require_paths("evaluate", experiment, columns)
        for values in zip(*columns.values(), strict=True):
            replace_at(experiment, dict(zip(columns, values, strict=True)))
    return columns


def as_numbers(values: object) -> np.ndarray:
    """A list of numbers as an array; an empty one of what is none."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        return np.empty(0)


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
        track_score=roc.track_scores(runs),
        is_deleted=(runs.first_deleted > 0) & runs.is_finite,
        is_moving=runs.is_moving.isel(seed=0),
    )
    coordinates: dict[str, Any] = {path: ("setting", values) for path, values in columns.items()}
    return figures.assign_coords(coordinates | {"scene": list(scenarios), "seed": np.arange(num_seeds)})


def _run_lane(scenes: Scenario, config: FilterConfig, objective: Objective, lane: dict[str, Array], key) -> dict:
    """One run of one setting in one scene."""
    values = {path: value for path, value in lane.items() if path != "scene"}
    experiment = replace_at(Experiment(scene(scenes, lane["scene"]), config), values)
    state, info, truth = simulate_and_filter(experiment, key)
    scenario = experiment.scenario
    costs = {"loss": objective(scenario, info, truth), "camera_motion_m2_s2": camera_motion_m2_s2(scenario)}
    return metrics_of(experiment, state, info, truth) | costs
