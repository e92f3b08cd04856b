"""What a run that was stopped leaves on disk, so that the same run goes on there, to the same numbers.

A folder of three kinds of files, each complete or not there:

| file | |
|---|---|
| `settings.json` | what the run is of; another run is refused |
| `frames_NNNNNN.npz` | infos of some frames, from that number on |
| `state.npz` | the filter's state after the last of them, written after their file, and replaced each time |

Arrays are told by their place in the tree that the filter makes (`jax.tree.leaves`), and shapes and types are compared
with it. A run that takes less than `EVERY_S` leaves nothing.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from vcjax.filter.config import FilterConfig
from vcjax.filter.info import FrameInfo
from vcjax.filter.known_landmarks import KnownLandmarks
from vcjax.filter.slam import start
from vcjax.filter.state import FilterState
from vcjax.recording import PER_FRAME, Recording
from vcjax.sources.arrays_file import read_arrays, write_arrays
from vcjax.storage import with_nulls, write_json
from vcjax.study.results import describe, refuse_other_settings

EVERY_S = 10.0
"""How often work is written, s: more often than anybody minds doing again, seldom enough to cost little."""
_SETTINGS, _STATE = "settings.json", "state.npz"


class Begun(NamedTuple):
    """The part of a run that is done."""

    next_frame: int
    """Number of the frame to go on with."""
    run_s: float
    """How long it took, s."""
    state: FilterState
    infos: Iterator[FrameInfo]
    """Infos of all frames before, in pieces, read as they are asked for; ValueError if one lacks or is damaged."""


class Unfinished:
    """The folder of one run."""

    def __init__(
        self,
        folder: str | os.PathLike,
        config: FilterConfig,
        recording: Recording,
        known: KnownLandmarks | None = None,
        every_s: float = EVERY_S,
    ):
        """Nothing is read or written yet.

        Args:
            folder: for this run alone.
            config, recording, known: of the run.
            every_s: how often work is written, s.
        """
        self.folder, self.every_s = Path(folder), every_s
        self._settings = _settings(config, recording, known)
        first = jax.tree.map(np.asarray, first_frames(recording, 1))
        self._shapes = jax.eval_shape(lambda r: start(config, r, None, known), first)

    def read(self) -> Begun | None:
        """What is done; None where nothing is.

        Raises:
            ValueError: for work of another run, or files that are none of it.
        """
        path = self.folder / _STATE
        if not path.is_file():
            return None
        remedy = f"remove {self.folder}, or give another directory for the results."
        try:
            found = json.loads((self.folder / _SETTINGS).read_text("utf-8"))
        except (ValueError, OSError, RecursionError) as error:
            raise ValueError(f"{self.folder / _SETTINGS}: not what a run left ({error}); {remedy}") from error
        if not isinstance(found, dict):
            raise ValueError(f"{self.folder / _SETTINGS}: not what a run left; {remedy}")
        refuse_other_settings(self.folder, found, self._settings)
        state, told = _read(path, self._shapes[0], {"next_frame": "iu", "run_s": "f"}, False)
        next_frame = int(told["next_frame"])
        return Begun(next_frame, float(told["run_s"]), state, self._infos(next_frame, remedy))

    def _infos(self, next_frame: int, remedy: str) -> Iterator[FrameInfo]:
        frame = 0
        while frame < next_frame:
            info, _ = _read(self._frames(frame), self._shapes[1], {}, True)
            frame += max(1, len(info.is_finite))
            if frame > next_frame:
                break
            yield info
        if frame != next_frame:
            raise ValueError(f"{self.folder}: holds frames up to {frame - 1}, not {next_frame - 1}; {remedy}")

    def write(self, first_frame: int, info: FrameInfo, state: FilterState, run_s: float) -> None:
        """Keep some frames, and the state after them.

        Raises:
            OSError: if the place cannot be written; what was there before stays.
        """
        if first_frame == 0:
            write_json(self.folder / _SETTINGS, self._settings)
        next_frame = first_frame + len(info.is_finite)
        write_arrays(self._frames(first_frame), _named(info))
        told = {"next_frame": np.array(next_frame), "run_s": np.array(run_s)}
        write_arrays(self.folder / _STATE, _named(state) | told)

    def remove(self) -> None:
        """The run is done, and its results are elsewhere. The state goes first: without it the rest counts nothing."""
        for pattern in (_STATE, _SETTINGS, "frames_*.npz", ".*.tmp"):
            for path in self.folder.glob(pattern):
                path.unlink()
        with contextlib.suppress(OSError):  # there was none, or it holds what is somebody else's
            self.folder.rmdir()

    def _frames(self, first: int) -> Path:
        return self.folder / f"frames_{first:06d}.npz"


def first_frames(recording: Recording, num: int) -> Recording:
    """The first frames of a recording: one tells what the filter makes, two compile all that the others need."""

    def of_frames(recording):
        return [getattr(recording, name) for name in PER_FRAME]

    return eqx.tree_at(of_frames, recording, [leaf[:num] for leaf in of_frames(recording)])


def digest(tree: PyTree) -> str:
    """SHA-256 of all arrays of a recording, or of another tree, in hexadecimal: the same for the same numbers only."""
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = np.ascontiguousarray(leaf)
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def _settings(config: FilterConfig, recording: Recording, known: KnownLandmarks | None) -> dict[str, Any]:
    """All that the numbers of a run depend on."""
    dtype = str(jax.dtypes.canonicalize_dtype(np.float64))
    settings = {
        "config": describe(config),
        "recording and known landmarks": digest((recording, known)),
        "dtype": dtype,
    }
    # As it is read: null stands for infinity, which no other value of the same field can be taken for.
    return json.loads(json.dumps(with_nulls(settings)))


def _named(tree: PyTree) -> dict[str, np.ndarray]:
    return {f"leaf_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}


def _read(path: Path, shapes: PyTree, others: Mapping[str, str], has_frames: bool) -> tuple[Any, dict[str, np.ndarray]]:
    """A tree of these shapes, with a leading axis of frames or not, and other arrays of no axis."""
    leaves, tree = jax.tree.flatten(shapes)
    names = [f"leaf_{i:03d}" for i in range(len(leaves))]
    kinds = {
        name: "iu" if leaf.dtype.kind in "iu" else leaf.dtype.kind for name, leaf in zip(names, leaves, strict=True)
    }
    found = read_arrays(path, {**kinds, **others})
    lengths = {found[name].shape[:1] for name in names if name in found} if has_frames else {()}
    length = next(iter(lengths), ())
    expected = {name: ((*length, *leaf.shape), leaf.dtype) for name, leaf in zip(names, leaves, strict=True)}
    expected |= {name: ((), found[name].dtype) for name in others if name in found}
    if {name: (array.shape, array.dtype) for name, array in found.items()} != expected or len(lengths) != 1:
        raise ValueError(f"{path}: not what this run left; remove {path.parent}, and the run begins anew.")
    return jax.tree.unflatten(tree, [found[name] for name in names]), found
