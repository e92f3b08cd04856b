"""Scripts that tune and compare: what they ask for, by which keys, and what they make of the answers."""

import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import xarray as xr
from fake_runs import fake_runs
from invented_tuning import NUM_RUNS, best_of_grid, judged, times, tuned
from loaded_script import recorded, script
from scipy import stats
from small_search import TH1, TH2

from vcjax.report import style
from vcjax.study.results import SCHEMA, load
from vcjax.study.sweep import Experiment, check_sweep
from vcjax.tuning.choice import ALL, Seeds, setting_of
from vcjax.tuning.intervals import OSCILLATION, THRESHOLDS
from vcjax.tuning.losses import WANTED, Objective
from vcjax.tuning.scenes import Scenes

AMPLITUDE, FREQUENCY = OSCILLATION


@pytest.fixture(autouse=True)
def blank_figures(monkeypatch):
    """Drawn and written, but not rendered, which takes most of the time."""
    monkeypatch.setattr(style, "_bytes", lambda figure, kind: kind.encode())


def key_of(number: int | jax.Array) -> tuple[int, ...]:
    key = jax.random.key(number) if isinstance(number, int) else number
    return tuple(jax.random.key_data(key).tolist())


def paired(losses: np.ndarray, one: int, other: int) -> list[float]:
    """Mean and 95 % interval of a setting's losses (setting, seed) less another's, by Student's t."""
    test = stats.ttest_rel(losses[one], losses[other])
    return [np.mean(losses[one] - losses[other]), *test.confidence_interval(0.95)]


TUNINGS = {
    "tune_thresholds": (
        {"th1": 8.0, "th2": 7.0, "position_weight": 3.0, "speeds_m_s": (0.5,)},
        {TH1: (8.0, 1.0, 100.0), TH2: (7.0, 0.1, 100.0)},
        {"position": 3.0},
        ["lateral, 0.5 m/s", "inverse forward, 0.5 m/s"],
    ),
    "tune_oscillation": (
        {"amplitude_m": 0.04, "frequency_hz": 2.0, "motion_weight": 0.1, "speeds_m_s": (0.5, 0.25)}
        | {"max_amplitude_m": 0.1, "frequency_band_hz": (1.0, 4.0)},
        {AMPLITUDE: (0.04, 0.0, 0.1), FREQUENCY: (2.0, 1.0, 4.0)},
        {"camera_motion": 0.1},
        ["inverse forward, 0.5 m/s", "inverse forward, 0.25 m/s"],
    ),
}


@pytest.mark.parametrize("name", TUNINGS)
def test_tuning_is_of_the_numbers_asked_for_and_written(name, tmp_path, capsys, monkeypatch):
    options, expected, weights, scenes = TUNINGS[name]
    study = script(name)
    calls = recorded(monkeypatch, study, "tune", tuned)
    sizes = {"starts": 4, "steps": 5, "pairs": 6, "choosing_seeds": 3, "held_out_seeds": 2}
    study.main(study.Study(**options, **sizes, out=tmp_path))
    (given,) = calls
    assert (given.num_starts, given.schedule.num_steps, given.schedule.pairs_per_step) == (4, 5, 6)
    assert (given.seeds, given.directory, key_of(given.key)) == (Seeds(3, 2), tmp_path, key_of(0))
    assert given.config.smoothing == "soft" and given.objective == Objective(track_f1=1.0, **weights)
    before = {path: at for path, (at, _, _) in expected.items()}
    assert {path: (before[path], i.low, i.high) for path, i in given.parameters.items()} == expected
    content, table = json.loads((tmp_path / "tune.json").read_text()), (tmp_path / "tune.md").read_text()
    assert [content[each]["parameters"] for each in ("before", "after")] == [before, times(before, 1.2)]
    assert list(content["paired"]) == [*scenes, ALL]
    told = capsys.readouterr().out
    assert "held out: 1 of 2" in told and table in told and f"wrote {tmp_path / 'tune.json'}" in told
    names = [f"{figure}.{kind}" for figure in ("curves", "descent", "roc_by_scene") for kind in ("png", "svg")]
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == names


def test_a_sweep_is_over_both_thresholds_and_keeps_all_runs(tmp_path, capsys, monkeypatch):
    study = script("sweep_thresholds")

    def swept(given) -> xr.Dataset:
        axes = check_sweep(Experiment(given.scenario, given.config), given.sweep)
        runs = fake_runs(num_seeds=given.num_seeds).expand_dims(axes).assign_attrs(schema=SCHEMA)
        return runs.assign(position_error_m=0 * runs.position_error_m + 0.01 * (runs[TH1] + 10 * runs[TH2]))

    calls = recorded(monkeypatch, study.vc, "monte_carlo", swept)
    options = {"dynamic": "inverse_forward", "speed_m_s": 0.25, "amplitude_m": 0.02, "seeds": 3}
    study.main(study.Study(th1=(6.0, 9.0), th2=(1.0, 2.0, 3.0), **options, out=tmp_path / "runs.nc"))
    (given,) = calls
    movers, camera = given.scenario.movers, given.scenario.oscillation
    assert (movers.speed_m_s, camera.amplitude_m, given.num_seeds) == (0.25, 0.02, 3)
    assert movers.direction.tolist() == [-1.0, 0.0, 0.0] and key_of(given.key) == key_of(0)
    runs = load(tmp_path / "runs.nc")
    assert dict(runs.position_error_m.sizes) == {TH1: 2, TH2: 3, "seed": 3, "frame": 20}
    rows = [line.split()[:3] for line in capsys.readouterr().out.splitlines()[1:7]]
    assert [[float(each) for each in row] for row in rows] == [[a, b, a + 10 * b] for a in (6, 9) for b in (1, 2, 3)]


FAILED = ((0, 1, 2), (1, 3, 5))
"""One seed failed with the setting before only, one by gradient only."""


@pytest.fixture
def against(monkeypatch):
    """The comparison of gradient and grid: the script, and a run of it that gives the calls of what takes time."""
    study = script("gradient_against_grid")
    answers = {"tune": tuned, "search": best_of_grid, "evaluate": lambda given: judged(given, *FAILED)}
    calls = {name: recorded(monkeypatch, study, name, answer) for name, answer in answers.items()}
    sizes = {"points": 2, "grid_seeds": 3, "starts": 3, "steps": 5, "learning_rate": 0.2, "near": 1, "pairs": 6}
    sizes |= {"choosing_seeds": 4, "held_out_seeds": 9, "seeds_by_scene": 2}

    def run(what: str, **options) -> SimpleNamespace:
        study.main(study.Study(what, **sizes, **options))
        return SimpleNamespace(**{name: each[-1] for name, each in calls.items()})

    return study, run


def test_gradient_and_grid_are_compared_in_pairs_and_a_seed_that_failed_is_in_no_mean(tmp_path, capsys, against):
    given, out = against[1]("thresholds", key=1, grid_key=0, out=tmp_path), tmp_path / "thresholds"
    both = out / "gradient_1_against_grid_0" / "choice_of_2_and_1_near"  # one of the three starts is left out
    directories = given.tune.directory, given.search.directory, given.evaluate.directory
    assert directories == (out / "gradient_1", out / "grid_0", both / "held_out")
    schedule = given.tune.schedule
    assert (schedule.num_steps, schedule.pairs_per_step, schedule.learning_rate) == (5, 6, 0.2)
    assert (given.tune.num_starts, given.tune.num_near, given.evaluate.num_seeds) == (3, 1, 9)
    assert (given.tune.seeds, given.search.seeds) == (Seeds(4, 2), Seeds(3, 2))
    for each in (given.tune, given.search, given.evaluate):
        assert each.objective == WANTED and each.config is given.tune.config
        assert list(each.scenarios) == list(Scenes().make())
    before = {TH1: 9.0, TH2: 9.0}
    settings = {"before": before, "gradient": times(before, 1.2), "grid": {TH1: 2.0, TH2: 64.0}}
    assert given.evaluate.settings == {path: [each[path] for each in settings.values()] for path in before}

    report = json.loads((both / "report.json").read_text())
    assert {name: pytest.approx(setting) for name, setting in settings.items()} == report["settings"]
    losses = np.delete(judged(given.evaluate).loss.values, [2, 5], axis=2).mean(axis=1)
    assert report["held_out_seeds"] == 7 and list(report["loss"].values()) == pytest.approx(losses.mean(axis=1))
    expected = 100 * np.array(paired(losses, 1, 2)) / losses[2].mean()
    np.testing.assert_allclose(report["gradient_minus_grid_percent"], expected, rtol=1e-9)
    assert report["runs"] == {"gradient": NUM_RUNS + 4 * 6 * 4, "grid": 5 * 6 * 3}
    for path, side in ((out / "gradient_1" / "tune", "gradient"), (out / "grid_0" / "sweep", "grid")):
        content = json.loads(path.with_suffix(".json").read_text())
        assert [content[each]["parameters"] for each in ("before", "after")] == [before, report["settings"][side]]
        assert path.with_suffix(".md").is_file()
    assert (both / "landscape.png").is_file() and (both / "landscape.svg").is_file()
    told = capsys.readouterr().out
    assert "gradient: held out 1 2" in told and "grid: held out 1 2" in told and json.dumps(report, indent=1) in told


@pytest.mark.parametrize(("what", "intervals"), [("thresholds", THRESHOLDS), ("oscillation", OSCILLATION)])
def test_both_search_the_same_numbers_by_keys_of_their_own(what, intervals, tmp_path, monkeypatch, against):
    """A grid that was searched has the same key and folder beside other descents."""
    study, run = against
    for name in ("write_tuning", "write_search", "write_figure"):
        monkeypatch.setattr(study, name, lambda *_: [])
    drawn = []
    monkeypatch.setattr(study, "landscape_figure", lambda *given: drawn.append(given))
    runs = [run(what, out=tmp_path, **keys) for keys in ({"key": 0}, {"key": 1}, {"key": 1, "grid_key": 0})]
    first, second, mixed = ([key_of(each.key) for each in (run.tune, run.search, run.evaluate)] for run in runs)
    assert len({*first, *second}) == 6 and mixed == [second[0], first[1], second[2]]
    assert runs[2].tune.directory == runs[1].tune.directory != runs[0].tune.directory
    assert runs[2].search.directory == runs[0].search.directory != runs[1].search.directory
    assert len({run.evaluate.directory for run in runs}) == 3
    assert runs[0].tune.parameters == intervals and list(runs[0].search.axes) == list(intervals)
    for path, values in runs[0].search.axes.items():
        assert len(values) == 2 and intervals[path].low < values[0] < values[1] <= intervals[path].high
    by_gradient, of_grid = ([each[i] for each in runs[0].evaluate.settings.values()] for i in (1, 2))
    _, title, marks, ways = drawn[0]
    assert "6 scenes × 3 runs" in title
    assert [list(marks[name].values()) for name in ("by gradient", "the grid's best")] == [by_gradient, of_grid]
    assert [way[0] for way in ways] == [marks["before"]] * 2 and ways[1][1] == marks["by gradient"]


def test_each_setting_is_compared_with_the_first_on_the_same_runs(tmp_path, capsys, monkeypatch):
    """A seed that failed in one setting counts where the others are compared."""
    study, paths = script("before_and_after"), [TH1, TH2, AMPLITUDE, FREQUENCY]
    values = ((9.0, 8.0, 0.05, 3.0), (2.5, 10.5, 0.04, 2.0), (4.0, 6.0, 0.1, 1.5))
    calls = recorded(monkeypatch, study, "evaluate", lambda given: given.progress(1, 3) or judged(given, (2, 1, 4)))
    study.main(study.Study(values, speeds_m_s=(0.5,), seeds=8, key=5, out=tmp_path))
    (given,), scenes = calls, ["lateral, 0.5 m/s", "inverse forward, 0.5 m/s"]
    assert given.settings == {path: list(column) for path, column in zip(paths, zip(*values, strict=True), strict=True)}
    assert list(setting_of(given.scenarios, given.config, paths).values()) == [9.0, 9.0, 0.05, 3.0]
    assert (given.num_seeds, given.directory, key_of(given.key)) == (8, tmp_path / "runs", key_of(5))
    assert given.objective == WANTED and list(given.scenarios) == scenes
    losses, told = judged(given).loss.values, capsys.readouterr().out
    assert "1 of 3 settings" in told
    for i, left_out in ((1, []), (2, [4])):
        content = json.loads((tmp_path / f"setting_{i}.json").read_text())
        parameters = [list(content[side]["parameters"].values()) for side in ("before", "after")]
        assert parameters == [list(values[0]), list(values[i])] and "runs" not in content
        assert [content[side]["seeds_failed"] for side in ("before", "after")] == [0, len(left_out)]
        assert content["before"]["loss"]["mean"] == pytest.approx(losses[0].mean())
        # None failed in the first scene.
        for scene, each in ((ALL, np.delete(losses, left_out, axis=2).mean(axis=1)), (scenes[0], losses[:, 0])):
            difference = content["paired"][scene]["loss"]
            assert list(difference.values()) == [*map(pytest.approx, paired(each, i, 0)), each.shape[1]]
        table = (tmp_path / f"setting_{i}.md").read_text()
        assert f"| `{TH1}` | 9 | {values[i][0]:g} |" in table and table in told
    assert len([*tmp_path.iterdir()]) == 4


def test_one_setting_alone_has_nothing_to_be_compared_with(tmp_path, monkeypatch):
    study = script("before_and_after")
    monkeypatch.setattr(study, "evaluate", lambda *_, **__: pytest.fail("worked"))
    with pytest.raises(SystemExit, match="--settings: give at least two, four numbers each"):
        study.main(study.Study(((9.0, 9.0, 0.05, 3.0),), out=tmp_path))
    assert not any(tmp_path.iterdir())
