"""Heat maps over two numbers: what every point of a grid does to detection and position."""

from collections.abc import Mapping, Sequence

import matplotlib
import matplotlib.patheffects as patheffects
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from vcjax.report.style import RC, new_figure
from vcjax.tuning.landscape import means

PANELS = {
    "detection_f1": ("F1", "viridis"),
    "detection_auc": ("AUC", "viridis"),
    "position_rmse_cm": ("position error, cm", "viridis_r"),
    "loss": ("objective", "viridis_r"),
}
"""Figures shown, their titles, and colours of which the brighter is the better."""
LABELS = {
    "config.gate.th1": "Th₁",
    "config.gate.th2": "Th₂",
    "scenario.oscillation.amplitude_m": "A, m",
    "scenario.oscillation.frequency_hz": "f, Hz",
}
"""What numbers are called on axes, by their paths."""


@matplotlib.rc_context(RC)
def landscape_figure(
    grid: xr.Dataset,
    title: str,
    marks: Mapping[str, Mapping[str, float]] | None = None,
    paths: Sequence[Sequence[Mapping[str, float]]] = (),
) -> Figure:
    """F1, AUC, position error and objective over a grid, means over its seeds and scenes (see `landscape.means`).

    White where a scene has no run with the figure.

    Args:
        grid: runs (x, y, scene, seed), as from `landscape.as_grid`.
        title: what is shown.
        marks: settings to mark, by name.
        paths: settings one after another, drawn as lines with their numbers: the paths of descents.
    """
    x, y = (str(dim) for dim in grid.loss.dims[:2])
    figure = new_figure(8.6, 6.6)
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    shown, edges = means(grid), (_edges(grid[x].values), _edges(grid[y].values))
    limits = [each[[0, -1]] for each in edges]
    for axes, (name, (label, colours)) in zip(panels.flat, PANELS.items(), strict=True):
        values = shown[name].transpose(y, x)
        image = axes.pcolormesh(*edges, values, cmap=colours, shading="flat", rasterized=True)
        figure.colorbar(image, ax=axes)
        axes.grid(False)
        axes.set_title(label)
        axes.set_xlabel(LABELS.get(x, x))
        axes.set_ylabel(LABELS.get(y, y))
        _scale(axes, grid[x].values, grid[y].values)
        for number, path in enumerate(paths):
            way = [p[x] for p in path], [p[y] for p in path]
            outline = [patheffects.Stroke(linewidth=2.4, foreground="black"), patheffects.Normal()]  # for bright ground
            label = None if number else "descents, numbered where they start"
            style = {"color": "white", "path_effects": outline}
            axes.plot(*way, linewidth=1.2, marker=".", markersize=3, label=label, **style)
            axes.annotate(
                f"{number + 1}", (way[0][0], way[1][0]), (4, 4), textcoords="offset points", fontsize=8, **style
            )
        # One setting may be another: then the mark of the first is seen around that of the second.
        for (mark, setting), symbol, size in zip((marks or {}).items(), "os^D", (12, 8, 8, 8), strict=False):
            is_inside = all(low <= setting[p] <= high for p, (low, high) in zip((x, y), limits, strict=True))
            label = mark if is_inside else f"{mark}: outside"
            style = {"color": "#d55e00", "markeredgecolor": "white", "markersize": size, "label": label}
            axes.plot(setting[x], setting[y], symbol, **style)
        axes.label_outer()
    handles, labels = panels[0, 0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    figure.suptitle(title, fontsize=10)
    return figure


def _is_log(values: np.ndarray) -> bool:
    """Whether values are spread by equal factors; two, if by equal steps their cells would reach below 0."""
    if len(values) < 2 or values[0] <= 0:
        return False
    return bool(values[1] > 3 * values[0]) if len(values) == 2 else bool(np.ptp(np.diff(np.log(values))) < 1e-6)


def _edges(values: np.ndarray) -> np.ndarray:
    """Ends of the cells around values, half-way between them on the axis that they are drawn on.

    The first does not reach below 0 where the values do not: no such number would make sense.
    """
    if len(values) < 2:
        return values[0] + np.array([-0.5, 0.5])
    is_log = _is_log(values)
    places = np.log(values) if is_log else values
    middle = (places[1:] + places[:-1]) / 2
    edges = np.concatenate([[2 * places[0] - middle[0]], middle, [2 * places[-1] - middle[-1]]])
    if not is_log and values[0] >= 0:
        edges[0] = max(edges[0], 0.0)
    return np.exp(edges) if is_log else edges


def _scale(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """A logarithmic scale where the values are spread so."""
    for values, set_scale, axis in ((x, axes.set_xscale, axes.xaxis), (y, axes.set_yscale, axes.yaxis)):
        if _is_log(values):
            set_scale("log")
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_locator(NullLocator())
    axes.set_xlim(*_edges(x)[[0, -1]])
    axes.set_ylim(*_edges(y)[[0, -1]])
