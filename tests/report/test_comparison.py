"""A comparison of settings against SciPy, as JSON, as Markdown, and as figures."""

import json

import numpy as np
import pytest
from invented_choice import SCENES, TH1, TH2, invented_choice
from scipy import stats

from vcjax.report import tuning as module
from vcjax.report.comparison import comparison, comparison_markdown
from vcjax.report.descent import descent_figure
from vcjax.report.detection_curves import curves_figure, roc_by_scene_figure
from vcjax.report.tuning import write_search, write_tuning
from vcjax.study.results import describe
from vcjax.tuning.choice import ALL, COMPARED, RECALL, Choice, Seeds
from vcjax.tuning.descent import Step
from vcjax.tuning.landscape import as_grid
from vcjax.tuning.losses import Objective
from vcjax.tuning.tune import End, Tuned


@pytest.fixture(scope="module")
def choice() -> Choice:
    return invented_choice()


def test_means_and_paired_intervals_are_those_of_scipy(choice):
    compared = comparison(choice)
    assert list(compared["paired"]) == [*SCENES, ALL] and compared["held_out_seeds"] == 30
    assert compared["runs"] == {"choosing": 60, "held_out": 120, "failed": 0, "map_full": 0}
    for name in COMPARED:
        for scene in (*SCENES, ALL):
            runs = choice.held_out[name]
            runs = runs.mean("scene", skipna=False) if scene == ALL else runs.sel(scene=scene)
            before, after = (runs.sel(setting=i).values for i in (0, 1))
            found = compared["after"]["metrics"][scene][name]
            np.testing.assert_allclose(found["mean"], np.nanmean(after), rtol=1e-12)
            np.testing.assert_allclose(found["se"], stats.sem(after, nan_policy="omit"), rtol=1e-12)
            difference = (after - before)[np.isfinite(after - before)]
            interval = stats.t.interval(0.95, len(difference) - 1, difference.mean(), stats.sem(difference))
            paired = compared["paired"][scene][name]
            assert paired["num_pairs"] == len(difference)
            np.testing.assert_allclose([paired["lower"], paired["upper"]], interval, rtol=1e-9)
    assert compared["after"]["loss"] == compared["after"]["metrics"][ALL]["loss"]
    recall = compared["paired"][ALL][RECALL]
    assert recall["lower"] < recall["mean"] < recall["upper"] and recall["mean"] > 0


def test_markdown_tells_what_is_decided(choice):
    compared = comparison(choice)
    text = comparison_markdown(compared)
    assert "| `config.gate.th2` | 9 | 27 |" in text and "30 seeds held out" in text
    line = next(line for line in text.splitlines() if line.startswith("| all scenes | ") and "cm" not in line)
    f1 = compared["after"]["metrics"][ALL]["detection_f1"]["mean"]
    assert f"→ {f1:.3f} [" in line and line.split(" | ")[1].startswith("**")


def test_seeds_that_failed_are_told_and_flatter_nobody(choice):
    """One of 30 went non-finite in one scene after, where it was good."""
    held_out = choice.held_out.copy(deep=True)
    held_out.is_finite[1, 0, 4] = False
    for name in COMPARED:
        held_out[name][1, 0, 4] = np.nan
    compared = comparison(choice._replace(held_out=held_out))
    assert (compared["before"]["seeds_failed"], compared["after"]["seeds_failed"]) == (0, 1)
    others = choice.held_out.position_rmse_cm.sel(setting=1).drop_sel(seed=4).mean()
    after = compared["after"]["metrics"]
    assert after[ALL]["position_rmse_cm"]["mean"] == pytest.approx(float(others))
    assert compared["paired"][ALL]["loss"]["num_pairs"] == compared["paired"][SCENES[0]]["loss"]["num_pairs"] == 29
    assert compared["paired"][SCENES[1]]["loss"]["num_pairs"] == 30
    assert "**0 seeds before and 1 after have a run that went non-finite" in comparison_markdown(compared)
    assert "went non-finite" not in comparison_markdown(comparison(choice))


@pytest.mark.parametrize(("failed_before", "failed_after"), [(0, 0), (0, 12), (3, 12)])
def test_equal_settings_do_not_differ_whatever_failed(choice, failed_before, failed_after):
    """Only what both sides have is compared, recall too, and in the same resamples."""
    held_out = choice.held_out.isel(setting=[0, 0]).copy(deep=True)
    for place in ((0, 0, slice(20, 20 + failed_before)), (1, 0, slice(failed_after))):
        held_out.is_finite[place] = False
        for name in (*COMPARED, "track_score"):
            held_out[name][place] = np.nan
    compared = comparison(choice._replace(held_out=held_out))
    num = 30 - failed_before - failed_after
    for scene, num_pairs in zip((*SCENES, ALL), (num, 30, num), strict=True):
        for name in ("loss", RECALL):
            expected = {"mean": 0.0, "lower": 0.0, "upper": 0.0, "num_pairs": num_pairs}
            assert compared["paired"][scene][name] == expected
        assert compared["before"]["metrics"][scene][RECALL]["se"] > 0.01


def test_of_few_seeds_recall_has_no_interval(choice):
    """Their resamples lie on one side of zero by chance: no interval, so nothing bold, and no error."""
    for num, has_interval in ((1, False), (7, False), (8, True)):
        few = comparison(choice._replace(held_out=choice.held_out.isel(seed=slice(num))))
        for scene in SCENES:
            recall = few["paired"][scene][RECALL]
            assert recall["num_pairs"] == num and np.isfinite(recall["mean"])
            assert np.isfinite([recall["lower"], recall["upper"]]).all() == has_interval
            assert np.isfinite(few["before"]["metrics"][scene][RECALL]["se"]) == has_interval


def test_recall_has_no_pairs_where_there_is_none(choice):
    """No mover among the tracks; and no seed that stayed finite on both sides."""
    static = choice.held_out.assign(track_score=choice.held_out.track_score.where(~choice.held_out.is_moving))
    failed = choice.held_out.copy(deep=True)
    failed.is_finite[0, :, :15] = failed.is_finite[1, :, 15:] = False
    failed["track_score"] = failed.track_score.where(failed.is_finite)
    for held_out in (static, failed):
        paired = comparison(choice._replace(held_out=held_out))["paired"]
        for scene in (*SCENES, ALL):
            assert paired[scene][RECALL]["num_pairs"] == 0
            assert all(np.isnan(paired[scene][RECALL][part]) for part in ("mean", "lower", "upper"))


def test_figures_of_one_scene_have_their_titles_whole(choice):
    one = choice._replace(held_out=choice.held_out.isel(scene=[0]))
    for figure in (roc_by_scene_figure(one), roc_by_scene_figure(choice), curves_figure(one)):
        figure.draw_without_rendering()
        box = figure._suptitle.get_window_extent()
        assert box.x0 >= 0 and box.x1 <= figure.bbox.width
    assert "scenes" not in curves_figure(one)._suptitle.get_text()


def test_curves_of_few_seeds_have_no_bands_nor_a_title_of_them(choice):
    for num in (7, 8):
        figure = curves_figure(choice._replace(held_out=choice.held_out.isel(seed=slice(num))))
        bands = [band for axes in figure.axes for band in axes.collections]
        drawn = [any(len(path.vertices) for path in band.get_paths()) for band in bands]
        assert len(drawn) == 4 and all(is_drawn == (num == 8) for is_drawn in drawn)
        assert ("bands" in figure._suptitle.get_text()) == (num == 8)


def test_figures_tell_what_they_cannot_show(choice, tmp_path, monkeypatch):
    """Curves without movers; and a best point where nothing is better than before."""
    static = choice.held_out.assign(track_score=choice.held_out.track_score.where(~choice.held_out.is_moving))
    for held_out, expected in (
        (static, [f"{side}: no mover was measured" for side in ("before", "after")]),
        (choice.held_out, []),
    ):
        figure = curves_figure(choice._replace(held_out=held_out))
        assert [[text.get_text() for text in axes.texts] for axes in figure.axes] == [expected, expected]
    marks = []
    monkeypatch.setattr(module, "landscape_figure", lambda grid, title, given: marks.append(given) or figure)
    for after in (choice.after, choice.before):
        write_search(choice._replace(after=after), tmp_path)
    assert marks[0] == {"before": choice.before, "best point": choice.after}
    assert marks[-1] == {"before, nothing is better": choice.before}


def test_a_descents_figure_names_its_numbers_as_the_landscape_does():
    steps = [Step({TH1: 9.0 + k, "config.pixel_std_px": 1.0}, 1.0, 0.5, 0.1, {}, {}, {}, 0) for k in range(3)]
    titles = [axes.get_title() for axes in descent_figure([steps]).axes]
    assert titles == ["smoothed objective", "Th₁", "pixel_std_px"]


def test_one_scene_stands_for_all_and_a_setting_that_stays_is_told(choice):
    one = choice._replace(held_out=choice.held_out.isel(scene=[0]))
    text = comparison_markdown(comparison(one))
    assert f"| {SCENES[0]} |" in text and f"| {ALL} |" not in text and "No candidate" not in text
    stays = comparison_markdown(comparison(choice._replace(after=choice.before)))
    assert "No candidate is better than the setting before" in stays


def test_a_choice_that_is_not_surely_better_on_other_seeds_is_told(choice):
    loss = choice.held_out.loss
    rng = np.random.default_rng(0)
    for rise, words in ((-0.2, None), (0.0, "is not surely smaller after than before"), (0.2, "is larger after than")):
        after = loss[0] + rise + rng.normal(0.0, 0.1, loss[0].shape)
        held_out = choice.held_out.assign(loss=loss.copy(data=np.stack([loss[0], after])))
        text = comparison_markdown(comparison(choice._replace(held_out=held_out)))
        assert ("On the seeds held out the objective" in text) == (words is not None) and (words or "") in text


def test_one_seed_is_called_one(choice):
    one = comparison_markdown(comparison(choice._replace(held_out=choice.held_out.isel(seed=[0]))))
    assert "Hard decisions, 1 seed held out" in one


def test_search_and_tuning_are_written_whole(choice, tmp_path):
    paths = write_search(choice, tmp_path / "sweep")
    assert all(path.is_file() and path.stat().st_size > 0 for path in paths)
    content = json.loads((tmp_path / "sweep" / "sweep.json").read_text())
    assert content["grid_dimensions"] == [TH1, TH2] and np.shape(content["grid"]["detection_f1"]) == (3, 3)
    grid = as_grid(choice)
    np.testing.assert_allclose(content["grid"]["loss"], grid.loss.mean(("scene", "seed")))
    figures = {path.name for path in paths if path.suffix == ".png"}
    assert figures == {
        "landscape.png", "landscape_scene_1.png", "landscape_scene_2.png", "curves.png", "roc_by_scene.png"
    }  # fmt: skip

    text = (tmp_path / "sweep" / "sweep.md").read_text()
    assert "all of these stayed finite" in text and "Wanted, by weight: `track_f1` 1, `position` 2.\n" in text
    assert content["wanted"] == describe(Objective(position=2.0)) and "candidates" not in content
    assert content["origin"] == {"vcjax": "0", "seeds": describe(Seeds(3, 30))}
    steps = [Step({TH1: 9.0 + k, TH2: 9.0 - k}, 1.0, 0.5, np.nan, {TH1: 0.1, TH2: 0.2}, {}, {}, k) for k in range(3)]
    steps.append(Step({TH1: 12.0, TH2: 6.0}, 1.0, np.nan, np.nan, {TH1: np.nan, TH2: np.nan}, {}, {}, 4))
    left_out = [{TH1: 50.0, TH2: 1.0}]
    points = choice.candidates.isel(setting=[0, 4, 9, 2]).copy(deep=True)
    points.loss[1, 0, 2] = np.nan
    choice = choice._replace(candidates=points)
    origin = {"vcjax": "1", "parameters": {TH1: "between"}}
    settings = [{path: float(points[path][i]) for path in (TH1, TH2)} for i in (1, 2)]
    other = {TH1: 5.0, TH2: 6.0}
    ends = [End(settings[0], 0.25, 0.01, True), End(other, 0.5, 0.02, False), End(settings[1], 0.375, np.nan, True)]
    tuned = Tuned([steps] * 3, ends, [{TH1: 7.0, TH2: 4.0}], choice, 96, origin, left_out)
    paths = write_tuning(tuned, {"thresholds": grid}, tmp_path / "tune")
    told = "1 of 4 starts were left out, 3 of 12 steps were not taken, 21 of 48 pairs of runs were left out of steps"
    assert told in (tmp_path / "tune" / "tune.md").read_text()
    content = json.loads((tmp_path / "tune" / "tune.json").read_text())
    assert content["before"]["parameters"] == choice.before and content["after"]["parameters"] == choice.after
    assert content["history"][1][2]["parameters"] == {TH1: 11.0, TH2: 7.0}
    assert content["history"][0][3]["loss"] is None and (content["steps_skipped"], content["pairs_failed"]) == (3, 21)
    assert content["starts_left_out"] == left_out
    assert content["wanted"] == describe(Objective(position=2.0))
    assert content["origin"] == {"vcjax": "1", "seeds": describe(Seeds(3, 30)), "parameters": {TH1: "between"}}
    before, failed, unasked, after, near = content["candidates"]
    losses = points.loss[3].mean("scene")
    assert near["name"] == "near the end of descent 1, 1" and near["parameters"] == {TH1: 7.0, TH2: 4.0}
    assert near["loss"]["mean"] == pytest.approx(float(losses.mean())) and near["is_judged"]
    assert before["parameters"] == choice.before and after["parameters"] == choice.after
    nothing = {"mean": None, "se": None}
    for number, (candidate, end) in enumerate(((failed, ends[0]), (unasked, ends[1])), start=1):
        name, smoothed = f"end of descent {number}", {"mean": end.smoothed_loss, "se": end.smoothed_se}
        expected = {"name": name, "parameters": end.setting, "smoothed_loss": smoothed, "is_judged": end.is_judged}
        expected |= {"loss": nothing}
        assert candidate == expected
    assert before["smoothed_loss"] == nothing and before["is_judged"]
    assert after["smoothed_loss"] == {"mean": 0.375, "se": None}
    losses = points.loss[2].mean("scene")
    assert after["loss"] == {"mean": pytest.approx(float(losses.mean())), "se": pytest.approx(stats.sem(losses))}
    text = (tmp_path / "tune" / "tune.md").read_text()
    assert "Wanted, by weight: `track_f1` 1, `position` 2.\n" in text
    assert "| end of descent 1 | 8 | 3 | 0.2500 ± 0.0100 | – |" in text
    assert "| end of descent 2 | 5 | 6 | 0.5000 ± 0.0200 | – |" in text and "of the 2 ends whose smoothed loss" in text
    chosen = f"| **end of descent 3** | 16 | 27 | 0.3750 | {after['loss']['mean']:.4f} ± {after['loss']['se']:.4f} |"
    assert chosen in text and "| before | 9 | 9 | " in text and "3 seeds of each scene" in text
    assert {"before", "after", "history", "paired"} <= set(content)
    figures = {path.name for path in paths if path.suffix == ".png"}
    assert figures == {"descent.png", "landscape_thresholds.png", "curves.png", "roc_by_scene.png"}
