"""A recording on disk: one `.npz` file with a schema version, and beside the recording what else is known of it.

The format is NumPy's `.npz`: a zip archive of arrays. It needs no package beyond NumPy, holds every number bit for bit,
is read from other languages, and is a single file, which can be written under a temporary name and renamed. (Parquet
holds tables, a recording is arrays of several shapes; Zarr is a folder of many files.) T is the number of frames, V of
columns, F of features in the world, L of labelled tracks:

| array | shape | |
|---|---|---|
| `schema` | () | version of this layout, 1 |
| `time_s`, `odometry`, … `start_cov` | | the fields of `Recording`, under their names |
| `camera_intrinsics_px`, `camera_image_size_px`, `camera_distortion` | (4,), (2,), (K,) | its camera; K is at most 8 |
| `truth_robot`, `truth_sensor` | (T, 7) | optional: true poses; NaN where nobody knows |
| `truth_landmarks_m`, `truth_is_moving` | (T, F, 3), (F,) | with them: the features of the world; F may be 0 |
| `label_track_id`, `label` | (L,) | optional: tracks and what each follows, a number of `TrackLabel` |
| `image_path` | (T,) | optional: the image of each frame; relative paths begin at the file's folder |
| `calibration` | () | optional: the calibration of the images as JSON, see `calibration.py` |

Floating-point numbers may have 16, 32 or 64 bits, and are read as they were written.
"""

import dataclasses
import enum
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from vcjax.fields import require_kind
from vcjax.models.camera import Camera
from vcjax.recording import Recording, Truth, validate
from vcjax.sources.arrays_file import MAX_BYTES, read_arrays, write_arrays
from vcjax.sources.calibration import MAX_SIDE_PX, Calibration

SCHEMA = 1
"""Version of the layout, raised when an older reader would misread it."""

MAX_DISTORTION = 8
"""Most coefficients of a recording's camera; no lens model here has more."""

_KINDS = {"track_id": "iu", "is_valid": "b", "is_last": "b"}
_RECORDING = {f.name: _KINDS.get(f.name, "f") for f in dataclasses.fields(Recording) if f.name != "camera"}
_CAMERA = {f"camera_{f.name}": "f" for f in dataclasses.fields(Camera)}
_TRUTH = {f"truth_{f.name}": "b" if f.name == "is_moving" else "f" for f in dataclasses.fields(Truth)}
_BESIDE = {"label_track_id": "iu", "label": "iu", "image_path": "U", "calibration": "U"}
_ALL = {"schema": "iu"} | _RECORDING | _CAMERA | _TRUTH | _BESIDE


class TrackLabel(enum.IntEnum):
    """What a track follows, as far as somebody knows."""

    UNKNOWN = -1
    STATIC = 0
    MOVING = 1
    BAD = 2
    """No point of the world: it slides along an edge, or jumps from one thing to another."""


class TrackLabels(NamedTuple):
    """Tracks, and what each follows."""

    track_id: Int[np.ndarray, " L"]
    label: Int[np.ndarray, " L"]
    """Numbers of `TrackLabel`."""


class RecordingFile(NamedTuple):
    """A recording, and what else is known of it."""

    recording: Recording
    truth: Truth | None = None
    """True poses of its frames, NaN where nobody knows, and of the features of the world, if there are any."""
    labels: TrackLabels | None = None
    """What its tracks follow."""
    image_paths: tuple[str, ...] | None = None
    """The image of each frame."""
    calibration: Calibration | None = None
    """Calibration of the images, whose lens may bend; the recording's camera is the pin-hole camera made from it."""


def save_recording(path: str | os.PathLike, recording: Recording | RecordingFile) -> Path:
    """Write a recording, and what is known beside it, to one file, complete or not at all.

    Args:
        path: name of the file; it is taken as given, usually it ends in `.npz`.
        recording: a recording, alone or with truth, labels and images.

    Raises:
        ValueError: if the recording, or what is beside it, would be refused when it is read.
        OSError: if the place cannot be written; what was there before stays.
    """
    content = recording if isinstance(recording, RecordingFile) else RecordingFile(recording)
    require_kind("save_recording", "recording", content.recording, Recording, "give a Recording or a RecordingFile.")
    content = _on_host(content)
    _check(str(path), content)
    recording, truth = content.recording, content.truth
    arrays: dict[str, Any] = {"schema": np.int64(SCHEMA)}
    arrays |= {name: getattr(recording, name) for name in _RECORDING}
    arrays |= {name: getattr(recording.camera, name.removeprefix("camera_")) for name in _CAMERA}
    if truth is not None:
        arrays |= {name: getattr(truth, name.removeprefix("truth_")) for name in _TRUTH}
    if content.labels is not None:
        arrays |= {"label_track_id": content.labels.track_id, "label": content.labels.label}
    if content.image_paths is not None:
        arrays["image_path"] = np.asarray(content.image_paths, np.str_)
    if content.calibration is not None:
        arrays["calibration"] = np.asarray(content.calibration.to_json())
    return write_arrays(path, {name: np.asarray(array) for name, array in arrays.items()})


def load_recording(path: str | os.PathLike, max_bytes: int = MAX_BYTES) -> RecordingFile:
    """Read a recording, with what is known beside it. Its arrays are NumPy's.

    Args:
        path: a file of `save_recording`.
        max_bytes: most memory that it may take; see `arrays_file.read_arrays`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming file, array and place: no such file format, another schema, arrays that lack, are unknown, of
            a wrong kind or too large, or a recording that `validate` refuses.
    """
    arrays = read_arrays(path, _ALL, max_bytes)
    schema = arrays.get("schema")
    if schema is None or schema.shape != () or schema != SCHEMA:
        raise ValueError(f"{path}: schema {schema}, but this version reads {SCHEMA}.")
    needed = {*_RECORDING, *_CAMERA}
    for group in (_TRUTH, ("label_track_id", "label")):
        needed |= {*group} if {*group} & {*arrays} else set()
    if missing := sorted(needed - {*arrays}):
        raise ValueError(f"{path}: lacks {', '.join(missing)}; write it with save_recording.")
    try:
        content = _content(arrays)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    _check(str(path), content)
    return content


def _content(arrays: dict[str, np.ndarray]) -> RecordingFile:
    """The objects that the arrays stand for."""
    camera = Camera(**{name.removeprefix("camera_"): arrays[name] for name in _CAMERA})
    recording = Recording(camera=camera, **{name: arrays[name] for name in _RECORDING})
    truth = labels = image_paths = calibration = None
    if "truth_robot" in arrays:
        truth = Truth(**{name.removeprefix("truth_"): arrays[name] for name in _TRUTH})
    if "label" in arrays:
        labels = TrackLabels(arrays["label_track_id"], arrays["label"])
    if "image_path" in arrays:
        image_paths = tuple(np.ravel(arrays["image_path"]).tolist())
    if "calibration" in arrays:
        calibration = Calibration.from_json(str(arrays["calibration"]))
    return RecordingFile(recording, truth, labels, image_paths, calibration)


def _on_host(content: RecordingFile) -> RecordingFile:
    """The same with the arrays of recording and truth in NumPy."""

    def on_host(part):
        fields = {f.name: getattr(part, f.name) for f in dataclasses.fields(part) if f.name != "camera"}
        # What is no array stays, to be refused by its name.
        is_array = {name: hasattr(value, "dtype") for name, value in fields.items()}
        return dataclasses.replace(
            part, **{name: np.asarray(value) if is_array[name] else value for name, value in fields.items()}
        )

    truth = None if content.truth is None else on_host(content.truth)
    return content._replace(recording=on_host(content.recording), truth=truth)


def _check(path: str, content: RecordingFile) -> None:
    """Refuse a recording that no filter can run on, and what does not belong to it."""
    recording, truth, labels, image_paths, _ = content
    try:
        validate(recording)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    num_frames, size = recording.num_frames, np.asarray(recording.camera.image_size_px)
    if not np.all((size >= 1) & (size <= MAX_SIDE_PX)):
        raise ValueError(
            f"{path}: Camera(image_size_px={size.tolist()}): give a width and height of 1 to {MAX_SIDE_PX} px."
        )
    if (num := np.size(recording.camera.distortion)) > MAX_DISTORTION:
        raise ValueError(f"{path}: Camera(distortion) has {num} coefficients; give at most {MAX_DISTORTION}.")
    if truth is not None:
        num_features = np.shape(truth.is_moving)[0] if np.ndim(truth.is_moving) == 1 else "F"
        shapes = {
            "robot": (num_frames, 7),
            "sensor": (num_frames, 7),
            "landmarks_m": (num_frames, num_features, 3),
            "is_moving": (num_features,),
        }
        for name, shape in shapes.items():
            if (found := np.shape(getattr(truth, name))) != shape:
                raise ValueError(f"{path}: Truth({name}) has shape {found}, but {shape} is needed.")
        _check_truth(path, truth)
    if labels is not None:
        ids, label = np.asarray(labels.track_id), np.asarray(labels.label)
        if ids.ndim != 1 or ids.shape != label.shape:
            raise ValueError(f"{path}: {ids.shape} labelled tracks have {label.shape} labels; give each track one.")
        if len(bad := np.flatnonzero(~np.isin(label, list(TrackLabel)))):
            known = ", ".join(f"{x:d} {x.name}" for x in TrackLabel)
            raise ValueError(f"{path}: label[{bad[0]}] = {label[bad[0]]}; give one of {known}.")
        if len(bad := np.flatnonzero((ids < 0) | (ids > np.iinfo(np.int32).max))):
            raise ValueError(f"{path}: label_track_id[{bad[0]}] = {ids[bad[0]]}; ids start at 0 and end before 2³¹.")
        if len(np.unique(ids)) != len(ids):
            raise ValueError(f"{path}: label_track_id names a track twice; give each one label.")
    if image_paths is not None and len(image_paths) != num_frames:
        raise ValueError(f"{path}: {len(image_paths)} images for {num_frames} frames; give one for each.")


def _check_truth(path: str, truth: Truth) -> None:
    """Refuse what no truth is: poses are finite or NaN, with quaternions of unit length; features are finite."""
    for name in ("robot", "sensor", "landmarks_m"):
        values, may_be_nan = np.asarray(getattr(truth, name), np.float64), name != "landmarks_m"
        if len(bad := np.argwhere(np.isinf(values) if may_be_nan else ~np.isfinite(values))):
            place = bad[0].tolist()
            remedy = "give a finite number" + (", or NaN where nobody knows." if may_be_nan else ".")
            raise ValueError(f"{path}: Truth({name}{place} = {values[tuple(place)]}): {remedy}")
    for name in ("robot", "sensor"):
        length = np.linalg.norm(np.asarray(getattr(truth, name), np.float64)[:, 3:], axis=1)
        if len(bad := np.flatnonzero(np.abs(length - 1.0) > 1e-3)):  # false of NaN
            t = bad[0]
            raise ValueError(
                f"{path}: Truth({name}[{t}]): the quaternion has length {length[t]:.4g}; divide it by its length."
            )
