"""What can be told before running: maps of power and of the smallest speed, tables, JSON."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MultipleLocator

from vcjax.detectability.best_oscillation import Oscillating
from vcjax.detectability.survey import SEARCHED_M_S, Prediction, Survey
from vcjax.report.markup import grid
from vcjax.report.style import RC, new_figure, write_figure
from vcjax.storage import write_file, write_json
from vcjax.tuning.intervals import OSCILLATION

_COLOURS = ("#4d4d4d", "#e69f00", "#009e73", "#0072b2", "#cc79a7", "#d55e00")
_NEVER, _UNSEEN = "#bdbdbd", "white"


class Detectability(NamedTuple):
    """All that is reported."""

    settings: dict[str, Any]
    """Robot, f, frames, false-alarm rate, power: what was asked for."""
    amplitudes_m: Sequence[float]
    headings_deg: Sequence[float]
    speeds_m_s: Sequence[float]
    side_m: np.ndarray
    """Coordinates of the map's square, the same for x and y."""
    path_m: np.ndarray
    """The robot's path, (T, 2)."""
    area: Survey
    """At side × side, x slower."""
    movers_m: np.ndarray
    """Places of the scene's movers, (D, 3)."""
    around_deg: np.ndarray
    """Directions all around, deg."""
    around: Survey
    """At the movers' places in all directions."""
    scenes: Mapping[float, Mapping[str, Prediction]]
    """What happens to the movers of each scene, by amplitude."""
    best: Oscillating


def write_detectability(found: Detectability, directory: Path) -> list[Path]:
    """Write `detectability.json`, `detectability.md` and the figures into a directory.

    Returns: the paths written.

    Raises:
        OSError: if the directory cannot be written to.
    """
    paths = [
        write_json(directory / "detectability.json", as_json(found)),
        write_file(directory / "detectability.md", markdown(found).encode()),
    ]
    folder = directory / "figures"
    paths += write_figure(smallest_speed_figure(found), folder / "smallest_speed")
    for number, speed in enumerate(found.speeds_m_s):
        paths += write_figure(power_figure(found, number), folder / f"power_{speed:g}_m_s")
    return [*paths, *write_figure(around_figure(found), folder / "all_directions")]


def as_json(found: Detectability) -> dict[str, Any]:
    """Settings, predictions for each scene, and the maps; what does not exist or is infinite becomes null."""
    A, side = len(found.amplitudes_m), len(found.side_m)
    return {
        **found.settings,
        "scenes": [
            {
                "scene": name,
                "amplitude_m": amplitude,
                **{key: np.asarray(value, float).tolist() for key, value in prediction._asdict().items()},
            }
            for amplitude, scenes in found.scenes.items()
            for name, prediction in scenes.items()
        ],
        "smallest_speed": _smallest(found),
        "best_oscillation": found.best._asdict(),
        "map": {
            "dimensions": ["amplitude_m", "x_m", "y_m", "heading_deg", "speed_m_s"],
            "amplitude_m": list(map(float, found.amplitudes_m)),
            "x_m": found.side_m.tolist(),
            "y_m": found.side_m.tolist(),
            "heading_deg": list(map(float, found.headings_deg)),
            "speed_m_s": list(map(float, found.speeds_m_s)),
            "power": found.area.power.reshape(A, side, side, *found.area.power.shape[2:]).tolist(),
            "smallest_speed_m_s": found.area.smallest_m_s.reshape(A, side, side, -1).tolist(),
        },
    }


def _smallest(found: Detectability) -> list[dict[str, Any]]:
    """Of each amplitude and direction: over the places of the map from which a feature is seen, and at the movers'."""
    rows = []
    for i, amplitude in enumerate(found.amplitudes_m):
        for j, angle in enumerate(found.headings_deg):
            speeds = found.area.smallest_m_s[i, :, j]
            speeds = speeds[~np.isnan(speeds)]
            quartiles = np.quantile(speeds, (0.25, 0.5, 0.75), method="inverted_cdf") if len(speeds) else [np.nan] * 3
            names = ("quarter_m_s", "median_m_s", "three_quarters_m_s")
            rows.append(
                {
                    "amplitude_m": float(amplitude),
                    "heading_deg": float(angle),
                    "places_seen": len(speeds),
                    "places_found": int(np.isfinite(speeds).sum()),
                    **dict(zip(names, map(float, quartiles), strict=True)),
                }
            )
    return rows


def markdown(found: Detectability) -> str:
    """The settings in words, the smallest speeds, the movers of each scene, and the best oscillation."""
    told, best = found.settings, found.best
    rows = _smallest(found)
    smallest = grid(
        ["A, m", "direction", "places", "found at all", "quarter", "median", "three quarters"],
        [
            [
                f"{row['amplitude_m']:g}",
                _direction(row["heading_deg"]),
                str(row["places_seen"]),
                str(row["places_found"]),
                *(_speed(row[name]) for name in ("quarter_m_s", "median_m_s", "three_quarters_m_s")),
            ]
            for row in rows
        ],
    )
    scenes = grid(
        ["scene", "A, m", "power", "power of all frames", "frames needed"],
        [
            [
                name,
                f"{amplitude:g}",
                _range(prediction.power, ".3f"),
                _range(prediction.power_of_all_frames, ".3f"),
                _range(prediction.frames_needed, ".0f"),
            ]
            for name in next(iter(found.scenes.values()))
            for amplitude, prediction in ((a, scenes[name]) for a, scenes in found.scenes.items())
        ],
    )
    return (
        f"# What can be told before running\n\n"
        f"Robot {told['robot']}, f = {told['frequency_hz']:g} Hz, {told['num_frames']} frames; a static feature is "
        f"called dynamic with probability {told['false_alarm_rate']:g}; {_frames(told)}.\n\n"
        f"## Smallest speed found with power {told['power']:g}, m/s\n\n"
        f"Over places {told['height_m']:g} m high from which a feature at rest is seen; up to {SEARCHED_M_S[-1]:g} "
        f"m/s.\n\n{smallest}\n"
        f"## Movers\n\nSmallest – largest of the {len(found.movers_m)}.\n\n{scenes}\n"
        f"## Best oscillation\n\nFor these scenes, at a price of {told['price']:g} s²/m²: "
        f"A = {best.amplitude_m:.3f} m, f = {best.frequency_hz:.2f} Hz; {1 - best.missed:.3f} of the movers found, "
        f"camera motion {best.camera_motion_m2_s2:.3f} m²/s².{_ends(best)}\n"
    )


def _ends(best: Oscillating) -> str:
    """What lies at an end of its interval, in words."""
    if not best.at_the_end:
        return ""
    A, f = OSCILLATION.values()
    names = " and ".join(best.at_the_end) + (" lies" if len(best.at_the_end) == 1 else " lie")
    return (
        f" {names} at an end of what was searched, {A.low:g} to {A.high:g} m and {f.low:g} to {f.high:g} Hz; nothing "
        "beyond was tried."
    )


def _frames(told: Mapping[str, Any]) -> str:
    within = told["within_frames"]
    return f"{within:g} frames from first sight" if np.isfinite(within) else "all frames in view"


def _direction(angle_deg: float) -> str:
    names = {0.0: "forward, +x", 90.0: "left, +y", 180.0: "towards, −x", 270.0: "right, −y"}
    return names.get(angle_deg % 360, f"{angle_deg:g}°")


def _speed(value: float) -> str:
    return "–" if np.isnan(value) else "none" if np.isinf(value) else f"{value:.3f}"


def _range(values: np.ndarray, form: str) -> str:
    low, high = (format(v, form) if np.isfinite(v) else "never" for v in (np.min(values), np.max(values)))
    return low if low == high else f"{low} – {high}"


@matplotlib.rc_context(RC)
def power_figure(found: Detectability, speed_number: int) -> Figure:
    """The power of the test at one speed over the scene: a row for each amplitude, a column for each direction."""
    values = np.where(np.isnan(found.area.smallest_m_s), np.nan, found.area.power[..., speed_number])
    title = f"Power of the test, movers at {found.speeds_m_s[speed_number]:g} m/s; white: never in view"
    return _maps(found, values, title, "power", cmap="viridis", vmin=0.0, vmax=1.0)


@matplotlib.rc_context(RC)
def smallest_speed_figure(found: Detectability) -> Figure:
    """The smallest speed found over the scene; grey where none is."""
    power, top = found.settings["power"], SEARCHED_M_S[-1]
    title = f"Smallest speed found with power {power:g}; grey: none up to {top:g} m/s; white: never in view"
    return _maps(
        found, found.area.smallest_m_s, title, "m/s", cmap="viridis_r", norm=LogNorm(SEARCHED_M_S[0], SEARCHED_M_S[-1])
    )


def _maps(found: Detectability, values: np.ndarray, title: str, label: str, **colours: Any) -> Figure:
    rows, columns, side = len(found.amplitudes_m), len(found.headings_deg), len(found.side_m)
    figure = new_figure(2.9 * columns + 1.2, 2.7 * rows + 0.9)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    half = (found.side_m[1] - found.side_m[0]) / 2
    edges = np.append(found.side_m - half, found.side_m[-1] + half)
    image = None
    for number, axes in enumerate(panels.flat):
        i, j = divmod(number, columns)
        one = values[i, :, j].reshape(side, side)
        axes.set_facecolor(_UNSEEN)
        axes.pcolormesh(edges, edges, np.where(np.isinf(one), 1.0, np.nan).T, cmap=_plain(_NEVER), rasterized=True)
        image = axes.pcolormesh(edges, edges, np.where(np.isinf(one), np.nan, one).T, rasterized=True, **colours)
        _draw_path(axes, found)
        axes.set_title(f"A = {found.amplitudes_m[i]:g} m, {_direction(found.headings_deg[j])}")
        axes.set_xlabel("x, forward (m)")
        axes.set_ylabel("y, left (m)")
        axes.label_outer()
    assert image is not None
    bar = figure.colorbar(image, ax=panels, label=label, aspect=40)
    if "norm" in colours:
        bar.formatter = FuncFormatter(lambda value, _: f"{value:g}")
        bar.update_ticks()
    told = found.settings
    figure.suptitle(f"{title}\nfalse-alarm rate {told['false_alarm_rate']:g}, {_frames(told)}", fontsize=10)
    return figure


def _plain(colour: str) -> ListedColormap:
    return ListedColormap([colour])


def _draw_path(axes: Axes, found: Detectability) -> None:
    axes.plot(*found.path_m.T, color="white", linewidth=3.4)
    axes.plot(*found.path_m.T, color="#d55e00", linewidth=1.8)
    axes.plot(*found.path_m[0], "s", color="#d55e00", markeredgecolor="white", markersize=6)
    axes.plot(*found.movers_m[:, :2].T, "o", color="none", markeredgecolor="#d55e00", markersize=5)
    axes.set_aspect("equal")
    axes.grid(False)


@matplotlib.rc_context(RC)
def around_figure(found: Detectability) -> Figure:
    """The smallest speed found at the movers' places against the direction of motion, a line for each amplitude.

    Of places above each other the first is shown, and its height told.
    """
    first = np.unique(found.movers_m[:, :2], axis=0, return_index=True)[1]
    figure = new_figure(max(2.6 * len(first), 4.0), 3.2)
    panels = figure.subplots(1, len(first), squeeze=False, sharey=True)[0]
    for axes, number in zip(panels, first, strict=True):
        for i, amplitude in enumerate(found.amplitudes_m):
            speed, style = found.around.smallest_m_s[i, number], {"color": _COLOURS[i % len(_COLOURS)]}
            is_none = np.isinf(speed)
            axes.plot(
                found.around_deg, np.where(is_none, np.nan, speed), marker=".", label=f"A = {amplitude:g} m", **style
            )
            top = np.full(is_none.sum(), SEARCHED_M_S[-1])
            axes.plot(found.around_deg[is_none], top, linestyle="none", marker="x", **style)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_major_locator(MultipleLocator(90))
        axes.set_title("from ({:g}, {:g}, {:g}) m".format(*found.movers_m[number]))
        axes.set_xlabel("direction, deg (0: +x)")
    panels[0].set_ylabel("smallest speed found, m/s")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    power, frames = found.settings["power"], _frames(found.settings)
    figure.suptitle(f"Power {power:g}, {frames}; crosses: none up to {SEARCHED_M_S[-1]:g} m/s", fontsize=10)
    return figure
