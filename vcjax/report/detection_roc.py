"""ROC and precision–recall curves of methods over their thresholds, for each amplitude: tables and figures."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vcjax.report.markup import grid
from vcjax.report.style import METHOD_STYLES, RC, new_figure
from vcjax.study import roc
from vcjax.study.detection_methods import METHODS
from vcjax.study.operating_curves import Curves, operating_point

_INTRODUCTION = """\
Each line is of runs at that threshold, all scenes with movers together but the harder ones: static features flagged of
those ever mapped, movers found of those ever mapped, and movers among all that was flagged, with 95 % intervals by
bootstrap over {min_seeds} seeds or more. Bold: the method's own threshold.
"""
_RESOLVED = 1e-3
"""Share of the static features above which the axis is logarithmic; below, down to none, it is linear."""


def curves_table(curves: Curves) -> list[dict[str, Any]]:
    """A line for each method and amplitude: `detector`, `amplitude_m` and `points`, in the order of the thresholds.

    Each point has its `threshold` and what `operating_point` gives.
    """
    return [
        {
            "detector": method,
            "amplitude_m": amplitude,
            "points": [{"threshold": value} | operating_point(counts) for value, counts in points.items()],
        }
        for (method, amplitude), points in curves.items()
    ]


def curves_markdown(table: Sequence[Mapping[str, Any]]) -> str:
    """The same as Markdown."""
    header = ("camera", "method", "threshold", "static flagged, %", "movers found, %", "precision, %")
    rows = [
        [
            _camera(amplitude),
            line["detector"],
            f"**{point['threshold']:g}**" if _is_own(line, point) else f"{point['threshold']:g}",
            _text(point["static_flagged_fraction"], 2),
            _text(point["found_of_mapped_fraction"], 1),
            _text(point["precision"], 1),
        ]
        for amplitude in dict.fromkeys(line["amplitude_m"] for line in table)
        for line in table
        if line["amplitude_m"] == amplitude
        for point in line["points"]
    ]
    return _INTRODUCTION.format(min_seeds=roc.MIN_SEEDS) + "\n" + grid(header, rows)


@matplotlib.rc_context(RC)
def roc_figure(table: Sequence[Mapping[str, Any]]) -> Figure:
    """Movers found over static features flagged, a panel for each amplitude, a line for each method."""
    figure, panels = _panels(table, "static_flagged_fraction", "found_of_mapped_fraction")
    for axes in panels:
        axes.set_xscale("symlog", linthresh=_RESOLVED)
        axes.set(xlim=(-_RESOLVED / 10, 1), xlabel="static features flagged")
    panels[0].set_ylabel("movers found")
    return figure


@matplotlib.rc_context(RC)
def precision_figure(table: Sequence[Mapping[str, Any]]) -> Figure:
    """Movers among what was flagged over movers found, a panel for each amplitude, a line for each method."""
    figure, panels = _panels(table, "found_of_mapped_fraction", "precision")
    for axes in panels:
        axes.set(xlim=(0, 1.02), xlabel="recall: movers found")
    panels[0].set_ylabel("precision")
    return figure


def _panels(table: Sequence[Mapping[str, Any]], across: str, up: str) -> tuple[Figure, list[Axes]]:
    """One figure over another: points joined in the order of the thresholds, 95 % bands upward and whiskers across."""
    amplitudes = list(dict.fromkeys(line["amplitude_m"] for line in table))
    figure = new_figure(max(2.9 * len(amplitudes), 4.6) + 0.6, 3.9)
    panels = list(figure.subplots(1, len(amplitudes), squeeze=False, sharey=True).flat)
    for axes, amplitude in zip(panels, amplitudes, strict=True):
        for line in (line for line in table if line["amplitude_m"] == amplitude):
            x, y = (_values(line, name) for name in (across, up))
            style = METHOD_STYLES[line["detector"]] | {"markersize": 4, "linewidth": 1.2, "label": line["detector"]}
            axes.fill_between(x[0], y[1], y[2], color=style["color"], alpha=0.15, linewidth=0)
            axes.errorbar(x[0], y[0], xerr=np.abs(x[1:] - x[0]), **style)
            own = [_is_own(line, point) for point in line["points"]]
            axes.plot(x[0][own], y[0][own], "o", color=style["color"], markersize=10, fillstyle="none", clip_on=False)
        axes.set_ylim(0, 1.02)
        axes.set_title(_camera(amplitude))
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=min(3, len(names)))
    figure.suptitle(
        "All scenes with movers, each at several thresholds (ring: the method's own), 95 % intervals", fontsize=10
    )
    return figure, panels


def _is_own(line: Mapping[str, Any], point: Mapping[str, Any]) -> bool:
    return point["threshold"] == METHODS[line["detector"]].threshold


def _values(line: Mapping[str, Any], name: str) -> np.ndarray:
    """Mean, lower and upper bound of a share at each threshold."""
    return np.array([[point[name][part] for point in line["points"]] for part in ("mean", "lower", "upper")])


def _camera(amplitude_m: float) -> str:
    return f"A = {amplitude_m:g} m" if amplitude_m else "steady"


def _text(share: Mapping[str, float], decimals: int) -> str:
    mean, lower, upper = (f"{100 * share[part]:.{decimals}f}" for part in ("mean", "lower", "upper"))
    if not np.isfinite(share["mean"]):
        return "–"
    return mean if not np.isfinite(share["lower"]) else f"{mean} [{lower}, {upper}]"
