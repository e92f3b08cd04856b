"""Small pictures in files, a calibration that fits them, and poses."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vcjax.sources.calibration import Calibration

CALIBRATION = Calibration(64, 48, 50.0, 51.0, 32.0, 24.0)


def picture(t, shape=(48, 64), dtype=np.uint8):
    """A picture of its own for each frame."""
    noise = np.random.default_rng(t).integers(0, 256, shape)
    return (noise * (257 if dtype == np.uint16 else 1)).astype(dtype)


def write_images(paths, **options):
    for t, path in enumerate(paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(path.suffix, picture(t, **options))[1].tobytes())


def poses_at(time_s):
    """A screw: 1 m/s along x, a turn of 0.5 rad/s about z."""
    turn = Rotation.from_rotvec(np.outer(time_s, [0, 0, 0.5]))
    return np.column_stack([time_s, 0 * time_s, 0 * time_s, turn.as_quat(scalar_first=True)])
