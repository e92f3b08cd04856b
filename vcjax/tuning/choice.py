"""Choosing among settings, and what the choice is worth: judged by hard decisions on seeds held out, in pairs.

However candidates were found, by gradient or on a grid, the best of them looks better than it is on the seeds that
chose it. So it is compared with the setting that was there before on seeds that nothing else has seen.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from vcjax.fields import require_count, require_key, require_kind
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario
from vcjax.study import roc
from vcjax.study.results import describe, provenance
from vcjax.study.sweep import Experiment, number_at, require_paths
from vcjax.tuning.blocks import as_directory, check_blocks, hard
from vcjax.tuning.evaluate import ALL, evaluate, stacked
from vcjax.tuning.losses import Objective

Setting = dict[str, float]
"""Path of a numeric leaf → its value."""
FALSE_RATE = 0.01
"""Share of the static tracks called dynamic at which the share of the movers found is reported."""
COMPARED = {
    "loss": "objective",
    "detection_f1": "F1",
    "detection_auc": "AUC",
    "dynamic_found_per_run": "movers found",
    "static_deleted_per_run": "static deleted",
    "detection_delay_frames": "delay, frames",
    "position_rmse_cm": "position, cm",
    "orientation_error_deg": "orientation, deg",
    "anees_position": "ANEES position",
    "camera_motion_m2_s2": "camera motion, m²/s²",
}
"""Figures in which settings are compared, and their labels."""
RECALL = "recall_at_1_percent_static"
"""Share of the movers found at `FALSE_RATE`."""


class Choice(NamedTuple):
    """A setting chosen among candidates."""

    before: Setting
    """What scenes and configuration had."""
    after: Setting
    """The candidate of least mean loss; `before`, which is one of them, where nothing is better."""
    candidates: Any
    """Runs (setting, scene, seed) of all candidates, the first being `before`; see `evaluate`."""
    held_out: Any
    """Runs of `before` (setting 0) and `after` (setting 1) on other seeds."""
    origin: Mapping[str, Any]
    """What it comes from, as plain values: version, key, scenes, filter, objective, numbers of seeds."""


class Seeds(eqx.Module):
    """How many runs of each scene there are, for each setting."""

    choosing: int = eqx.field(static=True, default=48)
    """To choose among the candidates: cheap beside the descents, and with few of them luck chooses."""
    held_out: int = eqx.field(static=True, default=100)
    """To compare the choice with what was there before."""

    def __check_init__(self):
        for name in ("choosing", "held_out"):
            require_count(self, name, 1)


def choose(
    scenarios: Mapping[str, Scenario],
    config: FilterConfig,
    candidates: Sequence[Setting],
    *,
    objective: Objective,
    seeds: Seeds,
    key: PRNGKeyArray,
    directory: str | Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Choice:
    """Run all candidates, take the best, and run it and the first of them on seeds held out.

    Args:
        scenarios: scenes by name.
        config: the filter; it decides hard.
        candidates: settings of the same paths, at least one, the first of them the one to compare with.
        objective: what is to be small.
        seeds: how many.
        key: base key. The seeds held out depend on it alone, and not on the candidates.
        directory: where finished blocks are kept, in `candidates` and `held_out`.
        progress: called with what is done, and how many settings of how many.

    Raises:
        ValueError: as `evaluate`, for candidates that are no such settings, or if every one has a run that is not
            finite.
    """
    _require_settings(candidates)
    require_key("choose", key)
    require_kind("choose", "seeds", seeds, Seeds, "give Seeds, e.g. Seeds(choosing=48, held_out=100).")
    (_, choosing_key), (_, held_out_key) = _kinds(seeds, key)
    directory = as_directory("choose", directory)
    stacked(scenarios, "choose")
    if directory is not None:
        check_directory(directory, scenarios, config, len(candidates), objective=objective, seeds=seeds, key=key)

    def judge(name: str, settings: Sequence[Setting], num_seeds: int, key) -> Any:
        def told(done: int, total: int) -> None:
            if progress is not None:
                progress(name, done, total)

        return evaluate(
            scenarios,
            config,
            {path: [setting[path] for setting in settings] for path in settings[0]},
            objective=objective,
            num_seeds=num_seeds,
            key=key,
            directory=None if directory is None else directory / name.replace(" ", "_"),
            progress=told,
        )

    runs = judge("candidates", candidates, seeds.choosing, choosing_key)
    # A candidate with a run that failed is not chosen: the others' mean would flatter it.
    loss = runs.loss.mean(("scene", "seed"), skipna=False).values
    if np.all(np.isnan(loss)):
        raise ValueError("every candidate has runs that did not stay finite; start elsewhere.")
    after = candidates[int(np.nanargmin(loss))]
    held_out = judge("held out", [candidates[0], after], seeds.held_out, held_out_key)
    origin = provenance(key) | {
        "scenarios": {name: describe(scenario) for name, scenario in scenarios.items()},
        "config": describe(hard(config)),
        "objective": describe(objective),
        "seeds": describe(seeds),
    }
    return Choice(candidates[0], after, runs, held_out, origin)


def check_directory(
    directory: Path,
    scenarios: Mapping[str, Scenario],
    config: FilterConfig,
    num_candidates: int,
    *,
    objective: Objective,
    seeds: Seeds,
    key: PRNGKeyArray,
) -> None:
    """Refuse a directory that `choose` could not use, as far as that is known before the candidates are.

    Arguments as of `choose`.

    Raises:
        ValueError: naming what is of other work.
        OSError: if the directory cannot be written.
    """
    for name, num, (num_seeds, own_key) in zip(
        ("candidates", "held_out"), (num_candidates, 2), _kinds(seeds, key), strict=True
    ):
        given = {"objective": objective, "num_seeds": num_seeds, "key": own_key}
        check_blocks(directory / name, scenarios, config, None, num, **given)


def _require_settings(candidates: Sequence[Setting]) -> None:
    """Refuse candidates that cannot be compared.

    Raises:
        ValueError: unless they are settings of the same paths, at least one.
    """
    remedy = "give at least one setting, a mapping of paths to numbers; all of the same paths."
    require_kind("choose", "candidates", candidates, Sequence, remedy)
    if not candidates or not all(isinstance(each, Mapping) and set(each) == set(candidates[0]) for each in candidates):
        raise ValueError(f"choose(candidates={list(candidates)!r:.200}): {remedy}")


def _kinds(seeds: Seeds, key: PRNGKeyArray) -> tuple[tuple[int, PRNGKeyArray], tuple[int, PRNGKeyArray]]:
    """Number and base key of the seeds that choose, and of those held out."""
    choosing_key, held_out_key = jax.random.split(key)
    return (seeds.choosing, choosing_key), (seeds.held_out, held_out_key)


def setting_of(scenarios: Mapping[str, Scenario], config: FilterConfig, paths: Sequence[str]) -> Setting:
    """The numbers at some paths, as scenes and configuration have them.

    Raises:
        ValueError: for a path of no number, or a number that differs between the scenes; or if there are no scenes or
            no configuration.
    """
    stacked(scenarios, "settings")
    require_kind("settings", "config", config, FilterConfig, "give a FilterConfig.")
    setting, experiments = {}, [Experiment(scenario, config) for scenario in scenarios.values()]
    require_paths("settings", experiments[0], paths)
    for path in paths:
        values = {number_at(experiment, path) for experiment in experiments}
        if len(values) > 1:
            raise ValueError(f"{path} is {sorted(values)} in the scenes; give all the same.")
        setting[path] = values.pop()
    return setting


def by_scene(runs: Any) -> dict[str, Any]:
    """Every seed's figures in each scene, and over all scenes: `mean_of_scenes` of seeds that failed in none."""
    names = [str(name) for name in runs.scene.values]
    scenes = {name: runs.sel(scene=name)[list(COMPARED)] for name in names}
    return scenes | {ALL: mean_of_scenes(without_failed(runs))}


def without_failed(runs: Any) -> Any:
    """The figures of seeds whose runs stayed finite in all scenes."""
    return runs[list(COMPARED)].where(runs.is_finite.all("scene"))


def mean_of_scenes(figures: Any) -> Any:
    """Means over the scenes in which a figure is found at all, NaN where one of these lacks it.

    As of delays, where no mover was found: the mean of the other scenes would be of other scenes than the rest.
    """
    has = figures.notnull()
    is_asked = has.any([dim for dim in has.dims if dim != "scene"])
    return figures.mean("scene").where((has | ~is_asked).all("scene"))


def tracks_of(runs: Any) -> dict[str, roc.Tracks]:
    """The tracks of one setting's runs for each scene, and of all scenes together.

    There those of a seed whose run failed in any scene are left out.
    """

    def tracks(runs) -> roc.Tracks:
        score = runs.track_score.transpose("seed", ..., "feature")
        is_mover = runs.is_moving.broadcast_like(score).transpose(*score.dims)
        num_seeds = score.sizes["seed"]
        return roc.Tracks(score.values.reshape(num_seeds, -1), is_mover.values.reshape(num_seeds, -1))

    together = runs.assign(track_score=runs.track_score.where(runs.is_finite.all("scene")))
    return {str(name): tracks(runs.sel(scene=name)) for name in runs.scene.values} | {ALL: tracks(together)}
