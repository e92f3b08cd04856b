"""Maps for other tools: landmarks with class and uncertainty, as a point cloud (PLY) and as a table (CSV, Parquet).

The PLY file is text, version 1.0: one vertex for each landmark with its place, a colour for its class, its track, the
number of its class and the six elements of its covariance; viewers show the coloured points and leave the rest.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from vcjax.sources.table_file import Kind, read_table, write_table
from vcjax.storage import write_file

CLASS_COLOURS: dict[str, tuple[int, int, int]] = {
    "accepted": (0, 158, 115),
    "recovered": (230, 159, 0),
    "dynamic": (213, 94, 0),
    "unused": (128, 128, 128),
}
"""What became of a landmark, and its colour (Okabe & Ito's, which colour-blind people can tell apart)."""

CLASSES = tuple(CLASS_COLOURS)

COVARIANCE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_UPPER = np.triu_indices(3)


class LandmarkMap(NamedTuple):
    """Landmarks as points of the world."""

    track_id: Int[np.ndarray, " L"]
    """Identity of the feature."""
    place_m: Float[np.ndarray, "L 3"]
    """Place in the world, m."""
    cov: Float[np.ndarray, "L 3 3"]
    """Covariance of the place, m²."""
    kind: Sequence[str]
    """What became of it, of `CLASSES`."""


def write_map(path: str | os.PathLike, landmarks: LandmarkMap) -> Path:
    """Write a map, complete or not at all, as the ending says: `.ply`, `.csv` or `.parquet`.

    The columns of a table are track_id, class (its number in `CLASSES`), x, y, z (m) and cov_xx … cov_zz (m²).

    Raises:
        ValueError: for another ending, lengths that disagree, a class that is none, or numbers that are not finite.
        OSError: if the place cannot be written; what was there before stays.
    """
    place, cov = np.asarray(landmarks.place_m, np.float64), np.asarray(landmarks.cov, np.float64)
    num = len(landmarks.track_id)
    if place.shape != (num, 3) or cov.shape != (num, 3, 3) or len(landmarks.kind) != num:
        raise ValueError(
            f"write_map(landmarks): {num} ids, places {place.shape}, covariances {cov.shape}, {len(landmarks.kind)} "
            "classes; give one of each for every landmark."
        )
    for i, kind in enumerate(landmarks.kind):
        if kind not in CLASSES:
            raise ValueError(f"write_map(kind[{i}]={kind!r}): choose one of {CLASSES}.")
    for name, values in (("place_m", place), ("cov", cov)):
        if len(bad := np.argwhere(~np.isfinite(values))):
            raise ValueError(f"write_map({name}{bad[0].tolist()} = {values[tuple(bad[0])]}): must be finite.")
    number = np.array([CLASSES.index(kind) for kind in landmarks.kind], np.int64)
    columns = {"track_id": np.asarray(landmarks.track_id, np.int64), "class": number}
    columns |= dict(zip("xyz", place.T, strict=True)) | dict(zip(COVARIANCE, cov[:, *_UPPER].T, strict=True))
    if Path(path).suffix.lower() == ".ply":
        return write_file(path, _ply(columns).encode("ascii"))
    return write_table(path, columns)


def read_map(path: str | os.PathLike) -> LandmarkMap:
    """Read a map from a `.csv` or `.parquet` table.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: as `read_table`; and ValueError for a class that is none.
    """
    kinds: dict[str, Kind] = {"track_id": "whole", "class": "whole"}
    kinds.update(dict.fromkeys(["x", "y", "z", *COVARIANCE], "real"))
    table = read_table(path, kinds)
    is_none = (table["class"] < 0) | (table["class"] >= len(CLASSES))
    table.refuse_where(is_none, "class", f"is no class; they are numbered from 0 to {len(CLASSES) - 1}")
    cov = np.empty((table.num_rows, 3, 3))
    for i, j, name in zip(*_UPPER, COVARIANCE, strict=True):
        cov[:, i, j] = cov[:, j, i] = table[name]
    place = np.column_stack([table[axis] for axis in "xyz"])
    return LandmarkMap(table["track_id"], place, cov, tuple(CLASSES[i] for i in table["class"]))


def _ply(columns: dict[str, np.ndarray]) -> str:
    """The text of a PLY file."""
    colours = np.array([CLASS_COLOURS[name] for name in CLASSES])[columns["class"]].reshape(-1, 3)
    properties = [("double", axis) for axis in "xyz"]
    properties += [("uchar", colour) for colour in ("red", "green", "blue")]
    properties += [("int", "track_id"), ("uchar", "class"), *(("double", name) for name in COVARIANCE)]
    head = ["ply", "format ascii 1.0", f"comment classes: {', '.join(f'{i} {n}' for i, n in enumerate(CLASSES))}"]
    head += [f"element vertex {len(colours)}", *(f"property {kind} {name}" for kind, name in properties), "end_header"]
    columns = columns | dict(zip(("red", "green", "blue"), colours.T, strict=True))
    rows = zip(*(columns[name].tolist() for _, name in properties), strict=True)
    return "\n".join([*head, *(" ".join(map(repr, row)) for row in rows)]) + "\n"
