"""Figures of merit: against hand-computed numbers and SciPy, with failed seeds, one seed, sweeps and pairing."""

import numpy as np
import pytest
import xarray as xr
from fake_runs import fake_runs, with_failed_seed
from scipy import stats

from vcjax.study.paper import Cell
from vcjax.study.summary import FIGURES, format_mean, paired_difference, per_run, student_t, summarise, summary_text


def tiny_runs() -> xr.Dataset:
    """Two seeds, two frames, three features (the first two move), with round numbers."""
    frames = ("seed", "frame")
    return xr.Dataset(
        {
            "position_error_m": (frames, [[0.03, 0.04], [0.05, 0.05]]),
            "orientation_error_deg": (frames, [[1.0, 7.0], [2.0, 2.0]]),
            "yaw_error_deg": (frames, [[0.0, 2.0], [1.0, 1.0]]),
            "nees_position": (frames, [[1.0, 3.0], [4.0, 8.0]]),
            "nees_pose": (frames, [[3.0, 3.0], [6.0, 12.0]]),
            "nees_map": ("seed", [3.0, 6.0]),
            "nis_sum": (frames, [[10.0, 30.0], [8.0, 0.0]]),
            "num_updates": (frames, [[5, 5], [2, 0]]),
            "num_recovered": (frames, [[1, 2], [0, 4]]),
            "num_dynamic": (frames, [[3, 0], [1, 1]]),
            "num_inconsistent": (frames, [[0, 2], [0, 0]]),
            "dynamic_deletions": (("seed", "feature"), [[3, 0, 0], [1, 1, 0]]),
            "inconsistent_deletions": (("seed", "feature"), [[1, 0, 1], [0, 0, 0]]),
            "first_mapped": (("seed", "feature"), [[1, 1, 3], [2, 1, 1]]),
            "first_deleted": (("seed", "feature"), [[5, 0, 9], [3, 9, 0]]),
            "dynamic_margin": (("seed", "feature"), [[2.0, -1.0, 1.0], [2.0, np.nan, np.nan]]),
            "detector_margin": (("seed", "feature"), [[np.nan] * 3, [np.nan, 1.75, 1.5]]),
            "is_moving": ("feature", [True, True, False]),
            "is_finite": ("seed", [True, True]),
            "map_full_frames": ("seed", [0, 2]),
        },
        coords={"seed": [0, 1], "frame": [1, 2], "feature": [0, 1, 2]},
    )


def test_per_run_equals_numbers_by_hand():
    expected = {
        "position_rmse_cm": [np.sqrt(12.5), 5.0],
        "orientation_error_deg": [5.0, 2.0],
        "yaw_error_deg": [np.sqrt(2.0), 1.0],
        "recovered_per_run": [3, 4],
        "dynamic_events_per_run": [5, 2],
        "dynamic_verdicts_per_run": [3, 2],
        "inconsistent_deletions_per_run": [2, 0],
        "dynamic_found_per_run": [1, 2],
        "static_deleted_per_run": [1, 0],
        "detection_f1": [2 * 1 / (2 * 1 + 1 + 1), 1.0],
        "detection_auc": [0.5, 1.0],
        "detection_delay_frames": [4.0, (1 + 8) / 2],
        "anees_position": [1.0, 3.0],
        "anees_pose": [1.0, 3.0],
        "anees_map": [1.0, 2.0],
        "nis": [2.0, 2.0],
    }
    figures = per_run(tiny_runs())
    assert set(expected) == set(FIGURES)
    for name, values in expected.items():
        np.testing.assert_allclose(figures[name], values, rtol=1e-14, err_msg=name)


def test_movers_that_are_never_mapped_are_not_found():
    runs = tiny_runs()
    runs = runs.assign(
        dynamic_margin=runs.dynamic_margin * np.nan,
        dynamic_deletions=0 * runs.dynamic_deletions,
        inconsistent_deletions=0 * runs.inconsistent_deletions,
    )
    np.testing.assert_array_equal(per_run(runs).detection_f1, 0.0)
    assert per_run(runs.assign(is_moving=~runs.is_moving & False)).detection_f1.isnull().all()


def test_summary_is_mean_and_standard_error_over_seeds():
    runs = fake_runs(num_seeds=7)
    figures, summary = per_run(runs), summarise(runs)
    for name in FIGURES:
        np.testing.assert_allclose(summary[name].sel(statistic="mean"), np.mean(figures[name]), rtol=1e-12)
        np.testing.assert_allclose(summary[name].sel(statistic="se"), stats.sem(figures[name]), rtol=1e-10)


def test_failed_seed_is_counted_and_changes_nothing_else():
    runs = with_failed_seed(fake_runs(num_seeds=5), 2)
    summary, expected = summarise(runs), summarise(runs.isel(seed=[0, 1, 3, 4]))
    assert summary.runs_failed == 1 and expected.runs_failed == 0
    assert summary.num_runs == 5
    for name in [*FIGURES, "anees_position_bounds", "anees_pose_bounds", "anees_map_bounds"]:
        np.testing.assert_allclose(summary[name], expected[name], rtol=1e-14)


def test_nan_in_a_run_that_counts_is_passed_on():
    runs = fake_runs(num_seeds=3)
    runs.position_error_m[1, 4] = np.nan
    assert np.isnan(summarise(runs).position_rmse_cm).all()


def test_figure_that_a_run_does_not_have_is_left_out_of_the_mean():
    """Frames without a defined NEES, runs without any or without an update: the others speak."""
    runs, expected = fake_runs(num_seeds=4), fake_runs(num_seeds=4)
    runs.nees_position[0], runs.nees_pose[0] = np.nan, np.nan
    runs.nees_position[1, :5] = np.nan
    runs.num_updates[2] = 0
    summary, figures = summarise(runs), per_run(runs)
    assert figures.anees_position[1] == pytest.approx(expected.nees_position[1, 5:].mean().item() / 2, rel=1e-12)
    for name, missing in (("anees_position", 0), ("anees_pose", 0), ("nis", 2)):
        others = np.delete(figures[name].values, missing)
        assert np.isnan(figures[name][missing])
        np.testing.assert_allclose(summary[name], [np.mean(others), stats.sem(others)], rtol=1e-12)
    np.testing.assert_allclose(summary.anees_pose_bounds, stats.chi2.ppf([0.025, 0.975], 9) / 9, rtol=1e-12)
    xr.testing.assert_identical(summary.position_rmse_cm, summarise(expected).position_rmse_cm)
    difference = paired_difference(runs, expected)
    np.testing.assert_array_equal(difference.anees_pose.values, 0)  # the three that both have are the same


def test_figure_that_no_run_has_is_a_dash():
    runs = fake_runs(num_seeds=3)
    summary = summarise(runs.assign(nees_position=runs.nees_position * np.nan))
    assert np.isnan(summary.anees_position).all() and np.isnan(summary.anees_position_bounds).all()
    line = next(line for line in str(summary).splitlines() if line.startswith("ANEES position"))
    assert line.split("  ")[-1].strip() == "–"


def test_summary_prints_as_text_and_its_parts_as_data():
    summary = summarise(tiny_runs())
    assert str(summary) == summary_text(summary) and f"{summary}".startswith("position RMSE, cm        4.27")
    assert isinstance(summary, xr.Dataset)
    for part in (summary[["nis"]], summary.sel(statistic="mean")):
        assert "Data variables" in str(part)


def test_one_seed_has_a_mean_and_no_error():
    runs = fake_runs(num_seeds=1)
    summary = summarise(runs)
    for name in FIGURES:
        np.testing.assert_array_equal(summary[name].sel(statistic="mean"), per_run(runs)[name][0])
        assert np.isnan(summary[name].sel(statistic="se"))
    difference = paired_difference(runs, runs)
    assert difference.nis.sel(statistic="mean") == 0 and np.isnan(difference.nis.sel(statistic="lower"))


def test_no_finite_seed_gives_nan_not_an_error():
    runs = with_failed_seed(fake_runs(num_seeds=1), 0)
    summary = summarise(runs)
    assert summary.runs_failed == 1
    assert all(np.isnan(summary[name]).all() for name in FIGURES)
    assert "–" in summary_text(summary)


def test_nis_without_updates_is_nan():
    runs = tiny_runs()
    runs["num_updates"] = xr.zeros_like(runs.num_updates)
    assert np.isnan(per_run(runs).nis).all()


@pytest.mark.parametrize(("name", "dof"), [("anees_position", 2), ("anees_pose", 3), ("anees_map", 3)])
def test_anees_bounds_are_those_of_one_frame_over_the_finite_seeds(name, dof):
    summary = summarise(with_failed_seed(fake_runs(num_seeds=6), 0))
    expected = stats.chi2.ppf([0.025, 0.975], 5 * dof) / (5 * dof)
    np.testing.assert_allclose(summary[f"{name}_bounds"].sel(bound=["lower", "upper"]), expected, rtol=1e-12)


def test_consistent_errors_stay_within_the_anees_bounds_as_often_as_stated():
    rng = np.random.default_rng(1)
    trials, seeds = 4000, 25
    nees = rng.chisquare(2, size=(trials, seeds)).mean(axis=1) / 2  # one frame
    lower, upper = summarise(fake_runs(num_seeds=seeds)).anees_position_bounds
    share = np.mean((lower.item() < nees) & (nees < upper.item()))
    assert abs(share - 0.95) < 4 * np.sqrt(0.95 * 0.05 / trials)


def test_sweep_dimensions_give_the_summary_of_each_point():
    steady, oscillating = fake_runs(Cell(3, "forward", "lateral", 1.0, "VC", False)), fake_runs()
    oscillating = with_failed_seed(oscillating, 0)
    axis = xr.Variable("oscillation_amplitude_m", [0.0, 0.05])
    summary = summarise(xr.concat([steady, oscillating], axis))
    for i, runs in enumerate([steady, oscillating]):
        xr.testing.assert_allclose(summary.isel(oscillation_amplitude_m=i, drop=True), summarise(runs), rtol=1e-12)
    lines = summary_text(summary).splitlines()
    assert len(lines) == 3 and lines[0].startswith("oscillation_amplitude_m")
    assert lines[2].startswith("0.05") and lines[2].endswith("4, 1 failed")


def test_paired_difference_equals_the_paired_t_test():
    a, b = fake_runs(num_seeds=9), fake_runs(Cell(2, "curved", None, None, "VC", True), num_seeds=9)
    difference = paired_difference(a, b)
    for name in ("position_rmse_cm", "yaw_error_deg", "recovered_per_run"):
        test = stats.ttest_rel(per_run(a)[name], per_run(b)[name])
        interval = test.confidence_interval(0.95)
        mean, error, lower, upper = difference[name].values
        np.testing.assert_allclose([mean / error, lower, upper], [test.statistic, *interval], rtol=1e-9)
    assert difference.num_pairs == 9


def test_paired_difference_cancels_the_noise_that_seeds_share():
    a = fake_runs(num_seeds=8)
    rmse_m = per_run(a).position_rmse_cm / 100
    b = a.assign(position_error_m=a.position_error_m * (rmse_m + 0.01) / rmse_m)  # each run's RMSE is 1 cm higher
    difference, spread = paired_difference(b, a), summarise(a)
    mean, error, lower, upper = difference.position_rmse_cm.values
    np.testing.assert_allclose([mean, lower, upper], 1.0, rtol=1e-9)
    assert error < 1e-9 * spread.position_rmse_cm.sel(statistic="se")
    assert (difference.yaw_error_deg == 0).all()


def test_paired_difference_pairs_by_seed_number_and_finite_in_both():
    a, b = fake_runs(num_seeds=6), fake_runs(Cell(2, "lateral", None, None, "RE", True), 6)
    expected = paired_difference(a.isel(seed=[1, 2, 4, 5]), b.isel(seed=[1, 2, 4, 5]))
    shuffled = with_failed_seed(b, 3).isel(seed=[5, 3, 1, 2, 0, 4])
    found = paired_difference(with_failed_seed(a, 0), shuffled)
    xr.testing.assert_allclose(found, expected, rtol=1e-12)
    assert found.num_pairs == 4
    some = [1, 2, 4]
    xr.testing.assert_allclose(paired_difference(a.isel(seed=some), b), paired_difference(a, b.isel(seed=some)))


def test_paired_difference_refuses_what_cannot_be_paired():
    runs = fake_runs(num_seeds=2)
    with pytest.raises(ValueError, match="none in common"):
        paired_difference(runs, runs.assign_coords(seed=[7, 8]))
    one, other = (xr.concat([runs, runs], xr.Variable("th1", values)) for values in ([4.0, 9.0], [4.0, 16.0]))
    with pytest.raises(ValueError, match="th1"):
        paired_difference(one, other)


def test_student_t_is_the_textbook_value():
    assert student_t(25) == pytest.approx(2.0639, abs=1e-4)
    assert np.isnan(student_t(1)) and np.isnan(student_t(0))


def test_text_shows_every_figure_with_its_error():
    summary = summarise(tiny_runs())
    lines = summary_text(summary).splitlines()
    assert len(lines) == len(FIGURES) + 1
    assert lines[0] == "position RMSE, cm        4.27 ± 0.73"
    assert lines[-1].endswith("2, 0 failed, map full in 1")
    assert format_mean("yaw_error_deg", 0.12347, 0.01) == "0.1235 ± 0.0100"
    assert format_mean("yaw_error_deg", 0.12347, np.nan) == "0.1235"
