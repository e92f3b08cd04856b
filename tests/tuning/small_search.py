"""A search and a tuning that are small: two scenes of eight frames, two thresholds."""

import functools

import jax
import tiny_runs

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
