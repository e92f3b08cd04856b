"""Settings × scenes × seeds: the same runs as one by one, kept on disk block by block, and what is refused."""

import dataclasses

import jax
import numpy as np
import pytest
import tiny_runs
import xarray as xr

import vcjax as vc
from vcjax.study.roc import track_scores
from vcjax.study.summary import FIGURES, per_run
from vcjax.tuning import blocks
from vcjax.tuning import evaluate as module
from vcjax.tuning.evaluate import evaluate
from vcjax.tuning.losses import Objective

KEY = jax.random.key(5)
SCENES = {f"{v} m/s": tiny_runs.scenario(dynamic_speed_m_s=v, num_frames=8) for v in (0.5, 1.0)}
SETTINGS = {"config.gate.th2": [0.5, 3.0, 8.0], "scenario.oscillation.amplitude_m": [0.0, 0.05, 0.02]}
OBJECTIVE = Objective(track_f1=1.0, position=2.0, camera_motion=0.5)
CONFIG = tiny_runs.config(tiny_runs.STRICT)


def evaluated(**options):
    arguments = {"objective": OBJECTIVE, "num_seeds": 2, "key": KEY} | options
    return evaluate(SCENES, CONFIG, SETTINGS, **arguments)


@pytest.fixture(scope="module")
def runs():
    return evaluated()


def test_figures_are_those_of_monte_carlo(runs):
    assert dict(runs.loss.sizes) == {"setting": 3, "scene": 2, "seed": 2}
    np.testing.assert_array_equal(runs["config.gate.th2"], SETTINGS["config.gate.th2"])
    for i, (name, scenario) in ((0, ("0.5 m/s", SCENES["0.5 m/s"])), (2, ("1.0 m/s", SCENES["1.0 m/s"]))):
        gate = dataclasses.replace(CONFIG.gate, th2=SETTINGS["config.gate.th2"][i])
        amplitude = SETTINGS["scenario.oscillation.amplitude_m"][i]
        scenario = dataclasses.replace(scenario, oscillation=vc.Oscillation(amplitude, 3.0))
        one_by_one = vc.monte_carlo(scenario, dataclasses.replace(CONFIG, gate=gate), num_seeds=2, key=KEY)
        found, expected = runs.sel(setting=i, scene=name), per_run(one_by_one)
        for figure in FIGURES:
            np.testing.assert_allclose(found[figure], expected[figure], rtol=1e-12, err_msg=figure)
        np.testing.assert_array_equal(found.track_score, track_scores(one_by_one))
        np.testing.assert_array_equal(found.is_deleted, one_by_one.first_deleted > 0)
        np.testing.assert_array_equal(found.is_moving, one_by_one.is_moving)
        motion = 0.5 * (2 * np.pi * 3.0 * amplitude) ** 2
        loss = 1 - expected.detection_f1 + 2.0 * expected.position_rmse_cm / 100 + 0.5 * motion
        np.testing.assert_allclose(found.loss, loss, rtol=1e-7)
        np.testing.assert_allclose(found.camera_motion_m2_s2, motion, rtol=1e-6)


def test_who_moves_is_told_of_each_setting():
    """Of a speed that is swept from 0 on it is not the same in all."""
    scenes = {"lateral": SCENES["0.5 m/s"]}
    found = evaluate(scenes, CONFIG, {"scenario.movers.speed_m_s": [0.0, 0.5]}, num_seeds=1, key=KEY)
    assert found.is_moving.any("feature").squeeze().values.tolist() == [False, True]


def test_decisions_are_hard_whatever_the_configuration_says(runs):
    soft = dataclasses.replace(CONFIG, smoothing="soft")
    xr.testing.assert_identical(evaluate(SCENES, soft, SETTINGS, objective=OBJECTIVE, num_seeds=2, key=KEY), runs)


def test_finished_blocks_are_kept_and_not_run_again(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(blocks, "RUNS_PER_BLOCK", 4)  # one setting each

    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluated(directory=tmp_path, progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["settings_00000-00000.nc", "settings_00001-00001.nc"]
    worked, run_lanes = [], module.run_lanes
    monkeypatch.setattr(module, "run_lanes", lambda *given: worked.append(given) or run_lanes(*given))
    xr.testing.assert_identical(evaluated(directory=tmp_path), runs)
    assert len(worked) == 1
    xr.testing.assert_identical(evaluated(directory=tmp_path), runs)
    assert len(worked) == 1
    with pytest.raises(ValueError, match=r"settings_00000-00000\.nc has other settings \(objective\..*; give another"):
        evaluated(directory=tmp_path, objective=Objective())
    with pytest.raises(ValueError, match=r"other settings \(key: "):
        evaluated(directory=tmp_path, key=jax.random.key(6))
    more = {path: [*values, values[0]] for path, values in SETTINGS.items()}
    monkeypatch.setattr(module, "run_lanes", lambda *_: pytest.fail("worked"))
    changed = {path: [*values[:2], 1.0] for path, values in SETTINGS.items()}
    with pytest.raises(ValueError, match=r"settings_00002-00002\.nc has other settings \(settings\."):
        evaluate(SCENES, CONFIG, changed, objective=OBJECTIVE, num_seeds=2, key=KEY, directory=tmp_path)
    monkeypatch.setattr(blocks, "RUNS_PER_BLOCK", 8)
    with pytest.raises(ValueError, match=r"settings_00000-00000\.nc is of another number of settings than 4"):
        evaluate(SCENES, CONFIG, more, objective=OBJECTIVE, num_seeds=2, key=KEY, directory=tmp_path)
    monkeypatch.setattr(blocks, "RUNS_PER_BLOCK", 4)
    (tmp_path / "settings_00000-00000.nc").write_bytes(b"no")
    with pytest.raises(ValueError, match="not a readable NetCDF-4 file"):
        evaluated(directory=tmp_path)


def test_bad_input_is_refused_before_any_work(monkeypatch, unchecked):
    monkeypatch.setattr(module, "run_lanes", lambda *_: pytest.fail("worked"))
    for arguments, message in (
        ({"scenarios": {}}, "give at least one scene"),
        ({"config": None}, "give a FilterConfig"),
        ({"settings": {}}, "at least one path with its values"),
        ({"settings": {"config.gate.th2": []}}, "all of one length, at least 1"),
        ({"settings": {"config.gate.th1": [1.0], "config.gate.th2": [1.0, 2.0]}}, "all of one length"),
        ({"settings": {"config.gate.th3": [1.0]}}, "no numeric leaf 'config.gate.th3'; choose among"),
        ({"settings": {"config.gate.th1": [9.0, -1.0]}}, r"th1=-1.0\)"),
        ({"settings": {"scenario.oscillation.frequency_hz": [6.0]}}, "not below half the frame rate"),
        ({"num_seeds": 0}, r"num_seeds=0\): give a whole number of at least 1"),
        ({"num_seeds": True}, r"num_seeds=True\)"),
        ({"scenarios": [tiny_runs.scenario()] * 3}, r"evaluate\(scenarios=<list>\): give at least one scene"),
        ({"settings": [1.0]}, r"evaluate\(settings=\[1.0\]\): give at least one path"),
        ({"settings": {"config.gate.th2": "many"}}, "all of one length, at least 1"),
        ({"objective": "F1"}, r"objective='F1'\): give an Objective"),
        ({"directory": 3}, r"directory=3\): give a path"),
        ({"key": 0}, r"key=0\)"),
    ):
        given = {"scenarios": SCENES, "config": CONFIG, "settings": SETTINGS, "num_seeds": 2, "key": KEY} | arguments
        with pytest.raises(ValueError, match=message):
            evaluate(**given)
