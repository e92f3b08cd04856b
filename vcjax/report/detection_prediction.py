"""What a velocity test found, beside what was predicted of it from the scenes alone, with nothing run."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from vcjax.detectability.chi_squared import survival
from vcjax.detectability.survey import predict_movers
from vcjax.detectability.velocity_test import VelocityTest
from vcjax.gates.velocity_glr import VelocityGLR
from vcjax.report.markup import grid
from vcjax.report.style import RC, new_figure
from vcjax.study.detect import Runs
from vcjax.study.detection_methods import METHODS
from vcjax.study.detection_scenes import Scene

_HALF = 0.5
"""Power at which a mover counts as found when frames are predicted."""
_INTRODUCTION = f"""\
The power of the χ² test against each mover (see `vcjax detectability`), with all its frames in view and the threshold
of the method, and the mean over the movers of the frames after which it is {_HALF:g}, beside what the method found. A
power at the false-alarm rate is what remains where a mover looks like a static feature at another place: one that
comes straight towards a steady camera, at β times the camera's own speed, is seen exactly as a static point at 1/(1 +
β) of its distance, frame by frame, so that no test of its pixels can find it. A swing sideways does not shrink with
the distance as the path does, and gives it away.
"""


def predictions(runs: Runs) -> dict[tuple[str, Scene], dict[str, float]]:
    """What is predicted of the methods with a velocity test of a fixed threshold.

    In the scenes with movers but the harder ones, whose movers the prediction was not made for.

    Returns: for each, `found_fraction`, the mean power over the movers, and `delay_frames`, the mean number of frames
        until it is 0.5, of the movers whose power ever is; NaN where there is none.
    """
    result = {}
    for (method, scene), found in runs.items():
        detector = METHODS[method].config.detector
        if not isinstance(detector, VelocityGLR) or detector.threshold is None:
            continue
        if scene.is_static or scene.harder is not None:
            continue
        test = VelocityTest(false_alarm_rate=float(survival(detector.threshold)))
        scenario = scene.scenario(found.sizes["frame"])
        (prediction,) = predict_movers({scene.identifier: scenario}, test, _HALF).values()
        frames = prediction.frames_needed[np.isfinite(prediction.frames_needed)]
        result[method, scene] = {
            "found_fraction": float(prediction.power_of_all_frames.mean()),
            "delay_frames": float(frames.mean()) if len(frames) else float("nan"),
        }
    return result


def prediction_markdown(cells: Sequence[Mapping[str, Any]]) -> str:
    """A table of the cells that have a prediction."""

    def row(cell: Mapping[str, Any]) -> list[str]:
        predicted, found, delay = cell["predicted"], cell["found_fraction"], cell["delay_frames"]
        return [
            f"{cell['label']}, " + (f"A = {cell['amplitude_m']:g} m" if cell["amplitude_m"] else "steady"),
            cell["detector"],
            f"{100 * predicted['found_fraction']:.1f}",
            _number(100 * found["mean"], "{:.1f}") + _number(100 * found["se"], " ± {:.1f}", instead=""),
            _number(predicted["delay_frames"], "{:.0f}"),
            _number(delay["mean"], "{:.1f}"),
        ]

    header = ("scene", "method", "predicted found, %", "found, %", "predicted delay, frames", "delay, frames")
    return _INTRODUCTION + "\n" + grid(header, [row(cell) for cell in cells])


@matplotlib.rc_context(RC)
def prediction_figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Delay and share found of each scene over their predictions; bars are ± standard errors."""
    figure = new_figure(6.8, 3.4)
    left, right = figure.subplots(1, 2)
    amplitudes = list(dict.fromkeys(cell["amplitude_m"] for cell in cells))
    for amplitude, colour in zip(amplitudes, ("#4d4d4d", "#e69f00", "#0072b2", "#009e73", "#cc79a7"), strict=False):
        chosen = [cell for cell in cells if cell["amplitude_m"] == amplitude]
        label = f"A = {amplitude:g} m" if amplitude else "steady"
        for axes, name, factor in ((left, "found_fraction", 100), (right, "delay_frames", 1)):
            axes.errorbar(
                [factor * cell["predicted"][name] for cell in chosen],
                [factor * cell[name]["mean"] for cell in chosen],
                [factor * np.nan_to_num(cell[name]["se"]) for cell in chosen],
                fmt="o",
                markersize=4,
                capsize=2,
                color=colour,
                label=label,
            )
    for axes, name in ((left, "movers found, %"), (right, "delay, frames")):
        low, high = (-4, 104) if axes is left else (0, 1.05 * max(*axes.get_xlim(), *axes.get_ylim()))
        axes.plot([low, high], [low, high], color="#b3b3b3", linewidth=0.8, linestyle=":")
        axes.set(xlim=(low, high), ylim=(low, high), xlabel=f"predicted {name}", ylabel=name)
        axes.set_aspect("equal")
    left.legend(loc="lower right")
    figure.suptitle("Predicted from the scene alone, and measured", fontsize=10)
    return figure


def _number(value: float, form: str, instead: str = "–") -> str:
    return form.format(value) if np.isfinite(value) else instead
