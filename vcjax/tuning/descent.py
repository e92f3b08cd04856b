"""Going down a smoothed objective by gradient, averaged over scenes and fresh seeds.

Each parameter lives in an interval and is moved as a free number x (see `intervals`). A step averages the objective and
its gradient over a mini-batch of seeds, new in every step, and over all scenes. What is followed is the gradient in
units of its standard errors, (∂L/∂xᵢ)/sᵢ: not how much a parameter matters, but how sure it is which way it has to go,
so that one whose gradient is mostly noise neither hides the others nor is moved far. A step is as long as the learning
rate where this is sure, and shorter where it is less so: its norm counts up to √2 errors in each parameter, so that
nothing but noise moves one to four parameters by 0.5 to 0.7 of the learning rate where the errors are known from many
pairs, and by up to 0.6 to 0.9 where they are known from two, in no direction in particular. The learning rate falls by
a cosine. (Units that an optimiser learns from earlier gradients are those of the first, steep ones, and too large where
it has to settle; Adam's, one for each parameter, move one of which nothing is known by its noise as far as the others.)
The temperature of the smoothing falls from step to step.

The derivative of one long run need not say where the mean of many goes: a run's phase of oscillation depends on f times
its whole length, and its loss ripples with f over less than a tenth of a hertz, steeply. So what is made small is the
mean over a neighbourhood, E[L(x + ε)] with ε ~ N(0, diag σ²) and a σ for each parameter. Its gradient has two unbiased
estimates:

    pathwise        ∂L/∂x at x ± ε                            sharp where runs change smoothly, as with Th₁, Th₂ and A
    of the pair     (L(x + ε) - L(x - ε)) ε / 2σ²             sharp where they ripple, as with f

Both come from the same pair of runs of one seed. Each parameter takes their mean weighted by the inverse of their
variances over the mini-batch, within the scenes; as these are known from a few pairs only, the weighted mean is
unbiased no more than nearly. A pair that goes non-finite is left out, and its scene counts less in that step. What a
soft filter says of a setting is not what the hard filter does with it: `choice` looks at that.

References:
    Parmas, Rasmussen, Peters, Doya 2018, "PIPPS: Flexible model-based policy search robust to the curse of chaos".
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.tree_util import Partial
from jaxtyping import Array, Float, PRNGKeyArray

from vcjax.fields import number, require, require_count, require_key
from vcjax.study.monte_carlo import run_lanes, simulate_and_filter
from vcjax.study.sweep import Experiment, replace_at
from vcjax.tuning.evaluate import scene
from vcjax.tuning.problem import Problem

_SURE = np.sqrt(2.0)
"""Standard errors in each parameter, as a root mean square, from which on a gradient is as good as certain."""
_FARTHEST = 12.0
"""How far a free number may go: its parameter is then within 1e-5 of an end of its interval, and not yet at it."""
_SUREST = 1e-3
"""Smallest standard error that is believed, as a part of a derivative."""


class Schedule(eqx.Module):
    """How long and how fast to go."""

    num_steps: int = eqx.field(static=True, default=20)
    """Steps of the optimiser."""
    pairs_per_step: int = eqx.field(static=True, default=4)
    """Seeds of each scene that a step averages; each gives a pair of runs."""
    learning_rate: float = eqx.field(converter=number, default=0.4)
    """How far the free numbers go in the first step if its gradient is sure; positive. Later steps fall to a tenth by a
    cosine."""
    temperature_start: float = eqx.field(converter=number, default=1.0)
    """τ of the smoothing in the first step, in χ² units; positive."""
    temperature_end: float = eqx.field(converter=number, default=0.25)
    """τ in the last; in between it changes by equal factors."""

    def __check_init__(self):
        for name in ("num_steps", "pairs_per_step"):
            require_count(self, name, 1)
        for name in ("learning_rate", "temperature_start", "temperature_end"):
            require(self, name, lambda v: np.isfinite(v) & (v > 0), "give a positive number.")

    def temperature(self, step: int) -> float:
        """τ of a step."""
        part = step / max(self.num_steps - 1, 1)
        return float(self.temperature_start * (self.temperature_end / self.temperature_start) ** part)

    def optimiser(self, num_parameters: int) -> optax.GradientTransformation:
        """What takes the steps, along gradients in units of their standard errors."""
        sure = float(_SURE * np.sqrt(num_parameters))
        rates = optax.cosine_decay_schedule(float(self.learning_rate) / sure, self.num_steps, alpha=0.1)
        return optax.chain(optax.clip_by_global_norm(sure), optax.sgd(rates))


class NotFinite(ValueError):
    """An objective that is not a number where a descent is to begin."""


class Step(NamedTuple):
    """One step: where it was taken, and what was found there."""

    parameters: dict[str, float]
    temperature: float
    loss: float
    """Mean of the smoothed objective over the runs that stayed finite."""
    loss_se: float
    """Its standard error over the runs of these scenes; NaN of a single pair."""
    gradient: dict[str, float]
    """By the free numbers."""
    gradient_se: dict[str, float]
    """Its standard errors; NaN of a single pair."""
    pathwise: dict[str, float]
    """Weight of the pathwise estimate in it, 0 to 1; the rest is that of the pairs."""
    num_failed: int
    """Pairs left out because a run of theirs, or its derivative, went non-finite."""


def descend(
    problem: Problem,
    start: Mapping[str, float],
    schedule: Schedule,
    *,
    key: PRNGKeyArray,
    history: Sequence[Step] = (),
    progress: Callable[[list[Step]], None] | None = None,
) -> list[Step]:
    """Go down from a start; step k draws its seeds by `fold_in(key, k)`.

    Args:
        problem: what is minimised.
        start: the parameters to begin with, inside their intervals.
        schedule: steps, seeds, temperatures.
        key: base key.
        history: steps that were made already, with equal arguments; they are not made again.
        progress: called with all steps made so far, after each.

    Returns: every step. Equal arguments give equal steps, wherever the work was stopped in between.

    Raises:
        NotFinite: if the objective is not finite at the start.
        ValueError: if the history is of other work.
    """
    require_key("descend", key)
    history, free = list(history), problem.to_free(start)
    optimiser = schedule.optimiser(len(free))
    state = optimiser.init(jnp.asarray(free))
    for k, step in enumerate(history):
        led_to = problem.to_parameters(free)
        if not np.allclose(list(step.parameters.values()), list(led_to.values()), rtol=1e-5, atol=0):
            raise ValueError(
                f"descend(history): step {k} was taken at {step.parameters}, but those before it lead to {led_to}: it "
                "is of other work, or of another version; begin anew in another directory."
            )
        free, state = _move(optimiser, free, state, step)
    num_scenes = len(jax.tree.leaves(problem.scenes)[0])
    # Lanes: scenes × seeds × the two of a pair. Every pair has a seed of its own.
    number, pair, other = (axis.ravel() for axis in np.indices((num_scenes, schedule.pairs_per_step, 2)))
    seeds, lanes = number * schedule.pairs_per_step + pair, {"scene": number, "sign": 1.0 - 2.0 * other}
    spread = np.array([float(interval.spread) for interval in problem.intervals])
    for k in range(len(history), schedule.num_steps):
        temperature = schedule.temperature(k)
        work = Partial(_value_and_gradient, problem, jnp.asarray(free), jnp.asarray(spread), jnp.asarray(temperature))
        runs = run_lanes(work, lanes, seeds, jax.random.fold_in(key, k))
        step = _average(runs, lanes["scene"][::2], problem.to_parameters(free), temperature, spread)
        if not history and not np.isfinite(step.loss):
            raise NotFinite(f"the objective is not finite at the start, {step.parameters}; start elsewhere.")
        history.append(step)
        free, state = _move(optimiser, free, state, step)
        if progress is not None:
            progress(list(history))
    return history


def end_of(problem: Problem, schedule: Schedule, history: Sequence[Step]) -> dict[str, float]:
    """Where a descent has led: the mean of the free numbers after each step of its last quarter, less noisy than one.

    References:
        Polyak, Juditsky 1992, "Acceleration of stochastic approximation by averaging".
    """
    free, places = problem.to_free(history[0].parameters), []
    optimiser = schedule.optimiser(len(free))
    state = optimiser.init(jnp.asarray(free))
    for step in history:
        free, state = _move(optimiser, free, state, step)
        places.append(free)
    return problem.to_parameters(np.mean(_last_quarter(places), axis=0))


def last_loss(history: Sequence[Step]) -> tuple[float, float]:
    """Mean of the smoothed objective over the last quarter of the steps, NaN where one has none; its standard error."""
    losses, errors = (_last_quarter([getattr(step, name) for step in history]) for name in ("loss", "loss_se"))
    return float(np.mean(losses)), float(np.linalg.norm(errors) / len(errors))


def _last_quarter(values: list) -> list:
    return values[-max(1, len(values) // 4) :]


def _move(optimiser: optax.GradientTransformation, free: np.ndarray, state: Any, step: Step) -> tuple[np.ndarray, Any]:
    """One step along the gradient in units of its errors; none where loss or gradient is not finite.

    Of a single pair the errors are not known, and it is taken for sure.
    """
    gradient, error = (np.array(list(each.values())) for each in (step.gradient, step.gradient_se))
    if not np.all(np.isfinite([step.loss, *gradient])):
        return free, state
    is_known = np.all(np.isfinite(error))
    error = error if is_known else np.full(len(error), _SUREST * np.linalg.norm(gradient))
    sure = gradient / np.maximum(error, _SUREST * np.abs(gradient) + np.finfo(float).tiny)
    update, state = optimiser.update(jnp.asarray(sure), state, free)
    return np.clip(free + np.asarray(update), -_FARTHEST, _FARTHEST), state


def _value_and_gradient(
    problem: Problem,
    free: Float[Array, " P"],
    spread: Float[Array, " P"],
    temperature: Float[Array, ""],
    lane: dict[str, Array],
    key: PRNGKeyArray,
) -> dict[str, Array]:
    """Objective of one run of one scene at x ± ε, and its derivative by the free numbers."""
    scenario = scene(problem.scenes, lane["scene"])
    # A run draws from the folds 0 to 2 and 4 of its key.
    shift = spread * jax.random.normal(jax.random.fold_in(key, 3), free.shape, free.dtype)

    def loss(free):
        values = {
            path: interval.to_parameter(x)
            for path, interval, x in zip(problem.paths, problem.intervals, free, strict=True)
        }
        config = eqx.tree_at(lambda c: c.temperature, problem.config, temperature)
        experiment = replace_at(Experiment(scenario, config), values)
        _, info, truth = simulate_and_filter(experiment, key)
        value = problem.objective(experiment.scenario, info, truth)
        return value, value

    derivative = jax.jacrev if problem.config.reverse_mode else jax.jacfwd
    gradient, value = derivative(loss, has_aux=True)(free + lane["sign"] * shift)
    return {"loss": value, "gradient": gradient, "shift": shift}


def _average(
    runs: dict[str, np.ndarray],
    scenes: np.ndarray,
    parameters: dict[str, float],
    temperature: float,
    spread: np.ndarray,
) -> Step:
    """Mean over the pairs that stayed finite, each of one scene, of both estimates of the gradient."""
    loss, gradient, shift = (runs[name].reshape(-1, 2, *runs[name].shape[1:]) for name in ("loss", "gradient", "shift"))
    is_finite = np.all(np.isfinite(loss), axis=1) & np.all(np.isfinite(gradient), axis=(1, 2))
    loss, gradient, shift, scenes = loss[is_finite], gradient[is_finite], shift[is_finite, 0], scenes[is_finite]
    pathwise, of_pair = gradient.mean(axis=1), (loss[:, 0] - loss[:, 1])[:, None] * shift / (2 * spread**2)
    precision = 1.0 / np.maximum([_variance(each, scenes) for each in (pathwise, of_pair)], np.finfo(float).tiny)
    # A single pair says nothing of variances.
    weight = precision[0] / precision.sum(axis=0) if len(loss) > 1 else np.ones(len(parameters))
    both = weight * pathwise + (1.0 - weight) * of_pair
    figures = np.column_stack([loss.mean(axis=1), both])
    if len(figures):
        mean, error = figures.mean(axis=0), np.sqrt(_variance(figures, scenes) / len(figures))
    else:
        mean = error = np.full(1 + len(parameters), np.nan)
    return Step(
        parameters,
        temperature,
        loss=float(mean[0]),
        loss_se=float(error[0]),
        gradient=dict(zip(parameters, mean[1:].tolist(), strict=True)),
        gradient_se=dict(zip(parameters, error[1:].tolist(), strict=True)),
        pathwise=dict(zip(parameters, weight.tolist(), strict=True)),
        num_failed=int((~is_finite).sum()),
    )


def _variance(values: np.ndarray, scenes: np.ndarray) -> np.ndarray:
    """Variance of pairs within their scenes; over all where no scene has two, NaN of a single pair."""
    if len(values) < 2:
        return np.full(values.shape[1:], np.nan)
    groups = [values[scenes == scene] for scene in np.unique(scenes)]
    groups = [values] if len(groups) == len(values) else groups
    squares = [np.sum((group - group.mean(axis=0)) ** 2, axis=0) for group in groups]
    return np.sum(squares, axis=0) / (len(values) - len(groups))
