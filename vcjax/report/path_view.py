"""The path and the landmarks of a filtered recording from above, beside odometry alone and the truth."""

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from vcjax.report.style import RC, new_figure
from vcjax.sources.map_file import CLASS_COLOURS, LandmarkMap

_PATH, _TRUTH, _ODOMETRY = "#0072b2", "#000000", "#999999"
_MARGIN = 0.15
"""How much room the view leaves around what it shows, as a part of its extent."""
_MOST_ROOM = 4.0
"""How far beyond the paths it reaches for landmarks, as a multiple of their extent."""
_WELL_KNOWN = 0.2
"""Largest standard deviation of a landmark that the view reaches for, as a part of its distance from the middle."""
_MOST_ELLIPSES = 400
"""Of each class."""


@matplotlib.rc_context(RC)
def path_figure(
    path: Float[np.ndarray, "T 7"],
    landmarks: LandmarkMap,
    odometry: Float[np.ndarray, "T 7"] | None = None,
    truth: Float[np.ndarray, "T 7"] | None = None,
) -> Figure:
    """Path (x, y) of the robot, and landmarks in the colours of their classes with 2 σ ellipses.

    The view holds the paths and most of the landmarks that are known well; those outside are counted in the title, by
    class. The legend counts all.

    Args:
        path: estimated poses.
        landmarks: the map.
        odometry: poses by odometry alone, if there is any.
        truth: true poses, NaN where nobody knows; not aligned.
    """
    figure = new_figure(7.2, 6.0)
    axes = figure.subplots()
    low, high = _view([poses for poses in (path, odometry, truth) if poses is not None], landmarks)
    xy = landmarks.place_m[:, :2]
    is_inside = np.all((xy >= low) & (xy <= high), axis=1)
    kinds = np.array(landmarks.kind, dtype=object)
    for kind, colour in reversed(CLASS_COLOURS.items()):
        chosen = is_inside & (kinds == kind)
        colour = tuple(part / 255 for part in colour)
        _ellipses(axes, landmarks, chosen, colour, float(np.max(high - low)))
        size = 16 if kind == "dynamic" else 6
        if num := int(np.sum(kinds == kind)):
            axes.scatter(*xy[chosen].T, s=size, color=[colour], label=f"{kind} ({num})", zorder=3)
    if odometry is not None:
        axes.plot(*odometry[:, :2].T, color=_ODOMETRY, linewidth=1.2, label="odometry alone", zorder=4)
    if truth is not None:
        axes.plot(*truth[:, :2].T, color=_TRUTH, linewidth=1.2, linestyle=(0, (4, 2)), label="truth", zorder=6)
    axes.plot(*path[:, :2].T, color=_PATH, linewidth=1.8, label="filter", zorder=5)
    axes.plot(*path[0, :2], "s", color=_PATH, markersize=6, label="start", zorder=7)
    axes.set(xlabel="x (m)", ylabel="y (m)", xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    far = [f"{num} {kind}" for kind in CLASS_COLOURS if (num := int(np.sum(~is_inside & (kinds == kind))))]
    axes.set_title("Path and landmarks from above" + (f"\nfarther away: {', '.join(far)}" if far else ""))
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _view(paths: list[np.ndarray], landmarks: LandmarkMap) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a view that holds the paths and the landmarks that are known well, up to some distance."""
    xy = np.concatenate([poses[:, :2] for poses in paths])
    xy = xy[np.isfinite(xy).all(axis=1)]
    low, high = xy.min(axis=0), xy.max(axis=0)
    reach = _MOST_ROOM * float(np.max(high - low))
    std = np.sqrt(np.linalg.eigvalsh(landmarks.cov[:, :2, :2])[:, -1].clip(min=0.0))
    distance = np.linalg.norm(landmarks.place_m[:, :2] - (low + high) / 2, axis=1)
    known = landmarks.place_m[std < _WELL_KNOWN * distance, :2]
    if len(known):
        ends = np.quantile(known, [0.05, 0.95], axis=0)
        low, high = np.minimum(low, ends[0].clip(low - reach)), np.maximum(high, ends[1].clip(max=high + reach))
    room = max(_MARGIN * float(np.max(high - low)), 0.5)
    return low - room, high + room


def _ellipses(axes, landmarks: LandmarkMap, chosen: np.ndarray, colour, extent_m: float) -> None:
    """2 σ ellipses of (x, y), of the landmarks that are known better than a part of the view."""
    values, vectors = np.linalg.eigh(landmarks.cov[chosen][:, :2, :2])
    size = 4.0 * np.sqrt(np.maximum(values, 0.0))
    every = max(1, -(-len(values) // _MOST_ELLIPSES))  # spread over the run
    for place, axis, (short, long) in list(zip(landmarks.place_m[chosen], vectors, size, strict=True))[::every]:
        if long < 0.15 * extent_m:
            angle = np.rad2deg(np.arctan2(axis[1, 1], axis[0, 1]))
            axes.add_patch(Ellipse(place[:2], long, short, angle=angle, fill=False, edgecolor=colour, linewidth=0.5))
