"""Answers to `tune`, `search` and `evaluate`, made at once from runs of the small search and invented losses."""

import itertools

import numpy as np
import xarray as xr
from small_search import grid_search, invented_runs

from vcjax.study.results import describe
from vcjax.tuning.choice import Choice, Setting, setting_of
from vcjax.tuning.descent import Step
from vcjax.tuning.problem import problem_of
from vcjax.tuning.tune import End, Tuned

NUM_RUNS = 1000
"""Runs in the descents that `tuned` tells of."""


def times(setting: Setting, factor: float) -> Setting:
    """Another setting."""
    return {path: factor * value for path, value in setting.items()}


def judged(given, *failed: tuple[int, int, int]) -> xr.Dataset:
    """What `evaluate` gives; the runs at some places (setting, scene, seed) went non-finite."""
    runs = _runs(given.scenarios, given.settings, given.num_seeds)
    is_finite = np.ones(runs.loss.shape, bool)
    for place in failed:
        is_finite[place] = False
    return runs.assign(loss=runs.loss.where(is_finite), is_finite=(runs.loss.dims, is_finite))


def tuned(given) -> Tuned:
    """What `tune` gives: two descents of two steps, since one start is left out, and the end of the second is best."""
    before = setting_of(given.scenarios, given.config, list(given.parameters))
    problem_of(given.scenarios, given.config, given.parameters, given.objective).to_free(before)  # refuses bad ones
    ends, near = [times(before, 1.1), times(before, 1.2)], [times(before, 1.3)] * given.num_near
    gradient, error, weight = (dict.fromkeys(before, each) for each in (0.1, 0.02, 1.0))
    descents = [[Step(at, 1.0, 0.5, 0.1, gradient, error, weight, 0) for at in (before, end)] for end in ends]
    choice = _chosen(given, [before, *ends, *near], ends[1])
    return Tuned(descents, [End(end, 0.4, 0.1, True) for end in ends], near, choice, NUM_RUNS, {}, [before])


def best_of_grid(given) -> Choice:
    """What `search` gives: the best has the first value of the first axis, and the second of the second."""
    before = setting_of(given.scenarios, given.config, list(given.axes))
    points = itertools.product(*(np.asarray(axis).tolist() for axis in given.axes.values()))
    candidates = [before, *(dict(zip(given.axes, point, strict=True)) for point in points)]
    return _chosen(given, candidates, candidates[2])


def _chosen(given, candidates: list[Setting], after: Setting) -> Choice:
    given.progress("held out", 1, 2)
    asked = ((candidates, given.seeds.choosing), ([candidates[0], after], given.seeds.held_out))
    runs = [
        _runs(given.scenarios, {path: [setting[path] for setting in settings] for path in after}, num_seeds)
        for settings, num_seeds in asked
    ]
    origin = {"objective": describe(given.objective), "seeds": describe(given.seeds)}
    return Choice(candidates[0], after, runs[0], runs[1], origin)


def _runs(scenarios, columns, num_seeds: int) -> xr.Dataset:
    runs, names = invented_runs(grid_search(), columns, num_seeds), list(scenarios)
    runs = runs.isel(scene=np.arange(len(names)) % runs.sizes["scene"]).assign_coords(scene=names)
    return runs.assign(loss=(runs.loss.dims, np.random.default_rng(1).uniform(0.2, 0.6, runs.loss.shape)))
