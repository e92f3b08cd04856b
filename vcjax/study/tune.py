"""Tuning numbers of gate and camera by gradient: a smoothed objective, averaged over scenes and fresh seeds.

Each parameter lives in an interval and is moved as a free number (see `intervals`). A step averages the objective and
its gradient (forward mode: a few numbers, many seeds) over a mini-batch of seeds, new in every step, and over all
scenes, and goes down it by Adam; the temperature of the smoothing falls from step to step. What a soft filter says of a
setting is not what the hard filter does with it: look at the result with `monte_carlo`, on seeds that were not tuned
on.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.tree_util import Partial
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vcjax.fields import number, require, require_count, require_key, require_kind
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario
from vcjax.study.intervals import Interval
from vcjax.study.losses import Objective
from vcjax.study.monte_carlo import run_lanes, simulate_and_filter
from vcjax.study.sweep import Experiment, numeric_paths, replace_at


class Schedule(eqx.Module):
    """How long and how fast to go."""

    num_steps: int = eqx.field(static=True, default=40)
    """Steps of the optimiser."""
    seeds_per_step: int = eqx.field(static=True, default=16)
    """Runs of each scene that a step averages."""
    learning_rate: float = eqx.field(converter=number, default=0.1)
    """Of Adam, in the free numbers: about how far x goes in a step. Positive."""
    temperature_start: float = eqx.field(converter=number, default=4.0)
    """τ of the smoothing in the first step, in χ² units; positive."""
    temperature_end: float = eqx.field(converter=number, default=1.0)
    """τ in the last; in between it changes by equal factors."""

    def __check_init__(self):
        for name in ("num_steps", "seeds_per_step"):
            require_count(self, name, 1)
        for name in ("learning_rate", "temperature_start", "temperature_end"):
            require(self, name, lambda v: np.isfinite(v) & (v > 0), "give a positive number.")

    def temperature(self, step: int) -> float:
        """τ of a step."""
        part = step / max(self.num_steps - 1, 1)
        return float(self.temperature_start * (self.temperature_end / self.temperature_start) ** part)


class Step(NamedTuple):
    """One step: where it was taken, and what was found there."""

    parameters: dict[str, float]
    temperature: float
    loss: float
    """Mean of the smoothed objective over the runs that stayed finite."""
    loss_se: float
    """Its standard error over runs."""
    gradient: dict[str, float]
    """By the free numbers."""
    num_failed: int
    """Runs left out because they, or their derivative, went non-finite."""


class Tuned(NamedTuple):
    """What tuning gave."""

    parameters: dict[str, float]
    history: list[Step]

    @property
    def num_skipped(self) -> int:
        """Steps not taken because no run of theirs stayed finite."""
        return sum(not np.isfinite(step.loss) for step in self.history)


def tune(
    scenarios: Scenario | Sequence[Scenario],
    config: FilterConfig,
    parameters: Mapping[str, Interval],
    *,
    objective: Objective | None = None,
    schedule: Schedule | None = None,
    key: PRNGKeyArray,
    progress: Callable[[int, Step], None] | None = None,
) -> Tuned:
    """Tune numbers of scenario and configuration, the same for all scenes, from where they are.

    Step k draws its seeds by `fold_in(key, k)`: equal arguments give equal results.

    Args:
        scenarios: one scene or several, which differ in numbers only (speeds, directions, places).
        config: the filter, with `smoothing` "soft" (a true gradient) or "straight_through" (the hard filter's numbers).
        parameters: path of a numeric leaf, as in a sweep → where it may go.
        objective: what to make small; soft F1 of the tracks if None.
        schedule: steps, seeds, temperatures.
        key: base key.
        progress: called with (steps done, step) after each.

    Returns: the parameters after the last step, and every step.

    Raises:
        ValueError: for hard decisions, scenes that differ in structure, unknown paths, a start outside its interval, or
            an objective that is not finite at the start; all but the last before anything compiles.
    """
    schedule, objective = schedule or Schedule(), objective or Objective()
    scenarios = [scenarios] if isinstance(scenarios, Scenario) else list(scenarios)
    _check_arguments(scenarios, config, parameters, key)
    first = Experiment(scenarios[0], config)
    free = np.array([interval.to_free(_value_at(first, path)) for path, interval in parameters.items()])
    scenes = jax.tree.map(lambda *leaves: np.stack(leaves), *scenarios)
    optimiser = optax.adam(float(schedule.learning_rate))
    state, history = optimiser.init(jnp.asarray(free)), []
    lanes = {"scene": np.repeat(np.arange(len(scenarios)), schedule.seeds_per_step)}
    seeds = np.tile(np.arange(schedule.seeds_per_step), len(scenarios))
    problem = Problem(scenes, config, objective, tuple(parameters), tuple(parameters.values()))
    for k in range(schedule.num_steps):
        temperature = schedule.temperature(k)
        work = Partial(_value_and_gradient, problem, jnp.asarray(free), jnp.asarray(temperature))
        runs = run_lanes(work, lanes, seeds, jax.random.fold_in(key, k))
        step, gradient = _average(runs, _parameters(parameters, free), temperature)
        if not history and not np.isfinite(step.loss):
            raise ValueError(f"tune: the objective is not finite at the start, {step.parameters}; start elsewhere.")
        if np.isfinite(step.loss):  # a step without a finite run is not taken
            update, state = optimiser.update(jnp.asarray(gradient), state)
            free = free + np.asarray(update)
        history.append(step)
        if progress is not None:
            progress(k + 1, step)
    return Tuned(_parameters(parameters, free), history)


class Problem(eqx.Module):
    """What is minimised: scenes (leading axis S), filter, objective, and which numbers are free."""

    scenes: Scenario
    config: FilterConfig
    objective: Objective
    paths: tuple[str, ...] = eqx.field(static=True)
    intervals: tuple[Interval, ...]


def _value_and_gradient(
    problem: Problem, free: Float[Array, " P"], temperature: Float[Array, ""], lane: dict[str, Int[Array, ""]], key
) -> dict[str, Array]:
    """Objective of one run of one scene and its derivative by the free numbers, in forward mode."""
    scenario = jax.tree.map(lambda leaves: jnp.asarray(leaves)[lane["scene"]], problem.scenes)

    def loss(free):
        intervals = zip(problem.paths, problem.intervals, free, strict=True)
        values = {path: interval.to_parameter(x) for path, interval, x in intervals}
        config = eqx.tree_at(lambda c: c.temperature, problem.config, temperature)
        experiment = replace_at(Experiment(scenario, config), values)
        value = problem.objective(experiment.scenario, *simulate_and_filter(experiment, key))
        return value, value

    gradient, value = jax.jacfwd(loss, has_aux=True)(free)
    return {"loss": value, "gradient": gradient}


def _average(runs: dict[str, np.ndarray], parameters: dict[str, float], temperature: float) -> tuple[Step, np.ndarray]:
    """Mean over the runs that stayed finite."""
    is_finite = np.isfinite(runs["loss"]) & np.all(np.isfinite(runs["gradient"]), axis=1)
    num, num_failed = int(is_finite.sum()), int((~is_finite).sum())
    loss, gradient = runs["loss"][is_finite], runs["gradient"][is_finite]
    mean = gradient.mean(axis=0) if num else np.full(gradient.shape[1], np.nan)
    step = Step(
        parameters,
        temperature,
        float(loss.mean()) if num else np.nan,
        float(loss.std(ddof=1) / np.sqrt(num)) if num > 1 else np.nan,
        dict(zip(parameters, mean.tolist(), strict=True)),
        num_failed,
    )
    return step, mean


def _parameters(intervals: Mapping[str, Interval], free: np.ndarray) -> dict[str, float]:
    """The parameters of some free numbers."""
    return {path: float(i.to_parameter(jnp.asarray(x))) for (path, i), x in zip(intervals.items(), free, strict=True)}


def _value_at(tree: Any, path: str) -> float:
    """The number at a path."""
    for name in path.split("."):
        tree = tree[int(name)] if name.isdecimal() else getattr(tree, name)
    return float(tree)


def _check_arguments(scenarios: list, config: FilterConfig, parameters: Mapping[str, Interval], key) -> None:
    """Refuse what cannot be tuned."""
    require_key("tune", key)
    require_kind("tune", "config", config, FilterConfig, "give a FilterConfig with smoothing='soft'.")
    if config.smoothing == "hard" or config.reverse_mode:
        raise ValueError(
            f"tune(config.smoothing={config.smoothing!r}, config.reverse_mode={config.reverse_mode}): give "
            "smoothing 'soft' or 'straight_through', which have a derivative, and reverse_mode=False."
        )
    if not scenarios:
        raise ValueError("tune(scenarios=[]): give at least one scene.")
    for scenario in scenarios:
        require_kind("tune", "scenarios", scenario, Scenario, "give scenes, e.g. vcjax.scenarios.paper().")
    structures = {(jax.tree.structure(s), tuple(np.shape(leaf) for leaf in jax.tree.leaves(s))) for s in scenarios}
    if len(structures) > 1:
        raise ValueError(
            "tune(scenarios): the scenes differ in more than numbers; give all as many frames and features."
        )
    if not isinstance(parameters, Mapping) or not parameters:
        raise ValueError(f"tune(parameters={parameters!r}): give at least one path with its interval.")
    known = list(numeric_paths(Experiment(scenarios[0], config)))
    for path, interval in parameters.items():
        if path not in known:
            raise ValueError(f"tune has no numeric leaf {path!r}; choose among: {', '.join(known)}.")
        require_kind("tune", f"parameters[{path!r}]", interval, Interval, "give an Interval(low, high).")
        values = {_value_at(Experiment(s, config), path) for s in scenarios}
        if len(values) > 1:
            raise ValueError(f"tune(scenarios): {path} is {sorted(values)} in them; give all scenes the same start.")
        rate = min(float(s.frame_rate_hz) for s in scenarios)
        if path == "scenario.oscillation.frequency_hz" and interval.high > rate / 2:
            raise ValueError(
                f"tune(parameters[{path!r}].high={interval.high:g}): f is below half the frame rate, {rate / 2:g} Hz."
            )
