"""`vcjax detect`, in this process and tiny: what it writes, says and refuses."""

import dataclasses
import json

import pytest
import tiny_runs
from told import assert_one_line, said

from vcjax.cli import main
from vcjax.simulation import scenarios
from vcjax.study import detect as module
from vcjax.study import reproduce

pytestmark = pytest.mark.usefixtures("unchecked")  # as people have it
TINY = ["--num-frames", "12", "--motions", "lateral", "--speeds-m-s", "1", "0.5", "--amplitudes-m", "0", "0.1"]
TINY += ["--methods", "VC", "RE"]


@pytest.fixture(autouse=True)
def small_maps(monkeypatch):
    small = {
        name: method._replace(config=dataclasses.replace(method.config, **tiny_runs.CAPACITIES))
        for name, method in module.METHODS.items()
    }
    monkeypatch.setattr(module, "METHODS", small)
    # In so few frames only what is near the start is mapped.
    near = tiny_runs.scenario().landmarks_m[tiny_runs.MOVERS]
    monkeypatch.setitem(scenarios.DYNAMIC_PLACES_M, "ahead", near.tolist())


def test_detect_writes_its_scores_and_goes_on_where_it_stopped(tmp_path, capsys, monkeypatch):
    arguments = ["detect", *TINY, "--out", str(tmp_path)]
    whole, stopped = reproduce.monte_carlo, []

    def stops(*args, **options):
        if len(stopped) == 5:
            raise KeyboardInterrupt
        stopped.append(args)
        return whole(*args, **options)

    monkeypatch.setattr(reproduce, "monte_carlo", stops)
    assert main([*arguments, "--seeds", "3"]) == 130
    assert "`detect`" in said(capsys)[1] and len(list(tmp_path.rglob("seeds_00000-00002.nc"))) == 5
    done = []
    monkeypatch.setattr(reproduce, "monte_carlo", lambda *a, **o: done.append(a) or whole(*a, **o))
    assert main([*arguments, "--seeds", "3"]) == 0
    printed, told = said(capsys)
    assert len(done) == 20 - 5  # two methods, two amplitudes, two scenes with movers and three without
    content = json.loads((tmp_path / "detect.json").read_text())
    assert content["num_seeds"] == 3 and list(content["methods"]) == ["VC", "RE"]
    assert len(content["cells"]) == 8 and len(content["static_cells"]) == 12
    for cell in content["cells"]:
        assert cell["dynamic_motion"] == "lateral" and cell["runs"] == 3 and cell["runs_failed"] == 0
        assert list(cell["anees_bounds"]) == ["anees_position", "anees_pose", "anees_map"]
        for name in ("static_flagged_fraction", "delay_frames", "anees_position", "anees_pose", "anees_map"):
            assert set(cell[name]) == {"mean", "se"}
        for name in ("found_fraction", "found_of_mapped_fraction", "found_per_run"):
            assert set(cell[name]) == {"mean", "se"}
        difference = cell["difference"]["position_rmse_cm"]
        expected = cell["position_rmse_cm"]["mean"] - cell["static_scene_position_rmse_cm"]["mean"]
        assert difference["mean"] == pytest.approx(expected) and difference["num_pairs"] == 3
        assert difference["lower"] < difference["mean"] < difference["upper"]
        still = [
            other
            for other in content["static_cells"]
            if (other["detector"], other["amplitude_m"]) == (cell["detector"], cell["amplitude_m"])
            and other["robot_motion"] == "forward"
        ]
        assert [other["position_rmse_cm"] for other in still] == [cell["static_scene_position_rmse_cm"]]
    assert printed.strip() == (tmp_path / "detect.md").read_text().strip()
    assert (
        "## Steady camera" in printed and "| lateral, 0.5 m/s | VC |" in printed and "static, robot curved" in printed
    )
    for name in ("movers_found", "position"):
        assert f"wrote {tmp_path / 'figures' / name}.png" in told and (tmp_path / "figures" / f"{name}.svg").is_file()

    monkeypatch.setattr(reproduce, "monte_carlo", lambda *_, **__: pytest.fail("worked again"))
    before = (tmp_path / "detect.json").read_bytes()
    assert main([*arguments, "--seeds", "3"]) == 0 and (tmp_path / "detect.json").read_bytes() == before
    said(capsys)
    assert main([*arguments, "--seeds", "3", "--key", "1"]) == 1
    assert_one_line(said(capsys)[1], "other settings (key: ", "give another directory")
    assert (tmp_path / "detect.json").read_bytes() == before


def test_curves_are_run_when_asked_for(tmp_path, capsys):
    """At every threshold in the scenes with movers, with nothing compiled again for another."""
    arguments = ["detect", *TINY, "--methods", "VC", "--out", str(tmp_path), "--seeds", "2"]
    assert main(arguments) == 0
    assert not (tmp_path / "curves").exists() and not (tmp_path / "figures" / "roc.png").exists()
    assert "At other thresholds" not in said(capsys)[0]
    with tiny_runs.compilations() as compiled:
        assert main([*arguments, "--curves"]) == 0
    printed, told = said(capsys)
    assert compiled.num == 0
    for name in ("roc", "precision_recall"):
        assert f"wrote {tmp_path / 'figures' / name}.png" in told
    thresholds = module.METHODS["VC"].curve
    assert len(list(tmp_path.glob("curves/VC/threshold_*/*/seeds_00000-00001.nc"))) == 2 * 2 * (len(thresholds) - 1)
    curves = json.loads((tmp_path / "detect.json").read_text())["curves"]
    assert [(line["detector"], line["amplitude_m"]) for line in curves] == [("VC", 0.0), ("VC", 0.1)]
    for line in curves:
        assert [point["threshold"] for point in line["points"]] == list(thresholds)
        strictest = line["points"][-1]
        assert 0 <= strictest["found_of_mapped_fraction"]["mean"] <= 1 and strictest["flagged"] <= strictest["static"]
        assert line["points"][0]["found"] > strictest["found"]
    assert "## At other thresholds" in printed and "| steady | VC | **9** |" in printed


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0"], ["num_seeds=0", "at least one seed"]),
        (["--methods", "VC", "GLR"], ["methods=('VC', 'GLR')", "RE+velocity_glr"]),
        (["--methods"], ["methods=()", "at least one of"]),
        (["--motions"], ["motions=()", "at least one"]),
        (["--speeds-m-s"], ["speeds_m_s=()"]),
        (["--speeds-m-s", "1", "1"], ["speeds_m_s=(1.0, 1.0)", "each once"]),
        (["--speeds-m-s", "0"], ["speeds_m_s=(0.0,)", "positive"]),
        (["--speeds-m-s", "nan"], ["speeds_m_s=(nan,)", "positive"]),
        (["--amplitudes-m"], ["amplitudes_m=()"]),
        (["--amplitudes-m", "-0.1"], ["amplitude_m=-0.1"]),
        (["--num-frames", "0"], ["num_frames=0"]),
    ],
)
def test_bad_input_gets_one_line_before_any_work(arguments, words, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(reproduce, "monte_carlo", lambda *_, **__: pytest.fail("worked"))
    assert main(["detect", *TINY, *arguments, "--out", str(tmp_path)]) == 1
    assert_one_line(said(capsys)[1], *words)
    assert not any(path.is_file() for path in tmp_path.rglob("*"))
