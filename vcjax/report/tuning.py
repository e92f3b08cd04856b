"""What a search for settings gave, as files: JSON for programs, Markdown for people, figures."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from vcjax.report.comparison import comparison, comparison_markdown
from vcjax.report.descent import descent_figure
from vcjax.report.detection_curves import curves_figure, roc_by_scene_figure
from vcjax.report.landscape import landscape_figure
from vcjax.report.markup import counted
from vcjax.report.markup import grid as table
from vcjax.report.style import write_figure
from vcjax.storage import check_writable, write_file, write_json
from vcjax.study.results import save
from vcjax.study.summary import mean_and_error
from vcjax.tuning.choice import Choice, Setting
from vcjax.tuning.landscape import as_grid, means
from vcjax.tuning.losses import SHAPES
from vcjax.tuning.tune import End, Tuned, smoothest


def write_tuning(tuned: Tuned, landscapes: Mapping[str, xr.Dataset], directory: Path) -> list[Path]:
    """Write `tune.json`, `tune.md` and the figures of a tuning into a directory.

    `tune.json` is a `comparison` with the `history` of every descent, each step with its parameters, temperature,
    smoothed loss and gradient; how many runs there were, and starts, steps and pairs of runs that were left out; what
    was `wanted`, the weights of the objective; the `origin` of it all; and the `candidates`, setting before, ends of
    the descents and what was tried near one of them, each with its `name`, the `smoothed_loss` in the last quarter
    of its descent and its `loss` on the seeds that chose, mean and standard error, null where that was not asked
    (`is_judged`).

    Figures of landscapes that an earlier tuning left there are removed.

    Args:
        tuned: the tuning.
        landscapes: grids over two of the numbers, by name, on which the paths are drawn.
        directory: where to write.

    Returns: the paths written.

    Raises:
        OSError: if the directory cannot be written to.
    """
    compared = comparison(tuned.choice) | _wanted({**tuned.choice.origin, **tuned.origin})
    compared["runs"]["descents"] = tuned.num_runs
    compared |= {
        "history": [[step._asdict() for step in steps] for steps in tuned.descents],
        "steps_skipped": tuned.num_skipped,
        "pairs_failed": tuned.num_failed,
        "starts_left_out": [dict(start) for start in tuned.left_out],
        "candidates": _candidates(tuned),
    }
    title = (
        f"# Tuned by gradient\n\n{_runs(compared)} {_left_out(tuned)}\n{_weights(compared)}\n{_costs(compared, tuned)}"
    )
    paths = _write(compared, title, directory / "tune")
    folder = directory / "figures"
    paths += write_figure(descent_figure(tuned.descents), folder / "descent")
    marks = _marks(tuned.choice, "after")
    # Those of an earlier choice would show another end.
    for old in folder.glob("landscape_*"):
        old.unlink()
    for name, grid in landscapes.items():
        others = {path: value for path, value in tuned.choice.after.items() if path not in grid.dims}
        title = f"Hard decisions, {_means(grid)}" + (", the other numbers as tuned" if others else "")
        ways = [[step.parameters for step in steps] for steps in tuned.descents]
        paths += write_figure(landscape_figure(grid, title, marks, ways), folder / f"landscape_{name}")
    return [*paths, *_write_curves(tuned.choice, folder)]


def write_search(choice: Choice, directory: Path) -> list[Path]:
    """Write `sweep.nc` (all runs of the grid), `sweep.json`, `sweep.md` and the figures of a search into a directory.

    `sweep.json` is a `comparison`, `after` being the best point of the grid, or `before` where none is better; with the
    means over all scenes and seeds of every point: `grid`; what was `wanted`, the weights of the objective; and the
    `origin` of it all.

    Returns: the paths written.

    Raises:
        OSError: if the directory cannot be written to.
    """
    compared, grid = comparison(choice) | _wanted(choice.origin), as_grid(choice)
    points = means(grid)[["loss", "detection_f1", "detection_auc", "detection_delay_frames", "position_rmse_cm"]]
    compared["grid"] = {str(name): values.values.tolist() for name, values in {**points.coords, **points}.items()}
    compared["grid_dimensions"] = [str(dim) for dim in points.loss.dims]
    paths = [save(grid, directory / "sweep.nc")]
    title = f"# Best point of a grid of {points.loss.size}\n\n{_runs(compared)}\n{_weights(compared)}"
    paths += _write(compared, title, directory / "sweep")
    folder, marks = directory / "figures", _marks(choice, "best point")
    paths += write_figure(landscape_figure(grid, f"Hard decisions, {_means(grid)}", marks), folder / "landscape")
    for number, name in enumerate(grid.scene.values, start=1):
        one = grid.sel(scene=[name])
        figure = landscape_figure(one, f"Hard decisions, {name}, {_means(one)}", marks)
        paths += write_figure(figure, folder / f"landscape_scene_{number}")
    return [*paths, *_write_curves(choice, folder)]


def check_places(directory: Path, name: str) -> None:
    """Refuse a directory that the files of `name`, tune or sweep, cannot be written to, before the work.

    Raises:
        OSError: naming the place and what is wrong with it.
    """
    for place in (f"{name}.nc", f"{name}.json", f"{name}.md", "figures/curves.png"):
        check_writable(directory / place)


def _write(compared: dict[str, Any], title: str, path: Path) -> list[Path]:
    return [
        write_json(path.with_suffix(".json"), compared),
        write_file(path.with_suffix(".md"), (title + "\n" + comparison_markdown(compared)).encode()),
    ]


def _write_curves(choice: Choice, folder: Path) -> list[Path]:
    return [
        *write_figure(curves_figure(choice), folder / "curves"),
        *write_figure(roc_by_scene_figure(choice), folder / "roc_by_scene"),
    ]


def _marks(choice: Choice, chosen: str) -> dict[str, Setting]:
    """Settings by what they are called in figures."""
    if choice.after == choice.before:
        return {"before, nothing is better": choice.before}
    return {"before": choice.before, chosen: choice.after}


def _means(grid: xr.Dataset) -> str:
    scenes, seeds = grid.sizes["scene"], grid.sizes["seed"]
    runs = f"{scenes} scenes × {seeds} runs" if scenes > 1 else f"{seeds} runs"
    return f"means over {runs} at every point" if scenes * seeds > 1 else "one run at every point"


def _runs(compared: Mapping[str, Any]) -> str:
    runs = compared["runs"]
    parts = [f"{runs['descents']} runs with their derivative in the descents"] if "descents" in runs else []
    parts += [f"{runs['choosing']} runs to choose", f"{runs['held_out']} held out"]
    failed = f"{runs['failed']} of these went non-finite" if runs["failed"] else "all of these stayed finite"
    return f"{', '.join(parts)}; {failed}."


def _wanted(origin: Mapping[str, Any]) -> dict[str, Any]:
    """The objective, and what else a search comes from."""
    rest = {name: value for name, value in origin.items() if name != "objective"}
    return {"wanted": origin["objective"], "origin": rest}


def _weights(compared: Mapping[str, Any]) -> str:
    weights = {name: value for name, value in compared["wanted"].items() if name not in ("class", *SHAPES) and value}
    return f"Wanted, by weight: {', '.join(f'`{name}` {value:g}' for name, value in weights.items())}.\n"


def _candidates(tuned: Tuned) -> list[dict[str, Any]]:
    """Each with the mean over scenes and seeds that chose, NaN where a run failed or none was made, and its error."""
    loss = tuned.choice.candidates.loss.mean("scene", skipna=False)
    mean, error = mean_and_error(loss, xr.ones_like(loss, bool))
    costs = iter(zip(mean.values.tolist(), error.values.tolist(), strict=True))
    before, *near = (End(setting, math.nan, math.nan, True) for setting in (tuned.choice.before, *tuned.near))
    named = [("before", before)]
    named += [(f"end of descent {number}", end) for number, end in enumerate(tuned.ends, start=1)]
    place = f"near the end of descent {1 + smoothest(tuned.ends)}"
    named += [(f"{place}, {number}", end) for number, end in enumerate(near, start=1)]
    return [
        {
            "name": name,
            "parameters": dict(end.setting),
            "smoothed_loss": {"mean": end.smoothed_loss, "se": end.smoothed_se},
            "is_judged": end.is_judged,
            "loss": dict(zip(("mean", "se"), next(costs) if end.is_judged else (math.nan, math.nan), strict=True)),
        }
        for name, end in named
    ]


def _costs(compared: Mapping[str, Any], tuned: Tuned) -> str:
    """The candidates as a table; bold what was chosen."""
    rows = []
    for candidate in compared["candidates"]:
        values, name = candidate["parameters"], candidate["name"]
        name = f"**{name}**" if values == compared["after"]["parameters"] else name
        costs = (_with_error(candidate[each]) for each in ("smoothed_loss", "loss"))
        rows.append([name, *(f"{value:.4g}" for value in values.values()), *costs])
    seeds = counted(compared["origin"]["seeds"]["choosing"], "seed")
    told = f"Candidates, and their loss on {seeds} of each scene that chose, ± standard error"
    if (num_judged := sum(end.is_judged for end in tuned.ends)) < len(tuned.ends):
        told += f", of the {num_judged} ends whose smoothed loss in the last quarter of the descent is the smallest"
    if tuned.near:
        told += f"; with {len(tuned.near)} from the neighbourhood of the end whose smoothed loss is the smallest"
    parameters = (f"`{path}`" for path in compared["before"]["parameters"])
    return f"{told}; bold the chosen one.\n\n{table(['candidate', *parameters, 'smoothed loss', 'loss'], rows)}"


def _with_error(cost: Mapping[str, float]) -> str:
    mean, error = cost["mean"], cost["se"]
    if not math.isfinite(mean):
        return "–"
    return f"{mean:.4f} ± {error:.4f}" if math.isfinite(error) else f"{mean:.4f}"


def _left_out(tuned: Tuned) -> str:
    """What the descents went without, since it was not finite."""
    if not (tuned.num_skipped or tuned.num_failed or tuned.left_out):
        return f"All {tuned.num_steps} steps were taken, each with all of its runs."
    counts = (
        (len(tuned.left_out), len(tuned.left_out) + len(tuned.descents), "starts were left out"),
        (tuned.num_skipped, tuned.num_steps, "steps were not taken"),
        (tuned.num_failed, tuned.num_runs // 2, "pairs of runs were left out of steps"),
    )
    told = ", ".join(f"{num} of {total} {what}" for num, total, what in counts if num)
    return f"**Not finite: {told}.**"
