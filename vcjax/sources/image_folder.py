"""A folder of images in whichever layout it is: what lies in it tells."""

import os
from pathlib import Path
from typing import Literal

from vcjax.sources.calibration import read_calibration
from vcjax.sources.image_sequence import ImageSequence
from vcjax.sources.layouts import euroc, kitti_odometry, plain_folder, tum_rgbd

Layout = Literal["tum", "euroc", "kitti", "plain"]


def layout_of(folder: str | os.PathLike) -> Layout:
    """The layout of a folder: `rgb.txt` is TUM's, `mav0` or `data.csv` EuRoC's, `calib.txt` KITTI's; else it is plain.

    Raises:
        FileNotFoundError: if there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder.")
    if (folder / "rgb.txt").is_file():
        return "tum"
    if (folder / "mav0").is_dir() or any(folder.glob("cam*/data.csv")):
        return "euroc"
    if (folder / "calib.txt").is_file() and (folder / "times.txt").is_file():
        return "kitti"
    return "plain"


def read_sequence(
    folder: str | os.PathLike,
    layout: Layout | None = None,
    calibration_file: str | os.PathLike | None = None,
    rate_hz: float | None = None,
    camera: int = 0,
) -> ImageSequence:
    """The image sequence in a folder.

    Args:
        folder: of one sequence.
        layout: how it lies there; None: as `layout_of` finds it.
        calibration_file: see `calibration.py`; needed for TUM, and for a plain folder without `calibration.json`; the
            other layouts have their own.
        rate_hz: images per second, for a plain folder without `times.csv`; the other layouts state times.
        camera: which camera of EuRoC or KITTI.

    Raises:
        FileNotFoundError, ModuleNotFoundError, ValueError: as the readers in `layouts.py` do; and ValueError for what a
            layout states itself, or lacks.
    """
    layout = layout_of(folder) if layout is None else layout
    if layout in ("euroc", "kitti") and calibration_file is not None:
        raise ValueError(f"{folder}: the layout {layout} states its calibration itself; leave out {calibration_file}.")
    if layout != "plain" and rate_hz is not None:
        raise ValueError(f"{folder}: the layout {layout} states the time of each image; leave out the rate {rate_hz}.")
    if layout in ("tum", "plain") and camera != 0:
        raise ValueError(f"{folder}: the layout {layout} has one camera, 0, and not {camera}.")
    calibration = None if calibration_file is None else read_calibration(calibration_file)
    if layout == "plain":
        return plain_folder(folder, calibration, rate_hz)
    if layout == "euroc":
        return euroc(folder, f"cam{camera}")
    if layout == "kitti":
        return kitti_odometry(folder, camera)
    if calibration is None:
        raise ValueError(f"{folder}: the layout tum states no calibration; give a calibration file.")
    return tum_rgbd(folder, calibration)
