"""What is tuned: an objective of runs in some scenes, as a function of free numbers."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vcjax.fields import require_kind, require_single
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario
from vcjax.study.sweep import Experiment, replace_at, require_paths
from vcjax.tuning.evaluate import stacked
from vcjax.tuning.intervals import Interval
from vcjax.tuning.losses import OF_MOVERS, Objective

MAX_AMPLITUDE_M = 0.5
"""How far a camera on a robot can be thought to swing to either side, m."""
FORWARD_MODE_UP_TO = 4
"""Numbers up to which forward mode costs about as much as reverse mode, whose cost does not depend on them."""


class Problem(eqx.Module):
    """What is minimised: an objective of runs in some scenes, by numbers of scenario and configuration.

    The numbers are the same in all scenes. `config` decides smoothly: `smoothing` is "soft" (a true gradient) or
    "straight_through" (the hard filter's numbers); its `reverse_mode` says how the derivative is taken.
    """

    scenes: Scenario
    """All scenes, stacked (see `evaluate.stacked`)."""
    config: FilterConfig
    objective: Objective
    paths: tuple[str, ...] = eqx.field(static=True)
    """Which numbers are free."""
    intervals: tuple[Interval, ...]
    """Where each may go."""

    def to_free(self, parameters: Mapping[str, float]) -> np.ndarray:
        """The free numbers of some parameters.

        Raises:
            ValueError: for a parameter outside its interval.
        """
        free = []
        for path, interval in self._each():
            try:
                free.append(interval.to_free(parameters[path]))
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
        return np.array(free)

    def to_parameters(self, free: np.ndarray) -> dict[str, float]:
        """The parameters of some free numbers."""
        return {path: float(i.to_parameter(jnp.asarray(x))) for (path, i), x in zip(self._each(), free, strict=True)}

    def _each(self) -> Iterator[tuple[str, Interval]]:
        return zip(self.paths, self.intervals, strict=True)


def problem_of(
    scenarios: Mapping[str, Scenario],
    config: FilterConfig,
    parameters: Mapping[str, Interval],
    objective: Objective | None = None,
) -> Problem:
    """The problem of making an objective small by some parameters.

    Args:
        scenarios: scenes by name, which differ in numbers only.
        config: the filter. Its derivative is taken in forward mode for up to `FORWARD_MODE_UP_TO` parameters, in
            reverse mode for more, whatever its `reverse_mode` says.
        parameters: path of a numeric leaf, as in a sweep → where it may go.
        objective: what to make small; soft F1 of the tracks if None.

    Raises:
        ValueError: for hard decisions, losses of them that have no derivative by mistakes, scenes that differ in
            structure, unknown paths, intervals with an end that scenario or configuration refuse, such as a frequency
            that the frame rate cannot show, amplitudes above `MAX_AMPLITUDE_M`, or scenes without movers where these
            are what the objective is about.
    """
    scenes = stacked(scenarios, "tune")
    require_kind("tune", "config", config, FilterConfig, "give a FilterConfig with smoothing='soft'.")
    require_single("tune", config)
    if objective is not None:
        require_kind("tune", "objective", objective, Objective, "give an Objective, e.g. Objective(position=2.0).")
        require_single("tune", objective)
    if config.smoothing == "hard":
        raise ValueError(
            "tune(config.smoothing='hard'): give smoothing 'soft' or 'straight_through', which have a derivative."
        )
    if config.smoothing == "straight_through" and objective is not None:
        for name in ("track_cross_entropy", "track_ranking", "candidate_cross_entropy"):
            if getattr(objective, name) > 0:
                raise ValueError(
                    f"tune(objective.{name}={getattr(objective, name):g}): of hard decisions, which straight_through "
                    "keeps, it has no derivative by mistakes; take smoothing='soft', or weigh F1 instead."
                )
    remedy = "give at least one path with its interval, a mapping."
    require_kind("tune", "parameters", parameters, Mapping, remedy)
    if not parameters:
        raise ValueError(f"tune(parameters={{}}): {remedy}")
    experiments = [Experiment(scenario, config) for scenario in scenarios.values()]
    require_paths("tune", experiments[0], parameters)
    for path, interval in parameters.items():
        require_kind("tune", f"parameters[{path!r}]", interval, Interval, "give an Interval(low, high).")
        if path == "config.temperature":
            raise ValueError(f"tune(parameters[{path!r}]): the schedule sets it; give another path.")
        for experiment in experiments:
            _require_ends(experiment, path, interval)
        if path == "scenario.oscillation.amplitude_m" and not 0 <= interval.low < interval.high <= MAX_AMPLITUDE_M:
            raise ValueError(
                f"tune(parameters[{path!r}]) from {interval.low:g} to {interval.high:g}: A is a swing of the camera, "
                f"between 0 and {MAX_AMPLITUDE_M} m."
            )
    _require_corners(experiments, parameters)
    config = dataclasses.replace(config, reverse_mode=len(parameters) > FORWARD_MODE_UP_TO)
    objective = Objective() if objective is None else objective
    require_movers("tune", scenarios, objective)
    return Problem(scenes, config, objective, tuple(parameters), tuple(parameters.values()))


def require_movers(
    owner: str, scenarios: Mapping[str, Scenario], objective: Objective, speeds_m_s: Sequence[float] | np.ndarray = ()
) -> None:
    """Refuse a scene where nothing moves if something is wanted that is the same there whatever is called dynamic.

    Args:
        owner: who refuses.
        scenarios: scenes by name.
        objective: what is wanted.
        speeds_m_s: speeds that the movers will have as well as their own.

    Raises:
        ValueError: naming scene and weight.
    """
    for name, scenario in scenarios.items():
        wanted = [loss for loss in OF_MOVERS if np.any(getattr(objective, loss) != 0)]
        speeds = np.append(speeds_m_s, scenario.movers.speed_m_s)
        if wanted and (len(scenario.movers.ids) == 0 or np.any(speeds == 0)):
            raise ValueError(
                f"{owner}(scenarios[{name!r}]): nothing moves there, so that {', '.join(wanted)} is the same whatever "
                "is called dynamic; leave the scene out, or weigh it 0 and a cross entropy more."
            )


def _require_ends(experiment: Experiment, path: str, interval: Interval) -> None:
    """Refuse an interval with an end that is no number for its place; a descent may come as near to it as it likes.

    Raises:
        ValueError: naming path and interval, and what is wrong with the end.
    """
    low, high = interval.low, interval.high
    for end in (low, high):
        try:
            replace_at(experiment, {path: end})
        except ValueError as error:
            raise ValueError(f"tune(parameters[{path!r}]) from {low:g} to {high:g}: {error}") from None


def _require_corners(experiments: Sequence[Experiment], parameters: Mapping[str, Interval]) -> None:
    """Refuse intervals each of which is right, but not any two of them together, such as of f and of the frame rate.

    Raises:
        ValueError: naming both, and what is wrong with the pair.
    """
    for one, other in itertools.combinations(parameters, 2):
        ends = ((interval.low, interval.high) for interval in (parameters[one], parameters[other]))
        for values, experiment in itertools.product(itertools.product(*ends), experiments):
            pair = dict(zip((one, other), values, strict=True))
            try:
                replace_at(experiment, pair)
            except ValueError as error:
                told = ", ".join(f"{path} = {value:g}" for path, value in pair.items())
                raise ValueError(f"tune(parameters), where {told}: {error}") from None
