"""Trajectories for other tools: the formats of TUM RGB-D and of KITTI.

TUM: one line `t x y z qx qy qz qw` for each pose: time (s), position (m), quaternion with its real part last. KITTI:
one line of the twelve numbers of the 3 × 4 matrix [R t], row by row, and no time. Lines that begin with # are comments.
Here as everywhere in vcjax a pose is (x, y, z, qw, qx, qy, qz); only the files have it otherwise.
"""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vcjax.storage import write_file

MAX_FILE_BYTES = 2**27
"""Largest text that is read: a million poses."""

Poses = Float[np.ndarray, "T 7"]


def write_tum(path: str | os.PathLike, time_s: Float[np.ndarray, " T"], T_a_b: Poses) -> Path:
    """Write a trajectory in the format of TUM RGB-D, complete or not at all. Numbers come back bit for bit.

    Args:
        path: of the file.
        time_s: of each pose, s.
        T_a_b: poses, quaternions (w, x, y, z).

    Raises:
        ValueError: for shapes that disagree or numbers that are not finite, by their place.
        OSError: if the place cannot be written; what was there before stays.
    """
    time_s, poses = _checked("write_tum", T_a_b, time_s)
    rows = np.column_stack([time_s, poses[:, :3], poses[:, 4:], poses[:, 3]])
    return _write_rows(path, rows)


def read_tum(path: str | os.PathLike) -> tuple[Float[np.ndarray, " T"], Poses]:
    """Read a trajectory in the format of TUM RGB-D: times (s) and poses, quaternions (w, x, y, z) of unit length.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming file, line and column: no number, not finite, too few or too many, times that do not grow, a
            quaternion that is not of unit length within 1 %.
    """
    rows, lines = read_numbers(path, 8)
    if len(bad := np.flatnonzero(np.diff(rows[:, 0]) <= 0)):
        raise ValueError(f"{path}, line {lines[bad[0] + 1]}: time {rows[bad[0] + 1, 0]} is not above the one before.")
    length = np.linalg.norm(rows[:, 4:], axis=1)
    if len(bad := np.flatnonzero(np.abs(length - 1.0) > 1e-2)):
        raise ValueError(f"{path}, line {lines[bad[0]]}: the quaternion has length {length[bad[0]]:.3g}, not 1.")
    # What was written as a unit quaternion, to the last bit or so, is left as it is.
    scale = np.where(np.abs(length - 1.0) > 1e-9, length, 1.0)[:, None]
    return rows[:, 0], np.column_stack([rows[:, 1:4], rows[:, 7:] / scale, rows[:, 4:7] / scale])


def write_kitti(path: str | os.PathLike, T_a_b: Poses) -> Path:
    """Write a trajectory in the format of KITTI odometry, complete or not at all.

    Raises:
        ValueError: for numbers that are not finite, by their place.
        OSError: if the place cannot be written; what was there before stays.
    """
    from scipy.spatial.transform import Rotation

    _, poses = _checked("write_kitti", T_a_b)
    matrix = np.empty((len(poses), 3, 4))
    matrix[:, :, :3] = Rotation.from_quat(poses[:, 3:], scalar_first=True).as_matrix()
    matrix[:, :, 3] = poses[:, :3]
    return _write_rows(path, matrix.reshape(-1, 12))


def read_kitti(path: str | os.PathLike) -> Poses:
    """Read a trajectory in the format of KITTI odometry: poses, quaternions (w, x, y, z).

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming file, line and column: no number, not finite, not twelve, no rotation within 1 %.
    """
    rows, lines = read_numbers(path, 12)
    return poses_of(rows.reshape(-1, 3, 4), [f"{path}, line {line}" for line in lines])


def read_trajectory(path: str | os.PathLike) -> tuple[Float[np.ndarray, " T"] | None, Poses]:
    """Read a trajectory in the format of TUM or KITTI, as its first line tells: times, or None, and poses.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: as `read_tum` and `read_kitti`; and for a first line of neither length, or none.
    """
    _, rows = read_words(path)
    length = len(rows[0]) if rows else 0
    if length == 12:
        return None, read_kitti(path)
    if length == 8:
        return read_tum(path)
    raise ValueError(f"{path}: {length} words in its first line; TUM's format has 8 numbers, KITTI's 12.")


def poses_of(matrices: Float[np.ndarray, "T 3 4"], places: list[str]) -> Poses:
    """Poses of matrices [R t]; refused by its place where R is no rotation within 1 %."""
    from scipy.spatial.transform import Rotation

    R = matrices[:, :, :3]
    is_bad = np.any(np.abs(R @ R.mT - np.eye(3)) > 1e-2, axis=(1, 2)) | (np.linalg.det(R) <= 0)
    if len(bad := np.flatnonzero(is_bad)):
        raise ValueError(f"{places[bad[0]]}: its 3 × 3 part is no rotation.")
    return np.column_stack([matrices[:, :, 3], Rotation.from_matrix(R).as_quat(scalar_first=True, canonical=True)])


def read_numbers(path: str | os.PathLike, num_columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of finite numbers from a text with spaces between them, (N, `num_columns`), and the line of each row.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming file, line, column and value.
    """
    lines, rows = read_words(path)
    for line, row in zip(lines, rows, strict=True):
        if len(row) != num_columns:
            raise ValueError(f"{path}, line {line}: {len(row)} words, but {num_columns} numbers are needed.")
    try:
        numbers = np.array(rows, np.float64).reshape(-1, num_columns)
    except ValueError:
        numbers = None
    if numbers is None or not np.all(np.isfinite(numbers)):
        for line, row in zip(lines, rows, strict=True):
            for column, word in enumerate(row, 1):
                if not _is_finite(word):
                    raise ValueError(f"{path}, line {line}, column {column}: {word[:40]!r} is not a finite number.")
    assert numbers is not None
    return numbers, np.array(lines, np.int64)


def read_words(path: str | os.PathLike) -> tuple[list[int], list[list[str]]]:
    """Words of each line of a text that is neither empty nor a comment, and the numbers of these lines, from 1.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a file that is no text, or larger than `MAX_FILE_BYTES`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(f"{path}: larger than {MAX_FILE_BYTES} bytes.")
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: no text ({error}).") from error
    found = [(i, line.split()) for i, line in enumerate(text.split("\n"), 1)]
    found = [(i, words) for i, words in found if words and not words[0].startswith("#")]
    return [i for i, _ in found], [words for _, words in found]


def _write_rows(path: str | os.PathLike, rows: np.ndarray) -> Path:
    """Numbers with spaces between them, as many digits as they need to come back."""
    return write_file(path, "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist()).encode())


def _is_finite(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


def _checked(function: str, poses: Poses, time_s: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Poses and times in float64; refused if they are none."""
    poses = np.array(poses, np.float64)
    if poses.ndim != 2 or poses.shape[1] != 7:
        raise ValueError(f"{function}(T_a_b) has shape {poses.shape}; give poses, (T, 7).")
    time_s = np.arange(len(poses), dtype=np.float64) if time_s is None else np.array(time_s, np.float64)
    if time_s.shape != (len(poses),):
        raise ValueError(f"{function}(time_s) has shape {time_s.shape}; give the time of each of {len(poses)} poses.")
    for name, values in (("T_a_b", poses), ("time_s", time_s)):
        if len(bad := np.argwhere(~np.isfinite(values))):
            raise ValueError(f"{function}({name}{bad[0].tolist()} = {values[tuple(bad[0])]}): must be finite.")
    return time_s, poses
