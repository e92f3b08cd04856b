"""Scripts that read what commands wrote: what they pair and compare, and what they refuse."""

import json
from pathlib import Path

import numpy as np
import pytest
from fake_runs import fake_runs, with_failed_seed
from loaded_script import script
from scipy import stats

from vcjax.simulation.scenarios import HARDER
from vcjax.study.detection_scenes import Scene, scenes_of
from vcjax.study.paper import Cell
from vcjax.study.results import SCHEMA, save

MOVING = Cell(4, "forward", "lateral", 1.0, "VC", True)


def written(directory: Path, scene: Scene, num_seeds: int, error_cm: float) -> None:
    """Runs of a scene whose position error is the same in every frame, and grows with the time in the map."""
    runs = fake_runs(MOVING, num_seeds=num_seeds)
    frames = runs.frames_mapped * 0 + runs.seed + 1
    error = runs.position_error_m * 0 + 0.01 * (error_cm + runs.seed)
    runs = runs.assign(frames_mapped=frames, position_error_m=error).assign_attrs(schema=SCHEMA)
    save(runs, directory / "runs" / "VC" / scene.identifier / f"seeds_00000-{num_seeds - 1:05d}.nc")


def test_consistency_tells_bounds_failed_runs_and_paired_differences_of_each_gate(tmp_path, capsys, monkeypatch):
    """In its files, not only on the screen."""
    study = script("consistency")
    worked = []

    def monte_carlo(scenario, config, *, num_seeds, **_):
        worked.append((type(config.gate).__name__, config.errors, scenario.num_frames))
        runs = fake_runs(MOVING, num_seeds=num_seeds)
        scale = 1 + 0.1 * runs.seed if config.errors == "invariant" else 1.0
        runs = runs.assign(position_error_m=runs.position_error_m * scale)
        return with_failed_seed(runs, 3) if config.errors == "invariant" else runs

    monkeypatch.setattr(study.vc, "monte_carlo", monte_carlo)
    study.main(study.Study(seeds=6, gates=("RE", "VC"), out=tmp_path))
    assert len(worked) == len(set(worked)) == 8
    report, table = json.loads((tmp_path / "consistency.json").read_text()), (tmp_path / "consistency.md").read_text()
    assert len(report) == 8 and capsys.readouterr().out.strip() in table
    cell = report["8 m, yaw 0.05 deg, VC, invariant"]
    assert (cell["num_runs"], cell["runs_failed"], cell["less_additive"]["num_pairs"]) == (6, 1, 5)
    for name, dof in (("anees_position", 2), ("anees_pose", 3), ("anees_map", 3)):
        expected = stats.chi2.ppf([0.025, 0.975], 5 * dof) / (5 * dof)
        assert list(cell["anees_bounds"][name].values()) == pytest.approx(expected)
    difference = cell["less_additive"]["position_rmse_cm"]
    assert difference["lower"] < difference["mean"] < difference["upper"] and "| 6, 1 |" in table
    assert "{mean:+.3f} [{lower:+.3f}, {upper:+.3f}]".format(**difference) in table


@pytest.fixture
def damage():
    return script("damage_before_detection")


def test_damage_is_against_the_scene_that_is_the_same_without_movers(tmp_path, capsys, damage):
    """Where the camera is badly known, that one's too; and with few seeds it is said that they are few."""
    moving, jittery = Scene(0.05, "lateral", 1.0), Scene(0.05, harder="jitter_5_mm")
    for scene, error in ((moving, 5.0), (Scene(0.05), 2.0), (jittery, 9.0), (jittery.static, 8.0)):
        written(tmp_path, scene, 7, error)
    damage.main(damage.Study(tmp_path, ("VC",)))
    told = capsys.readouterr().out
    assert f"{moving.identifier}: 7 seeds, static scene 5.00 cm, damage +3.00 ± 0.00 cm" in told
    assert f"{jittery.identifier}: 7 seeds, static scene 11.00 cm, damage +1.00 ± 0.00 cm" in told and "nan" not in told
    few = tmp_path / "few"
    written(few, moving, 1, 5.0)
    written(few, moving.static, 1, 2.0)
    damage.main(damage.Study(few, ("VC",)))
    told = capsys.readouterr().out
    assert "too few seeds to tell (1; at least 6)" in told and "nan" not in told


def test_damage_pairs_every_scene_of_the_command(damage):
    scenes = scenes_of((0.0, 0.05), ("lateral", "inverse_forward"), (1.0, 0.25), ("ahead", "near_path"), tuple(HARDER))
    for scene in (scene for scene in scenes if not scene.is_static):
        assert damage.static_of(Path("runs", "VC", scene.identifier)).name == scene.static.identifier


def test_damage_refuses_what_holds_no_runs_in_one_line(tmp_path, damage):
    written(tmp_path, Scene(0.05, "lateral", 1.0), 7, 5.0)
    for directory, method, words in (
        (tmp_path, "RE", "no scenes with movers"),
        (tmp_path / "no", "VC", "no scenes with movers"),
        (tmp_path, "VC", "A_0.05_forward_static: no runs"),
    ):
        with pytest.raises(SystemExit, match=words) as refused:
            damage.main(damage.Study(directory, (method,)))
        assert len(str(refused.value).splitlines()) == 1


def followed_run(num_frames=30):
    """Mover 3 stands from frame 10 to 19, and 4 is never followed; 7 stands always."""
    moves = np.zeros((num_frames, 8), bool)
    moves[:10, 3:5] = moves[20:, 3:5] = True
    nobody = np.full((num_frames, 2), -1)
    run = {"moves": moves, "deleted": nobody.copy(), "handed_back": nobody.copy(), "followed": nobody.copy()}
    run |= {"velocity_m_s": np.zeros((num_frames, 2, 3)), "error_m": np.full((num_frames, 3), 0.03)}
    run["deleted"][[2, 23], 0] = 3
    run["deleted"][5, 1] = 7
    run["followed"][2:14, 1] = 3
    run["velocity_m_s"][:, 1] = (0.3, 0.4, 0.0)
    run["handed_back"][14, 1] = 3
    return run


def test_followed_movers_are_counted_when_they_stop_stand_and_start_again():
    study, run = script("follow_movers"), followed_run()
    told = study.stops([run, run])
    assert "2 followed when they stop, their velocity off by 0.30, 0.10, 0.00 m/s" in told
    assert "2 handed back while they stand, within 4 frames (median)" in told
    assert "2 of these flagged again, within 3 frames (median) of their start; 0 handed back while they move" in told
    assert study.never_stop([run]) == "1 of 2 movers flagged and 0 of 1 others handed back"
    early = followed_run()
    early["handed_back"][[4, 14], 1] = 3, -1
    assert (
        "0 handed back while they stand" in (told := study.stops([early])) and "1 handed back while they move" in told
    )
    np.testing.assert_allclose(study.position_cm([run]), 100 * 0.03 * np.sqrt(3))
