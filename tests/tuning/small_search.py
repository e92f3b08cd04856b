"""A search and a tuning that are small: two scenes of eight frames, two thresholds."""

import functools
from collections.abc import Mapping, Sequence

import jax
import numpy as np
import tiny_runs
import xarray as xr

from vcjax.tuning.choice import Choice, Seeds
from vcjax.tuning.intervals import Interval
from vcjax.tuning.landscape import search
from vcjax.tuning.losses import Objective

KEY = jax.random.key(5)
SCENES = {f"{v} m/s": tiny_runs.scenario(dynamic_speed_m_s=v, num_frames=8) for v in (0.5, 1.0)}
SOFT = tiny_runs.config(tiny_runs.STRICT, smoothing="soft")
OBJECTIVE = Objective(track_f1=1.0, position=2.0)
TH1, TH2 = "config.gate.th1", "config.gate.th2"
INTERVALS = {TH1: Interval(0.2, 50.0, is_log=True), TH2: Interval(0.1, 20.0, is_log=True)}
SEEDS = Seeds(2, 3)


@functools.cache
def grid_search() -> Choice:
    """Six points of a grid and the setting before; made once."""
    return search(SCENES, SOFT, {TH1: [0.5, 4.0], TH2: [0.4, 1.0, 6.0]}, objective=OBJECTIVE, seeds=SEEDS, key=KEY)


def invented_runs(found: Choice, columns: Mapping[str, Sequence[float] | np.ndarray], num_seeds: int) -> xr.Dataset:
    """Runs of a choice as if they were of other settings and as many seeds."""
    made, number = found.held_out, len(next(iter(columns.values())))
    runs = made.isel(setting=np.zeros(number, int), seed=np.arange(num_seeds) % made.sizes["seed"])
    runs = runs.drop_vars([TH1, TH2]).assign_coords(setting=np.arange(number), seed=np.arange(num_seeds))
    return runs.assign_coords({path: ("setting", np.asarray(values)) for path, values in columns.items()})
