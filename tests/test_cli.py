"""The command line: which options reach what, its help, and one clear line for what it refuses."""

import subprocess
import sys

import numpy as np
import pytest
from fake_runs import fake_runs
from told import assert_one_line, said

import vcjax as vc
from vcjax.cli import main
from vcjax.study import monte_carlo as monte_carlo_module
from vcjax.study.reproduce import DETECTORS
from vcjax.study.results import describe

pytestmark = pytest.mark.usefixtures("unchecked")  # as people have it


@pytest.mark.parametrize(
    ("options", "gate", "th1"),
    [
        ([], "VirtualCorrection", 9.0),
        (["--gate=RE", "--th1=4"], "ReprojectionError", 4.0),
        (["--gate", "RE", "--gate", "VC", "--th2", "2"], "VirtualCorrection", 9.0),
        (["--out", "RE"], "VirtualCorrection", 9.0),
    ],
)
def test_gate_is_the_last_one_named(options, gate, th1, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    seen = []

    def monte_carlo(scenario, config, **_):
        seen.append(config)
        return fake_runs(num_seeds=2)

    monkeypatch.setattr("vcjax.commands.simulate.monte_carlo", monte_carlo)
    assert main(["simulate", *options]) == 0
    assert type(seen[0].gate).__name__ == gate and seen[0].gate.th1 == th1
    assert len(list(tmp_path.rglob("*"))) >= 1


@pytest.mark.parametrize("name", [None, *DETECTORS])
def test_detector_is_the_one_named_with_options_of_its_own(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    seen = []
    monkeypatch.setattr(
        "vcjax.commands.simulate.monte_carlo", lambda _, config, **__: seen.append(config) or fake_runs(num_seeds=2)
    )
    own = {"velocity_glr": ["--threshold", "20", "--velocity-std-m-s", "1"], "cusum": ["--drift", "3"]}
    named = [] if name is None else ["--detector", name]
    assert main(["simulate", "--gate", "RE", *named, *own.get(name, [])]) == 0
    expected = {"velocity_glr": vc.VelocityGLR(threshold=20, velocity_std_m_s=1.0), "cusum": vc.Cusum(3.0)}
    assert describe(seen[0].detector) == describe(expected.get(name, DETECTORS[name or "inlier_ratio"]()))


@pytest.mark.parametrize("detector", ["inlier_ratio", "velocity_glr"])
def test_what_is_flagged_can_be_followed(detector, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    seen = []
    monkeypatch.setattr(
        "vcjax.commands.simulate.monte_carlo", lambda _, config, **__: seen.append(config) or fake_runs(num_seeds=2)
    )
    options = ["--max-followed", "8", "--rest-frames", "30", "--rest-limit", "9", "--blacklist-capacity", "64"]
    assert main(["simulate", "--gate", "RE", "--detector", detector, *options]) == 0
    following = vc.Following(max_followed=8, rest_frames=30, rest_limit=9)
    assert describe(seen[0].following) == describe(following)


def test_numbers_given_reach_the_filter(tmp_path, monkeypatch, capsys):
    seen = []
    monkeypatch.setattr(
        "vcjax.commands.simulate.monte_carlo",
        lambda *given, **more: seen.append((*given, more)) or fake_runs(num_seeds=2),
    )
    options = "--robot curved --dynamic-set 3 4 5 --noise six_axis --pixel-error-std-px 0.5 --pixel-std-px 2 "
    options += "--min-searches 7 --no-retire --update stacked --prior predicted --th2 0"
    assert main(["simulate", *options.split(), "--out", str(tmp_path / "runs.nc")]) == 0
    scenario, config, more = seen[0]
    assert scenario.increment[2] == 0.5 and scenario.odometry_std[2] == 0.005
    assert np.asarray(scenario.movers.ids).tolist() == [3, 4, 5]
    assert (scenario.pixel_std_px, config.pixel_std_px) == (0.5, 2.0)
    assert (config.detector.min_searches, config.retire, config.update) == (7.0, False, "stacked")
    assert (config.gate.prior, config.gate.th2, more["num_seeds"]) == ("predicted", 0.0, 25)


def test_every_number_of_the_scenario_has_an_option(tmp_path, monkeypatch, capsys):
    seen = []
    monkeypatch.setattr(
        "vcjax.commands.simulate.monte_carlo", lambda *given, **_: seen.append(given) or fake_runs(num_seeds=2)
    )
    options = "--start 1 2 30 --increment 0.1 0 -1 --odometry-std 1 2 3 4 5 6 --mount 0 0 1 -80 0 -90 "
    options += "--intrinsics-px 300 200 250 251 --image-size-px 600 400 --distortion 0.1 -0.02 "
    options += "--grid-low-m -4 --grid-high-m 4 --grid-per-side 5 --grid-heights-m 0.5 --dynamic-direction 1 0 1 "
    options += "--dynamic-speed-m-s 0.5 --dynamic-places-m 0 0 0.5 2 -2 0.5"
    assert main(["simulate", *options.split(), "--out", str(tmp_path / "runs.nc")]) == 0
    expected = vc.scenarios.paper(
        dynamic_speed_m_s=0.5,
        dynamic_set=[12, 16],
        start=(1.0, 2.0, 30.0),
        increment=(0.1, 0.0, -1.0),
        odometry_std=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        mount=(0.0, 0.0, 1.0, -80.0, 0.0, -90.0),
        intrinsics_px=(300.0, 200.0, 250.0, 251.0),
        image_size_px=(600.0, 400.0),
        distortion=(0.1, -0.02),
        dynamic_direction=(1.0, 0.0, 1.0),
        grid_low_m=-4.0,
        grid_high_m=4.0,
        grid_per_side=5,
        grid_heights_m=(0.5,),
    )
    assert describe(seen[0][0]) == describe(expected)
    options = ["--dynamic", "lateral", "--dynamic-drawn", "4", "--dynamic-seed", "7"]
    assert main(["simulate", *options, "--out", str(tmp_path / "b.nc")]) == 0
    assert describe(seen[1][0]) == describe(vc.scenarios.paper(dynamic="lateral", dynamic_drawn=4, dynamic_seed=7))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", ["reproduce, report, simulate"]),
        ("reprot", ["reprot"]),
        ("report", ["PATH"]),
        ("report nowhere", ["nowhere: no results", "run `vcjax reproduce` first"]),
        ("report file", ["file: no results"]),
        ("reproduce --tables 2 6 --out new", ["no table 6; choose among (2, 3, 4, 5)"]),
        ("reproduce --tables --out new", ["give at least one of (2, 3, 4, 5)"]),
        ("reproduce --seeds 0 --out new", ["num_seeds=0", "give at least one seed"]),
        ("reproduce --out file", ["file"]),
        ("reproduce --out file/below", ["file"]),
        ("reproduce --seeds many", ["--seeds", "'many'"]),
        ("simulate --out file/below.nc", ["file is a file; give a place in a directory"]),
        ("simulate --out folder", ["folder is a directory; give the name of a file"]),
        ("simulate --seeds 0", ["num_seeds=0", "give at least one seed"]),
        ("simulate --devices 0", ["--devices 0: give at least one device"]),
        ("simulate --devices -1", ["--devices -1"]),
        (
            "simulate --distributed",
            ["processes cannot be joined", "give each --coordinator HOST:PORT, --num-processes and --process-id"],
        ),
        ("simulate --process-id 0", ["belong together: give all three"]),
        ("simulate --coordinator here:1 --num-processes 2 --process-id 2", ["--process-id 2 of --num-processes 2"]),
        ("simulate --coordinator here --num-processes 1 --process-id 0", ["--coordinator here: give HOST:PORT"]),
        ("simulate --coordinator 1234 --num-processes 1 --process-id 0", ["--coordinator 1234: give HOST:PORT"]),
        (
            "simulate --coordinator here:99999 --num-processes 1 --process-id 0",
            ["--coordinator here:99999: give HOST:PORT"],
        ),
        ("simulate --key 99999999999999999999", ["--key 99999999999999999999", "from 0 to 2**63 - 1"]),
        ("simulate --nonsense 3", ["--nonsense"]),
        ("simulate --gate XX", ["'XX'", "--gate", "'RE', 'VC'"]),
        ("simulate --gate RE --th2 3", ["--th2", "--th1"]),
        ("simulate --th1 -1", ["VirtualCorrection(th1=-1.0)", "is positive"]),
        ("simulate --gate RE --th1 0", ["ReprojectionError(th1=0.0)", "is positive"]),
        ("simulate --th2 nan", ["VirtualCorrection(th2=nan)"]),
        (
            "simulate --oscillation-frequency-hz 5",
            ["frequency_hz=5.0", "half the frame rate of 10.0 Hz", "lower frequency"],
        ),
        ("simulate --oscillation-amplitude-m -0.1", ["amplitude_m=-0.1"]),
        ("simulate --num-frames 0", ["num_frames=0", "at least 1"]),
        ("simulate --max-updates 0", ["max_updates=0", "at least 1"]),
        ("simulate --max-landmarks 8", ["max_updates=10", "max_landmarks=8", "raise max_landmarks"]),
        ("simulate --pixel-std-px -1", ["FilterConfig(pixel_std_px=-1.0)", "positive"]),
        ("simulate --pixel-error-std-px -1", ["pixel_std_px=-1.0", "at least 0"]),
        ("simulate --dynamic-set 1 162", ["162", "there are 162 features, numbered from 0"]),
        ("simulate --dynamic-set 5 5", ["Movers(ids=[5, 5])", "feature 5 comes twice"]),
        (
            "simulate --dynamic-places-m 4 0 0 4 3 0",
            ["places_m[1]=[4.0, 3.0, 0.0]", "no feature is there", "nearest, 59"],
        ),
        ("simulate --dynamic-drawn 200", ["num_drawn=200", "from 0 to 162"]),
        ("simulate --dynamic lateral --dynamic-direction 1 0 0", ["dynamic='lateral'", "give one of the two"]),
        ("simulate --start 1 2", ["--start"]),
        ("simulate --intrinsics-px 320 240 0 320", ["Camera(intrinsics_px=", "must be positive"]),
        ("simulate --odometry-std 0 0 0 0 0 -1", ["Scenario(odometry_std=", "at least 0"]),
        ("simulate --grid-per-side 0", ["grid(num_per_side=0)", "at least 1"]),
        ("simulate --dynamic-speed-m-s -1 --dynamic lateral", ["speed_m_s=-1.0", "at least 0"]),
        ("simulate --robot sideways", ["'sideways'", "--robot", "lateral"]),
        ("simulate --detector XX", ["'XX'", "--detector", "velocity_glr"]),
        ("simulate --detector velocity_glr --false-alarm-rate 2", ["VelocityGLR(false_alarm_rate=2.0)", "(0, 1)"]),
        ("simulate --detector velocity_glr --forgetting 0.9", ["VelocityGLR(forgetting=0.9)", "give a threshold"]),
        ("simulate --max-followed 8", ["Following(max_followed=8)", "set blacklist_capacity"]),
        ("simulate --key -1", ["--key -1", "from 0"]),
        ("detect --key -1", ["--key -1", "from 0"]),
        ("simulate --blacklist-frames -1", ["FilterConfig(blacklist_frames=-1.0)", "infinity: for good"]),
    ],
)
def test_what_is_refused_is_said_clearly(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "folder").mkdir()
    compiled = monte_carlo_module._run_lanes._cache_size()
    status = status_of(arguments.split())
    printed, told = said(capsys)
    assert status in (1, 2) and printed == "" and monte_carlo_module._run_lanes._cache_size() == compiled
    assert status == 1 or not any("=" in word for word in words)  # what our own classes refuse gets our own line
    if status == 1:
        assert_one_line(told, *words)
    else:  # the parser's box
        assert "Traceback" not in told and "dummy" not in told and all(word in told for word in words), told
    assert {path.name for path in tmp_path.iterdir()} == {"file", "folder"}


def status_of(arguments: list[str]) -> int:
    """Exit status of the command; the parser leaves by an exception of its own."""
    try:
        return main(arguments)
    except SystemExit as stop:
        return int(stop.code)


def test_interruption_is_told_without_a_traceback(monkeypatch, capsys, tmp_path):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("vcjax.commands.paper.reproduce", interrupt)
    assert main(["reproduce", "--out", str(tmp_path)]) == 130
    assert (
        "stopped; what `reproduce`, `detect`, `tune`, `sweep` and `run` have saved until now is on disk"
        in said(capsys)[1]
    )


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ([], ["reproduce", "report", "simulate", "track", "record", "inspect", "run", "evaluate"]),
        (["reproduce"], ["--seeds", "--tables", "2 3 4 5", "--out", "--key", "--devices", "the paper: 25"]),
        (["report"], ["PATH", "Directory of an earlier"]),
        (["simulate", "--gate", "RE"], ["--gate {RE,VC,one_point_ransac}", "--th1", "--min-searches"]),
        (
            ["simulate"],
            [
                "--gate {RE,VC,one_point_ransac}", "--seeds", "--out", "--th1", "--th2", "--prior", "--robot",
                "--dynamic", "speed, m/s",
                "--oscillation-amplitude-m", "--oscillation-frequency-hz", "Hz, below half the frame rate", "--noise",
                "step per frame, m", "--num-frames", "--max-landmarks", "--birth-margin-px", "px; at least 0", "1/m",
                "--min-corrected-ratio", "--mount", "camera in the robot frame", "--intrinsics-px", "--grid-heights-m",
                "--dynamic-places-m", "--dynamic-drawn", "--start", "--odometry-std", "(default: 9.0)",
                "(default: 0.05)",
            ],
        ),
    ],
)  # fmt: skip
def test_help_shows_every_option_with_its_unit(command, words, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    printed, told = said(capsys)
    assert not stop.value.code and told == ""
    for word in words:
        assert word in printed
    if command[:1] == ["simulate"]:
        assert ("--th2" in printed) == ("RE" not in command)


def test_installed_command_starts_with_one_line_for_bad_input(tmp_path):
    """In a process of its own, as people have it: exit status, no traceback, standard output left alone."""
    command = [
        sys.executable,
        "-m",
        "vcjax",
        "simulate",
        "--devices",
        "2",
        "--seeds",
        "0",
        "--out",
        str(tmp_path / "a.nc"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout == ""
    assert_one_line(done.stderr, "num_seeds=0")
