"""Movers found and position error over their speed: a panel for each motion and amplitude, a line for each method."""

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vcjax.report.style import METHOD_STYLES, RC, new_figure


@matplotlib.rc_context(RC)
def found_figure(tables: dict[str, Any]) -> Figure:
    """Share of the movers found over their speed, a panel for each motion and amplitude; bars are ± standard errors.

    Of the cells of one set of movers.
    """

    def draw(axes: Axes, speeds: np.ndarray, cells: list[dict[str, Any]], style: dict[str, Any]) -> None:
        mean, error = (np.array([100 * cell["found_fraction"][part] for cell in cells]) for part in ("mean", "se"))
        axes.errorbar(speeds, mean, error, **style)
        axes.set_ylim(-4, 104)

    return _panels(tables, "movers found, %", draw)


@matplotlib.rc_context(RC)
def position_figure(tables: dict[str, Any]) -> Figure:
    """What movers add to the position error, over their speed; bars are 95 % intervals, paired by seed."""

    def draw(axes: Axes, speeds: np.ndarray, cells: list[dict[str, Any]], style: dict[str, Any]) -> None:
        added = [cell["difference"]["position_rmse_cm"] for cell in cells]
        mean = np.array([each["mean"] for each in added])
        half_width = np.array([each["upper"] - each["mean"] for each in added])
        axes.axhline(0, color="#4d4d4d", linewidth=0.8)
        axes.errorbar(speeds, mean, half_width, **style)

    return _panels(tables, "position error added, cm", draw)


def _panels(tables: dict[str, Any], label: str, draw) -> Figure:
    """A row of panels for each motion, a column for each amplitude, a line for each method."""
    cells = tables["cells"]
    motions, amplitudes, speeds, methods = (
        list(dict.fromkeys(cell[name] for cell in cells))
        for name in ("dynamic_motion", "amplitude_m", "dynamic_speed_m_s", "detector")
    )
    figure = new_figure(2.3 * len(amplitudes) + 1.2, 2.2 * len(motions) + 0.8)
    panels = figure.subplots(len(motions), len(amplitudes), squeeze=False, sharex=True, sharey=True)
    place = {speed: i for i, speed in enumerate(sorted(speeds))}
    for row, motion in zip(panels, motions, strict=True):
        for axes, amplitude in zip(row, amplitudes, strict=True):
            for i, method in enumerate(methods):
                chosen = [
                    cell
                    for cell in cells
                    if (cell["dynamic_motion"], cell["amplitude_m"], cell["detector"]) == (motion, amplitude, method)
                ]
                style = METHOD_STYLES[method] | {"markersize": 4, "capsize": 2, "linewidth": 1.2, "label": method}
                # Side by side, so that equal values are seen.
                beside = 0.07 * (i - (len(methods) - 1) / 2)
                at = np.array([place[cell["dynamic_speed_m_s"]] + beside for cell in chosen])
                draw(axes, at, chosen, style)
            camera = f"A = {amplitude:g} m" if amplitude else "steady"
            axes.set_title(f"{motion.replace('_', ' ')}, {camera}")
            axes.set_xticks(range(len(place)), [f"{speed:g}" for speed in place])
    for axes in panels[-1]:
        axes.set_xlabel("speed, m/s")
    for axes in panels[:, 0]:
        axes.set_ylabel(label)
    handles, names = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=min(4, len(names)))
    figure.suptitle(f"{tables['num_seeds']} runs each", fontsize=10)
    return figure
