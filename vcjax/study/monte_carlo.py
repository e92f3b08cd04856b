"""Monte Carlo in one call: all seeds, and all points of a sweep, as one compiled batch.

A **lane** is one run: one seed at one point of the sweep. Lanes are split over the devices; each device works through
its part in small batches. On a CPU a batch is a single lane, so that the lane's covariance stays in cache; on an
accelerator it is all of them. A lane's result depends on its seed number and its numbers only, not on how lanes are
grouped.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from numbers import Integral

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jax.tree_util import Partial
from jaxtyping import Array, PRNGKeyArray

from vcjax.devices import gather, meet, spread
from vcjax.fields import require_key, require_kind, require_single
from vcjax.filter.config import FilterConfig, check_arguments
from vcjax.filter.info import FrameInfo
from vcjax.filter.run import run
from vcjax.filter.state import FilterState
from vcjax.recording import Truth
from vcjax.simulation.scenarios import Scenario
from vcjax.simulation.simulate import simulate
from vcjax.study.metrics import run_metrics
from vcjax.study.results import as_dataset, import_xarray
from vcjax.study.sweep import Experiment, Sweep, check_sweep, replace_at
from vcjax.study.velocity_error import velocity_errors

Work = Callable[[dict[str, Array], PRNGKeyArray], dict[str, Array]]
LANES_PER_CALL = 64
"""Lanes in one compiled call on CPUs: what is finished between two reports of progress."""
LANES_PER_ACCELERATOR = 256
"""Lanes that each accelerator has in one call, at most: a bound on memory."""


def monte_carlo(
    scenario: Scenario,
    config: FilterConfig | None = None,
    *,
    num_seeds: int = 25,
    key: PRNGKeyArray,
    first_seed: int = 0,
    sweep: Sweep | None = None,
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm] (jax.Device is untyped)
    progress: Callable[[int, int], None] | None = None,
):
    """Run a scenario for many seeds, and for every point of a sweep, and compare with the truth.

    Seed i uses `fold_in(key, i)` whatever scenario, gate or sweep point it runs: differences are paired (common random
    numbers). Nothing compiles again for other values of numeric leaves.

    Args:
        scenario: the experiment.
        config: filter configuration; the paper's VC filter if None.
        num_seeds: number of runs for each point of the sweep, at least 1.
        key: base key, e.g. `jax.random.key(0)`.
        first_seed: number of the first seed; seeds are `first_seed … first_seed + num_seeds - 1`.
        sweep: path of a numeric leaf → values, e.g. `{"config.gate.th1": [6, 9, 12],
            "scenario.oscillation.amplitude_m": [0, 0.05]}`; several paths span a grid.
        devices: devices to use; all there are if None, those of other processes too (see below).
        progress: called with (lanes done, lanes in all).

    In a program of several processes (`jax.distributed.initialize`), each process makes the same call, works on its
    own part of the lanes, and returns them all; the first time they have 30 s to find each other. With
    `devices=jax.local_devices()` a process works alone.

    Returns:
        xarray.Dataset with dimensions (*sweep paths, seed, frame or feature); see `results.as_dataset`.

    Raises:
        ValueError: for a scenario, configuration or key that is none, a bad number of seeds or list of devices,
            unknown sweep paths or values out of range, before anything compiles.
        ModuleNotFoundError: if xarray is not installed.
    """
    import_xarray()  # where it is missing, say so now and not after the work
    config = FilterConfig() if config is None else config
    _check_arguments(scenario, config, num_seeds, first_seed, key, devices)
    experiment = Experiment(scenario, config)
    values = check_sweep(experiment, sweep or {})
    seeds = np.arange(first_seed, first_seed + num_seeds)
    axes = np.meshgrid(*values.values(), seeds, indexing="ij")
    shape = axes[0].shape
    *swept, lane_seed = (axis.ravel() for axis in axes)
    swept = dict(zip(values, swept, strict=True))
    lanes = run_lanes(Partial(_run_point, experiment), swept, lane_seed, key, devices, progress)
    lanes = {name: value.reshape(*shape, *value.shape[1:]) for name, value in lanes.items()}
    return as_dataset(lanes, experiment, values, seeds, key)


def _check_arguments(scenario, config, num_seeds: int, first_seed: int, key, devices: Sequence | None) -> None:
    """Refuse what `monte_carlo` cannot run, naming argument, value and remedy."""
    require_kind("monte_carlo", "scenario", scenario, Scenario, "give a Scenario, e.g. vcjax.scenarios.paper().")
    require_single("monte_carlo", scenario)
    check_arguments("monte_carlo", config, key)
    require_key("monte_carlo", key)
    if not isinstance(num_seeds, Integral) or num_seeds < 1:
        raise ValueError(f"monte_carlo(num_seeds={num_seeds!r}): give at least one seed, a whole number.")
    if not isinstance(first_seed, Integral) or not 0 <= first_seed <= 2**32 - num_seeds:
        raise ValueError(f"monte_carlo(first_seed={first_seed!r}): seeds are whole numbers from 0 to 2**32 - 1.")
    if devices is not None and (not isinstance(devices, Sequence | np.ndarray) or len(devices) == 0):
        raise ValueError(f"monte_carlo(devices={devices!r}): give at least one device in a list, or None for all.")


def run_lanes(
    work: Work,
    values: dict[str, np.ndarray],
    seeds: np.ndarray,
    key: PRNGKeyArray,
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm] (jax.Device is untyped)
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, np.ndarray]:
    """Run a list of lanes, in calls of equal size so that one compilation serves any number of them.

    Args:
        work: what is done in each, a function of the lane's values and its seed's key that gives arrays by name. A
            `jax.tree_util.Partial` of a function of some module compiles once for all values of its arguments.
        values: values of each lane, by name.
        seeds: seed number of each lane.
        key: base key.
        devices: devices to use; all there are if None.
        progress: called with (lanes done, lanes in all).

    Returns: what `work` gives, each array with the lanes as leading axis.
    """
    devices = jax.devices() if devices is None else list(devices)
    mesh = Mesh(np.array(devices), ("lane",))
    total, is_cpu = len(seeds), devices[0].platform == "cpu"
    # On a CPU all calls have one size, whatever is asked for; elsewhere empty places cost: only the last call has any.
    places = math.ceil((LANES_PER_CALL if is_cpu else total) / len(devices))
    places = places if is_cpu else min(places, LANES_PER_ACCELERATOR)
    meet(devices)
    done = []
    for first in range(0, total, places * len(devices)):
        new = np.arange(first, min(first + places * len(devices), total))
        lane = _share(new, len(devices), places)
        mine = {name: value[lane] for name, value in values.items()}
        args = spread((mine, seeds[lane].astype(np.uint32), lane >= 0), mesh)
        result = _run_lanes(work, *args, key, mesh, batch_size=1 if is_cpu else places)
        done.append({name: value[lane >= 0] for name, value in gather(result).items()})
        if progress is not None:
            progress(first + len(new), total)
    return {name: np.concatenate([part[name] for part in done]) for name in done[0]}


def _share(lanes: np.ndarray, num_devices: int, places: int) -> np.ndarray:
    """Lanes in order, shared evenly by devices of so many places each; -1 for a place that stays empty."""
    each = math.ceil(len(lanes) / num_devices)
    shared = np.full((num_devices, places), -1)
    for device in range(num_devices):
        part = lanes[device * each : (device + 1) * each]
        shared[device, : len(part)] = part
    return shared.ravel()


# On a CPU lanes are what runs in parallel: sharing each small product between threads as well only costs.
ONE_THREAD_PER_LANE = {"xla_cpu_multi_thread_eigen": False}


@partial(jax.jit, static_argnames=("mesh", "batch_size"), compiler_options=ONE_THREAD_PER_LANE)
def _run_lanes(work, values, seeds, is_there, key, mesh: Mesh, batch_size: int) -> dict[str, Array]:
    def run_lane(lane):
        values, seed, is_there = lane

        def run():
            return work(values, jax.random.fold_in(key, seed))

        # An empty place costs nothing where lanes run one by one.
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(run))
        return jax.lax.cond(is_there, run, lambda: nothing)

    def run_part(*lanes):
        return jax.lax.map(run_lane, lanes, batch_size=None if batch_size == 1 else batch_size)

    lanes = PartitionSpec("lane")
    # Lanes do not talk to each other, so there is nothing to check of what varies over the mesh.
    return jax.shard_map(run_part, mesh=mesh, in_specs=lanes, out_specs=lanes, check_vma=False)(values, seeds, is_there)


def _run_point(experiment: Experiment, swept: dict[str, Array], key: PRNGKeyArray) -> dict[str, Array]:
    """One run at one point of a sweep."""
    return run_one(replace_at(experiment, swept), key)


def run_one(experiment: Experiment, key: PRNGKeyArray) -> dict[str, Array]:
    """One run: simulate, filter, compare with the truth. Pure; the function to differentiate or to batch otherwise."""
    return metrics_of(experiment, *simulate_and_filter(experiment, key))


def metrics_of(experiment: Experiment, state: FilterState, info: FrameInfo, truth: Truth) -> dict[str, Array]:
    """All that is kept of a run, of which `state` is the last, under the names of the results."""
    rate = experiment.scenario.frame_rate_hz
    return run_metrics(state, info, truth) | velocity_errors(experiment.config.detector, info, truth, rate)


def simulate_and_filter(experiment: Experiment, key: PRNGKeyArray) -> tuple[FilterState, FrameInfo, Truth]:
    """One run: the last state, every frame's info, and the truth beside it. Pure."""
    recording, truth = simulate(experiment.scenario, key)
    # Births in random order draw from a key of their own; `simulate` splits the key, which uses up its folds 0 and 1.
    birth_key = jax.random.fold_in(key, 2) if experiment.config.birth_order == "random" else None
    return *run(experiment.config, recording, birth_key), truth
