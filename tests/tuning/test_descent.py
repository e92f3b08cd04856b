"""Descent: parameters that stay valid, gradients of the averaged objective, steps that go down, what is left out."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_runs
from hypothesis import given
from hypothesis import strategies as st
from quick import QUICK

from vcjax.tuning import descent as module
from vcjax.tuning.descent import Schedule, descend, end_of
from vcjax.tuning.intervals import OSCILLATION, Interval
from vcjax.tuning.losses import Objective
from vcjax.tuning.problem import problem_of

KEY = jax.random.key(3)
SCENES = {
    f"{v} m/s": tiny_runs.scenario(oscillation_amplitude_m=0.05, dynamic_speed_m_s=v, num_frames=8) for v in (0.5, 1.0)
}
SOFT = tiny_runs.config(tiny_runs.STRICT, smoothing="soft")
TH1, A, F = "config.gate.th1", *OSCILLATION
PARAMETERS = {TH1: Interval(0.2, 50.0, is_log=True), **OSCILLATION}
START = {TH1: 1.0, A: 0.05, F: 3.0}
OBJECTIVE = Objective(track_f1=1.0, position=5.0, camera_motion=0.1)
PROBLEM = problem_of(SCENES, SOFT, PARAMETERS, OBJECTIVE)
ONE_STEP = Schedule(num_steps=1, pairs_per_step=2, learning_rate=0.2)


@given(st.floats(1e-3, 1e3), st.floats(1.001, 1e3), st.booleans(), st.floats(-30, 30))
def test_intervals_map_every_number_inside_and_back(low, factor, is_log, free):
    interval = Interval(low, factor * low, is_log)
    parameter = float(interval.to_parameter(jnp.asarray(free)))
    assert interval.low * (1 - 1e-9) <= parameter <= interval.high * (1 + 1e-9)
    if abs(free) < 10:
        assert interval.to_free(parameter) == pytest.approx(free, abs=1e-5)
    slope = float(jax.grad(interval.to_parameter)(jnp.asarray(free)))
    assert np.isfinite(slope) and slope >= 0


def test_a_step_averages_both_estimates_over_the_pairs_and_goes_down():
    """Against runs made one by one here: the loss at x ± ε, its finite differences, and the weights of the two."""
    (step,) = descend(PROBLEM, START, ONE_STEP, key=KEY)
    free, sigma, h = PROBLEM.to_free(START), np.array([0.05, 0.05, 0.4]), 1e-5

    def loss(number, seed, free):
        lane = {"scene": jnp.asarray(number), "sign": jnp.asarray(1.0)}
        key = jax.random.fold_in(jax.random.fold_in(KEY, 0), seed)
        return float(plain(PROBLEM, free, jnp.zeros(3), jnp.asarray(ONE_STEP.temperature(0)), lane, key)["loss"])

    plain = jax.jit(module._value_and_gradient)
    losses, pathwise, of_pairs = [], [], []
    for seed in range(4):
        key = jax.random.fold_in(jax.random.fold_in(KEY, 0), seed)
        shift = sigma * np.asarray(jax.random.normal(jax.random.fold_in(key, 3), (3,)))
        pair = [loss(seed // 2, seed, free + sign * shift) for sign in (1, -1)]
        slopes = [
            [
                (loss(seed // 2, seed, free + sign * shift + d) - loss(seed // 2, seed, free + sign * shift - d))
                / (2 * h)
                for d in h * np.eye(3)
            ]
            for sign in (1, -1)
        ]
        losses.append(np.mean(pair))
        pathwise.append(np.mean(slopes, axis=0))
        of_pairs.append((pair[0] - pair[1]) * shift / (2 * sigma**2))
    assert (step.loss, step.num_failed) == (pytest.approx(np.mean(losses), rel=1e-9), 0)
    # Two scenes of two pairs: half the squared difference of the two is a variance, of one degree of freedom each.
    losses, pathwise, of_pairs = (np.reshape(each, (2, 2, -1)) for each in (losses, pathwise, of_pairs))

    def variance(pairs):
        return np.mean((pairs[:, 0] - pairs[:, 1]) ** 2 / 2, axis=0)

    assert step.loss_se == pytest.approx(np.sqrt(variance(losses)[0] / 4), rel=1e-9)
    weight = 1 / variance(pathwise)
    weight = weight / (weight + 1 / variance(of_pairs))
    np.testing.assert_allclose(list(step.pathwise.values()), weight, rtol=1e-3)
    both = weight * pathwise + (1 - weight) * of_pairs
    np.testing.assert_allclose(list(step.gradient.values()), both.mean(axis=(0, 1)), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(list(step.gradient_se.values()), np.sqrt(variance(both) / 4), rtol=1e-3)


def test_steps_go_down_the_gradient_in_units_of_its_errors():
    """Against plain NumPy: as long as the learning rate where that is sure, and shorter where it is not."""
    schedule = dataclasses.replace(ONE_STEP, num_steps=4)
    steps = descend(PROBLEM, START, schedule, key=KEY)
    assert steps[0].parameters == {path: pytest.approx(value) for path, value in START.items()}
    free = PROBLEM.to_free(START)
    for k, step in enumerate(steps):
        np.testing.assert_allclose(PROBLEM.to_free(step.parameters), free, rtol=1e-7, atol=1e-9)
        in_errors = np.array(list(step.gradient.values())) / np.array(list(step.gradient_se.values()))
        certainty = min(1.0, np.sqrt(np.mean(in_errors**2) / 2))
        rate = 0.2 * (0.1 + 0.9 * (1 + np.cos(np.pi * k / 4)) / 2)
        free = free - rate * certainty * in_errors / np.linalg.norm(in_errors)


@pytest.mark.parametrize(
    ("gradient", "error", "length"),
    [
        ([3.0, 4.0, 0.0], [1.0, 1.0, 1.0], 0.2),  # 5 errors: as long as the learning rate
        ([0.3, 0.4, 0.0], [1.0, 1.0, 1.0], 0.2 * 0.5 / np.sqrt(6)),  # half an error in all
        ([1e-3, 0.0, 0.0], [1e-6, 1.0, 1.0], 0.2),  # small but certain
        ([1e-3, 2e-3, 0.0], [np.nan] * 3, 0.2),  # errors not known
        ([0.0, 0.0, 0.0], [np.nan] * 3, 0.0),
        ([0.0, 0.0, 0.0], [0.0] * 3, 0.0),
    ],
)
def test_a_step_is_as_long_as_it_is_sure(gradient, error, length):
    paths, free = list(PARAMETERS), np.zeros(3)
    step = module.Step(START, 1.0, 0.5, 0.1, *(dict(zip(paths, v, strict=True)) for v in (gradient, error)), {}, 0)
    optimiser = ONE_STEP.optimiser(3)
    moved, _ = module._move(optimiser, free, optimiser.init(jnp.asarray(free)), step)
    assert np.linalg.norm(moved) == pytest.approx(length, rel=1e-6)
    np.testing.assert_allclose(moved[1] * gradient[0], moved[0] * gradient[1], rtol=1e-5, atol=1e-12)


def test_steps_draw_new_seeds_the_temperature_falls_and_a_stopped_descent_goes_on():
    schedule = Schedule(num_steps=3, pairs_per_step=1, temperature_start=4.0, temperature_end=1.0)
    told = []
    steps = descend(PROBLEM, START, schedule, key=KEY, progress=told.append)
    assert [step.temperature for step in steps] == pytest.approx([4.0, 2.0, 1.0])
    assert told == [steps[:1], steps[:2], steps]
    assert len({step.loss for step in steps}) == 3
    assert descend(PROBLEM, START, schedule, key=KEY, history=steps[:2]) == steps
    assert descend(PROBLEM, START, schedule, key=KEY, history=steps) == steps
    # Steps of another rule would be continued from where they never were.
    elsewhere = [steps[0], steps[1]._replace(parameters=steps[2].parameters)]
    with pytest.raises(ValueError, match=r"step 1 was taken at .* lead to .*another version; begin anew"):
        descend(PROBLEM, START, schedule, key=KEY, history=elsewhere)
    # The end is where the last step led, which is where the next one would have been taken.
    assert end_of(PROBLEM, schedule, steps[:2]) == pytest.approx(steps[2].parameters, rel=1e-9)
    assert end_of(PROBLEM, schedule, steps) != pytest.approx(steps[2].parameters, rel=1e-9)
    for path, interval in PARAMETERS.items():
        assert all(interval.low < step.parameters[path] < interval.high for step in steps)


def test_the_end_is_the_mean_after_each_step_of_the_last_quarter_in_the_free_numbers(monkeypatch):
    monkeypatch.setattr(module, "_move", lambda optimiser, free, state, step: (free + step.loss, state))
    start = PROBLEM.to_free(START)
    sizes = np.array([0.1, -0.2, 0.3, 0.1, 0.05, -0.1, 0.2, 0.4])
    steps = [module.Step(dict(START), 1.0, size, 0.0, {}, {}, {}, 0) for size in sizes]
    expected = start + np.cumsum(sizes)[6:].mean()
    np.testing.assert_allclose(PROBLEM.to_free(end_of(PROBLEM, Schedule(num_steps=8), steps)), expected, rtol=1e-9)


def broken_after(num_calls: int, monkeypatch):
    """Runs that went non-finite: all of them after so many calls, all but one of four pairs before."""
    calls = []

    def run_lanes(*_, **__):
        calls.append(len(calls))
        losses = np.array([1.0, 2.0, np.nan, 3.0, *(np.nan,) * 4])
        runs = {"loss": losses, "gradient": np.ones((8, 3)), "shift": np.ones((8, 3))}
        return runs if len(calls) <= num_calls else {name: np.full_like(v, np.nan) for name, v in runs.items()}

    monkeypatch.setattr(module, "run_lanes", run_lanes)


def test_of_many_parameters_the_derivative_is_taken_in_reverse_mode():
    """And is that of forward mode."""
    more = {"config.gate.th2": Interval(0.1, 10.0, is_log=True), "config.pixel_std_px": Interval(0.5, 2.0)}
    many = problem_of(SCENES, SOFT, PARAMETERS | more, OBJECTIVE)
    assert many.config.reverse_mode and not PROBLEM.config.reverse_mode
    forward = eqx.tree_at(lambda p: p.config, many, PROBLEM.config)
    free = jnp.asarray(many.to_free(START | {"config.gate.th2": 0.7, "config.pixel_std_px": 1.0}))
    lane, temperature = {"scene": jnp.asarray(0), "sign": jnp.asarray(1.0)}, jnp.asarray(1.0)
    found, expected = (
        jax.jit(module._value_and_gradient, compiler_options=QUICK)(problem, free, 0.1 * free, temperature, lane, KEY)
        for problem in (many, forward)
    )
    np.testing.assert_allclose(found["loss"], expected["loss"], rtol=1e-9)
    np.testing.assert_allclose(found["gradient"], expected["gradient"], rtol=1e-6, atol=1e-9)
    assert np.all(np.abs(expected["gradient"]) > 1e-6)


def test_what_goes_non_finite_is_left_out_and_counted(monkeypatch):
    broken_after(1, monkeypatch)
    first, *rest = descend(PROBLEM, START, dataclasses.replace(ONE_STEP, num_steps=3), key=KEY)
    assert (first.loss, first.num_failed) == (1.5, 3)
    assert list(first.gradient.values()) == [1.0, 1.0, 1.0]  # of a single pair the pathwise one alone
    assert all(step.num_failed == 4 and np.isnan(step.loss) for step in rest)
    assert rest[0].parameters == rest[1].parameters  # no step was taken from there


def test_no_step_is_taken_along_a_gradient_that_is_not_finite():
    """Nor does the optimiser remember it."""
    optimiser, free = ONE_STEP.optimiser(3), np.array([0.1, -0.2, 0.3])
    state = optimiser.init(jnp.asarray(free))
    step = module.Step(START, 1.0, 0.5, 0.1, dict.fromkeys(START, 1.0), dict.fromkeys(START, 0.5), {}, 0)
    moved, moved_state = module._move(optimiser, free, state, step)
    assert np.all(moved < free)
    for gradient in (np.nan, np.inf, -np.inf):
        broken = step._replace(gradient=step.gradient | {A: gradient})
        found, found_state = module._move(optimiser, moved, moved_state, broken)
        np.testing.assert_array_equal(found, moved)
        assert found_state is moved_state


def test_an_objective_that_is_not_finite_at_the_start_is_refused(monkeypatch):
    broken_after(0, monkeypatch)
    with pytest.raises(ValueError, match=r"not finite at the start, {'config.gate.th1': 1.0"):
        descend(PROBLEM, START, ONE_STEP, key=KEY)


def test_a_step_too_far_ends_inside():
    """However long a step, its parameter stays inside the interval, where it can be gone on from."""
    nothing = dict.fromkeys(PARAMETERS, 0.0)
    here = PROBLEM.to_parameters(PROBLEM.to_free(START))
    step = module.Step(here, 1.0, 0.5, 0.1, dict.fromkeys(PARAMETERS, 1.0), dict.fromkeys(PARAMETERS, 0.1), nothing, 0)
    schedule = Schedule(learning_rate=1e9)
    optimiser = schedule.optimiser(len(PARAMETERS))
    free = PROBLEM.to_free(START)
    free, _ = module._move(optimiser, free, optimiser.init(jnp.asarray(free)), step)
    there = PROBLEM.to_parameters(free)
    np.testing.assert_allclose(PROBLEM.to_free(there), free, rtol=1e-6)
    assert there[TH1] < 0.21 and end_of(PROBLEM, schedule, [step]) == pytest.approx(there)
