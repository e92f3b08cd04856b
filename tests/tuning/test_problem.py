"""Problems of tuning: what may be free, in which scenes and for what objective, and what is refused."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_runs
from small_search import INTERVALS, SCENES, SOFT, TH1

from vcjax.tuning.descent import Schedule, descend
from vcjax.tuning.intervals import OSCILLATION, THRESHOLDS, Interval
from vcjax.tuning.losses import Objective
from vcjax.tuning.problem import problem_of

A, F = OSCILLATION
PARAMETERS = {TH1: INTERVALS[TH1], **OSCILLATION}
START = {TH1: 1.0, A: 0.05, F: 3.0}
PROBLEM = problem_of(SCENES, SOFT, PARAMETERS)
STATIC = {"static": tiny_runs.scenario(dynamic="lateral", dynamic_speed_m_s=0.0, num_frames=8)}
BATCH = eqx.tree_at(lambda s: s.pixel_std_px, tiny_runs.scenario(), jnp.array([1.0, 2.0]))


def test_bad_problems_are_refused(unchecked):
    for arguments, message in (
        ({"config": tiny_runs.config()}, r"smoothing='hard'.*'soft' or 'straight_through'"),
        ({"config": None}, "give a FilterConfig with smoothing"),
        ({"scenarios": {}}, "give at least one scene"),
        ({"scenarios": [tiny_runs.scenario()]}, r"tune\(scenarios=<list>\): give at least one scene by its name"),
        ({"scenarios": {"a": 3}}, r"tune\(scenarios\['a'\]=3\): give a Scenario"),
        ({"scenarios": {"batch": BATCH}}, r"tune, scenarios\['batch'\]: .* has shape \(2,\), but one number"),
        ({"objective": 3}, r"tune\(objective=3\): give an Objective"),
        ({"scenarios": SCENES | {"long": tiny_runs.scenario(num_frames=13)}}, "differ in more than numbers"),
        ({"parameters": {}}, "at least one path with its interval"),
        ({"parameters": {"config.gate.th3": Interval(0, 1)}}, "no numeric leaf 'config.gate.th3'; choose among: "),
        ({"parameters": {TH1: (1, 2)}}, "give an Interval"),
        ({"parameters": [TH1]}, r"tune\(parameters=.*at least one path with its interval"),
        ({"parameters": {F: Interval(0.5, 5.5)}}, r"from 0.5 to 5.5: .*not below half the frame rate of 10"),
        ({"parameters": {F: Interval(0.5, 5.0)}}, r"from 0.5 to 5: .*not below half the frame rate of 10"),
        ({"parameters": {F: Interval(-1.0, 4.0)}}, r"from -1 to 4: Oscillation\(frequency_hz=-1.0\)"),
        ({"parameters": {A: Interval(-0.1, 0.4)}}, r"from -0.1 to 0.4: Oscillation\(amplitude_m=-0.1\)"),
        ({"parameters": {TH1: Interval(0.0, 4.0)}}, r"from 0 to 4: VirtualCorrection\(th1=0.0\)"),
        (
            {"parameters": {"config.pixel_std_px": Interval(-1.0, 4.0)}},
            r"from -1 to 4: FilterConfig\(pixel_std_px=-1.0",
        ),
        ({"parameters": {"config.temperature": Interval(1.0, 4.0)}}, "the schedule sets it"),
        (
            {"parameters": {F: Interval(1.0, 4.5), "scenario.frame_rate_hz": Interval(6.5, 20.0)}},
            r"where scenario.oscillation.frequency_hz = 4.5, scenario.frame_rate_hz = 6.5: .*not below half the frame",
        ),
        ({"scenarios": SCENES | STATIC}, r"scenarios\['static'\]\): nothing moves there"),
        ({"scenarios": {"all scenes": tiny_runs.scenario()}}, "give each scene a name, a text other than 'all scenes'"),
        ({"parameters": {A: Interval(0.0, 3.0)}}, r"from 0 to 3: A is a swing of the camera, between 0 and 0.5 m"),
    ):
        given = {"scenarios": SCENES, "config": SOFT, "parameters": PARAMETERS} | arguments
        with pytest.raises(ValueError, match=message):
            problem_of(**given)
    for make, message in (
        (lambda: Interval(2.0, 1.0), "above low=2"),
        (lambda: Interval(0.0, 1.0, is_log=True), "logarithmic scale needs a positive number"),
        (lambda: Schedule(pairs_per_step=0), "pairs_per_step=0"),
        (lambda: Interval(1.0, 2.0, spread=0.0), r"spread=0.0\).*positive"),
        (lambda: Schedule(temperature_end=0.0), r"temperature_end=0.0\).*positive"),
        (
            lambda: PROBLEM.to_free(START | {TH1: 60.0}),
            r"config.gate.th1: Interval\(0.2, 50\): 60 is not inside; widen",
        ),
        (lambda: descend(PROBLEM, START, Schedule(num_steps=1), key=0), r"key=0\)"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_a_scene_without_movers_serves_what_static_features_cost():
    for wanted in ({"track_cross_entropy": 1.0}, {"position": 1.0}, {"consistency": 1.0}):
        problem_of(SCENES | STATIC, SOFT, PARAMETERS, Objective(**({"track_f1": 0.0} | wanted)))
    for wanted in ("candidate_f1", "track_ranking"):
        with pytest.raises(ValueError, match=f"so that {wanted} is the same"):
            problem_of(STATIC, SOFT, PARAMETERS, Objective(**({"track_f1": 0.0, "position": 1.0} | {wanted: 1.0})))


def test_an_end_may_be_the_last_number_that_is_valid():
    ends = {A: Interval(0.0, 0.5), F: Interval(0.0, 4.999), "config.gate.th2": Interval(0.0, 9.0)}
    assert problem_of(SCENES, SOFT, ends).paths == tuple(ends)


def test_the_numbers_of_the_paper_are_inside():
    assert all(np.isfinite(interval.to_free(9.0)) for interval in THRESHOLDS.values())
    assert np.isfinite(OSCILLATION[A].to_free(0.05)) and np.isfinite(OSCILLATION[F].to_free(3.0))


def test_losses_without_a_derivative_of_hard_decisions_are_refused():
    hard = dataclasses.replace(SOFT, smoothing="straight_through")
    for name in ("track_cross_entropy", "track_ranking", "candidate_cross_entropy"):
        with pytest.raises(ValueError, match=rf"objective.{name}=0.5\): of hard decisions"):
            problem_of(SCENES, hard, PARAMETERS, Objective(**{name: 0.5}))
    problem_of(SCENES, hard, PARAMETERS, Objective(position=2.0))
