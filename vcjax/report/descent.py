"""Descents: objective and parameters from step to step."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vcjax.report.landscape import LABELS
from vcjax.report.style import RC, new_figure
from vcjax.tuning.descent import Step

_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")


@matplotlib.rc_context(RC)
def descent_figure(descents: Sequence[Sequence[Step]]) -> Figure:
    """The smoothed objective (± one standard error) and every parameter against the step, a line for each start."""
    names = list(descents[0][0].parameters)
    columns = 1 + len(names)
    figure = new_figure(2.5 * columns, 2.9)
    panels = figure.subplots(1, columns, squeeze=False)[0]
    for number, steps in enumerate(descents):
        style = {"color": _COLOURS[number % len(_COLOURS)], "label": f"start {number + 1}"}
        places = np.arange(1, len(steps) + 1)
        loss, error = (np.array([getattr(step, name) for step in steps]) for name in ("loss", "loss_se"))
        panels[0].plot(places, loss, **style)
        panels[0].fill_between(places, loss - error, loss + error, color=style["color"], alpha=0.15, linewidth=0)
        for axes, name in zip(panels[1:], names, strict=True):
            axes.plot(places, [step.parameters[name] for step in steps], **style)
    panels[0].set_title("smoothed objective")
    for axes, name in zip(panels[1:], names, strict=True):
        axes.set_title(LABELS.get(name, name.split(".")[-1]))
    for axes in panels:
        axes.set_xlabel("step")
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    first, last = descents[0][0].temperature, descents[0][-1].temperature
    figure.suptitle(
        f"Descent by gradient, fresh seeds in every step, temperature {first:.2g} to {last:.2g}", fontsize=10
    )
    if len(descents) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(6, len(descents)))
    return figure
