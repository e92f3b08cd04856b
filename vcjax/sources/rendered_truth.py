"""What the tracks of a rendered sequence follow: the truth that a front end is measured with.

A corner at the rim of a patch belongs to the patch, though the pixel beside it is of what lies behind. So a track is
not given to the surface under its pixel, but to that one, of all seen around its first sighting, on which a fixed point
follows it best: the first sighting is cast on the surface, the point moves with it, and is projected into every frame.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from vcjax.sources.calibration import Calibration
from vcjax.sources.distortion import denormalise, normalise
from vcjax.sources.recording_file import TrackLabel, TrackLabels
from vcjax.sources.render import Surface, cast
from vcjax.sources.tracks import Tracks

AROUND_PX = 4.0
"""How far from a track's first sighting the surface that it follows may be seen, px."""
WORST_PX = 2.0
"""Largest median distance, px, of a track from the point that it is to follow; beyond, it follows none."""


class Followed(NamedTuple):
    """What tracks follow, for L tracks and N sightings."""

    track_id: Int[np.ndarray, " L"]
    """The tracks, growing."""
    surface: Int[np.ndarray, " L"]
    """Number of the surface; -1 where none is near."""
    labels: TrackLabels
    """Static, moving, or bad."""
    error_px: Float[np.ndarray, "N 2"]
    """Sighting less projection of the point that was seen first there, px."""


def what_tracks_follow(
    tracks: Tracks,
    surfaces: Sequence[Surface],
    calibration: Calibration,
    T_w_c: Float[np.ndarray, "T 7"],
    time_s: Float[np.ndarray, " T"],
) -> Followed:
    """Which surface each track follows, and how exactly.

    Args:
        tracks: sightings in the rendered images.
        surfaces: what was rendered.
        calibration: of the camera.
        T_w_c: its pose in each frame.
        time_s: of each frame.
    """
    frame, uv_px = np.asarray(tracks.frame), np.asarray(tracks.uv_px, np.float64)
    ids, track = np.unique(tracks.track_id, return_inverse=True)
    order = np.lexsort((frame, track))
    starts = np.searchsorted(track[order], np.arange(len(ids)))
    first = order[starts]
    angles = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
    offsets = AROUND_PX * np.vstack([np.zeros((1, 2)), np.column_stack([np.cos(angles), np.sin(angles)])])

    around = np.full((len(ids), len(offsets)), -1)
    for t in np.unique(frame[first]):
        here = np.flatnonzero(frame[first] == t)
        places = (uv_px[first[here], None] + offsets).reshape(-1, 2)
        around[here] = cast(surfaces, calibration, T_w_c[t], float(time_s[t]), places).reshape(len(here), -1)

    best, surface = np.full(len(ids), np.inf), np.full(len(ids), -1)
    error_px = np.full((len(frame), 2), np.nan)
    for j in range(len(offsets)):
        error = uv_px - _projected(around[:, j], first, track, frame, uv_px, surfaces, calibration, T_w_c, time_s)
        size = np.linalg.norm(error, axis=1)
        median = np.array([np.median(part) for part in np.split(size[order], starts[1:])])
        # The first sighting is exact by construction, on every surface.
        is_better = (around[:, j] >= 0) & (median < best - 1e-9)
        best[is_better], surface[is_better] = median[is_better], around[is_better, j]
        error_px = np.where(is_better[track][:, None], error, error_px)
    is_moving = np.array([np.any(s.velocity_m_s != 0) for s in surfaces] + [False])
    label = np.where(is_moving[surface], TrackLabel.MOVING, TrackLabel.STATIC)
    label = np.where(best <= WORST_PX, label, TrackLabel.BAD)
    return Followed(ids, surface, TrackLabels(ids, label), error_px)


def _projected(number, first, track, frame, uv_px, surfaces, calibration, T_w_c, time_s) -> Float[np.ndarray, "N 2"]:
    """Pixel in each sighting of the point that its track's first sighting has on a surface; NaN without one."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(np.array(T_w_c)[:, 3:], scalar_first=True)
    edges = np.array([[s.edge_u_m, s.edge_v_m] for s in surfaces])[number]
    corner = np.array([s.corner_m for s in surfaces])[number]
    velocity = np.array([s.velocity_m_s for s in surfaces])[number]
    t = frame[first]
    rays = turn[t].apply(np.column_stack([normalise(calibration, uv_px[first]), np.ones(len(first))]))
    normal = np.cross(edges[:, 0], edges[:, 1])
    # At time 0, when the surface is where it is kept.
    start = np.asarray(T_w_c)[t, :3] - velocity * np.asarray(time_s)[t, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.sum((corner - start) * normal, axis=1) / np.sum(rays * normal, axis=1)
        point = (start + depth[:, None] * rays)[track] + velocity[track] * np.asarray(time_s)[frame, None]
        seen = turn[frame].apply(point - np.asarray(T_w_c)[frame, :3], inverse=True)
        seen = np.where(seen[:, 2:] > 0, seen, np.nan)
        return denormalise(calibration, seen[:, :2] / seen[:, 2:])
