"""The landscape of an objective over two numbers: a grid of settings, every point judged by hard decisions."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import PRNGKeyArray

from vcjax.fields import require_key, require_kind
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario
from vcjax.study.results import import_xarray
from vcjax.tuning.blocks import as_directory
from vcjax.tuning.choice import Choice, Seeds, Setting, choose, mean_of_scenes, setting_of, without_failed
from vcjax.tuning.evaluate import as_numbers, evaluate
from vcjax.tuning.intervals import Interval
from vcjax.tuning.losses import Objective
from vcjax.tuning.problem import require_movers


def search(
    scenarios: Mapping[str, Scenario],
    config: FilterConfig,
    axes: Mapping[str, Sequence[float] | np.ndarray],
    *,
    objective: Objective | None = None,
    seeds: Seeds | None = None,
    key: PRNGKeyArray,
    directory: str | Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Choice:
    """Run a grid over two numbers, take its best point, and compare it with the setting that was there before.

    Args:
        scenarios: scenes by name, which differ in numbers only.
        config: the filter; it decides hard.
        axes: two paths of numeric leaves → the values they take.
        objective: what is to be small; F1 of the tracks if None.
        seeds: runs of each scene at every point, and of the comparison.
        key: base key.
        directory: where finished blocks are kept, and looked for.
        progress: called with what is done, and how many settings of how many.

    Raises:
        ValueError: for arguments that make no sense, such as a scene without movers where these are what the objective
            is about, before anything compiles.
        OSError: if the directory cannot be written.
        ModuleNotFoundError: if xarray is not installed.
    """
    import_xarray()
    require_key("search", key)
    values = _axes(axes)
    before = setting_of(scenarios, config, list(values))
    objective = Objective() if objective is None else objective
    require_kind("search", "objective", objective, Objective, "give an Objective, e.g. Objective(position=2.0).")
    require_movers("search", scenarios, objective, values.get("scenario.movers.speed_m_s", ()))
    grid = np.stack([axis.ravel() for axis in np.meshgrid(*values.values(), indexing="ij")], axis=1)
    candidates = [before, *(dict(zip(values, point.tolist(), strict=True)) for point in grid)]
    return choose(
        scenarios,
        config,
        candidates,
        objective=objective,
        seeds=Seeds() if seeds is None else seeds,
        key=key,
        directory=as_directory("search", directory),
        progress=progress,
    )


def means(grid: Any) -> Any:
    """Every figure at every point of a grid: its mean over the seeds that did not fail in any scene, then over scenes.

    NaN where a scene has no seed with the figure; the `loss` where any run failed, as in the choice of the best.
    """
    points = mean_of_scenes(without_failed(grid).mean("seed"))
    return points.assign(loss=grid.loss.mean(("scene", "seed"), skipna=False))


def as_grid(choice: Choice) -> Any:
    """The candidates of a `search` with the two paths as dimensions: (x, y, scene, seed); `before` is left out."""
    return _unstacked(choice.candidates.isel(setting=slice(1, None)), tuple(choice.before))


def around(
    scenarios: Mapping[str, Scenario],
    config: FilterConfig,
    setting: Setting,
    intervals: Mapping[str, Interval],
    *,
    objective: Objective,
    num_points: int,
    num_seeds: int,
    key: PRNGKeyArray,
    directory: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Any:
    """The landscape over two intervals, at the middles of equal cells; the other numbers of a setting stay as they are.

    Args:
        scenarios: scenes by name.
        config: the filter; it decides hard.
        setting: numbers by their paths.
        intervals: two of the paths, and between what values they go.
        objective: what is drawn beside detection and position.
        num_points: values along each interval, at least 2.
        num_seeds: runs of each scene at every point.
        key: base key.
        directory: where finished blocks are kept.
        progress: called with settings done, and settings in all.

    Returns: runs (x, y, scene, seed), as `as_grid`.
    """
    middles = (np.arange(num_points) + 0.5) / num_points
    axes = [interval.at(middles) for interval in intervals.values()]
    grid = dict(zip(intervals, (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")), strict=True))
    rest = {path: np.full(num_points**2, value) for path, value in setting.items() if path not in grid}
    runs = evaluate(
        scenarios,
        config,
        grid | rest,
        objective=objective,
        num_seeds=num_seeds,
        key=key,
        directory=directory,
        progress=progress,
    )
    return _unstacked(runs.drop_vars(list(rest)), tuple(intervals))


def _unstacked(runs: Any, paths: tuple[str, ...]) -> Any:
    """Settings as a grid over two paths."""
    return runs.set_index(setting=list(paths)).unstack("setting").transpose(*paths, ...)


def _axes(axes: Mapping[str, Sequence[float] | np.ndarray]) -> dict[str, np.ndarray]:
    """The grid's values.

    Raises:
        ValueError: unless they are two lists of numbers that differ.
    """
    remedy = "give two paths with their values, a mapping."
    require_kind("search", "axes", axes, Mapping, remedy)
    if len(axes) != 2:
        raise ValueError(f"search(axes={list(axes)}): {remedy}")
    values = {path: as_numbers(listed) for path, listed in axes.items()}
    for path, listed in values.items():
        if listed.ndim != 1 or listed.size == 0 or not np.all(np.isfinite(listed)) or np.any(np.diff(listed) <= 0):
            raise ValueError(f"search(axes[{path!r}]): give at least one number, in rising order.")
    return values
