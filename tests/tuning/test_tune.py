"""Tuning: descents from several starts, which of their ends are judged, and going on after a stop."""

import json

import numpy as np
import pytest
import xarray as xr
from scipy import stats
from small_search import INTERVALS, KEY, OBJECTIVE, SCENES, SEEDS, SOFT, TH1, TH2, grid_search, invented_runs

from vcjax.tuning import descent
from vcjax.tuning import evaluate as evaluate_module
from vcjax.tuning import tune as tune_module
from vcjax.tuning.choice import Choice, setting_of
from vcjax.tuning.descent import Schedule, end_of
from vcjax.tuning.intervals import Interval
from vcjax.tuning.problem import problem_of
from vcjax.tuning.tune import tune


@pytest.fixture
def found() -> Choice:
    return grid_search()


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
    return invented_runs(found, columns, num_seeds)
