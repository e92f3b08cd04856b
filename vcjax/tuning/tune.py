"""Tuning numbers of gate and camera: descents by gradient from several starts, and a choice among their ends.

Three kinds of seeds, none used twice: those of the descents, those by which the best of their ends is chosen, and those
held out (see `choice`). With a directory every step and every block of runs is kept there, and tuning that was stopped
goes on to the same numbers.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.stats import norm, qmc

from vcjax.fields import require_key, require_kind, require_whole
from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario
from vcjax.storage import check_writable, with_nulls, write_json
from vcjax.study.results import describe, import_xarray, provenance, refuse_other_settings
from vcjax.tuning.blocks import as_directory
from vcjax.tuning.choice import Choice, Seeds, Setting, check_directory, choose, setting_of
from vcjax.tuning.descent import NotFinite, Schedule, Step, descend, end_of, last_loss
from vcjax.tuning.intervals import Interval
from vcjax.tuning.losses import Objective
from vcjax.tuning.problem import Problem, problem_of

_MARGIN = 0.1
"""How near to the ends of their intervals starts are drawn, as a part of these."""


class End(NamedTuple):
    """Where a descent has led."""

    setting: Setting
    smoothed_loss: float
    """Mean of the smoothed objective over the last quarter of its steps."""
    smoothed_se: float
    """Its standard error."""
    is_judged: bool
    """Whether it is a candidate of the choice."""


class Tuned(NamedTuple):
    """What tuning gave."""

    descents: list[list[Step]]
    """Every step from every start that was not left out; the first is where the parameters were."""
    ends: list[End]
    """Where each of them has led."""
    near: list[Setting]
    """Candidates from around the end of the smallest smoothed loss, see `smoothest`."""
    choice: Choice
    """Where the parameters were, the best candidate, and what it is worth."""
    num_runs: int
    """Runs in the descents, each with its derivative."""
    origin: Mapping[str, Any]
    """What the descents come from, as plain values, like that of `choice`; with the intervals and the schedule."""
    left_out: Sequence[Setting] = ()
    """Starts without a descent, since the objective was not finite there."""

    @property
    def num_steps(self) -> int:
        """Steps of all descents."""
        return sum(map(len, self.descents))

    @property
    def num_skipped(self) -> int:
        """Steps not taken because their loss or gradient was not finite."""
        steps = (step for steps in self.descents for step in steps)
        return sum(not np.all(np.isfinite([step.loss, *step.gradient.values()])) for step in steps)

    @property
    def num_failed(self) -> int:
        """Pairs of runs left out of steps because one, or its derivative, went non-finite."""
        return sum(step.num_failed for steps in self.descents for step in steps)


def tune(
    scenarios: Mapping[str, Scenario],
    config: FilterConfig,
    parameters: Mapping[str, Interval],
    *,
    objective: Objective | None = None,
    schedule: Schedule | None = None,
    num_starts: int = 1,
    num_near: int = 0,
    seeds: Seeds | None = None,
    key: PRNGKeyArray,
    directory: str | Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Tuned:
    """Tune numbers of scenario and configuration, the same for all scenes.

    Args:
        scenarios: scenes by name, which differ in numbers only and have the same start.
        config: the filter, with `smoothing` "soft" (a true gradient) or "straight_through" (the hard filter's numbers).
        parameters: path of a numeric leaf, as in a sweep → where it may go.
        objective: what to make small; F1 of the tracks if None.
        schedule: steps, seeds and temperatures of each descent.
        num_starts: descents; the first from where the parameters are, the others from points spread over the intervals
            (a Halton sequence), since an objective may have several valleys. One of the others where the objective is
            not finite is left out. Of more than two, the better half of the ends, by the smoothed loss of their
            descents, is judged by hard decisions: so a choice costs less, and may have more seeds.
        num_near: further candidates, from around the end of the smallest smoothed loss: points of the neighbourhood
            over which its descent averaged, x + σz with z spread as a normal distribution (a Halton sequence). Where
            runs ripple with a parameter, that mean cannot say where in the neighbourhood it is best.
        seeds: to choose the best candidate, and to compare it with the start.
        key: base key.
        directory: where the work is kept, and looked for.
        progress: called with what was done last, and how much of how many steps or settings.

    Raises:
        ValueError: for arguments that make no sense, before anything compiles; for an objective that is not finite
            where the parameters are; or if the directory holds other work.
        OSError: if the directory cannot be written.
        ModuleNotFoundError: if xarray is not installed.
    """
    import_xarray()
    require_key("tune", key)
    schedule, seeds = Schedule() if schedule is None else schedule, Seeds() if seeds is None else seeds
    require_kind("tune", "schedule", schedule, Schedule, "give a Schedule, e.g. Schedule(num_steps=20).")
    require_kind("tune", "seeds", seeds, Seeds, "give Seeds, e.g. Seeds(choosing=48, held_out=100).")
    require_whole("tune", "num_starts", num_starts, 1)
    require_whole("tune", "num_near", num_near, 0)
    directory = as_directory("tune", directory)
    problem = problem_of(scenarios, config, parameters, objective)
    starts = _starts(problem, setting_of(scenarios, config, problem.paths), num_starts)
    origin = _origin(scenarios, problem, schedule, key)
    descent_key, choice_key = jax.random.split(key)
    kept = [_KeptSteps(directory, number, origin, start) for number, start in enumerate(starts)]
    before = [each.read() for each in kept]
    num_begun = sum(history is not None for history in before)
    given = {"objective": problem.objective, "seeds": seeds, "key": choice_key}
    if directory is not None:
        num_candidates = 1 + _num_judged(num_begun) + num_near
        check_directory(choice_of(directory, num_begun, num_near), scenarios, config, num_candidates, **given)
    descents, left_out = [], []
    for number, (start, history) in enumerate(zip(starts, before, strict=True)):

        def told(history: list[Step], number=number):
            kept[number].write(history)
            if progress is not None:
                loss = f"descent {number + 1} of {num_starts}, loss {history[-1].loss:.3f}"
                progress(loss, len(history), schedule.num_steps)

        if history is not None:
            own_key = jax.random.fold_in(descent_key, number)
            try:
                descents.append(descend(problem, start, schedule, key=own_key, history=history, progress=told))
                continue
            except NotFinite:
                # Where the parameters are, this is for the user to know; elsewhere it is one start less.
                if number == 0:
                    raise
            except ValueError as error:
                if not history:
                    raise
                raise ValueError(f"{kept[number].path}: {error}") from None
            kept[number].write(None)
        left_out.append(start)
    ends = _ends(problem, schedule, descents)
    near = _near(problem, ends, num_near)
    candidates = [starts[0], *(end.setting for end in ends if end.is_judged), *near]
    place = None if directory is None else choice_of(directory, len(descents), num_near)
    choice = choose(scenarios, config, candidates, directory=place, progress=progress, **given)
    runs_per_step = 2 * schedule.pairs_per_step * len(scenarios)
    num_runs = runs_per_step * (sum(map(len, descents)) + len(left_out))
    return Tuned(descents, ends, near, choice, num_runs, origin, left_out)


def _ends(problem: Problem, schedule: Schedule, descents: Sequence[list[Step]]) -> list[End]:
    losses = [last_loss(steps) for steps in descents]
    order = np.argsort([loss for loss, _ in losses], kind="stable")  # NaN comes last
    judged = order[: _num_judged(len(descents))]
    return [
        End(end_of(problem, schedule, steps), *loss, number in judged)
        for number, (steps, loss) in enumerate(zip(descents, losses, strict=True))
    ]


def _num_judged(num_descents: int) -> int:
    return min(num_descents, max(2, -(-num_descents // 2)))


def smoothest(ends: Sequence[End]) -> int:
    """Which of the ends has the smallest smoothed loss; NaN comes last."""
    return int(np.argsort([end.smoothed_loss for end in ends], kind="stable")[0])


def _near(problem: Problem, ends: Sequence[End], num: int) -> list[Setting]:
    """Points of the neighbourhood of the end of the smallest smoothed loss."""
    if num == 0:
        return []
    best = problem.to_free(ends[smoothest(ends)].setting)
    spread = np.array([float(interval.spread) for interval in problem.intervals])
    z = norm.ppf(qmc.Halton(len(spread), scramble=False).random(num + 1)[1:])  # its first point is at infinity
    return [problem.to_parameters(best + spread * each) for each in z]


def choice_of(directory: Path, num_descents: int, num_near: int) -> Path:
    """Where a choice is kept: another for more candidates, so that these go on from the descents that there are."""
    return directory / (f"choice_of_{num_descents}" + (f"_and_{num_near}_near" if num_near else ""))


def _starts(problem: Problem, before: dict[str, float], num: int) -> list[dict[str, float]]:
    """Where the descents begin."""
    problem.to_free(before)
    spread = qmc.Halton(len(problem.paths), scramble=False).random(num)[1:]  # its first point is a corner
    parts = _MARGIN + (1 - 2 * _MARGIN) * spread
    each = list(zip(problem.paths, problem.intervals, strict=True))
    return [before, *({path: float(i.at(p)) for (path, i), p in zip(each, row, strict=True)} for row in parts)]


def _origin(scenarios, problem: Problem, schedule: Schedule, key) -> dict[str, Any]:
    """What the steps of a descent come from, as it is kept beside them."""
    return provenance(key) | {
        "scenarios": {name: describe(scenario) for name, scenario in scenarios.items()},
        "config": describe(problem.config),
        "objective": describe(problem.objective),
        "parameters": {path: describe(i) for path, i in zip(problem.paths, problem.intervals, strict=True)},
        "schedule": describe(schedule),
    }


class _KeptSteps(NamedTuple):
    """The file of a descent's steps; none without a directory."""

    directory: Path | None
    number: int
    origin: dict[str, Any]
    start: Setting

    @property
    def path(self) -> Path | None:
        """Where it is."""
        return None if self.directory is None else self.directory / "descents" / f"start_{self.number}.json"

    def write(self, history: list[Step] | None) -> None:
        """Write all steps, completely or not at all; None: the start was left out."""
        if self.path is not None:
            steps = None if history is None else [step._asdict() for step in history]
            write_json(self.path, {"origin": self.origin, "start": self.start, "steps": steps})

    def read(self) -> list[Step] | None:
        """The steps made already; None if the start was left out.

        Raises:
            ValueError: if they are of other work, or not readable.
            OSError: if none could be written.
        """
        if self.path is None:
            return []
        check_writable(self.path)
        if not self.path.is_file():
            return []
        try:
            content = json.loads(self.path.read_text("utf-8"))
            found, steps = content["origin"] | {"start": content["start"]}, content["steps"]
            if not isinstance(steps, list | None):
                raise TypeError("steps are a list")
            steps = None if steps is None else [_step(step, self.start) for step in steps]
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"{self.path}: no steps of a descent ({error}); remove it and run again.") from None
        expected = json.loads(json.dumps(with_nulls(self.origin | {"start": self.start})))
        refuse_other_settings(self.path, with_nulls(found), expected)
        return steps


def _step(content: dict[str, Any], setting: Setting) -> Step:
    """A step as it was kept.

    Raises:
        ValueError, TypeError: if it is of other parameters, or something in it is no number.
    """
    step = Step(**_with_nan(content))
    tables = (step.parameters, step.gradient, step.gradient_se, step.pathwise)
    if any(list(table) != list(setting) for table in tables):
        raise ValueError("a step of other parameters")
    numbers = [step.temperature, step.loss, step.loss_se, *(n for table in tables for n in table.values())]
    if not all(type(n) in (int, float) for n in numbers) or type(step.num_failed) is not int or step.num_failed < 0:
        raise TypeError("a step with something that is no such number")
    return step


def _with_nan(value: Any) -> Any:
    """What was read, with the numbers that JSON does not know."""
    if isinstance(value, dict):
        return {key: _with_nan(item) for key, item in value.items()}
    return math.nan if value is None else value
