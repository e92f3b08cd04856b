"""Points of the world whose place is known, from a table: what gives a run without odometry its scale.

A CSV or Parquet file with a row for each point: its place in the world of the recording's start, `x, y, z` (m), and
which feature it is, by its track, `track_id`, or by where it is seen in the first image, `u, v` (px, in the image as it
was taken): the nearest feature is taken.
"""

import os
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from vcjax.sources.recording_file import RecordingFile
from vcjax.sources.table_file import Kind, read_table
from vcjax.sources.tracks import tracks_of

NEAR_PX = 5.0
"""How far from a point's pixel its feature may be, px."""


class KnownPoints(NamedTuple):
    """Points, and the tracks that follow them."""

    track_id: Int[np.ndarray, " k"]
    place_m: Float[np.ndarray, "k 3"]
    """Place in the world, m."""


def read_known_points(path: str | os.PathLike, content: RecordingFile) -> KnownPoints:
    """Read a table of known points of a recording.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: as `read_table`; and ValueError for no point, neither or
            both of track and pixel, a track that the recording has not, or a pixel without a feature at most `NEAR_PX`
            away, by file and line.
    """
    kinds: dict[str, Kind] = {"track_id": "whole", **dict.fromkeys(["x", "y", "z", "u", "v"], "real")}
    table = read_table(path, kinds, optional=["track_id", "u", "v"])
    given = sorted({"track_id", "u", "v"} & {*table.columns})
    if given not in (["track_id"], ["u", "v"]):
        raise ValueError(f"{path}: give the column track_id, or u and v; it has {', '.join(given) or 'none of them'}.")
    if table.num_rows == 0:
        raise ValueError(f"{path}: no row; give the known points.")
    place = np.column_stack([table[axis] for axis in "xyz"])
    tracks = tracks_of(content.recording, content.calibration)
    if given == ["track_id"]:
        ids = table["track_id"]
        table.refuse_where(~np.isin(ids, tracks.track_id), "track_id", "is no track of the recording")
    else:
        is_first = tracks.frame == 0
        if not np.any(is_first):
            raise ValueError(f"{path}: the first frame of the recording has no features; give track_id.")
        uv_px = np.column_stack([table["u"], table["v"]])
        distance = np.linalg.norm(tracks.uv_px[is_first] - uv_px[:, None], axis=-1)
        nearest = np.argmin(distance, axis=1)
        is_far = distance[np.arange(len(nearest)), nearest] > NEAR_PX
        table.refuse_where(is_far, "u", f"has no feature of the first frame at most {NEAR_PX:g} px from it")
        ids = tracks.track_id[is_first][nearest]
    is_repeated = np.ones(len(ids), bool)
    is_repeated[np.unique(ids, return_index=True)[1]] = False
    table.refuse_where(is_repeated, given[0], "is the same feature as a point above")
    return KnownPoints(np.asarray(ids, np.int64), place)
