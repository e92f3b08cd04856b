"""Tuning by gradient: parameters that stay valid, steps that go down, and what is refused or left out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_runs
from hypothesis import given
from hypothesis import strategies as st

import vcjax as vc
from vcjax.study import tune as module
from vcjax.study.intervals import OSCILLATION, THRESHOLDS, Interval
from vcjax.study.losses import Objective
from vcjax.study.tune import Schedule, tune

KEY = jax.random.key(3)
SCENES = [tiny_runs.scenario(oscillation_amplitude_m=0.05, dynamic_speed_m_s=v) for v in (0.5, 1.0)]
SOFT = tiny_runs.config(tiny_runs.STRICT, smoothing="soft")
PARAMETERS = {"config.gate.th1": Interval(0.2, 50.0, is_log=True), **OSCILLATION}
OBJECTIVE = Objective(track_f1=1.0, position=5.0, camera_motion=0.1)
ONE_STEP = Schedule(num_steps=1, seeds_per_step=2, learning_rate=0.2)


@given(st.floats(1e-3, 1e3), st.floats(1.001, 1e3), st.booleans(), st.floats(-30, 30))
def test_intervals_map_every_number_inside_and_back(low, factor, is_log, free):
    interval = Interval(low, factor * low, is_log)
    parameter = float(interval.to_parameter(jnp.asarray(free)))
    assert interval.low * (1 - 1e-9) <= parameter <= interval.high * (1 + 1e-9)
    if abs(free) < 10:
        assert interval.to_free(parameter) == pytest.approx(free, abs=1e-5)
    slope = float(jax.grad(interval.to_parameter)(jnp.asarray(free)))
    assert np.isfinite(slope) and slope >= 0


def test_a_step_goes_down_the_mean_gradient_of_all_scenes():
    """The gradient is the finite difference of the mean loss, with the same seeds; Adam's first step is its sign."""
    tuned = tune(SCENES, SOFT, PARAMETERS, objective=OBJECTIVE, schedule=ONE_STEP, key=KEY)
    (step,) = tuned.history
    assert step.num_failed == 0 and tuned.num_skipped == 0 and step.loss_se > 0
    assert step.parameters == {"config.gate.th1": pytest.approx(1.0)} | {
        "scenario.oscillation.amplitude_m": pytest.approx(0.05),
        "scenario.oscillation.frequency_hz": pytest.approx(3.0),
    }
    for path, interval in PARAMETERS.items():
        before, after = (interval.to_free(p[path]) for p in (step.parameters, tuned.parameters))
        assert after - before == pytest.approx(-0.2 * np.sign(step.gradient[path]), rel=1e-5)

    def loss(th1):
        config = dataclasses.replace(SOFT, gate=vc.VirtualCorrection(th1, 0.7))
        return tune(SCENES, config, PARAMETERS, objective=OBJECTIVE, schedule=ONE_STEP, key=KEY).history[0].loss

    interval, h = PARAMETERS["config.gate.th1"], 1e-5
    at = interval.to_free(1.0)
    low, high = (loss(float(interval.to_parameter(jnp.asarray(at + s * h)))) for s in (-1, 1))
    assert (high - low) / (2 * h) == pytest.approx(step.gradient["config.gate.th1"], rel=1e-4)


def test_steps_draw_new_seeds_and_the_temperature_falls():
    schedule = Schedule(num_steps=3, seeds_per_step=2, temperature_start=4.0, temperature_end=1.0)
    told = []
    tuned = tune(SCENES, SOFT, PARAMETERS, schedule=schedule, key=KEY, progress=lambda *step: told.append(step))
    assert [step.temperature for step in tuned.history] == pytest.approx([4.0, 2.0, 1.0])
    assert told == list(enumerate(tuned.history, start=1))
    assert len({step.loss for step in tuned.history}) == 3
    for path, interval in PARAMETERS.items():
        assert interval.low < tuned.parameters[path] < interval.high
    again = tune(SCENES, SOFT, PARAMETERS, schedule=schedule, key=KEY)
    assert again.parameters == tuned.parameters


def broken_after(num_calls: int, monkeypatch):
    """Runs that went non-finite: all of them after so many calls, one of four before."""
    calls = []

    def run_lanes(*_, **__):
        calls.append(len(calls))
        runs = {"loss": np.array([1.0, 2.0, np.nan, 3.0]), "gradient": np.ones((4, 3))}
        runs["gradient"][0, 1] = np.inf
        return runs if len(calls) <= num_calls else {name: np.full_like(v, np.nan) for name, v in runs.items()}

    monkeypatch.setattr(module, "run_lanes", run_lanes)


def test_what_goes_non_finite_is_left_out_and_counted(monkeypatch):
    broken_after(1, monkeypatch)
    tuned = tune(SCENES, SOFT, PARAMETERS, schedule=dataclasses.replace(ONE_STEP, num_steps=3), key=KEY)
    first, *rest = tuned.history
    assert (first.loss, first.num_failed) == (2.5, 2)
    assert tuned.num_skipped == 2 and all(step.num_failed == 4 and np.isnan(step.loss) for step in rest)
    assert tuned.parameters == rest[0].parameters  # no step was taken from there


def test_an_objective_that_is_not_finite_at_the_start_is_refused(monkeypatch):
    broken_after(0, monkeypatch)
    with pytest.raises(ValueError, match="not finite at the start"):
        tune(SCENES, SOFT, PARAMETERS, schedule=ONE_STEP, key=KEY)


def test_bad_input_is_refused_before_any_work(monkeypatch, unchecked):
    monkeypatch.setattr(module, "run_lanes", lambda *_: pytest.fail("worked"))
    wide = {"scenario.oscillation.frequency_hz": Interval(0.5, 5.5)}
    for arguments, message in (
        ({"config": tiny_runs.config()}, r"smoothing='hard'.*'soft' or 'straight_through'"),
        ({"scenarios": []}, "give at least one scene"),
        ({"scenarios": [SCENES[0], tiny_runs.scenario(num_frames=13)]}, "differ in more than numbers"),
        ({"parameters": {}}, "at least one path with its interval"),
        ({"parameters": {"config.gate.th3": Interval(0, 1)}}, "no numeric leaf 'config.gate.th3'; choose among: "),
        ({"parameters": {"config.gate.th1": (1, 2)}}, "give an Interval"),
        ({"parameters": {"config.gate.th1": Interval(2.0, 3.0)}}, r"Interval\(2, 3\): 1 is not inside; widen"),
        ({"parameters": wide}, r"high=5.5\): f is below half the frame rate, 5 Hz"),
        ({"parameters": {"scenario.movers.speed_m_s": Interval(0.1, 2)}}, r"is \[0.5, 1.0\] in them"),
        ({"key": 0}, r"key=0\)"),
    ):
        given = {"scenarios": SCENES, "config": SOFT, "parameters": PARAMETERS, "key": KEY} | arguments
        with pytest.raises(ValueError, match=message):
            tune(**given)
    for make, message in (
        (lambda: Interval(2.0, 1.0), "above low=2"),
        (lambda: Interval(0.0, 1.0, is_log=True), "logarithmic scale needs a positive number"),
        (lambda: Schedule(seeds_per_step=0), "seeds_per_step=0"),
        (lambda: Schedule(temperature_end=0.0), r"temperature_end=0.0\).*positive"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_the_thresholds_of_the_paper_are_inside():
    assert all(np.isfinite(interval.to_free(9.0)) for interval in THRESHOLDS.values())
