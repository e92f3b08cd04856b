"""Data sets as they lie on disk: TUM RGB-D and Bonn, EuRoC (ASL), KITTI odometry, and a plain folder of images.

Each reader gives an `ImageSequence`. Names in the files are taken only if they lead to files inside the data set.
"""

import os
import re
from collections.abc import Sequence
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vcjax.sources.calibration import Calibration, read_calibration
from vcjax.sources.image_sequence import ImageSequence, PoseTruth, image_size
from vcjax.sources.odometry import read_odometry
from vcjax.sources.table_file import read_table
from vcjax.sources.tracks import read_times
from vcjax.sources.trajectory_file import poses_of, read_kitti, read_numbers, read_tum, read_words

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")
_MAX_YAML_BYTES = 2**20
_MAX_DIGITS = 19
"""Of a time in ns: what 64 bits hold."""


def tum_rgbd(folder: str | os.PathLike, calibration: Calibration) -> ImageSequence:
    """A sequence of TUM RGB-D or Bonn RGB-D: `rgb.txt` (time, file) and, if it is there, `groundtruth.txt`.

    Sturm et al., IROS 2012; Palazzolo et al., IROS 2019. The truth is of the colour camera. The data sets state their
    calibration on their web pages, and not in the folder.

    Raises:
        FileNotFoundError, ValueError: naming file and line of what lacks or cannot be read.
    """
    folder = _folder(folder)
    lines, rows = read_words(folder / "rgb.txt")
    times, paths = [], []
    for line, row in zip(lines, rows, strict=True):
        place = f"{folder / 'rgb.txt'}, line {line}"
        if len(row) != 2:
            raise ValueError(f"{place}: {len(row)} words; a time and a file are needed.")
        times.append(_number(row[0], place))
        paths.append(_inside(folder, row[1], place))
    _refuse_times(folder / "rgb.txt", lines, times)
    truth = None
    if (folder / "groundtruth.txt").exists():
        truth = PoseTruth(*read_tum(folder / "groundtruth.txt"), of="camera")
    return ImageSequence(tuple(paths), np.array(times), calibration, truth)


def euroc(folder: str | os.PathLike, camera: str = "cam0") -> ImageSequence:
    """A sequence in the ASL layout of EuRoC: `mav0/cam0/{data.csv, sensor.yaml, data/}` and the state estimates.

    Burri et al., IJRR 2016. The robot is the body frame of the data set; the truth, of `state_groundtruth_estimate0`,
    is of it. Times are in ns in the files and in s here, both since 1970.

    Args:
        folder: that holds `mav0`, or `mav0` itself.
        camera: which one.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: naming file, line or key of what lacks or cannot be read.
    """
    folder = _folder(folder)
    folder = folder / "mav0" if (folder / "mav0").is_dir() else folder
    lines, rows = read_words(folder / camera / "data.csv")
    times, paths = [], []
    for line, row in zip(lines, rows, strict=True):
        place = f"{folder / camera / 'data.csv'}, line {line}"
        cells = [cell.strip() for cell in "".join(row).split(",")]
        if len(cells) != 2 or not cells[0].isdecimal() or len(cells[0]) > _MAX_DIGITS:
            raise ValueError(f"{place}: a time in ns and a file are needed, with a comma between them.")
        times.append(int(cells[0]) * 1e-9)
        paths.append(_inside(folder / camera / "data", cells[1], place))
    _refuse_times(folder / camera / "data.csv", lines, times)
    truth, states = None, folder / "state_groundtruth_estimate0" / "data.csv"
    if states.exists():
        table = _euroc_states(states)
        truth = PoseTruth(table[:, 0] * 1e-9, table[:, 1:8], of="robot")
    return ImageSequence(tuple(paths), np.array(times), _euroc_calibration(folder / camera / "sensor.yaml"), truth)


def kitti_odometry(folder: str | os.PathLike, camera: int = 0, poses: str | os.PathLike | None = None) -> ImageSequence:
    """A sequence of KITTI odometry: `image_0/`, `times.txt`, `calib.txt` and, elsewhere, the true poses.

    Geiger et al., CVPR 2012. Images are rectified. The poses are of camera 0, in its first place; with another camera
    they are moved to it. The camera sits in the robot's origin and looks along its x axis.

    Args:
        folder: of one sequence, e.g. `sequences/07`.
        camera: 0 or 1 (grey), 2 or 3 (colour).
        poses: file of the true poses; by default `../../poses/07.txt` if it is there.

    Raises:
        FileNotFoundError, ValueError: naming file and line of what lacks or cannot be read.
    """
    folder = _folder(folder)
    paths = _images(folder / f"image_{camera}")
    times, lines = read_numbers(folder / "times.txt", 1)
    times = times[:, 0]
    _refuse_times(folder / "times.txt", lines, times)
    lines, rows = read_words(folder / "calib.txt")
    found = {row[0].rstrip(":"): (line, row[1:]) for line, row in zip(lines, rows, strict=True)}
    if f"P{camera}" not in found:
        raise ValueError(f"{folder / 'calib.txt'}: no line P{camera}.")
    line, words = found[f"P{camera}"]
    place = f"{folder / 'calib.txt'}, line {line}"
    if len(words) != 12:
        raise ValueError(f"{place}: {len(words)} numbers; P{camera} has 12.")
    P = np.array([_number(word, place) for word in words]).reshape(3, 4)
    width, height = image_size(paths[0])
    try:
        calibration = Calibration(width, height, float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]))
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error
    if len(times) < len(paths):
        raise ValueError(f"{folder / 'times.txt'}: {len(times)} times for {len(paths)} images.")
    times = times[: len(paths)]
    poses = folder.parent.parent / "poses" / f"{folder.name}.txt" if poses is None else Path(poses)
    truth = None
    if poses.exists():
        T_w_c = read_kitti(poses)[: len(times)]
        # In camera 0, camera k sits at -P[0, 3]/fx along x.
        T_w_c[:, :3] += _rotated(T_w_c, np.array([-P[0, 3] / P[0, 0], 0.0, 0.0]))
        truth = PoseTruth(times[: len(T_w_c)], T_w_c, of="camera")
    return ImageSequence(tuple(paths), times, calibration, truth)


def plain_folder(
    folder: str | os.PathLike, calibration: Calibration | None = None, rate_hz: float | None = None
) -> ImageSequence:
    """Images in a folder, in the order of the numbers in their names, with what lies beside them.

    Args:
        folder: the images lie in it or in its folder `images`; beside them may lie `calibration.json` (see
            `calibration.py`), `times.csv` (columns frame and time_s, one row for each image), `odometry.csv` (see
            `odometry.read_odometry`) and `groundtruth.txt`, true poses of the camera in the format of TUM.
        calibration: instead of the file.
        rate_hz: images per second, where there are no times.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: naming what lacks or cannot be read.
    """
    folder = _folder(folder)
    paths = _images(folder / "images" if (folder / "images").is_dir() else folder)
    calibration = calibration or read_calibration(folder / "calibration.json")
    if (folder / "times.csv").exists() == (rate_hz is not None):
        raise ValueError(f"plain_folder({folder}): give times.csv in the folder or rate_hz, one of the two.")
    if rate_hz is not None:
        if not 0 < rate_hz < np.inf:
            raise ValueError(f"plain_folder(rate_hz={rate_hz}): give a positive number.")
        frames, times = np.arange(len(paths)), np.arange(len(paths)) / rate_hz
    else:
        frames, times = read_times(folder / "times.csv")
    if len(times) != len(paths):
        raise ValueError(f"{folder / 'times.csv'}: {len(times)} times for {len(paths)} images; give one for each.")
    truth = odometry = None
    if (folder / "groundtruth.txt").exists():
        truth = PoseTruth(*read_tum(folder / "groundtruth.txt"), of="camera")
    if (folder / "odometry.csv").exists():
        odometry = read_odometry(folder / "odometry.csv", frames)
    return ImageSequence(tuple(paths), times, calibration, truth, odometry)


def _folder(folder: str | os.PathLike) -> Path:
    if not Path(folder).is_dir():
        raise FileNotFoundError(f"{folder}: no such folder.")
    return Path(folder)


def _images(folder: Path) -> list[Path]:
    found = (path for path in _folder(folder).iterdir() if not path.name.startswith("."))
    paths = [path for path in found if path.suffix.lower() in IMAGE_ENDINGS]
    if not paths:
        raise FileNotFoundError(f"{folder}: no image in it ({', '.join(IMAGE_ENDINGS)}).")
    by_whole, by_decimal = (sorted(paths, key=partial(_by_numbers, number=n)) for n in (_WHOLE, _DECIMAL))
    for one, other in zip(by_whole, by_decimal, strict=True):
        if one != other:
            raise ValueError(
                f"{folder}: which comes first, {one.name} or {other.name}? With whole numbers the one, with decimals "
                "the other; give these numbers the same count of digits in every name."
            )
    return by_whole


_WHOLE, _DECIMAL = r"(\d+)", r"(\d+(?:\.\d+)?)"


def _by_numbers(path: Path, number: str) -> tuple[list[str | Decimal], str]:
    """The key of a name in which a pattern of numbers counts as numbers: 2 before 10."""
    return [Decimal(part) if i % 2 else part for i, part in enumerate(re.split(number, path.stem))], path.name


def _refuse_times(path: Path, lines: Sequence[int] | np.ndarray, times: Sequence[float] | np.ndarray) -> None:
    """Refuse a list without images, or with times that do not grow, by its line."""
    if not len(times):
        raise ValueError(f"{path}: no line; give the time of each image.")
    if len(bad := np.flatnonzero(~(np.diff(times) > 0))):
        raise ValueError(f"{path}, line {lines[bad[0] + 1]}: time {times[bad[0] + 1]} s is not above the one before.")


def _inside(folder: Path, name: str, place: str) -> Path:
    """A file of the data set by the name that it has in a list; refused if it leads out of it."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise ValueError(f"{place}: {name!r} leads out of the data set; give names inside it.")
    return folder / name


def _number(word: str, place: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"{place}: {word[:40]!r} is not a finite number.")
    return value


def _rotated(T_w_c: np.ndarray, vector: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(T_w_c[:, 3:], scalar_first=True).apply(vector)


def _euroc_states(path: Path) -> np.ndarray:
    """Time in ns, position and quaternion (w, x, y, z) of each row."""
    kinds: Any = {"#timestamp": "whole"}
    names = ("p_RS_R_x [m]", "p_RS_R_y [m]", "p_RS_R_z [m]", "q_RS_w []", "q_RS_x []", "q_RS_y []", "q_RS_z []")
    kinds.update(dict.fromkeys(names, "real"))
    table = read_table(path, kinds)
    length = np.sqrt(sum(table[name] ** 2 for name in names[3:]))
    table.refuse_where(np.abs(length - 1.0) > 1e-2, "q_RS_w []", "begins a quaternion that is not of length 1")
    table.refuse_where(np.diff(table["#timestamp"], prepend=-1) <= 0, "#timestamp", "is not above the one before")
    columns = [table[name] / (length if i >= 3 else 1.0) for i, name in enumerate(names)]
    return np.column_stack([table["#timestamp"], *columns])


def _euroc_calibration(path: Path) -> Calibration:
    import yaml

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    if path.stat().st_size > _MAX_YAML_BYTES:
        raise ValueError(f"{path}: larger than a calibration can be ({_MAX_YAML_BYTES} bytes).")
    try:
        text = path.read_text("utf-8")
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
            raise ValueError("an alias (*), of which a few can stand for any number of values; write values out")
        found = yaml.safe_load(text)
        width, height = found["resolution"]
        fx, fy, cx, cy = (float(x) for x in found["intrinsics"])
        model = {"radial-tangential": "radial_tangential", "equidistant": "equidistant"}[found["distortion_model"]]
        distortion = tuple(float(x) for x in found["distortion_coefficients"])
        T_B_S = np.array(found["T_BS"]["data"], np.float64).reshape(4, 4)[None, :3]
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path}: {type(error).__name__} {str(error)[:200]}; needed are resolution, intrinsics, distortion_model "
            "(radial-tangential or equidistant), distortion_coefficients and T_BS."
        ) from error
    mount = poses_of(T_B_S, [f"{path}, T_BS"])[0]
    try:
        return Calibration(width, height, fx, fy, cx, cy, model, distortion, tuple(mount.tolist()))  # type: ignore
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
