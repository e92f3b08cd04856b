"""Figures of merit of Monte-Carlo runs: per run, across seeds, and as differences paired by seed.

A run's figure is computed first and then averaged over the runs (paper section 4), so that every mean has a standard
error. Runs that went non-finite are left out of the averages and counted. All functions take one cell's runs with the
dimensions `seed`, `frame` and `feature` and keep any further (sweep) dimensions.
"""

import math
from typing import Any

import numpy as np
import xarray as xr
from scipy import stats

from vcjax.study import roc

FIGURES = {
    "position_rmse_cm": "position RMSE, cm",
    "orientation_error_deg": "orientation error, deg",
    "yaw_error_deg": "yaw error, deg",
    "recovered_per_run": "recovered features",
    "dynamic_events_per_run": "dynamic events",
    "dynamic_verdicts_per_run": "… by the gate's verdict",
    "inconsistent_deletions_per_run": "… by the detector",
    "dynamic_found_per_run": "movers found",
    "static_deleted_per_run": "static deleted",
    "detection_f1": "detection F1",
    "detection_auc": "detection AUC",
    "detection_delay_frames": "detection delay, frames",
    "anees_position": "ANEES position (2 dof)",
    "anees_pose": "ANEES pose (3 dof)",
    "anees_map": "ANEES map (3 dof)",
    "nis": "NIS / 2",
}
"""Every per-run figure and its label, in the order of print."""

DECIMALS = dict.fromkeys(FIGURES, 2) | {
    "orientation_error_deg": 4,
    "yaw_error_deg": 4,
    "detection_f1": 3,
    "detection_auc": 3,
}
"""Decimals shown of each figure: one more than a standard error over 25 runs warrants."""

SOMETIMES_UNDEFINED = (
    "detection_f1",
    "detection_auc",
    "detection_delay_frames",
    "anees_position",
    "anees_pose",
    "anees_map",
    "nis",
)
"""Figures that a run need not have (no mover, none found, no covariance to speak of, no update): means are over the
runs that have them."""

DEGREES_OF_FREEDOM = {"anees_position": 2, "anees_pose": 3, "anees_map": 3}
"""Of the errors in each ANEES."""
_CONFIDENCE = 0.95
_SWEPT = (
    "position_rmse_cm",
    "orientation_error_deg",
    "recovered_per_run",
    "dynamic_events_per_run",
    "dynamic_found_per_run",
    "static_deleted_per_run",
    "anees_position",
)  # what fits on one line per point of a sweep


class Summary(xr.Dataset):
    """What `summarise` gives: a Dataset which, while whole, prints as `summary_text`."""

    __slots__ = ()

    def __str__(self) -> str:
        is_whole = {*FIGURES, "num_runs", "runs_failed", "runs_map_full"} <= set(self) and "statistic" in self.dims
        return summary_text(self) if is_whole else repr(self)


def per_run(runs: xr.Dataset) -> xr.Dataset:
    """Figures of each run: RMS errors over the frames, counts of events, and normalised consistency statistics.

    Errors are √(mean over frames of e²). A dynamic event is any deletion, by the gate's verdict or by the detector;
    `dynamic_found_per_run` and `static_deleted_per_run` count distinct moving and static features deleted at least
    once. With them, and with as many movers as were measured candidates or deleted, `detection_f1` is
    2 found / (found + static deleted + movers), NaN where nothing moves; `detection_auc` is the area under the ROC of
    the features' `roc.track_scores`, which says little of other thresholds where what is deleted never comes back, NaN
    where no mover was measured, or nothing else. `detection_delay_frames` is the mean over the movers found of the
    frames from first birth to first deletion.

    ANEES is the mean over frames of NEES / dof, 1 in expectation for a consistent filter; frames where it is not
    defined (see `metrics.trajectory_errors`) are left out, and NaN stands where it never is. `anees_map` is that of the
    map in the last frame (see `metrics.map_nees`). `nis` is the mean squared Mahalanobis distance of the accepted
    updates / 2, NaN where there was none; the gate cuts its tail off, so a consistent filter has 1 − t·exp(−t) / (1 −
    exp(−t)) with t = Th₁ / 2, which is 0.95 for Th₁ = 9.

    Args:
        runs: one cell's runs with dimensions (..., seed, frame, feature).

    Returns:
        The variables named in `FIGURES` and `is_finite`, each (..., seed); figures of failed runs are NaN.
    """
    was_deleted = (runs.dynamic_deletions + runs.inconsistent_deletions) > 0
    num_updates = runs.num_updates.sum("frame")
    is_found = was_deleted & runs.is_moving
    found, called = is_found.sum("feature"), was_deleted.sum("feature")
    num_movers = ((was_deleted | runs.dynamic_margin.notnull()) & runs.is_moving).sum("feature")
    verdicts, inconsistent = runs.num_dynamic.sum("frame"), runs.num_inconsistent.sum("frame")
    with np.errstate(over="ignore", invalid="ignore"):  # a failed run may hold anything; it is masked below
        figures = xr.Dataset(
            {
                "position_rmse_cm": 100.0 * _rms(runs.position_error_m),
                "orientation_error_deg": _rms(runs.orientation_error_deg),
                "yaw_error_deg": _rms(runs.yaw_error_deg),
                "recovered_per_run": runs.num_recovered.sum("frame"),
                "dynamic_events_per_run": verdicts + inconsistent,
                "dynamic_verdicts_per_run": verdicts,
                "inconsistent_deletions_per_run": inconsistent,
                "dynamic_found_per_run": found,
                "static_deleted_per_run": (was_deleted & ~runs.is_moving).sum("feature"),
                "detection_f1": (2 * found / np.maximum(called + num_movers, 1)).where(runs.is_moving.any("feature")),
                "detection_auc": _area(runs),
                "detection_delay_frames": (runs.first_deleted - runs.first_mapped).where(is_found).mean("feature"),
                "anees_position": runs.nees_position.mean("frame", skipna=True) / DEGREES_OF_FREEDOM["anees_position"],
                "anees_pose": runs.nees_pose.mean("frame", skipna=True) / DEGREES_OF_FREEDOM["anees_pose"],
                "anees_map": runs.nees_map / DEGREES_OF_FREEDOM["anees_map"],
                "nis": runs.nis_sum.sum("frame", skipna=False) / num_updates.where(num_updates > 0) / 2,
            }
        )
    return figures.where(runs.is_finite).assign(is_finite=runs.is_finite)


def mean_and_error(values: xr.DataArray, counts: xr.DataArray) -> tuple[xr.DataArray, xr.DataArray]:
    """Mean over the seeds that count and its standard error s / √n, with n − 1 in the variance.

    Args:
        values: (..., seed, ...).
        counts: (..., seed), which runs count.

    Returns:
        Mean and standard error without the dimension `seed`; NaN where no run (error: fewer than two runs) is left. A
        NaN of a run that counts is passed on, not skipped.
    """
    num = counts.sum("seed")
    mean = values.where(counts, 0.0).sum("seed", skipna=False) / num.where(num > 0)
    deviation = (values - mean).where(counts, 0.0)
    variance = (deviation**2).sum("seed", skipna=False) / (num - 1).where(num > 1)
    return mean, (variance / num) ** 0.5


def summarise(runs: xr.Dataset) -> Summary:
    """Mean and standard error over the finite seeds of every figure of `per_run`, with bounds for ANEES.

    The bounds are `anees_bounds` for the n finite seeds that have an ANEES: 2 degrees of freedom for the position
    (x, y), 3 for the pose (x, y, yaw), and 3 for a landmark's place. The frames of a run are correlated, and so are the
    landmarks of a map, so they add nothing to the degrees of freedom: the interval is that of one frame's average over
    seeds, or of one landmark's, cautious for the mean over all.

    Args:
        runs: one cell's runs with dimensions (..., seed, frame, feature).

    Returns:
        A Dataset that prints as text: every figure as (statistic, ...) with statistic "mean" and "se";
        `anees_position_bounds`, `anees_pose_bounds` and `anees_map_bounds` as (bound, ...) with bound "lower" and
        "upper"; `num_runs`, `runs_failed` and `runs_map_full` (runs in which the map was full in some frame) as counts.

    References:
        Bar-Shalom, Li, Kirubarajan 2001, *Estimation with Applications to Tracking and Navigation*, section 5.4.
    """
    figures = per_run(runs)
    is_finite = figures.is_finite
    array = _as_array(figures)
    mean, error = mean_and_error(array, _counts(array, is_finite))
    summary = _statistics({"mean": mean, "se": error})
    for name, dof in DEGREES_OF_FREEDOM.items():
        num = (is_finite & figures[name].notnull()).sum("seed")
        bounds = xr.apply_ufunc(anees_bounds, num.where(num > 0), dof, output_core_dims=[[], []])
        summary[f"{name}_bounds"] = xr.concat(bounds, xr.Variable("bound", ["lower", "upper"]))
    summary["num_runs"] = xr.ones_like(is_finite, dtype=int).sum("seed")
    summary["runs_failed"] = (~is_finite).sum("seed")
    summary["runs_map_full"] = (runs.map_full_frames > 0).sum("seed")
    return Summary(summary.data_vars, summary.coords)


def anees_bounds(num: Any, dof: int) -> tuple[Any, Any]:
    """The central 95 % of an average over `num` independent NEES / dof: quantiles of χ²(n·dof) / (n·dof)."""
    tail = (1 - _CONFIDENCE) / 2
    lower, upper = (stats.chi2.ppf(q, num * dof) / (num * dof) for q in (tail, 1 - tail))
    return lower, upper


def paired_difference(runs_a: xr.Dataset, runs_b: xr.Dataset) -> xr.Dataset:
    """Mean difference a − b of every figure over the seeds finite in both, with a 95 % Student-t interval.

    The same seed sees the same draws in both, so the noise they share cancels: with d the difference of one seed and n
    pairs, the interval is mean(d) ± t(0.975, n − 1)·s(d)/√n.

    Args:
        runs_a: one cell's runs with dimensions (..., seed, frame, feature).
        runs_b: another's; sweep coordinates are equal to those of `runs_a`.

    Returns:
        Every figure as (statistic, ...) with statistic "mean", "se", "lower" and "upper", and `num_pairs`.

    Raises:
        ValueError: if the two have no seed in common.
    """
    seeds = np.intersect1d(runs_a.seed.values, runs_b.seed.values)
    if len(seeds) == 0:
        raise ValueError(
            f"paired_difference: runs_a has the seeds {runs_a.seed.values.tolist()} and runs_b "
            f"{runs_b.seed.values.tolist()}, none in common; run both with the same seeds."
        )
    a, b = per_run(runs_a).sel(seed=seeds), per_run(runs_b).sel(seed=seeds)
    with xr.set_options(arithmetic_join="exact"):
        is_finite = a.is_finite & b.is_finite
        difference = _as_array(a) - _as_array(b)
    counts = _counts(difference, is_finite)
    mean, error = mean_and_error(difference, counts)
    half_width = error * xr.apply_ufunc(student_t, counts.sum("seed"))
    statistics = {"mean": mean, "se": error, "lower": mean - half_width, "upper": mean + half_width}
    return _statistics(statistics).assign(num_pairs=is_finite.sum("seed"))


def student_t(num: Any) -> Any:
    """Standard errors on each side of a 95 % interval of a mean over `num` runs: t(0.975, num − 1); NaN below two."""
    return stats.t.ppf((1 + _CONFIDENCE) / 2, num - 1)


def format_mean(name: str, mean: float, error: float) -> str:
    """`mean ± error` of a figure with its decimals; without the error, or as a dash, where they are not known."""
    if not math.isfinite(mean):
        return "–"
    text = f"{mean:.{DECIMALS[name]}f}"
    return text + (f" ± {error:.{DECIMALS[name]}f}" if math.isfinite(error) else "")


def summary_text(summary: xr.Dataset) -> str:
    """The result of `summarise` as plain text: a line per figure, or a line per point of a sweep."""
    sweep = [str(dim) for dim in summary.num_runs.dims]
    if not sweep:
        rows = [[label, _figure_text(summary, name)] for name, label in FIGURES.items()]
        return _columns([*rows, ["runs", runs_text(summary)]])
    points = summary.stack(point=sweep)
    rows = [[*sweep, *(FIGURES[name] for name in _SWEPT), "runs"]]
    for i in range(points.sizes["point"]):
        point = points.isel(point=i)
        place = [f"{point[dim].item():.6g}" for dim in sweep]
        figures = [format_mean(name, *point[name].values) for name in _SWEPT]
        rows.append([*place, *figures, runs_text(point)])
    return _columns(rows)


def runs_text(summary: xr.Dataset) -> str:
    """How many runs there were, failed, and met a full map: e.g. "25, 1 failed"."""
    text = f"{summary.num_runs.item()}, {summary.runs_failed.item()} failed"
    full = summary.runs_map_full.item()
    return text + (f", map full in {full}" if full else "")


def _figure_text(summary: xr.Dataset, name: str) -> str:
    text = format_mean(name, *summary[name].values)
    if f"{name}_bounds" in summary and summary[f"{name}_bounds"].notnull().all():
        text += "  (95 % of consistent filters: {:.2f} to {:.2f})".format(*summary[f"{name}_bounds"].values)
    return text


def _columns(rows: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def _rms(error: xr.DataArray) -> xr.DataArray:
    return (error**2).mean("frame", skipna=False) ** 0.5


def _area(runs: xr.Dataset) -> xr.DataArray:
    """Area under the ROC of each run."""
    core = [["feature"], ["feature"]]
    return xr.apply_ufunc(roc.area_of_each, roc.track_scores(runs), runs.is_moving, input_core_dims=core)


def _as_array(figures: xr.Dataset) -> xr.DataArray:
    return figures[list(FIGURES)].to_dataarray("figure")


def _counts(figures: xr.DataArray, is_finite: xr.DataArray) -> xr.DataArray:
    """Which runs count for each figure: the finite ones, where a figure need not be defined those that have it."""
    return is_finite & (figures.notnull() | ~figures.figure.isin(SOMETIMES_UNDEFINED))


def _statistics(statistics: dict[str, xr.DataArray]) -> xr.Dataset:
    return xr.concat(list(statistics.values()), xr.Variable("statistic", list(statistics))).to_dataset(dim="figure")
