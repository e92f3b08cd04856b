"""ROC and precision–recall curves over tracks, before and after a choice of settings."""

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vcjax.report.style import RC, new_figure
from vcjax.study import roc
from vcjax.tuning.choice import ALL, FALSE_RATE, Choice, tracks_of

_STYLES = {
    "before": {"color": "#4d4d4d", "linestyle": (0, (5, 2))},
    "after": {"color": "#009e73", "linestyle": "-"},
}
_RESAMPLES = 300


@matplotlib.rc_context(RC)
def curves_figure(choice: Choice) -> Figure:
    """Both curves over the tracks of all scenes and held-out seeds; from 8 seeds on with pointwise 95 % bands."""
    figure = new_figure(7.2, 3.6)
    left, right = figure.subplots(1, 2)
    for tracks, (side, style) in zip(_tracks(choice), _STYLES.items(), strict=True):
        draw_curve(left, roc.FALSE_RATES, roc.recall_at, tracks[ALL], side, style)
        draw_curve(right, roc.RECALLS, roc.precision_at, tracks[ALL], side, style)
    roc_axes(left)
    precision_axes(right)
    seeds, scenes = choice.held_out.sizes["seed"], choice.held_out.sizes["scene"]
    of = f"{scenes} scenes × {seeds}" if scenes > 1 else str(seeds)
    _finish(figure, left, f"Tracks of {of} held-out runs{_bands(seeds)}")
    return figure


@matplotlib.rc_context(RC)
def roc_by_scene_figure(choice: Choice) -> Figure:
    """The ROC of each scene by itself."""
    before, after = _tracks(choice)
    names = [name for name in before if name != ALL]
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(2.4 * columns + 0.4, 2.3 * rows + 0.5)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axes in panels.flat[len(names) :]:
        axes.remove()
    for axes, name in zip(panels.flat, names, strict=False):
        for tracks, (side, style) in zip((before, after), _STYLES.items(), strict=True):
            draw_curve(axes, roc.FALSE_RATES, roc.recall_at, tracks[name], side, style)
        roc_axes(axes)
        axes.set_title(name)
        axes.label_outer()
    seeds = choice.held_out.sizes["seed"]
    title = f"ROC over the tracks of {seeds} held-out runs{_bands(seeds)}"
    # A figure of one panel is narrower than its title.
    _finish(figure, panels[0, 0], title if columns > 1 else title.replace(" of ", "\nof "))
    return figure


def _bands(seeds: int) -> str:
    return ", 95 % bands" if seeds >= roc.MIN_SEEDS else ""


def _tracks(choice: Choice) -> list[dict[str, roc.Tracks]]:
    return [tracks_of(choice.held_out.isel(setting=i)) for i in (0, 1)]


def draw_curve(axes: Axes, levels: np.ndarray, curve, tracks: roc.Tracks, label: str, style: dict) -> None:
    """`roc.recall_at` or `precision_at` with its pointwise 95 % band, where seeds suffice; a word where no curve is."""
    if np.all(np.isnan(curve(tracks, levels)[0])):
        axes.plot([], [], label=label, **style)
        height = 0.5 - 0.1 * len(axes.texts)
        axes.text(0.5, height, f"{label}: no mover was measured", transform=axes.transAxes, ha="center")
        return
    low, high = roc.interval(roc.resampled(curve, tracks, levels, _RESAMPLES))
    axes.plot(levels, curve(tracks, levels)[0], label=label, **style)
    axes.fill_between(levels, low, high, color=style["color"], alpha=0.18, linewidth=0)


def precision_axes(axes: Axes) -> None:
    """Axes of precision over recall."""
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("recall: movers found")
    axes.set_ylabel("precision")


def roc_axes(axes: Axes) -> None:
    """Axes of the ROC, with a line at the share of static tracks at which recall is told."""
    axes.axvline(FALSE_RATE, color="#b3b3b3", linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set_xlim(roc.FALSE_RATES[0], 1)
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("static tracks called dynamic")
    axes.set_ylabel("movers found")


def _finish(figure: Figure, axes: Axes, title: str) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, handlelength=2.8)
    figure.suptitle(title, fontsize=10)
