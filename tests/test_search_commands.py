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
TUNE = [*SCENES, "--num-steps", "2", "--pairs-per-step", "1", "--choosing-seeds", "2", "--landscape-points", "3"]
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
    assert content["steps_skipped"] == content["pairs_failed"] == 0 and content["starts_left_out"] == []
    wanted, origin, candidates = content["wanted"], content["origin"], content["candidates"]
    assert (wanted["track_f1"], wanted["position"], wanted["camera_motion"]) == (1.0, 2.0, 0.02)
    assert origin["seeds"] == {"class": "Seeds", "choosing": 2, "held_out": 3} and origin["key"] == "[0, 0]"
    assert origin["config"]["smoothing"] == "soft" and origin["schedule"]["num_steps"] == 2
    assert list(origin["scenarios"]) == ["lateral, 1 m/s", "lateral, 0.5 m/s"]
    assert origin["scenarios"]["lateral, 0.5 m/s"]["movers"]["speed_m_s"] == 0.5
    assert origin["parameters"]["scenario.oscillation.amplitude_m"]["high"] == 0.1
    assert candidates[0]["parameters"] == content["before"]["parameters"] and len(candidates) == 3
    assert content["after"]["parameters"] == min(candidates, key=lambda c: c["loss"]["mean"])["parameters"]
    assert "Wanted, by weight: `track_f1` 1, `position` 2, `camera_motion` 0.02." in printed
    assert "All 4 steps were taken, each with all of its runs." in printed
    assert "| lateral, 0.5 m/s |" in printed and printed.strip() in (folder / "tune.md").read_text()
    for name in ("descent", "curves", "roc_by_scene", "landscape_thresholds", "landscape_oscillation"):
        assert f"wrote {folder / 'figures' / name}.png" in told and (folder / "figures" / f"{name}.png").is_file()

    monkeypatch.setattr(descent, "run_lanes", lambda *_: pytest.fail("worked again"))
    monkeypatch.setattr(evaluate, "run_lanes", lambda *_: pytest.fail("worked again"))
    before = (folder / "tune.json").read_bytes()
    assert main([*arguments, "--landscape-points", "0"]) == 0
    assert not list((folder / "figures").glob("landscape_*"))  # those that were not asked for now
    assert main(arguments) == 0 and (folder / "tune.json").read_bytes() == before
    assert (folder / "figures" / "landscape_thresholds.png").is_file()
    said(capsys)

    # What is of other settings is refused before any work, as far as that can be known then.
    for changed, *words in (
        (["--learning-rate", "0.1"], "start_0.json", "other settings (schedule.", "give another directory"),
        (["--choosing-seeds", "3"], "choice_of_2/candidates", "other settings (num_seeds: 2, now 3)"),
        (["--held-out-seeds", "4"], "choice_of_2/held_out", "other settings (num_seeds: 3, now 4)"),
        (["--landscape-points", "4"], "landscape_thresholds", "another number of settings than"),
    ):
        assert main([*arguments, *changed]) == 1
        assert_one_line(said(capsys)[1], *words)
    for path in (folder / "descents").iterdir():
        path.unlink()  # the steps were lost: what they led to is found beside them
    assert main([*arguments, "--position", "3"]) == 1
    assert_one_line(said(capsys)[1], "settings_00000-", "other settings (objective.")


def test_sweep_draws_a_grid_over_any_two_numbers(tmp_path, capsys):
    path, grid_options = "config.pixel_std_px", ["--x", "config.pixel_std_px", "--x-range", "0.5", "2"]
    assert main(["sweep", *SWEEP, *grid_options, "--out", str(tmp_path)]) == 0
    printed, told = said(capsys)
    content = json.loads((tmp_path / "sweep.json").read_text())
    assert content["grid_dimensions"] == [path, "config.gate.th2"]
    assert content["grid"][path] == pytest.approx([0.5, 2.0])
    np.testing.assert_allclose(content["grid"]["config.gate.th2"], np.geomspace(0.5, 64, 3))
    assert np.shape(content["grid"]["loss"]) == (2, 3)
    assert content["wanted"]["position"] == 2.0 and content["origin"]["seeds"]["choosing"] == 2
    assert content["origin"]["config"]["smoothing"] == "hard" and content["origin"]["key"] == "[0, 0]"
    assert list(content["origin"]["scenarios"]) == ["lateral, 1 m/s", "lateral, 0.5 m/s"]
    assert f"`{path}`" in printed and f"wrote {tmp_path / 'figures' / 'landscape'}.png" in told
    with xr.open_dataset(tmp_path / "sweep.nc") as runs:
        assert dict(runs.loss.sizes) == {path: 2, "config.gate.th2": 3, "scene": 2, "seed": 2}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["tune", "oscillation", "--max-amplitude-m", "2"], ["--max-amplitude-m 2", "up to 0.5 m"]),
        (["tune", "joint", "--max-amplitude-m", "0"], ["--max-amplitude-m 0", "above 0"]),
        (
            ["tune", "oscillation", "--frequency-band-hz", "1", "7"],
            ["--frequency-band-hz 1 7", "below half the frame rate, 5 Hz"],
        ),
        (["tune", "oscillation", "--frequency-band-hz", "1", "5"], ["--frequency-band-hz 1 5", "below half"]),
        (["tune", "oscillation", "--frequency-band-hz", "-1", "4"], ["--frequency-band-hz -1 4", "from 0"]),
        (["tune", "oscillation", "--frequency-band-hz", "4", "2"], ["--frequency-band-hz 4 2", "rising"]),
        (["tune", "oscillation", "--frequency-band-hz", "nan", "2"], ["--frequency-band-hz nan 2"]),
        (["tune", "oscillation", "--amplitude-m", "0.2"], ["--amplitude-m 0.2", "below 0.15", "--max-amplitude-m"]),
        (["tune", "oscillation", "--amplitude-m", "0"], ["--amplitude-m 0", "above 0 and"]),
        (["tune", "joint", "--frequency-hz", "4.5"], ["--frequency-hz 4.5", "below 4.5", "--frequency-band-hz"]),
        (["tune", "thresholds", "--th1", "200"], ["--th1 200", "above 1 and below 100"]),
        (["tune", "thresholds", "--th2", "0.1"], ["--th2 0.1", "above 0.1 and below 100"]),
        (["tune", "thresholds", "--track-f1", "0", "--position", "0", "--camera-motion", "0"], ["all weights are 0"]),
        (["tune", "thresholds", "--position", "inf"], ["position=inf", "finite"]),
        (["tune", "thresholds", "--mover-weight", "0"], ["mover_weight=0", "positive"]),
        (["tune", "thresholds", "--speeds-m-s", "0.5", "0.5"], ["speeds_m_s=(0.5, 0.5)", "each once"]),
        (["tune", "thresholds", "--held-out-seeds", "0"], ["held_out=0", "at least 1"]),
        (["tune", "thresholds", "--choosing-seeds", "0"], ["choosing=0", "at least 1"]),
        (["tune", "thresholds", "--starts", "0"], ["num_starts=0"]),
        (["tune", "thresholds", "--num-steps", "0"], ["num_steps=0"]),
        (["tune", "thresholds", "--th1", "-3"], ["th1=-3"]),
        (["tune", "thresholds", "--track-f1", "-1"], ["track_f1=-1"]),
        (["tune", "thresholds", "--landscape-points", "1"], ["--landscape-points 1", "at least 3"]),
        (["tune", "thresholds", "--max-amplitude-m", "0.1"], ["--max-amplitude-m", "these stay", "`joint`"]),
        (["tune", "thresholds", "--frequency-band-hz", "1", "4"], ["--frequency-band-hz", "these stay"]),
        (["tune", "thresholds", "--frequency-hz", "6"], ["not below half the frame rate"]),
        (["sweep", "--x", "config.gate.th3"], ["no numeric leaf 'config.gate.th3'"]),
        (["sweep", "--x", "config.gate.th2"], ["two numbers", "config.gate.th2"]),
        (["sweep", "--x-range", "5", "1"], ["--x-range 5 1", "rising"]),
        (["sweep", "--y-range", "0", "1"], ["--y-range 0 1", "positive"]),
        (["sweep", "--y-points", "1"], ["--y-points 1", "at least two"]),
        (["sweep", "--x-points", "100000"], ["--x-points 100000", "at most 200"]),
        (["sweep", "--x", "config.temperature", "--x-range", "1", "2"], ["config.temperature", "no effect"]),
        (
            ["sweep", "--x", "scenario.oscillation.amplitude_m"],
            ["amplitude_m: give --x-range"],
        ),
        (["sweep", "--speeds-m-s", "0", "1"], ["'lateral, 0 m/s'", "nothing moves there", "track_f1 is the same"]),
        (["tune", "thresholds", "--speeds-m-s", "0", "1"], ["nothing moves there", "leave the scene out"]),
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


@pytest.mark.parametrize("command", ["tune", "sweep"])
@pytest.mark.parametrize("place", ["", "candidates", "held_out", "figures", "{}.json/x", "{}.md/x"])
def test_a_place_that_cannot_be_written_to_is_refused_before_any_work(command, place, tmp_path, capsys, monkeypatch):
    """A file where a directory is needed, or a directory where a file is."""
    monkeypatch.setattr(descent, "run_lanes", lambda *_: pytest.fail("worked"))
    monkeypatch.setattr(evaluate, "run_lanes", lambda *_: pytest.fail("worked"))
    arguments = ["tune", "thresholds", *TUNE] if command == "tune" else ["sweep", *SWEEP]
    folder = tmp_path / "out" / "thresholds" if command == "tune" else tmp_path / "out"
    in_choice = command == "tune" and place in ("candidates", "held_out")
    bad = folder / ("choice_of_3" if in_choice else "") / place.format(command)
    bad.parent.mkdir(parents=True, exist_ok=True)
    bad.write_text("mine")
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 1
    named = bad.parent if bad.name == "x" else bad
    assert_one_line(said(capsys)[1], str(named), "is a directory" if bad.name == "x" else "is a file")
    assert bad.read_text() == "mine"


def test_more_starts_extend_a_tuning_whose_landscapes_depend_on_the_choice(tmp_path, capsys):
    """A price of motion that only another start can pay: the other two numbers of each landscape change with it."""
    arguments = ["tune", "joint", *TUNE, "--camera-motion", "50", "--out", str(tmp_path), "--starts"]
    tuned = []
    for starts in ("1", "3"):
        assert main([*arguments, starts]) == 0, said(capsys)[1]
        tuned.append(json.loads((tmp_path / "joint" / "tune.json").read_text()))
    assert [len(each["history"]) for each in tuned] == [1, 3]
    assert tuned[0]["after"]["parameters"] != tuned[1]["after"]["parameters"]


def test_scenes_are_every_motion_at_every_speed(unchecked):
    scenes = Scenes(speeds_m_s=(1.0, 0.5), amplitude_m=0.02, frequency_hz=2.0).make()
    assert list(scenes) == [f"{motion}, {v} m/s" for motion in ("lateral", "inverse forward") for v in ("1", "0.5")]
    for name, scenario in scenes.items():
        assert tuple(scenario.movers.direction) == ((0, 1, 0) if name.startswith("lateral") else (-1, 0, 0))
        assert scenario.movers.speed_m_s == float(name.split()[-2])
        assert (scenario.oscillation.amplitude_m, scenario.oscillation.frequency_hz) == (0.02, 2.0)
    near = Scenes(motions=("lateral",), speeds_m_s=(0.5, 0.50000001, 2)).make()
    assert list(near) == ["lateral, 0.5 m/s", "lateral, 0.50000001 m/s", "lateral, 2 m/s"]
    for scenes, message in (
        (Scenes(motions=()), r"motions=\(\)\): give at least one, in a tuple"),
        (Scenes(speeds_m_s=(1.0, 0.5, 1)), r"speeds_m_s=\(1.0, 0.5, 1\)\): .* each once"),
        (Scenes(motions=("lateral", "lateral")), "motions=.* each once"),
        (Scenes(motions="lateral"), r"motions='lateral'\): give at least one, in a tuple"),
        (Scenes(speeds_m_s=0.5), r"speeds_m_s=0.5\)"),
    ):
        with pytest.raises(ValueError, match=message):
            scenes.make()
