"""Monte-Carlo runs small enough for tests, which share their shapes and so their compilations: one for each gate."""

import dataclasses
from contextlib import contextmanager
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from quick import QUICK

from vcjax.filter.config import FilterConfig
from vcjax.filter.run import run
from vcjax.filter.slam import start
from vcjax.gates.gate import AbstractGate
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.simulation.scenarios import Scenario, paper
from vcjax.simulation.simulate import simulate
from vcjax.study import monte_carlo as module
from vcjax.study import reproduce
from vcjax.study.paper import Cell, cells
from vcjax.study.reproduce import cell_experiment
from vcjax.study.results import RUN_VARIABLES
from vcjax.study.sweep import Experiment

NUM_SEEDS = 3
"""Runs of an experiment in most tests."""
NUM_FRAMES = 12
NUM_FEATURES = 162
MOVERS = [21, 23, 30, 32, 102, 104]
NUM_CELLS = 4
"""Those that `make_tiny` leaves of the paper's."""
CAPACITIES = {"max_landmarks": 24, "max_updates": 6}
MEASURES = RUN_VARIABLES
"""All that a run is reduced to."""
# Thresholds so low that a few frames hold recovered, dynamic and inconsistent features.
STRICT = VirtualCorrection(th1=1.0, th2=0.7)

simulate_once, run_once = jax.jit(simulate, compiler_options=QUICK), jax.jit(run, compiler_options=QUICK)
start_once = jax.jit(start, compiler_options=QUICK)
# The inside of `monte_carlo` as it is, but compiled quickly.
module._run_lanes = jax.jit(
    module._run_lanes.__wrapped__, static_argnames=("mesh", "batch_size"), compiler_options=QUICK
)

_compiled = 0


def scenario(**options) -> Scenario:
    """A few frames of one of the paper's scenarios, with six features that move near its start."""
    return paper(**{"dynamic": "lateral", "dynamic_set": MOVERS, "num_frames": NUM_FRAMES, **options})


def config(gate: AbstractGate | None = None, **options) -> FilterConfig:
    """A filter with a small map."""
    return FilterConfig(gate=VirtualCorrection() if gate is None else gate, **{**CAPACITIES, **options})


def run_strict(**options):
    """`monte_carlo` of the default scenario and the strict gate, one call's worth of seeds."""
    arguments = {"num_seeds": NUM_SEEDS, "key": jax.random.key(7), **options}
    return module.monte_carlo(scenario(), config(STRICT), **arguments)


def tiny_experiment(experiment: Experiment) -> Experiment:
    """An experiment cut down to a few frames and a small map."""
    return Experiment(
        dataclasses.replace(experiment.scenario, num_frames=NUM_FRAMES),
        dataclasses.replace(experiment.config, **CAPACITIES),
    )


def make_tiny(patch: pytest.MonkeyPatch) -> None:
    """Make `reproduce` small: only the cells of the robot's forward motion, few frames, and calls of one size."""
    patch.setattr(reproduce, "cells", some_cells)
    patch.setattr(reproduce, "cell_experiment", lambda cell: tiny_experiment(cell_experiment(cell)))
    patch.setattr(module, "LANES_PER_CALL", NUM_SEEDS)


def some_cells(tables=(2, 3, 4, 5)) -> list[Cell]:
    """The cells of Table 2 with the robot's forward motion."""
    return [cell for cell in cells(tables) if cell.robot_motion == "forward" and cell.dynamic_motion is None]


def assert_same_runs(found, expected, **tolerance) -> None:
    """All measures of two data sets (or mappings of arrays) agree: exactly, unless a tolerance is given."""
    for name in MEASURES:
        np.testing.assert_allclose(found[name], expected[name], **{"rtol": 0, **tolerance}, err_msg=name)


@contextmanager
def compilations():
    """Counts what XLA compiles in a block: `.num` of what it gives, after the block."""
    counted = SimpleNamespace(num=-_compiled)
    yield counted
    counted.num += _compiled


def _count(event: str, duration_secs: float, **_) -> None:
    global _compiled
    _compiled += event == "/jax/core/compile/backend_compile_duration"


jax.monitoring.register_event_duration_secs_listener(_count)
