"""The paper's Figures 3–6 made again: errors against the frame with bands, and the scene from above.

Colours are those of Okabe and Ito, which people with colour-blindness can tell apart, and every method keeps its own in
all figures; lines differ in style as well. The files depend on the results alone: no date, no random identifiers.
"""

import os
from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, MultipleLocator

from vcjax.report.style import RC, new_figure, write_figure
from vcjax.study.paper import RE, VC, VC_OSCILLATING, Cell, cells
from vcjax.study.summary import mean_and_error, student_t

_EXPERIMENTS = {3: (2, "forward"), 4: (3, "lateral"), 5: (3, "inverse forward")}
_TITLES = {
    3: "Robot forward, static scene",
    4: "Robot forward, dynamic features lateral at 1 m/s",
    5: "Robot forward, dynamic features inverse forward at 1 m/s",
}
_STYLES = {
    RE: {"color": "#4d4d4d", "linestyle": "-"},
    VC: {"color": "#e69f00", "linestyle": (0, (5, 2))},
    VC_OSCILLATING: {"color": "#009e73", "linestyle": "-"},
}
_ROBOT, _MOVING, _STATIC = "#0072b2", "#d55e00", "#b3b3b3"


def write_figures(results: Mapping[Cell, xr.Dataset], directory: str | os.PathLike) -> list[Path]:
    """Write `figures/figure_3.png` and `.svg` to `figure_6` into a directory, those that the cells allow.

    Args:
        results: runs (seed, frame, feature) of any of the paper's cells.
        directory: an existing directory; `figures` is made in it.

    Returns:
        The paths written.

    Raises:
        OSError: if the directory cannot be written to.
    """
    folder = Path(directory) / "figures"
    paths = []
    with matplotlib.rc_context(RC):
        drawn = {number: error_figure(number, results) for number in _EXPERIMENTS} | {6: scene_figure(results)}
        for number, figure in drawn.items():
            if figure is not None:
                paths += write_figure(figure, folder / f"figure_{number}")
    return paths


def error_figure(number: int, results: Mapping[Cell, xr.Dataset]) -> Figure | None:
    """Figure 3, 4 or 5: mean position error (cm) and orientation error (deg) over the finite seeds against the frame.

    Bands are pointwise 95 % Student-t intervals of the mean; from a single run there is none.

    Returns:
        The figure with the methods whose cells exist, of RE steady, VC steady and VC oscillating; None if none does.
    """
    table, case = _EXPERIMENTS[number]
    found = [
        cell
        for cell in cells([table])
        if cell in results and cell.case == case and (cell.gate, cell.oscillating) in _STYLES
    ]
    if not found:
        return None
    figure = new_figure(7.2, 3.4)
    position, orientation = figure.subplots(1, 2)
    for cell in found:
        runs = results[cell]
        _draw_error(position, cell, 100.0 * runs.position_error_m, runs.is_finite)
        _draw_error(orientation, cell, runs.orientation_error_deg, runs.is_finite)
    position.set_ylabel("position error (cm)")
    orientation.set_ylabel("orientation error (deg)")
    for axes in (position, orientation):
        axes.set_xlabel("frame")
        axes.set_xlim(0, results[found[0]].frame.max().item())
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 4, 5, 10]))
        axes.yaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))
    nums = sorted({int(results[cell].is_finite.sum()) for cell in found})
    count = f"{nums[0]}" if len(nums) == 1 else f"{nums[0]} to {nums[-1]}"  # failed runs are left out
    caption = "one run" if nums == [1] else f"mean of {count} runs, 95 % bands"
    figure.suptitle(f"{_TITLES[number]} ({caption})", fontsize=10)
    handles, labels = position.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(found), handlelength=2.8)
    return figure


def scene_figure(results: Mapping[Cell, xr.Dataset]) -> Figure | None:
    """Figure 6: the scene from above with the robot's path and the motion of the dynamic features at 1 m/s.

    Returns:
        The panels (a) lateral and (b) inverse forward whose cells exist; None if neither does.
    """
    panels = {}
    for letter, case in (("a", "lateral"), ("b", "inverse forward")):
        scenes = [results[cell] for cell in cells([3]) if cell in results and cell.case == case]
        if scenes:
            panels[f"({letter}) dynamic: {case}, 1 m/s"] = scenes[0]
    if not panels:
        return None
    figure = new_figure(3.6 * len(panels), 6.0 - 0.8 * len(panels))
    for axes, (title, runs) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        _draw_scene(axes, runs)
        axes.set_title(title)
    heights = np.unique(next(iter(panels.values())).landmark_true.values[0, :, 2])
    if len(heights) <= 3:  # features above one another are one dot
        figure.suptitle(f"From above; features at heights {' and '.join(f'{z:g}' for z in heights)} m", fontsize=10)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(panels), handlelength=2.8)
    return figure


def _draw_error(axes: Axes, cell: Cell, error: xr.DataArray, is_finite: xr.DataArray) -> None:
    mean, standard_error = mean_and_error(error, is_finite)
    half_width = standard_error * student_t(int(is_finite.sum()))
    style = _STYLES[cell.gate, cell.oscillating]
    axes.plot(mean.frame, mean, label=cell.method, **style)
    if np.isfinite(half_width).any():
        low, high = mean - half_width, mean + half_width
        axes.fill_between(mean.frame, low, high, color=style["color"], alpha=0.15, linewidth=0)


def _draw_scene(axes: Axes, runs: xr.Dataset) -> None:
    is_moving = runs.is_moving.values
    places = runs.landmark_true.values[..., :2]
    num_arrow = -(-runs.sizes["frame"] // 10) % runs.sizes["frame"]  # a tenth: longer arrows run into each other
    static, start, end = places[0, ~is_moving], places[0, is_moving], places[num_arrow, is_moving]
    axes.scatter(*static.T, s=10, color=_STATIC, label=f"{len(static)} static features", zorder=2)
    axes.scatter(*start.T, s=26, color=_MOVING, label=f"{len(start)} dynamic features in frame 1", zorder=4)
    _draw_arrows(axes, start, end, _MOVING)
    axes.plot([], [], color=_MOVING, linewidth=1.8, marker=">", label=f"their motion over {num_arrow} frames")
    path = runs.robot_true.values[:, :2]
    axes.plot(*path.T, color=_ROBOT, linestyle=":", linewidth=2, label="robot's path", zorder=3)
    _draw_arrows(axes, path[-2:][:1], path[-1:], _ROBOT)
    axes.scatter(*path[:1].T, s=26, color=_ROBOT, marker="s", zorder=4)
    axes.annotate("start", path[0], (5, 6), textcoords="offset points", color=_ROBOT)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(4))
    axes.set_aspect("equal")
    axes.set_xlabel("x, forward (m)")
    axes.set_ylabel("y, left (m)")


def _draw_arrows(axes: Axes, start: np.ndarray, end: np.ndarray, color: str) -> None:
    axes.update_datalim(end)  # an arrow does not widen the axes by itself, and would be left out beyond them
    axes.autoscale_view()
    arrow = {"arrowstyle": "-|>", "color": color, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
    for tail, head in zip(start, end, strict=True):
        axes.annotate("", head, tail, arrowprops=arrow, zorder=5)
