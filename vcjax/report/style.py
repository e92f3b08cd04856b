"""How all figures look, and their files, which depend on the results alone: no date, no random identifiers."""

import io
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from vcjax.storage import write_file

RC: Any = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so the figures look the same everywhere
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#4d4d4d",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "svg.hashsalt": "vcjax",
    "svg.fonttype": "path",
}
"""Matplotlib's settings."""
METHOD_STYLES: dict[str, dict[str, Any]] = {
    "VC": {"color": "#000000", "marker": "o"},
    "RE": {"color": "#e69f00", "marker": "s"},
    "one_point_ransac": {"color": "#009e73", "marker": "D"},
    "VC+blacklist": {"color": "#7a7a7a", "marker": "o", "linestyle": "--"},
    "RE+blacklist": {"color": "#b87333", "marker": "s", "linestyle": "--"},
    "one_point_ransac+blacklist": {"color": "#66c2a5", "marker": "D", "linestyle": "--"},
    "RE+velocity_glr": {"color": "#0072b2", "marker": "^"},
    "VC+velocity_glr": {"color": "#d55e00", "marker": "v"},
    "RE+velocity_likelihood_ratio": {"color": "#cc79a7", "marker": "P"},
    "RE+windowed_nis": {"color": "#56b4e9", "marker": "X"},
    "RE+cusum": {"color": "#8c8c00", "marker": "*"},
    "RE+immediate": {"color": "#7f3c8d", "marker": "h"},
}
"""Of the methods that `vcjax detect` compares: the same in every figure, whichever are in it."""
_METADATA = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure whose panels make room for each other."""
    figure = Figure(figsize=(width_in, height_in), layout=ConstrainedLayoutEngine(wspace=0.06, h_pad=0.08))
    FigureCanvasAgg(figure)
    return figure


def write_figure(figure: Figure, path: Path) -> list[Path]:
    """Write a figure as `path` with the endings .png and .svg; folders are made as needed.

    Raises:
        OSError: if the place cannot be written to.
    """
    return [write_file(path.with_name(f"{path.name}.{kind}"), _bytes(figure, kind)) for kind in _METADATA]


def write_picture(figure: Figure, path: Path) -> Path:
    """Write a figure as one PNG file under the name given; folders are made as needed.

    Raises:
        OSError: if the place cannot be written to.
    """
    return write_file(path, _bytes(figure, "png"))


def _bytes(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    with matplotlib.rc_context(RC):
        figure.savefig(buffer, format=kind, dpi=200, metadata=_METADATA[kind])
    return buffer.getvalue()
