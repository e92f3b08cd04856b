"""The choice among settings, a search on a grid, tuning: what is chosen, on which seeds, and going on after a stop."""

import json

import jax
import numpy as np
import pytest
import tiny_runs
import xarray as xr
from scipy import stats

from vcjax.tuning import choice as module
from vcjax.tuning import descent
from vcjax.tuning import evaluate as evaluate_module
from vcjax.tuning import tune as tune_module
from vcjax.tuning.choice import ALL, COMPARED, Choice, Seeds, by_scene, choose, setting_of, tracks_of
from vcjax.tuning.descent import Schedule, end_of
from vcjax.tuning.intervals import Interval
from vcjax.tuning.landscape import around, as_grid, means, search
from vcjax.tuning.losses import Objective
from vcjax.tuning.problem import problem_of
from vcjax.tuning.tune import tune

KEY = jax.random.key(5)
SCENES = {f"{v} m/s": tiny_runs.scenario(dynamic_speed_m_s=v, num_frames=8) for v in (0.5, 1.0)}
SOFT = tiny_runs.config(tiny_runs.STRICT, smoothing="soft")
OBJECTIVE = Objective(track_f1=1.0, position=2.0)
TH1, TH2 = "config.gate.th1", "config.gate.th2"
INTERVALS = {TH1: Interval(0.2, 50.0, is_log=True), TH2: Interval(0.1, 20.0, is_log=True)}
SEEDS = Seeds(2, 3)


@pytest.fixture(scope="module")
def found() -> Choice:
    return search(SCENES, SOFT, {TH1: [0.5, 4.0], TH2: [0.4, 1.0, 6.0]}, objective=OBJECTIVE, seeds=SEEDS, key=KEY)


def test_the_best_candidate_is_chosen_and_compared_on_other_seeds(found):
    assert found.before == {TH1: 1.0, TH2: 0.7} == setting_of(SCENES, SOFT, [TH1, TH2])
    loss = found.candidates.loss.mean(("scene", "seed")).values
    assert loss.shape == (7,) and len(set(loss)) > 3
    best = found.candidates.isel(setting=int(np.argmin(loss)))
    assert found.after == {TH1: float(best[TH1]), TH2: float(best[TH2])}
    assert dict(found.held_out.loss.sizes) == {"setting": 2, "scene": 2, "seed": 3}
    assert not np.isin(found.held_out.loss.values, found.candidates.loss.values).any()
    other = choose(SCENES, SOFT, [found.before], objective=OBJECTIVE, seeds=SEEDS, key=KEY)
    assert other.after == other.before
    # The seeds held out do not depend on the candidates.
    np.testing.assert_array_equal(other.held_out.loss[0], found.held_out.loss[0])


def test_a_grid_has_its_two_numbers_as_dimensions(found):
    grid = as_grid(found)
    assert grid.loss.dims == (TH1, TH2, "scene", "seed") and grid.loss.shape == (2, 3, 2, 2)
    for i, point in enumerate(found.candidates.setting.values[1:], start=1):
        one = found.candidates.isel(setting=i)
        same = grid.sel({TH1: float(one[TH1]), TH2: float(one[TH2])})
        np.testing.assert_array_equal(same.loss, one.loss)
        assert point == i


def test_figures_and_tracks_of_each_scene_and_of_all(found):
    runs = found.held_out.isel(setting=1)
    scenes, tracks = by_scene(runs), tracks_of(runs)
    assert list(scenes) == list(tracks) == [*SCENES, ALL]
    np.testing.assert_allclose(scenes[ALL].detection_f1, runs.detection_f1.mean("scene"))
    for name in SCENES:
        one = runs.sel(scene=name)
        np.testing.assert_array_equal(scenes[name].position_rmse_cm, one.position_rmse_cm)
        np.testing.assert_array_equal(tracks[name].score, one.track_score)
        np.testing.assert_array_equal(tracks[name].is_mover, np.tile(one.is_moving, (3, 1)))
    np.testing.assert_array_equal(tracks[ALL].score, np.concatenate([tracks[name].score for name in SCENES], axis=1))


def with_failed_run(runs: xr.Dataset, **place) -> xr.Dataset:
    """The same runs, one of which went non-finite."""
    failed = runs.copy(deep=True)
    failed.is_finite.loc[place] = False
    for name in (*COMPARED, "track_score"):
        if failed[name].dtype == float:
            failed[name].loc[place] = np.nan
    return failed


def test_a_seed_that_failed_in_one_scene_is_in_no_mean_over_all(found):
    first = next(iter(SCENES))
    runs = with_failed_run(found.held_out, setting=1, scene=first, seed=2).isel(setting=1)
    scenes, tracks = by_scene(runs), tracks_of(runs)
    assert np.isnan(scenes[ALL].position_rmse_cm[2]) and np.isnan(tracks[ALL].score[2]).all()
    unharmed = by_scene(found.held_out.isel(setting=1))[ALL]
    np.testing.assert_array_equal(scenes[ALL].position_rmse_cm[:2], unharmed.position_rmse_cm[:2])
    assert not np.isnan(tracks["1.0 m/s"].score[2]).all() and not np.isnan(scenes["1.0 m/s"].loss[2])


def test_means_of_a_grid_do_not_skip_a_run_that_failed(found):
    grid = as_grid(found._replace(candidates=with_failed_run(found.candidates, setting=1, scene="1.0 m/s", seed=0)))
    expected, points = means(as_grid(found)), means(grid)
    np.testing.assert_array_equal(np.isnan(points.loss), [[True, False, False], [False, False, False]])
    np.testing.assert_array_equal(points.loss.values.ravel()[1:], expected.loss.values.ravel()[1:])
    second = as_grid(found).position_rmse_cm.sel(seed=1).mean("scene")
    assert float(points.position_rmse_cm[0, 0]) == pytest.approx(float(second[0, 0]))


def test_a_candidate_with_a_run_that_failed_is_not_chosen(found, monkeypatch):
    """Though the mean of its others is the least."""
    best = int(np.argmin(found.candidates.loss.mean(("scene", "seed")).values))
    losses = found.candidates.loss[best].values
    scene, seed = np.unravel_index(losses.argmax(), losses.shape)
    place = {"setting": best, "scene": list(SCENES)[scene], "seed": int(seed)}
    failed = with_failed_run(found.candidates, **place)
    assert int(np.argmin(failed.loss.mean(("scene", "seed")).values)) == best
    monkeypatch.setattr(module, "evaluate", lambda *_, **__: failed)
    candidates = [{path: float(failed[path][i]) for path in (TH1, TH2)} for i in failed.setting.values]
    other = choose(SCENES, SOFT, candidates, objective=OBJECTIVE, seeds=SEEDS, key=KEY)
    assert other.after != candidates[best] and other.after in candidates


def test_the_landscape_around_a_setting_keeps_the_other_numbers(found):
    """At the middles of cells that fill the intervals."""
    setting = {TH1: 3.0, TH2: 0.7, "scenario.oscillation.amplitude_m": 0.02}
    grid = around(SCENES, SOFT, setting, INTERVALS, objective=OBJECTIVE, num_points=2, num_seeds=2, key=KEY)
    assert grid.loss.dims == (TH1, TH2, "scene", "seed") and grid.loss.shape == (2, 2, 2, 2)
    np.testing.assert_allclose(grid[TH1], [0.2 * 250**0.25, 0.2 * 250**0.75])


def test_runs_that_all_fail_are_refused(found, monkeypatch):
    failed = found.candidates.assign(loss=found.candidates.loss * np.nan)
    monkeypatch.setattr(module, "evaluate", lambda *_, **__: failed)
    with pytest.raises(ValueError, match="every candidate has runs that did not stay finite"):
        choose(SCENES, SOFT, [found.before], objective=OBJECTIVE, seeds=SEEDS, key=KEY)


def test_bad_searches_are_refused(unchecked):
    for axes, seeds, message in (
        ({TH1: [1.0, 2.0]}, SEEDS, "give two paths with their values"),
        ({TH1: [2.0, 1.0], TH2: [1.0]}, SEEDS, r"search\(axes\['config.gate.th1'\]\): .*in rising order"),
        ({TH1: "many", TH2: [1.0]}, SEEDS, r"axes\['config.gate.th1'\]\): .*in rising order"),
        ([TH1, TH2], SEEDS, "give two paths with their values"),
        ({TH1: [1.0], TH2: [1.0]}, 3, r"choose\(seeds=3\): give Seeds"),
        ({TH1: [1.0], TH2: []}, SEEDS, "in rising order"),
        ({TH1: [1.0], "config.gate.th3": [1.0]}, SEEDS, "no numeric leaf 'config.gate.th3'; choose among"),
        ({TH1: [1.0], "scenario.movers.speed_m_s": [1.0]}, SEEDS, r"is \[0.5, 1.0\] in the scenes; give all the same"),
    ):
        with pytest.raises(ValueError, match=message):
            search(SCENES, SOFT, axes, seeds=seeds, key=KEY)
    with pytest.raises(ValueError, match=r"settings\(scenarios=<list>\): give at least one scene"):
        search([tiny_runs.scenario()] * 2, SOFT, {TH1: [1.0], TH2: [1.0]}, key=KEY)
    with pytest.raises(ValueError, match=r"Seeds\(choosing=0\): give a whole number of at least 1"):
        Seeds(0, 3)
    with pytest.raises(ValueError, match=r"Seeds\(held_out=0\)"):
        Seeds(2, 0)


def tuned(directory=None, **options):
    arguments = {
        "objective": OBJECTIVE,
        "schedule": Schedule(num_steps=2, pairs_per_step=1),
        "num_starts": 2,
        "seeds": SEEDS,
        "key": KEY,
        "directory": directory,
    }
    return tune(SCENES, SOFT, INTERVALS, **arguments | options)


def test_tuning_descends_from_each_start_chooses_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    whole = tuned()
    first, second = whole.descents
    assert first[0].parameters == {TH1: pytest.approx(1.0), TH2: pytest.approx(0.7)}
    assert second[0].parameters != first[0].parameters and first[0].loss != second[0].loss
    problem, schedule = problem_of(SCENES, SOFT, INTERVALS, OBJECTIVE), Schedule(num_steps=2, pairs_per_step=1)
    ends = [setting_of(SCENES, SOFT, [TH1, TH2]), *(end_of(problem, schedule, steps) for steps in whole.descents)]
    for path in (TH1, TH2):
        np.testing.assert_allclose(whole.choice.candidates[path], [end[path] for end in ends], rtol=1e-12)
    assert whole.choice.after in ends
    assert (whole.num_runs, whole.num_skipped, whole.num_failed) == (2 * 2 * 2 * 2, 0, 0)

    def stop(name, done, total):
        if name.startswith("descent 2 of 2, loss ") and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tuned(tmp_path, progress=stop)
    assert len(json.loads((tmp_path / "descents" / "start_1.json").read_text())["steps"]) == 1
    steps, average = [], descent._average
    monkeypatch.setattr(descent, "_average", lambda *given: steps.append(given) or average(*given))
    again = tuned(tmp_path)
    assert len(steps) == 1 and again.descents == whole.descents and again.choice.after == whole.choice.after
    xr.testing.assert_identical(again.choice.held_out, whole.choice.held_out)
    assert tuned(tmp_path).descents == whole.descents and len(steps) == 1
    # Another start is one more descent: those that there are stay, and are among the candidates again.
    more = tuned(tmp_path, num_starts=3)
    assert len(steps) == 1 + 2 and more.descents[:2] == whole.descents
    # Of three ends the two are judged whose descents ended with the smaller smoothed loss.
    losses = [end.smoothed_loss for end in more.ends]
    assert [end.smoothed_loss for end in whole.ends] == losses[:2]
    assert losses == [pytest.approx(steps[-1].loss) for steps in more.descents]
    assert [end.is_judged for end in more.ends] == [loss < max(losses) for loss in losses]
    judged = [end.setting for end in more.ends if end.is_judged]
    np.testing.assert_allclose(more.choice.candidates[TH1][1:], [setting[TH1] for setting in judged], rtol=1e-12)
    assert tuned(tmp_path).choice.after == whole.choice.after and len(steps) == 3
    # So is what lies around the best end: quantiles of the neighbourhood, at 1/2, 1/4, 3/4 and 1/3, 2/3, 1/9.
    near = tuned(tmp_path, num_starts=3, num_near=3)
    assert len(steps) == 3 and near.ends == more.ends and near.choice.candidates.sizes["setting"] == 1 + 2 + 3
    best = problem.to_free(min(more.ends, key=lambda end: end.smoothed_loss).setting)
    for path, k, levels in ((TH1, 0, [0.5, 0.25, 0.75]), (TH2, 1, [1 / 3, 2 / 3, 1 / 9])):
        x = [problem.to_free(setting)[k] for setting in near.near]
        np.testing.assert_allclose(x, stats.norm(best[k], 0.05).ppf(levels), rtol=1e-6)
        np.testing.assert_allclose(near.choice.candidates[path][3:], [each[path] for each in near.near], rtol=1e-12)

    with pytest.raises(ValueError, match=r"start_0\.json has other settings \(schedule\..*; give another directory"):
        tuned(tmp_path, schedule=Schedule(num_steps=3, pairs_per_step=1))
    place = tmp_path / "descents" / "start_0.json"
    content = json.loads(place.read_text())
    first = content["steps"][0]
    for broken in (
        {"loss": "x"},
        {"parameters": 3},
        {"gradient": {TH1: "x"}},
        {"gradient": {"th1": 0.0}},
        {"lost": 0},
        {"num_failed": 1.5},
    ):
        place.write_text(json.dumps(content | {"steps": [first | broken]}))
        with pytest.raises(ValueError, match=r"start_0\.json: no steps of a descent"):
            tuned(tmp_path)
    place.write_text('{"origin": {}')
    with pytest.raises(ValueError, match=r"start_0\.json: no steps of a descent"):
        tuned(tmp_path)
    place.write_text(json.dumps(content | {"steps": [first | {"parameters": first["parameters"] | {TH1: 5.0}}]}))
    with pytest.raises(ValueError, match=r"start_0\.json: descend\(history\): step 0 was taken at .*th1': 5\.0"):
        tuned(tmp_path)


def test_bad_tuning_is_refused_before_any_work(monkeypatch, unchecked):
    monkeypatch.setattr(descent, "run_lanes", lambda *_: pytest.fail("worked"))
    for options, message in (
        ({"num_starts": 0}, r"num_starts=0\): give a whole number of at least 1"),
        ({"num_near": -1}, r"num_near=-1\): give a whole number"),
        ({"num_starts": True}, r"num_starts=True\): give a whole number"),
        ({"schedule": 3}, r"schedule=3\): give a Schedule"),
        ({"seeds": 3}, r"tune\(seeds=3\): give Seeds"),
        ({"objective": "F1"}, r"tune\(objective='F1'\): give an Objective"),
        ({"directory": 3}, r"tune\(directory=3\): give a path"),
        ({"key": 0}, r"key=0\)"),
    ):
        with pytest.raises(ValueError, match=message):
            tuned(**options)
    with pytest.raises(ValueError, match=r"config.gate.th1: Interval\(2, 3\): 1 is not inside"):
        tune(SCENES, SOFT, {TH1: Interval(2.0, 3.0)}, key=KEY)
    with pytest.raises(ValueError, match=r"is \[0.5, 1.0\] in the scenes"):
        tune(SCENES, SOFT, {"scenario.movers.speed_m_s": Interval(0.1, 2)}, key=KEY)


def broken_at(*starts: int):
    """Descents by invention: from these starts the objective is not finite."""
    begun = []

    def descend(problem, start, schedule, *, key, history, progress):
        begun.append(dict(start))
        if len(begun) - 1 in starts:
            raise descent.NotFinite(f"the objective is not finite at the start, {start}; start elsewhere.")
        nan = dict.fromkeys(start, np.nan)
        steps = list(history) or [
            descent.Step(dict(start), 1.0, 0.5, np.nan, *(dict.fromkeys(start, each) for each in (0.1, 0.02, 1.0)), 1),
            descent.Step(dict(start), 0.5, np.nan, np.nan, nan, nan, nan, 2),
        ]
        progress(steps)
        return steps

    return descend, begun


def test_a_later_start_where_the_objective_is_not_finite_is_left_out_and_told(tmp_path, found, monkeypatch):
    monkeypatch.setattr(evaluate_module, "_run_block", lambda *given: invented_block(found, *given))
    descend, begun = broken_at(1)
    monkeypatch.setattr(tune_module, "descend", descend)
    given = {"num_starts": 3, "directory": tmp_path}
    whole = tuned(**given)
    assert len(begun) == 3 and len(whole.descents) == 2 and whole.left_out == [begun[1]]
    assert whole.choice.candidates.sizes["setting"] == 3  # before, and two ends
    assert np.isnan(whole.ends[0].smoothed_loss) and all(end.is_judged for end in whole.ends)
    assert (whole.num_steps, whole.num_skipped, whole.num_failed) == (4, 2, 6)
    # JSON has no NaN: there are nulls, which are read back as what they were; and the start is not tried again.
    kept = (tmp_path / "descents" / "start_0.json").read_text()
    assert "NaN" not in kept and json.loads(kept)["steps"][1]["loss"] is None
    descend, begun = broken_at()
    monkeypatch.setattr(tune_module, "descend", descend)
    again = tuned(**given)
    assert len(begun) == 2 and again.left_out == whole.left_out and again.num_runs == whole.num_runs
    assert np.isnan(again.descents[0][1].loss) and np.isnan(again.descents[1][1].gradient[TH1])
    np.testing.assert_equal(again.descents, whole.descents)


def test_where_the_parameters_are_an_objective_that_is_not_finite_is_an_error(monkeypatch):
    monkeypatch.setattr(tune_module, "descend", broken_at(0)[0])
    with pytest.raises(ValueError, match="not finite at the start"):
        tuned()


def invented_block(found: Choice, scenarios, config, columns, objective, num_seeds, key) -> xr.Dataset:
    """Runs that were made already, under other settings and as many seeds."""
    number = len(next(iter(columns.values())))
    runs = found.held_out.isel(setting=np.zeros(number, int), seed=np.arange(num_seeds)).drop_vars([TH1, TH2])
    return runs.assign_coords({path: ("setting", values) for path, values in columns.items()})
