"""`vcjax tune` and `vcjax sweep`, in this process and tiny: what they write, say and refuse."""

import json

import numpy as np
import pytest
import tiny_runs
import xarray as xr
from told import assert_one_line, said

from vcjax.cli import main
from vcjax.tuning import descent, evaluate
from vcjax.tuning.scenes import Scenes

pytestmark = pytest.mark.usefixtures("unchecked")  # as people have it
SCENES = ["--num-frames", "8", "--motions", "lateral", "--speeds-m-s", "1", "0.5", "--held-out-seeds", "3"]
TUNE = [*SCENES, "--num-steps", "2", "--pairs-per-step", "1", "--choosing-seeds", "2", "--landscape-points", "2"]
SWEEP = [*SCENES, "--x-points", "2", "--y-points", "3", "--seeds", "2"]


@pytest.fixture(autouse=True)
def small_maps(monkeypatch):
    for module in ("tune", "sweep"):
        monkeypatch.setattr(f"vcjax.commands.{module}.FilterConfig", tiny_runs.config)


def test_tune_writes_its_proof_and_goes_on_where_it_stopped(tmp_path, capsys, monkeypatch):
    arguments = ["tune", "joint", *TUNE, "--starts", "2", "--out", str(tmp_path), "--max-amplitude-m", "0.1"]
    assert main(arguments) == 0
    printed, told = said(capsys)
    folder = tmp_path / "joint"
    content = json.loads((folder / "tune.json").read_text())
    assert {"before", "after", "history", "paired"} <= set(content) and content["held_out_seeds"] == 3
    assert content["before"]["parameters"]["scenario.oscillation.amplitude_m"] == 0.05
    assert all(step["parameters"]["scenario.oscillation.amplitude_m"] < 0.1 for step in content["history"][1])
    assert len(content["before"]["parameters"]) == 4
    assert "| lateral, 0.5 m/s |" in printed and printed.strip() in (folder / "tune.md").read_text()
    for name in ("descent", "curves", "roc_by_scene", "landscape_thresholds", "landscape_oscillation"):
        assert f"wrote {folder / 'figures' / name}.png" in told and (folder / "figures" / f"{name}.png").is_file()

    monkeypatch.setattr(descent, "run_lanes", lambda *_: pytest.fail("worked again"))
    monkeypatch.setattr(evaluate, "run_lanes", lambda *_: pytest.fail("worked again"))
    before = (folder / "tune.json").read_bytes()
    assert main(arguments) == 0 and (folder / "tune.json").read_bytes() == before
    said(capsys)
    assert main([*arguments, "--learning-rate", "0.1"]) == 1
    assert_one_line(said(capsys)[1], "other settings (schedule: ", "give another directory")


def test_sweep_draws_a_grid_over_any_two_numbers(tmp_path, capsys):
    path, grid_options = "config.pixel_std_px", ["--x", "config.pixel_std_px", "--x-range", "0.5", "2"]
    assert main(["sweep", *SWEEP, *grid_options, "--out", str(tmp_path)]) == 0
    printed, told = said(capsys)
    content = json.loads((tmp_path / "sweep.json").read_text())
    assert content["grid_dimensions"] == [path, "config.gate.th2"]
    assert content["grid"][path] == pytest.approx([0.5, 2.0])
    np.testing.assert_allclose(content["grid"]["config.gate.th2"], np.geomspace(0.5, 64, 3))
    assert np.shape(content["grid"]["loss"]) == (2, 3)
    assert f"`{path}`" in printed and f"wrote {tmp_path / 'figures' / 'landscape'}.png" in told
    with xr.open_dataset(tmp_path / "sweep.nc") as runs:
        assert dict(runs.loss.sizes) == {path: 2, "config.gate.th2": 3, "scene": 2, "seed": 2}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["tune", "oscillation", "--max-amplitude-m", "2"], ["from 0 to 2", "between 0 and 0.5 m"]),
        (["tune", "oscillation", "--frequency-band-hz", "1", "7"], ["high=7", "below half the frame rate, 5 Hz"]),
        (["tune", "oscillation", "--frequency-band-hz", "4", "2"], ["high=2", "above low=4"]),
        (["tune", "oscillation", "--amplitude-m", "0.2"], ["amplitude_m", "0.2 is not inside"]),
        (["tune", "thresholds", "--held-out-seeds", "0"], ["held_out=0", "at least 1"]),
        (["tune", "thresholds", "--choosing-seeds", "0"], ["choosing=0", "at least 1"]),
        (["tune", "thresholds", "--starts", "0"], ["num_starts=0"]),
        (["tune", "thresholds", "--num-steps", "0"], ["num_steps=0"]),
        (["tune", "thresholds", "--th1", "-3"], ["th1=-3"]),
        (["tune", "thresholds", "--track-f1", "-1"], ["track_f1=-1"]),
        (["tune", "thresholds", "--landscape-points", "1"], ["--landscape-points 1", "at least 2"]),
        (["tune", "thresholds", "--frequency-hz", "6"], ["not below half the frame rate"]),
        (["sweep", "--x", "config.gate.th3"], ["no numeric leaf 'config.gate.th3'"]),
        (["sweep", "--x", "config.gate.th2"], ["two numbers", "config.gate.th2"]),
        (["sweep", "--x-range", "5", "1"], ["--x-range 5 1", "rising"]),
        (["sweep", "--y-range", "0", "1"], ["--y-range 0 1", "positive"]),
        (["sweep", "--y-points", "1"], ["--y-points 1", "at least two"]),
        (["sweep", "--seeds", "0"], ["choosing=0"]),
        (
            ["sweep", "--y", "scenario.oscillation.frequency_hz", "--y-range", "1", "9"],
            ["not below half the frame rate"],
        ),
    ],
)
def test_bad_input_gets_one_line_before_any_work(arguments, words, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(descent, "run_lanes", lambda *_: pytest.fail("worked"))
    monkeypatch.setattr(evaluate, "run_lanes", lambda *_: pytest.fail("worked"))
    assert main([*arguments, "--out", str(tmp_path)]) == 1
    assert_one_line(said(capsys)[1], *words)
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_scenes_are_every_motion_at_every_speed(unchecked):
    scenes = Scenes(speeds_m_s=(1.0, 0.5), amplitude_m=0.02, frequency_hz=2.0).make()
    assert list(scenes) == [f"{motion}, {v} m/s" for motion in ("lateral", "inverse forward") for v in ("1", "0.5")]
    for name, scenario in scenes.items():
        assert tuple(scenario.movers.direction) == ((0, 1, 0) if name.startswith("lateral") else (-1, 0, 0))
        assert scenario.movers.speed_m_s == float(name.split()[-2])
        assert (scenario.oscillation.amplitude_m, scenario.oscillation.frequency_hz) == (0.02, 2.0)
    with pytest.raises(ValueError, match="at least one each"):
        Scenes(motions=()).make()
