"""ROC and precision–recall curves of methods over the tracks of all scenes with movers, for each amplitude."""

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from vcjax.report.detection_curves import draw_curve, precision_axes, roc_axes
from vcjax.report.style import METHOD_COLOURS, RC, new_figure
from vcjax.study import roc
from vcjax.study.detect import Runs
from vcjax.tuning.choice import FALSE_RATE

_RESAMPLES = 200


def _tracks(runs: Any) -> roc.Tracks:
    """The tracks of one method in one scene, by what deletes them (see `roc.track_scores`)."""
    score = roc.track_scores(runs).transpose("seed", "feature")
    return roc.Tracks(score.values, np.broadcast_to(runs.is_moving.values, score.shape))


def separation(runs: Any) -> dict[str, dict[str, float]]:
    """How well a method tells movers from static tracks in a scene, at all thresholds of its score.

    Returns: `auc`, and `recall_at_1_percent`, the share of movers found when 1 % of the static tracks are called
        dynamic; each with the 95 % interval `lower` to `upper` by bootstrap over seeds.
    """
    tracks = _tracks(runs)
    weights = roc.resamples(len(tracks.score), _RESAMPLES)
    rate = np.array([FALSE_RATE])
    return {
        "auc": _with_interval(roc.area(tracks)[0], roc.area(tracks, weights)),
        "recall_at_1_percent": _with_interval(
            roc.recall_at(tracks, rate)[0, 0], roc.recall_at(tracks, rate, weights)[:, 0]
        ),
    }


def _with_interval(value: float, resampled: np.ndarray) -> dict[str, float]:
    lower, upper = roc.interval(resampled)
    return {"mean": float(value), "lower": float(lower), "upper": float(upper)}


@matplotlib.rc_context(RC)
def roc_figure(runs: Runs) -> Figure:
    """Both curves with pointwise 95 % bands by bootstrap over seeds, a row for each amplitude, a line for each method.

    The tracks of the scenes with movers are pooled, the harder scenes left out.
    """
    pooled = _pooled(runs)
    amplitudes = list(dict.fromkeys(amplitude for amplitude, _ in pooled))
    methods = list(dict.fromkeys(method for _, method in pooled))
    figure = new_figure(7.2, 2.5 * len(amplitudes) + 0.7)
    panels = figure.subplots(len(amplitudes), 2, squeeze=False)
    for (left, right), amplitude in zip(panels, amplitudes, strict=True):
        for method, colour in zip(methods, METHOD_COLOURS, strict=False):
            if (tracks := pooled.get((amplitude, method))) is not None:
                style = {"color": colour, "linewidth": 1.2}
                draw_curve(left, roc.FALSE_RATES, roc.recall_at, tracks, method, style)
                draw_curve(right, roc.RECALLS, roc.precision_at, tracks, method, style)
        roc_axes(left)
        precision_axes(right)
        for axes in (left, right):
            axes.set_title(f"A = {amplitude:g} m" if amplitude else "steady")
    handles, names = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=min(4, len(names)))
    figure.suptitle("Tracks of all scenes with movers, at every threshold, 95 % bands", fontsize=10)
    return figure


def _pooled(runs: Runs) -> Mapping[tuple[float, str], roc.Tracks]:
    """The tracks of each amplitude and method; those of one seed in all scenes belong together."""
    parts: dict[tuple[float, str], list[roc.Tracks]] = {}
    for (method, scene), found in runs.items():
        if scene.dynamic_motion is not None:
            parts.setdefault((scene.amplitude_m, method), []).append(_tracks(found))
    return {
        key: roc.Tracks(*(np.concatenate([part[i] for part in each], axis=1) for i in (0, 1)))
        for key, each in parts.items()
    }
