"""Calibration of a real camera: image size, focal lengths, lens distortion and mount, in a JSON file.

A calibration file is one JSON object, for example

    {"width": 752, "height": 480, "fx": 458.654, "fy": 457.296, "cx": 367.215, "cy": 248.375,
     "distortion_model": "radial_tangential", "distortion": [-0.2834, 0.0740, 0.0002, 1.8e-05],
     "T_r_s": [0, 0, 0.6, 0.5, -0.5, 0.5, -0.5]}

with lengths in px, m. `T_r_s` is the pose of the camera in the robot: position and quaternion (w, x, y, z). Without it
the camera sits in the robot's origin and looks along its x axis. Without a distortion model the lens is a pin-hole.

Pixels follow OpenCV: whole numbers are the centres of pixels, (0, 0) that of the first one.
"""

import dataclasses
import json
import math
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vcjax.models.camera import Camera
from vcjax.storage import write_file

DistortionModel = Literal["none", "radial_tangential", "equidistant", "wide_angle"]

LOOKING_FORWARD = (0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5)
"""T_r_s of a camera (x right, y down, z forward) in the origin of a robot (x forward, y left, z up)."""

NUM_COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "none": (0,),
    "radial_tangential": (4, 5, 8),
    "equidistant": (4,),
    "wide_angle": (1,),
}

MAX_SIDE_PX = 2**15
"""Largest width or height of an image, px."""
_MAX_FILE_BYTES = 2**20


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A camera as it is calibrated."""

    width: int
    """Image width, px."""
    height: int
    """Image height, px."""
    fx: float
    """Horizontal focal length, px."""
    fy: float
    """Vertical focal length, px."""
    cx: float
    """Principal point from the left, px."""
    cy: float
    """Principal point from above, px."""
    distortion_model: DistortionModel = "none"
    """How the lens bends; the formulas stand in `distortion.py`."""
    distortion: tuple[float, ...] = ()
    """Its coefficients."""
    T_r_s: tuple[float, ...] = LOOKING_FORWARD
    """Pose of the camera in the robot: position (m) and unit quaternion (w, x, y, z)."""

    def __post_init__(self):
        for name in ("width", "height"):
            value = getattr(self, name)
            is_size = isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MAX_SIDE_PX
            _require(self, name, is_size, f"give a whole number of pixels from 1 to {MAX_SIDE_PX}.")
        for name in ("fx", "fy", "cx", "cy"):
            _require(self, name, _is_number(getattr(self, name)), "give a finite number of pixels.")
        for name in ("fx", "fy"):
            _require(self, name, bool(getattr(self, name) > 0), "a focal length is positive.")
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))
        is_known = isinstance(self.distortion_model, str) and self.distortion_model in NUM_COEFFICIENTS
        _require(self, "distortion_model", is_known, f"choose one of {', '.join(NUM_COEFFICIENTS)}.")
        for name, counts in (("distortion", NUM_COEFFICIENTS[self.distortion_model]), ("T_r_s", (7,))):
            values = getattr(self, name)
            is_vector = isinstance(values, list | tuple | np.ndarray) and len(values) in counts
            needed = f"give {' or '.join(map(str, counts))} finite numbers."
            _require(self, name, is_vector and all(map(_is_number, values)), needed)
            object.__setattr__(self, name, tuple(float(value) for value in values))
        is_unit = abs(math.hypot(*self.T_r_s[3:]) - 1.0) <= 1e-3
        _require(self, "T_r_s", is_unit, "its last four numbers are a quaternion (w, x, y, z) of length 1.")

    @property
    def matrix(self) -> np.ndarray:
        """K, (3, 3) px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @classmethod
    def from_camera(cls, camera: Camera, T_r_s: Any = LOOKING_FORWARD) -> "Calibration":
        """The calibration of a camera of the filter or the simulation.

        Raises:
            ValueError: for more than three coefficients of radial distortion, which no model here has.
        """
        u0, v0, au, av = (float(x) for x in np.asarray(camera.intrinsics_px))
        width, height = (int(np.ceil(x)) for x in np.asarray(camera.image_size_px))
        radial = [float(d) for d in np.ravel(camera.distortion)]
        if len(radial) > 3:
            raise ValueError(f"Calibration.from_camera: {len(radial)} coefficients of distortion; give at most 3.")
        k1, k2, k3 = radial + [0.0] * (3 - len(radial))
        model = ("radial_tangential", (k1, k2, 0.0, 0.0, k3)) if radial else ("none", ())
        return cls(width, height, au, av, u0, v0, *model, tuple(float(x) for x in np.asarray(T_r_s)))

    def to_json(self) -> str:
        """The contents of a calibration file."""
        return json.dumps(dataclasses.asdict(self), indent=1)

    @classmethod
    def from_json(cls, text: str) -> "Calibration":
        """The calibration that a text in JSON states.

        Raises:
            ValueError: naming key, value and remedy.
        """
        try:
            found = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"calibration: no JSON ({error}).") from error
        fields = {field.name: field for field in dataclasses.fields(cls)}
        if not isinstance(found, dict):
            raise ValueError(f"calibration: give one JSON object with {', '.join(fields)}.")
        if unknown := sorted(set(found) - set(fields)):
            raise ValueError(f"calibration: unknown key {unknown[0]!r}; known are {', '.join(fields)}.")
        missing = [n for n, field in fields.items() if field.default is dataclasses.MISSING and n not in found]
        if missing:
            raise ValueError(f"calibration: lacks {', '.join(missing)}.")
        # JSON knows no tuples, and writes 320.0 as 320 too.
        for name, value in found.items():
            if isinstance(value, list):
                found[name] = tuple(value)
            elif fields[name].type is float and _is_number(value):
                found[name] = float(value)
        return cls(**found)


def read_calibration(path: str | os.PathLike) -> Calibration:
    """Read a calibration file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming file, key, value and remedy.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such calibration file.")
    if path.stat().st_size > _MAX_FILE_BYTES:
        raise ValueError(f"{path}: larger than a calibration can be ({_MAX_FILE_BYTES} bytes).")
    try:
        return Calibration.from_json(path.read_text("utf-8"))
    except ValueError as error:  # also of what is no text
        raise ValueError(f"{path}: {error}") from error


def write_calibration(path: str | os.PathLike, calibration: Calibration) -> Path:
    """Write a calibration file, complete or not at all.

    Raises:
        OSError: if the place cannot be written; what was there before stays.
    """
    return write_file(path, f"{calibration.to_json()}\n".encode())


def _is_number(value: object) -> bool:
    """Whether a value is one finite number that fits in 64 bits."""
    if not isinstance(value, int | float | np.number) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except (OverflowError, TypeError):
        return False


def _require(owner: Calibration, name: str, condition: bool, remedy: str) -> None:
    if not condition:
        raise ValueError(f"Calibration({name}={getattr(owner, name)!r}): {remedy}")
