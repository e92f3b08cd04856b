"""Sweeps: equal to separate calls, labelled by path, refused before anything compiles."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_runs
from jax.tree_util import Partial
from tiny_runs import NUM_SEEDS, assert_same_runs, compilations

import vcjax as vc
from vcjax.study import monte_carlo as module
from vcjax.study.monte_carlo import monte_carlo
from vcjax.study.summary import summarise
from vcjax.study.sweep import Experiment, check_sweep, numeric_paths, replace_at

KEY = jax.random.key(7)
TH1, AMPLITUDE = "config.gate.th1", "scenario.oscillation.amplitude_m"
# The last is legal, but the camera's displacement between two frames overflows.
THRESHOLDS, AMPLITUDES_M = [1.0, 9.0], [0.0, 0.05, 1.7e308]


@cache
def swept_runs():
    sweep = {TH1: THRESHOLDS, AMPLITUDE: np.array(AMPLITUDES_M)}
    return monte_carlo(tiny_runs.scenario(), tiny_runs.config(), num_seeds=NUM_SEEDS, key=KEY, sweep=sweep)


def experiment(**options) -> Experiment:
    return Experiment(tiny_runs.scenario(**options), tiny_runs.config())


def test_grid_equals_separate_calls():
    runs = swept_runs()
    assert runs.position_error_m.dims == (TH1, AMPLITUDE, "seed", "frame")
    assert runs.is_moving.dims == (TH1, AMPLITUDE, "feature")
    np.testing.assert_array_equal(runs[TH1], THRESHOLDS)
    np.testing.assert_array_equal(runs[AMPLITUDE], AMPLITUDES_M)
    assert "robot_true" not in runs  # it differs from point to point
    for th1 in THRESHOLDS:
        for amplitude_m in AMPLITUDES_M[:2]:
            alone = monte_carlo(
                tiny_runs.scenario(oscillation_amplitude_m=amplitude_m),
                tiny_runs.config(vc.VirtualCorrection(th1)),
                num_seeds=NUM_SEEDS,
                key=KEY,
            )
            point = runs.sel({TH1: th1, AMPLITUDE: amplitude_m})
            assert_same_runs(point, alone, rtol=1e-9, atol=1e-10)
    good = runs.isel({AMPLITUDE: [0, 1]})
    assert (good.isel({TH1: 0}).num_recovered.sum() > good.isel({TH1: 1}).num_recovered.sum()).item()


def test_failed_point_is_counted_and_spoils_no_other():
    runs = swept_runs()
    assert not runs.is_finite.sel({AMPLITUDE: 1.7e308}).any()
    assert runs.is_finite.isel({AMPLITUDE: [0, 1]}).all()
    summary = summarise(runs)
    np.testing.assert_array_equal(summary.runs_failed.transpose(TH1, AMPLITUDE), [[0, 0, NUM_SEEDS]] * 2)
    mean = summary.position_rmse_cm.sel(statistic="mean")
    np.testing.assert_array_equal(np.isfinite(mean.transpose(TH1, AMPLITUDE)), [[True, True, False]] * 2)


def test_values_of_one_path_share_a_compilation_whatever_they_are():
    swept_runs()
    with compilations() as compiled:
        other = monte_carlo(
            tiny_runs.scenario(dynamic=None),
            tiny_runs.config(),
            num_seeds=NUM_SEEDS,
            key=KEY,
            sweep={TH1: [2, 3], AMPLITUDE: [0, 0.01, 0.02]},
        )
    assert compiled.num == 0 and other.sizes[TH1] == 2


def test_paths_reach_every_number_and_nothing_else():
    base = Experiment(tiny_runs.scenario(oscillation_frequency_hz=0.1), tiny_runs.config(blacklist_capacity=8))
    paths = list(numeric_paths(base))
    assert len(set(paths)) == len(paths)
    for path in (
        "config.gate.th1",
        "config.gate.th2",
        "config.detector.min_corrected_ratio",
        "config.pixel_std_px",
        "scenario.oscillation.frequency_hz",
        "scenario.movers.speed_m_s",
        "scenario.pixel_std_px",
        "scenario.odometry_std.5",
        "scenario.increment.0",
    ):
        assert path in paths
    heads = {path.removesuffix(f".{i}") for path in paths for i in range(10)}
    assert not heads & {"config.max_landmarks", "config.update", "scenario.num_frames", "scenario.landmarks_m"}
    assert not any("movers.ids" in path for path in paths)
    for path in paths:  # every one of them can be replaced, by one number as well as by several
        replace_at(base, {path: np.float64(0.25)})
        replace_at(base, {path: jnp.array([0.25, 0.3])})


def test_replaces_leaves_and_elements_together():
    old = experiment()
    values = {"scenario.odometry_std.1": 0.25, "scenario.odometry_std.5": 0.5, "config.gate.th2": 3.0}
    new = replace_at(old, values)
    np.testing.assert_array_equal(new.scenario.odometry_std, [0.005, 0.25, 0, 0, 0, 0.5])
    assert new.config == dataclasses.replace(old.config, gate=vc.VirtualCorrection(th2=3.0))
    traced = jax.jit(lambda v: replace_at(old, {"scenario.odometry_std.1": v}).scenario.odometry_std)(0.75)
    np.testing.assert_array_equal(traced, [0.005, 0.75, 0, 0, 0, 0.05])


def test_lanes_get_their_own_values_and_seeds(monkeypatch):
    """Elements of vectors too. A run that only says what it was given, so that nothing large is compiled."""
    monkeypatch.setattr(
        module, "run_one", lambda point, key: {"std": point.scenario.odometry_std, "key": jax.random.key_data(key)}
    )
    work = Partial(module._run_point, experiment())
    lanes = module.run_lanes(work, {"scenario.odometry_std.5": np.array([0.1, 0.2])}, np.array([4, 9]), KEY)
    np.testing.assert_array_equal(lanes["std"], [[0.005, 0.005, 0, 0, 0, 0.1], [0.005, 0.005, 0, 0, 0, 0.2]])
    np.testing.assert_array_equal(lanes["key"], [jax.random.key_data(jax.random.fold_in(KEY, i)) for i in (4, 9)])


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        ({"config.gate.th3": [1.0]}, r"no numeric leaf 'config.gate.th3'; choose among: .*config.gate.th1, "),
        ({"th1": [1.0]}, r"no numeric leaf 'th1'"),
        ({"config.max_updates": [5.0]}, r"no numeric leaf 'config.max_updates'"),
        ({"scenario.odometry_std.6": [5.0]}, r"no numeric leaf 'scenario.odometry_std.6'"),
        ({TH1: []}, r"sweep\['config.gate.th1'\] = \[\]: give a list of at least one number"),
        ({TH1: 9.0}, r"= 9.0: give a list"),
        ({TH1: [[9.0]]}, r"= \[\[9.0\]\]: give a list"),
        ({TH1: ["high"]}, r"= \['high'\]: give a list"),
        ({TH1: [4.0, -1.0, 9.0]}, r"VirtualCorrection\(th1=-1.0\): a threshold .* is positive"),
        ({TH1: [4.0, np.nan]}, r"VirtualCorrection\(th1=nan\)"),
        ({"config.gate.th2": [-0.1]}, r"VirtualCorrection\(th2=-0.1\).*at least 0"),
        ({"scenario.oscillation.frequency_hz": [3.0, 5.0]}, r"frequency_hz=5.0\) is not below half .* 10.0 Hz"),
        ({"scenario.frame_rate_hz": [20.0, 6.0]}, r"frequency_hz=3.0\) is not below half .* 6.0 Hz"),
        ({AMPLITUDE: [-0.05]}, r"Oscillation\(amplitude_m=-0.05\)"),
        ({"config.pixel_std_px": [0.0]}, r"FilterConfig\(pixel_std_px=0.0\): give a positive"),
        ({"scenario.pixel_std_px": [1.0, -1.0]}, r"Scenario\(pixel_std_px=-1.0\)"),
        ({"scenario.odometry_std.5": [0.1, -0.1]}, r"Scenario\(odometry_std=.*-0.1\]\)"),
        (
            {"scenario.movers.direction.1": [0.5, 0.0]},
            r"Movers\(direction=\[0.0, 0.0, 0.0\]\): give a direction; its len",
        ),
        ({"scenario.movers.speed_m_s": [-1.0]}, r"Movers\(speed_m_s=-1.0\)"),
    ],
)
def test_bad_sweep_is_refused_before_anything_compiles(sweep, message, unchecked):
    with compilations() as compiled, pytest.raises(ValueError, match=message):
        monte_carlo(tiny_runs.scenario(), tiny_runs.config(), key=KEY, sweep=sweep)
    assert compiled.num == 0


def test_values_are_checked_in_float32_too():
    """Where some of them round to what is refused; they are given on as they are."""
    sweep = {
        "config.gate.th1": [9.0, 1e-60],
        "scenario.odometry_std.5": [0.1, 0.2],
        "scenario.movers.direction.0": [0.0],
    }
    with jax.enable_x64(False):
        values = check_sweep(experiment(), sweep)
        with pytest.raises(ValueError, match=r"VirtualCorrection\(th1=-1.0\)"):
            check_sweep(experiment(), {"config.gate.th1": [9.0, -1.0]})
    assert {path: listed.tolist() for path, listed in values.items()} == sweep


def test_points_are_checked_as_a_grid_not_axis_by_axis():
    """A frequency that only another swept frame rate allows is fine, one that it forbids is not."""
    rate, frequency = "scenario.frame_rate_hz", "scenario.oscillation.frequency_hz"
    values = check_sweep(experiment(), {rate: [20.0, 30.0], frequency: [6.0, 9.0]})
    assert values[frequency].tolist() == [6.0, 9.0]
    with pytest.raises(ValueError, match=r"frequency_hz=4.0\) .* 7.0 Hz"):  # each is fine beside the default
        check_sweep(experiment(), {rate: [9.0, 7.0], frequency: [1.0, 4.0]})
