"""The choice among settings and a search on a grid: what is chosen, and on which seeds."""

import numpy as np
import pytest
import tiny_runs
import xarray as xr
from small_search import INTERVALS, KEY, OBJECTIVE, SCENES, SEEDS, SOFT, TH1, TH2, grid_search

from vcjax.tuning import choice as module
from vcjax.tuning.choice import ALL, COMPARED, Choice, Seeds, by_scene, choose, setting_of, tracks_of
from vcjax.tuning.landscape import around, as_grid, means, search


@pytest.fixture
def found() -> Choice:
    return grid_search()


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


def test_means_over_all_scenes_are_of_the_same_scenes(found):
    """Delays: where no mover is found in a scene in one run, the mean of the others would be of other scenes."""
    first, second = SCENES
    runs = found.held_out.copy(deep=True)
    delay = runs.detection_delay_frames
    delay[:] = 10.0
    delay.loc[{"scene": second}] = 50.0
    delay.loc[{"scene": second, "setting": 0, "seed": 1}] = np.nan
    of_all = by_scene(runs)[ALL].detection_delay_frames
    np.testing.assert_array_equal(of_all, [[30.0, np.nan, 30.0], [30.0, 30.0, 30.0]])
    delay.loc[{"scene": second, "setting": 0}] = np.nan
    assert np.isnan(by_scene(runs)[ALL].detection_delay_frames[0]).all()
    # A scene that no run has a figure of, such as one without movers, is not asked for one.
    delay.loc[{"scene": second}] = np.nan
    np.testing.assert_array_equal(by_scene(runs)[ALL].detection_delay_frames, np.full((2, 3), 10.0))
    np.testing.assert_array_equal(by_scene(runs)[first].detection_delay_frames, np.full((2, 3), 10.0))


def test_means_of_a_grid_do_not_skip_a_run_that_failed(found):
    grid = as_grid(found._replace(candidates=with_failed_run(found.candidates, setting=1, scene="1.0 m/s", seed=0)))
    expected, points = means(as_grid(found)), means(grid)
    np.testing.assert_array_equal(np.isnan(points.loss), [[True, False, False], [False, False, False]])
    np.testing.assert_array_equal(points.loss.values.ravel()[1:], expected.loss.values.ravel()[1:])
    second = as_grid(found).position_rmse_cm.sel(seed=1).mean("scene")
    assert float(points.position_rmse_cm[0, 0]) == pytest.approx(float(second[0, 0]))


def test_means_of_a_grid_are_of_all_seeds_that_have_a_figure(found):
    """In each scene by itself; a scene that nobody has it in at a point leaves none there."""
    grid, (first, second) = as_grid(found).copy(deep=True), SCENES
    area = grid.detection_auc
    area[:] = 0.5
    area.loc[{"scene": second}] = [0.7, 0.9]
    area[0, 0].loc[{"scene": first, "seed": 0}] = np.nan
    area[0, 1].loc[{"scene": second}] = np.nan
    expected = np.full((2, 3), 0.65)
    expected[0, 1] = np.nan
    np.testing.assert_allclose(means(grid).detection_auc, expected)


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
    rest = {"objective": OBJECTIVE, "seeds": SEEDS, "key": KEY}
    with pytest.raises(ValueError, match=r"choose\(scenarios={}\): give at least one scene"):
        choose({}, SOFT, [{TH1: 1.0}], directory="anywhere", **rest)
    speeds = {TH1: [1.0], "scenario.movers.speed_m_s": [0.0, 1.0]}
    with pytest.raises(ValueError, match=r"search\(scenarios\['one'\]\): nothing moves there"):
        search({"one": tiny_runs.scenario(dynamic_speed_m_s=1.0)}, SOFT, speeds, key=KEY)
    for candidates in ([], [{TH1: 1.0}, {TH2: 1.0}], [1.0], "best"):
        with pytest.raises(ValueError, match=r"choose\(candidates=.*: give at least one setting, a mapping"):
            choose(SCENES, SOFT, candidates, **rest)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"choose\(directory=3"):
        choose(SCENES, SOFT, [{TH1: 1.0}], directory=3, **rest)  # pyright: ignore[reportArgumentType]
    for name in (1, True, ALL):
        scenes = {name: tiny_runs.scenario()}
        with pytest.raises(ValueError, match=rf"scenarios\[{name!r}\]: give each scene a name, a text other than"):
            search(scenes, SOFT, {TH1: [1.0], TH2: [1.0]}, key=KEY)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"Seeds\(choosing=0\): give a whole number of at least 1"):
        Seeds(0, 3)
    with pytest.raises(ValueError, match=r"Seeds\(held_out=0\)"):
        Seeds(2, 0)
