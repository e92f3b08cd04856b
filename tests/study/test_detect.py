"""Scores of detection against plain Python, on invented runs; which scenes there are, and what is refused."""

import jax
import numpy as np
import pytest
import xarray as xr
from fake_runs import fake_runs
from scipy import stats

from vcjax.study import reproduce
from vcjax.study.detect import detect
from vcjax.study.detection_methods import METHODS
from vcjax.study.detection_scenes import Scene
from vcjax.study.detection_scores import Counts, counts, pooled, scores
from vcjax.study.operating_curves import operating_point
from vcjax.study.paper import Cell
from vcjax.study.results import attributes, describe
from vcjax.study.sweep import Experiment

NUM_SEEDS = 7
MOVING = Cell(4, "forward", "lateral", 1.0, "VC", True)


def invented(seed: int = 0) -> xr.Dataset:
    """Runs whose features were mapped, flagged and flagged again in every combination; one run has failed."""
    rng = np.random.default_rng(seed)
    runs = fake_runs(MOVING, num_seeds=NUM_SEEDS, num_frames=40)
    shape = runs.frames_mapped.shape
    mapped = rng.choice([0, 5, 19, 20, 40], size=shape)
    first = np.where(mapped > 0, rng.integers(1, 10, size=shape), 0)
    verdicts, deletions = (rng.integers(0, 2, size=shape) * (mapped > 0) for _ in range(2))
    flagged = verdicts + deletions > 0
    is_finite = np.ones(NUM_SEEDS, bool)
    is_finite[2] = False
    new = {
        "frames_mapped": mapped,
        "first_mapped": first,
        "dynamic_deletions": verdicts,
        "inconsistent_deletions": deletions,
        "first_deleted": np.where(flagged, first + rng.integers(1, 30, size=shape), 0),
        "velocity_error_m_s": np.where(deletions > 0, rng.random(shape), np.nan),
        "velocity_nees": np.where(deletions > 0, 3 * rng.random(shape), np.nan),
    }
    runs = runs.assign({name: (("seed", "feature"), values) for name, values in new.items()})
    return runs.assign(is_finite=("seed", is_finite), position_error_m=runs.position_error_m * (1 + 0.1 * seed))


def test_scores_equal_python_loops():
    runs, static = invented(1), invented(2)
    found, movers, false, mapped, delays = ([] for _ in range(5))
    velocity_errors, nees, ever_mapped = [], [], 0
    for s in range(NUM_SEEDS):
        if s == 2:
            continue
        counts, run = dict.fromkeys(("found", "movers", "false", "mapped", "delay"), 0), runs.isel(seed=s)
        for f in range(runs.sizes["feature"]):
            one = run.isel(feature=f)
            flagged = int(one.dynamic_deletions) > 0 or int(one.inconsistent_deletions) > 0
            if bool(runs.is_moving[f]):
                counts["movers"] += flagged or int(one.frames_mapped) >= 20
                counts["found"] += flagged
                ever_mapped += int(one.frames_mapped) > 0
                if int(one.inconsistent_deletions) > 0:
                    velocity_errors.append(float(one.velocity_error_m_s))
                    nees.append(float(one.velocity_nees) / 3)
                counts["delay"] += (int(one.first_deleted) - int(one.first_mapped)) if flagged else 0
            elif int(one.frames_mapped) > 0:
                counts["mapped"] += 1
                counts["false"] += flagged
        for into, name in zip(
            (found, movers, false, mapped, delays), ("found", "movers", "false", "mapped", "delay"), strict=True
        ):
            into.append(counts[name])
    score = scores(runs, static)
    assert 0 < sum(found) < sum(movers) < 6 * (NUM_SEEDS - 1) and 0 < sum(false) < sum(mapped)
    assert (score["movers_found"], score["movers"]) == (sum(found), sum(movers))
    assert score["movers_mapped"] == ever_mapped > score["movers"]
    assert score["found_of_mapped_fraction"]["mean"] == pytest.approx(sum(found) / ever_mapped)
    per_run = [np.mean(found), np.std(found, ddof=1) / np.sqrt(len(found))]
    assert list(score["found_per_run"].values()) == pytest.approx(per_run)
    assert (score["static_flagged"], score["static_mapped"]) == (sum(false), sum(mapped))
    assert (score["runs"], score["runs_failed"]) == (NUM_SEEDS, 1)
    assert score["found_fraction"]["mean"] == pytest.approx(sum(found) / sum(movers))
    assert score["static_flagged_fraction"]["mean"] == pytest.approx(sum(false) / sum(mapped))
    assert score["delay_frames"]["mean"] == pytest.approx(sum(delays) / sum(found))
    assert score["velocity_error_m_s"]["mean"] == pytest.approx(np.mean(velocity_errors))
    assert score["velocity_nees"]["mean"] == pytest.approx(np.mean(nees)) and len(nees) < sum(found)
    good = np.arange(NUM_SEEDS) != 2
    rmse, static_rmse = (100 * np.sqrt((r.position_error_m.values[good] ** 2).mean(1)) for r in (runs, static))
    assert score["position_rmse_cm"]["mean"] == pytest.approx(rmse.mean())
    assert score["position_rmse_cm"]["se"] == pytest.approx(rmse.std(ddof=1) / np.sqrt(NUM_SEEDS - 1))
    assert score["position_ratio"]["mean"] == pytest.approx(rmse.mean() / static_rmse.mean())
    anees = runs.nees_position.values[good].mean(1) / 2
    assert score["anees_position"]["mean"] == pytest.approx(anees.mean())
    assert score["anees_map"]["mean"] == pytest.approx(runs.nees_map.values[good].mean() / 3)
    low, high = stats.chi2.ppf([0.025, 0.975], 3 * (NUM_SEEDS - 1)) / (3 * (NUM_SEEDS - 1))
    assert score["anees_bounds"]["anees_map"] == pytest.approx({"lower": low, "upper": high})


def test_the_error_of_a_pooled_share_is_its_spread_over_many_studies():
    """And not that of independent features: those of a run share its luck."""
    rng = np.random.default_rng(0)
    whole = rng.integers(3, 7, size=(4000, 40))
    part = rng.binomial(whole, rng.beta(4, 2, size=whole.shape))
    found = [pooled(p, w) for p, w in zip(part, whole, strict=True)]
    ratios, errors = (np.array([each[name] for each in found]) for name in ("mean", "se"))
    np.testing.assert_allclose(np.mean(errors), np.std(ratios), rtol=0.05)
    independent = np.sqrt(np.mean(ratios) * (1 - np.mean(ratios)) / np.mean(whole.sum(1)))
    assert np.mean(errors) > 1.15 * independent


def test_a_share_of_nothing_is_unknown():
    assert np.isnan(list(pooled(np.zeros(3), np.zeros(3)).values())).all()
    one = pooled(np.array([2]), np.array([4]))
    assert one["mean"] == 0.5 and np.isnan(one["se"])
    assert pooled(np.array([6, 6]), np.array([6, 6])) == {"mean": 1.0, "se": 0.0}


def test_runs_of_a_static_scene_have_no_movers_to_find():
    runs = invented()
    runs = runs.assign(is_moving=xr.zeros_like(runs.is_moving))
    score = scores(runs, runs)
    assert (
        score["movers"] == 0 and np.isnan(score["found_fraction"]["mean"]) and np.isnan(score["delay_frames"]["mean"])
    )
    assert score["position_ratio"] == {"mean": 1.0, "se": 0.0}


def test_scenes_are_the_six_with_movers_and_the_three_without(tmp_path, monkeypatch):
    """Every method in each, steady and oscillating; method by method, with the seeds of a block at a time."""
    worked = []

    def monte_carlo(scenario, config, *, first_seed, num_seeds, key, **_):
        worked.append((scenario, config, first_seed, num_seeds))
        runs = fake_runs(MOVING, num_seeds=num_seeds).assign_coords(seed=first_seed + np.arange(num_seeds))
        return runs.assign_attrs(attributes(Experiment(scenario, config), key))

    monkeypatch.setattr(reproduce, "monte_carlo", monte_carlo)
    runs, curves = detect(tmp_path, ["RE+velocity_glr", "VC"], num_seeds=26, key=jax.random.key(0))
    assert curves == {}
    assert len(runs) == 2 * 3 * 9 and len(worked) == 2 * len(runs)
    assert [(first, num) for _, _, first, num in worked[:2]] == [(0, 25), (25, 1)]
    assert all(found.seed.values.tolist() == list(range(26)) for found in runs.values())
    assert [type(config.gate).__name__ for _, config, *_ in worked] == ["VirtualCorrection"] * 54 + [
        "ReprojectionError"
    ] * 54
    moving = [s for s, *_ in worked[:54:2] if s.movers.speed_m_s > 0]
    assert sorted((s.oscillation.amplitude_m, s.movers.direction[0], s.movers.speed_m_s) for s in moving) == sorted(
        (a, x, v) for a in (0.0, 0.05, 0.1) for x in (0.0, -1.0) for v in (0.25, 0.5, 1.0)
    )
    still = {(s.oscillation.amplitude_m, *s.start) for s, *_ in worked[:54:2] if s.movers.speed_m_s == 0}
    assert len(still) == 9
    # More seeds: only what is new; fewer: nothing.
    worked.clear()
    detect(tmp_path, ["VC"], num_seeds=30, key=jax.random.key(0))
    assert {(first, num) for _, _, first, num in worked} == {(25, 5)} and len(worked) == 27
    worked.clear()
    fewer, _ = detect(tmp_path, ["VC"], num_seeds=2, key=jax.random.key(0))
    assert not worked and all(found.sizes["seed"] == 2 for found in fewer.values())


def test_a_scene_knows_its_static_one():
    scene = Scene(0.05, "inverse_forward", 0.25)
    assert scene.static == Scene(0.05) and scene.label == "inverse forward, 0.25 m/s"
    assert len({Scene(a, m, v).identifier for a in (0.0, 0.05) for m in ("lateral", None) for v in (1.0, 0.25)}) == 8


def test_harder_scenes_stand_beside_their_static_ones(tmp_path, monkeypatch):
    """With the oscillation as badly known there; several sets of movers share theirs."""
    worked = []

    def monte_carlo(scenario, config, *, first_seed, num_seeds, key, **_):
        worked.append(scenario)
        runs = fake_runs(MOVING, num_seeds=num_seeds).assign_coords(seed=first_seed + np.arange(num_seeds))
        return runs.assign_attrs(attributes(Experiment(scenario, config), key))

    monkeypatch.setattr(reproduce, "monte_carlo", monte_carlo)
    options = dict(amplitudes_m=(0.1,), motions=("lateral",), speeds_m_s=(1.0,), num_seeds=1, key=jax.random.key(0))
    runs, _ = detect(
        tmp_path, ["VC"], dynamic_sets=("ahead", "near_path"), harder_scenes=("turns", "jitter_5_mm"), **options
    )
    scenes = [scene for _, scene in runs]
    assert len(scenes) == len(worked) == 2 + 2 + 3 + 1 and all(scene.static in scenes for scene in scenes)
    jittery = [s for s in worked if s.oscillation_std_m == 0.005]
    assert len(jittery) == 2 and {float(s.movers.speed_m_s) for s in jittery} == {0.0, 0.5}
    assert len({scene.identifier for scene in scenes}) == len(scenes)
    with pytest.raises(ValueError, match=r"harder_scenes=\('fog',\).*late, stops"):
        detect(tmp_path, ["VC"], harder_scenes=("fog",), **options)


def test_each_gate_stands_there_with_the_settings_of_the_tests_too():
    """So that what a detector adds is told from what the blacklist and more updates add."""
    for gate in ("VC", "RE", "one_point_ransac"):
        plain, config = METHODS[gate].config, METHODS[f"{gate}+blacklist"].config
        test = METHODS["RE+velocity_glr"].config
        assert describe(config.gate) == describe(plain.gate) and describe(config.detector) == describe(plain.detector)
        expected = describe(test) | {name: describe(config)[name] for name in ("gate", "detector")}
        assert describe(config) == expected != describe(plain)


def test_only_the_plain_gates_let_what_was_flagged_come_back():
    assert {name for name, method in METHODS.items() if method.config.blacklist_capacity == 0} == {
        "VC",
        "RE",
        "one_point_ransac",
    }


def test_every_method_has_its_own_threshold_on_its_curve_and_flags_less_along_it():
    """Whatever its threshold is called, and without a new structure: what is traced does not compile again."""
    scenario = Scene(0.1).scenario(12)
    for method in METHODS.values():
        assert method.threshold in method.curve and len(set(method.curve)) == len(method.curve) >= 5
        own, *others = (method.experiment(scenario, value) for value in (None, *method.curve))
        assert {jax.tree.structure(each) for each in others} == {jax.tree.structure(own)}
        assert {leaf.shape for each in others for leaf in map(np.asarray, jax.tree.leaves(each.config))} == {()}
        assert list(method.curve) == sorted(method.curve, reverse="false_alarm_rate" in method.leaves[0])


def test_curves_are_of_runs_at_each_threshold_in_the_scenes_with_movers(tmp_path, monkeypatch):
    """The method's own is not run twice, and what is there is not run again."""
    worked = []

    def monte_carlo(scenario, config, *, first_seed, num_seeds, key, **_):
        worked.append((float(scenario.movers.speed_m_s), float(config.detector.threshold)))
        runs = fake_runs(MOVING, num_seeds=num_seeds).assign_coords(seed=first_seed + np.arange(num_seeds))
        return runs.assign_attrs(attributes(Experiment(scenario, config), key))

    monkeypatch.setattr(reproduce, "monte_carlo", monte_carlo)
    options = dict(amplitudes_m=(0.1,), motions=("lateral",), speeds_m_s=(1.0, 0.5), harder_scenes=("turns",))
    options |= dict(num_seeds=3, key=jax.random.key(0))
    name, thresholds = "RE+velocity_glr", METHODS["RE+velocity_glr"].curve
    runs, curves = detect(tmp_path, [name], curves=True, **options)
    assert len(runs) == 6 and list(curves) == [(name, 0.1)] and tuple(curves[name, 0.1]) == thresholds
    assert sorted(worked[6:]) == sorted((v, th) for v in (1.0, 0.5) for th in thresholds if th != 24.0)
    two_scenes = [2 * each for each in counts(runs[name, Scene(0.1, "lateral", 1.0)])]
    for point in curves[name, 0.1].values():
        np.testing.assert_array_equal(point, two_scenes)
    worked.clear()
    _, again = detect(tmp_path, [name], curves=True, **options)
    assert not worked and all(map(np.array_equal, again[name, 0.1].values(), curves[name, 0.1].values()))


def test_a_point_of_a_curve_has_the_interval_of_many_studies():
    """Features of a seed share its luck; of a share that no seed departs from, nothing is known but itself."""
    rng = np.random.default_rng(0)
    movers, static = np.full((300, 40), 6), np.full((300, 40), 90)
    found, flagged = rng.binomial(movers, rng.beta(4, 2, size=movers.shape)), rng.binomial(static, 0.02)
    points = [operating_point(Counts(*each)) for each in zip(found, movers, flagged, static, strict=True)]
    for name, truth in (("found_of_mapped_fraction", 2 / 3), ("static_flagged_fraction", 0.02), ("precision", 4 / 5.8)):
        covered = [point[name]["lower"] <= truth <= point[name]["upper"] for point in points]
        assert 0.88 < np.mean(covered) < 0.99, name
    assert points[0]["found"] == found[0].sum() and points[0]["static"] == 40 * 90
    assert points[0]["precision"]["mean"] == pytest.approx(found[0].sum() / (found[0] + flagged[0]).sum())
    never = operating_point(Counts(np.zeros(8), np.full(8, 6), np.zeros(8), np.full(8, 90)))
    assert never["found_of_mapped_fraction"] == {"mean": 0.0, "lower": 0.0, "upper": 0.0}
    assert np.isnan(list(never["precision"].values())).all()
    few = operating_point(Counts(*(np.full(7, number) for number in (4, 6, 1, 90))))["precision"]
    assert few["mean"] == 0.8 and np.isnan([few["lower"], few["upper"]]).all()


def test_counts_leave_failed_runs_out():
    count = counts(invented(1))
    assert [each[2] for each in count] == [0] * 4 and all((each[[0, 1]] > 0).all() for each in count)
