"""What methods found in the scenes with movers, as files: JSON for programs, Markdown for people, figures."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vcjax.report.detection_figures import found_figure, position_figure
from vcjax.report.detection_prediction import prediction_figure, prediction_markdown, predictions
from vcjax.report.detection_roc import curves_markdown, curves_table, precision_figure, roc_figure
from vcjax.report.markup import grid
from vcjax.report.style import write_figure
from vcjax.storage import write_file, write_json
from vcjax.study.detect import Detection
from vcjax.study.detection_methods import METHODS
from vcjax.study.detection_scores import MIN_FRAMES_MAPPED, scores
from vcjax.study.results import describe
from vcjax.study.summary import DEGREES_OF_FREEDOM, paired_difference

DIFFERENCES = ("position_rmse_cm", "orientation_error_deg")
"""Figures that are compared with the static scene's, seed by seed."""
_HEADER = (
    "scene",
    "method",
    "movers found, %",
    "… of all mapped, %",
    "… in a run",
    "static flagged, %",
    "delay, frames",
    "velocity error, m/s",
    "position, cm",
    "against the static scene, cm",
    "ratio",
    "orientation, deg",
    "against the static scene, deg",
    "ANEES position",
    "ANEES pose",
    "ANEES map",
)
_INTRODUCTION = f"""\
*Movers found*: unique movers flagged of those in the map for at least {MIN_FRAMES_MAPPED} frames or flagged, features
of all runs pooled, and how many: what was mapped for less counts here if it was found and not if it was missed, which
flatters; *of all mapped*: of all movers ever in the map; *in a run*: how many unique movers, which needs no
denominator; *static flagged*: static features ever flagged of those ever mapped; *delay*: frames from first birth to
first deletion of the movers found; *velocity error*: |v̂ − v| of movers when they were flagged, of methods that estimate
it, and in brackets its NEES / 3; *position*, *orientation*: RMS error of a run; *against the static scene*: the
difference of it from the same seeds without movers, with its 95 % interval, bold where that excludes zero; *ratio*: of
the two errors of position; *ANEES*: of position, pose and the places of the map's static landmarks, 1 of a consistent
filter, bold outside the bounds in which 95 % of averages over so many runs lie. ± is a standard error over runs, which
is 0 where all runs agree. The features that are flagged are those that gate or detector has ever deleted.
"""


def detection_tables(found: Detection) -> dict[str, Any]:
    """Scores of every method in every scene as plain values.

    Args:
        found: what `study.detect` gives.

    Returns: `cells` with movers and `static_cells` without, each with `detector`, `robot_motion`, `dynamic_motion`,
        `dynamic_speed_m_s`, `amplitude_m` and the `study.detect.scores`. Those with movers have the static scene's
        `static_scene_position_rmse_cm`, and `difference`: by figure of `DIFFERENCES` the `mean` of scene - static scene
        of the same seeds, its 95 % interval `lower` to `upper` and `num_pairs`. `harder_cells` are like them, with the
        harder scene's name as `label`. `curves` are the operating curves (see `detection_roc.curves_table`). Beside
        them `methods`, the configuration of each, and `num_seeds`.
    """
    cells, harder_cells, static_cells, predicted = [], [], [], predictions(found.runs)
    for (method, scene), runs in found.runs.items():
        static = found.runs[method, scene.static]
        cell: dict[str, Any] = {
            "detector": method,
            "robot_motion": scene.robot,
            "dynamic_motion": scene.dynamic_motion,
            "dynamic_speed_m_s": scene.dynamic_speed_m_s,
            "amplitude_m": scene.amplitude_m,
            "label": scene.label,
        }
        if scene.is_static:
            cell |= scores(runs, runs)
            static_cells.append(cell)
            continue
        if scene.dynamic_motion is not None:
            cell["dynamic_set"] = scene.dynamic_set
        cell |= scores(runs, static)
        cell["static_scene_position_rmse_cm"] = scores(static, static)["position_rmse_cm"]
        cell["difference"] = _difference(runs, static)
        if (method, scene) in predicted:
            cell["predicted"] = predicted[method, scene]
        (cells if scene.harder is None else harder_cells).append(cell)
    return {
        "num_seeds": max(int(runs.sizes["seed"]) for runs in found.runs.values()),
        "min_frames_mapped": MIN_FRAMES_MAPPED,
        "methods": {name: describe(METHODS[name].config) for name in dict.fromkeys(method for method, _ in found.runs)},
        "cells": cells,
        "harder_cells": harder_cells,
        "static_cells": static_cells,
        "curves": curves_table(found.curves),
    }


def detection_markdown(tables: Mapping[str, Any]) -> str:
    """The same as Markdown: a table for each amplitude, the methods of a scene below each other."""
    every = [*tables["cells"], *tables["harder_cells"], *tables["static_cells"]]
    failed, full = (sum(cell[name] for cell in every) for name in ("runs_failed", "runs_map_full"))
    num_runs = sum(cell["runs"] for cell in every)
    counts = f"{tables['num_seeds']} runs of each method in each scene; of {num_runs} runs {failed} failed"
    sections = ["# Movers found\n", f"{counts}, and in {full} the map was full.\n", _INTRODUCTION]
    for amplitude in dict.fromkeys(cell["amplitude_m"] for cell in every):
        sections.append(f"## {'Oscillating, A = ' + format(amplitude, 'g') + ' m' if amplitude else 'Steady camera'}\n")
        cells = [cell for cell in every if cell["amplitude_m"] == amplitude]
        scenes = dict.fromkeys(cell["label"] for cell in cells)
        sections.append(grid(_HEADER, [_row(cell) for scene in scenes for cell in cells if cell["label"] == scene]))
    if tables["curves"]:
        sections += ["## At other thresholds\n", curves_markdown(tables["curves"])]
    if predicted := [cell for cell in every if "predicted" in cell]:
        sections += ["## Predicted before anything was run\n", prediction_markdown(predicted)]
    return "\n".join(sections)


def write_detection(found: Detection, directory: Path) -> list[Path]:
    """Write `detect.json`, `detect.md` and the figures into a directory.

    Returns: the paths written.

    Raises:
        OSError: if the directory cannot be written to.
    """
    tables = detection_tables(found)
    paths = [write_json(directory / "detect.json", tables)]
    paths.append(write_file(directory / "detect.md", detection_markdown(tables).encode()))
    for dynamic_set in dict.fromkeys(cell["dynamic_set"] for cell in tables["cells"]):
        chosen = [cell for cell in tables["cells"] if cell["dynamic_set"] == dynamic_set]
        name = "" if dynamic_set == "ahead" else f"_{dynamic_set}"
        paths += write_figure(found_figure(tables | {"cells": chosen}), directory / "figures" / f"movers_found{name}")
        paths += write_figure(position_figure(tables | {"cells": chosen}), directory / "figures" / f"position{name}")
    if curves := tables["curves"]:
        paths += write_figure(roc_figure(curves), directory / "figures" / "roc")
        paths += write_figure(precision_figure(curves), directory / "figures" / "precision_recall")
    if predicted := [cell for cell in [*tables["cells"], *tables["harder_cells"]] if "predicted" in cell]:
        paths += write_figure(prediction_figure(predicted), directory / "figures" / "predicted")
    return paths


def _difference(found: Any, static: Any) -> dict[str, Any]:
    """Scene - static scene, paired by seed."""
    difference = paired_difference(found, static)
    return {
        name: {part: float(difference[name].sel(statistic=part)) for part in ("mean", "lower", "upper")}
        | {"num_pairs": int(difference.num_pairs)}
        for name in DIFFERENCES
    }


def _row(cell: Mapping[str, Any]) -> list[str]:
    found = _text(cell["found_fraction"], 1, 100)
    if cell["movers"]:
        found += f" ({cell['movers_found']} of {cell['movers']})"
    position, orientation = (cell.get("difference", {}).get(name) for name in DIFFERENCES)
    return [
        cell["label"],
        cell["detector"],
        found,
        _text(cell["found_of_mapped_fraction"], 1, 100),
        _text(cell["found_per_run"], 2),
        _text(cell["static_flagged_fraction"], 2, 100),
        _text(cell["delay_frames"], 1),
        _velocity(cell),
        _text(cell["position_rmse_cm"], 2),
        "–" if position is None else _interval(position, 2),
        "–" if position is None else _text(cell["position_ratio"], 2),
        _text(cell["orientation_error_deg"], 3),
        "–" if orientation is None else _interval(orientation, 3),
        *(_anees(cell, name) for name in DEGREES_OF_FREEDOM),
    ]


def _text(figure: Mapping[str, float], decimals: int, factor: float = 1.0) -> str:
    """Mean ± standard error; without the error, or a dash, where they are not known."""
    mean, error = factor * figure["mean"], factor * figure["se"]
    if not math.isfinite(mean):
        return "–"
    return f"{mean:.{decimals}f}" + (f" ± {error:.{decimals}f}" if math.isfinite(error) else "")


def _anees(cell: Mapping[str, Any], name: str) -> str:
    text, bounds = _text(cell[name], 2), cell["anees_bounds"][name]
    is_outside = not bounds["lower"] <= cell[name]["mean"] <= bounds["upper"]
    return f"**{text}**" if is_outside and math.isfinite(cell[name]["mean"]) else text


def _velocity(cell: Mapping[str, Any]) -> str:
    if not math.isfinite(cell["velocity_error_m_s"]["mean"]):
        return "–"
    return f"{_text(cell['velocity_error_m_s'], 2)} ({cell['velocity_nees']['mean']:.2f})"


def _interval(difference: Mapping[str, float], decimals: int) -> str:
    mean, lower, upper = (difference[part] for part in ("mean", "lower", "upper"))
    if not math.isfinite(lower):
        return "–" if not math.isfinite(mean) else _signed(mean, decimals)
    text = f"{_signed(mean, decimals)} [{_signed(lower, decimals)}, {_signed(upper, decimals)}]"
    return f"**{text}**" if lower > 0 or upper < 0 else text


def _signed(value: float, decimals: int) -> str:
    return f"{value:+.{decimals}f}".replace("-", "−")
