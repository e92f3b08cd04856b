"""Recording: everything a filter run reads, simulated or real; and Truth, what a simulation knows beside it.

This is the one seam between where data comes from and what is done with it. A filter cannot tell a simulated recording
from a real one.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vcjax.fields import is_concrete, require_kind
from vcjax.models.camera import Camera

# A recording may be kept in NumPy; `Recording.frame` hands out JAX arrays.
AnyArray = Array | np.ndarray

COVARIANCE_TOLERANCE = 1e-5
"""Rounding left to a covariance, relative to its largest element: what 14 × 14 numbers of float32 need, tenfold."""


class Frame(eqx.Module):
    """One frame of a recording: the odometry that led to it and the features seen in it."""

    time_step_s: Float[Array, ""]
    """Time since the frame before, s; 0 in the first."""
    odometry: Float[Array, "6"]
    odometry_cov: Float[Array, "6 6"]
    sensor_shift_m: Float[Array, "3"]
    track_id: Int[Array, " V"]
    uv_px: Float[Array, "V 2"]
    is_valid: Bool[Array, " V"]
    is_last: Bool[Array, " V"]
    camera: Camera


class Recording(eqx.Module):
    """Odometry and feature tracks of T frames with at most V features each, and the calibration.

    The poses and their covariance are those before the first frame, whose odometry leads from there to the first image.
    """

    time_s: Float[AnyArray, " T"]
    """Time of each frame, s."""
    odometry: Float[AnyArray, "T 6"]
    """Robot-frame increment since the frame before: Δposition (m), Δrotation vector (rad)."""
    odometry_cov: Float[AnyArray, "T 6 6"]
    """Covariance of the odometry, per frame."""
    sensor_shift_m: Float[AnyArray, "T 3"]
    """Commanded displacement of the camera in the robot frame since the frame before, m (the oscillation)."""
    track_id: Int[AnyArray, "T V"]
    """Identity of each feature; the same number in two frames is the same feature. At least 0 where valid."""
    uv_px: Float[AnyArray, "T V 2"]
    """Pixel of each feature; anything where not valid."""
    is_valid: Bool[AnyArray, "T V"]
    """Whether the entry holds a measured feature."""
    is_last: Bool[AnyArray, "T V"]
    """Whether the feature is never seen again in this recording (see `last_sightings`); all false where nobody
    knows."""
    camera: Camera
    """Calibration."""
    robot_start: Float[AnyArray, "7"]
    """Robot pose T_w_r before the first frame."""
    sensor_start: Float[AnyArray, "7"]
    """Sensor pose T_r_s before the first frame (the mount)."""
    start_cov: Float[AnyArray, "14 14"]
    """Covariance of robot and sensor pose before the first frame."""

    @property
    def num_frames(self) -> int:
        """T, the number of frames."""
        return self.odometry.shape[-2]

    @property
    def time_step_s(self) -> Float[Array, " T"]:
        """Time since the frame before, s; 0 in the first."""
        return jnp.diff(jnp.asarray(self.time_s), prepend=jnp.asarray(self.time_s)[:1])

    def frame(self, t: int | Int[Array, ""]) -> Frame:
        """Frame t, 0 ≤ t < T, in the precision that a run works in, whatever the recording is stored in."""
        per_frame = (f.name for f in dataclasses.fields(Frame) if f.name != "camera")
        frame = Frame(camera=self.camera, **{name: jnp.asarray(getattr(self, name))[t] for name in per_frame})
        return jax.tree.map(in_working_precision, frame)


PER_FRAME = ("time_s", "odometry", "odometry_cov", "sensor_shift_m", "track_id", "uv_px", "is_valid", "is_last")
"""Fields of a recording that have a row for each frame."""


class Truth(eqx.Module):
    """What really happened, known in simulation only."""

    robot: Float[AnyArray, "T 7"]
    """Robot pose T_w_r of each frame."""
    sensor: Float[AnyArray, "T 7"]
    """Sensor pose T_r_s of each frame."""
    landmarks_m: Float[AnyArray, "T F 3"]
    """Place of every feature in each frame; feature number = track id."""
    is_moving: Bool[AnyArray, " F"]
    """Whether a feature moves at any time."""


def in_working_precision(leaf: AnyArray) -> Array:
    """An array on the device; of floating-point numbers, in JAX's own precision: float64, or float32 without x64."""
    leaf = jnp.asarray(leaf)
    return leaf.astype(jnp.result_type(float)) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def moves_in_frame(truth: Truth) -> Bool[Array, "T F"]:
    """Whether each feature moves in each frame: is elsewhere than in the frame before (the first: than in the second).

    A mover that starts late or stops does not move in the other frames, though `is_moving` says so of it.
    """
    landmarks = jnp.asarray(truth.landmarks_m)
    if landmarks.shape[0] == 1:
        return jnp.asarray(truth.is_moving)[None]
    moves = jnp.any(landmarks[1:] != landmarks[:-1], axis=-1)
    return jnp.concatenate([moves[:1], moves])


def last_sightings(track_id: Int[AnyArray, "T V"], is_valid: Bool[AnyArray, "T V"]) -> Bool[np.ndarray, "T V"]:
    """Which entries are the last valid one of their track in a recording that is known to its end.

    The filter frees a landmark's slot there, so that the map need only hold what is still to be seen.
    """
    shape = np.shape(track_id)
    track_id, is_valid = np.ravel(track_id), np.ravel(is_valid)
    # In reversed order the first occurrence of an id is its last sighting.
    entries = np.flatnonzero(is_valid)[::-1]
    _, first = np.unique(track_id[entries], return_index=True)
    is_last = np.zeros(track_id.shape, bool)
    is_last[entries[first]] = True
    return is_last.reshape(shape)


def validate(recording: Recording) -> None:
    """Refuse a recording that no filter can run on.

    Raises:
        ValueError: naming field, place, value and remedy: no recording, fields that are no arrays of numbers, shapes
            that disagree, no frames or no columns, times that do not grow, a non-finite number where one is needed
            (pixels count only where valid), negative or repeated ids in a frame, a last sighting that is not the last,
            covariances that are not symmetric or have a negative eigenvalue, quaternions that are not of unit length.
            Traced recordings are not checked.
    """
    require_kind("run", "recording", recording, Recording, "give a Recording, as vcjax.simulate makes one.")
    leaves = jax.tree.leaves(recording)
    if not all(is_concrete(leaf) for leaf in leaves):
        return
    _refuse_types(recording)
    num_frames = np.shape(recording.time_s)[0] if np.ndim(recording.time_s) == 1 else "T"
    if num_frames == 0:
        raise ValueError("Recording(time_s=[]): the recording is empty; give at least one frame.")
    num_features = np.shape(recording.track_id)[-1] if np.ndim(recording.track_id) == 2 else "V"
    if num_features == 0:
        raise ValueError(
            f"Recording(track_id) has shape {np.shape(recording.track_id)}: no column for features; "
            "where none is seen, give one column that is marked invalid throughout."
        )
    shapes = {
        "time_s": (num_frames,),
        "odometry": (num_frames, 6),
        "odometry_cov": (num_frames, 6, 6),
        "sensor_shift_m": (num_frames, 3),
        "track_id": (num_frames, num_features),
        "uv_px": (num_frames, num_features, 2),
        "is_valid": (num_frames, num_features),
        "is_last": (num_frames, num_features),
        "robot_start": (7,),
        "sensor_start": (7,),
        "start_cov": (14, 14),
    }
    for name, shape in shapes.items():
        found = np.shape(getattr(recording, name))
        if found != shape:
            raise ValueError(
                f"Recording({name}) has shape {found}, but {shape} is needed (T frames first, from time_s)."
            )
    for name in ("time_s", "odometry", "odometry_cov", "sensor_shift_m", "robot_start", "sensor_start", "start_cov"):
        _refuse_where(~np.isfinite(getattr(recording, name)), name, recording, "must be finite.")

    is_valid, track_id = np.asarray(recording.is_valid), np.asarray(recording.track_id)
    _refuse_where(
        is_valid[..., None] & ~np.isfinite(recording.uv_px),
        "uv_px",
        recording,
        "is marked valid; clear is_valid there.",
    )
    is_no_id = (track_id < 0) | (track_id > np.iinfo(np.int32).max)
    _refuse_where(is_valid & is_no_id, "track_id", recording, "is marked valid; ids start at 0 and end before 2³¹.")
    reappears = np.asarray(recording.is_last) & is_valid & ~last_sightings(track_id, is_valid)
    _refuse_where(reappears, "is_last", recording, "its track is seen again; see last_sightings.")
    _refuse_where(np.diff(recording.time_s, prepend=-np.inf) <= 0, "time_s", recording, "times must grow.")
    for name in ("odometry_cov", "start_cov"):
        _refuse_covariance(name, recording)
    for name in ("robot_start", "sensor_start"):
        norm = float(np.linalg.norm(np.asarray(getattr(recording, name))[3:]))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"Recording({name}): the quaternion has length {norm}; divide it by its length.")
    ordered = np.sort(np.where(is_valid, track_id, -1 - np.arange(track_id.shape[1])), axis=1)
    repeated = np.argwhere((np.diff(ordered, axis=1) == 0) & (ordered[:, 1:] >= 0))
    if len(repeated):
        frame, column = repeated[0]
        raise ValueError(
            f"Recording(track_id): frame {frame} has id {ordered[frame, column]} twice; "
            "keep one measurement per feature."
        )


def _refuse_types(recording: Recording) -> None:
    """Refuse what is no array of numbers, ids that are no integers, masks that are no booleans, no camera."""
    for name in (field.name for field in dataclasses.fields(Recording) if field.name != "camera"):
        value = getattr(recording, name)
        if not isinstance(value, jax.Array | np.ndarray):
            raise ValueError(f"Recording({name}) is a {type(value).__name__}; give a NumPy or JAX array.")
        kind, needed = {
            "track_id": (jnp.integer, "ids are integers"),
            "is_valid": (jnp.bool_, "give booleans"),
            "is_last": (jnp.bool_, "give booleans"),
        }.get(name, (jnp.floating, "give floating-point numbers"))
        if not jnp.issubdtype(value.dtype, kind):
            raise ValueError(f"Recording({name}) is {value.dtype}; {needed}.")
        if value.dtype.itemsize > 8:
            raise ValueError(f"Recording({name}) is {value.dtype}; give numbers of at most 64 bits.")
    require_kind("Recording", "camera", recording.camera, Camera, "give a vcjax.Camera.")


def _refuse_covariance(name: str, recording: Recording) -> None:
    """Refuse covariances with a negative variance, or beyond rounding not symmetric or with a negative eigenvalue."""
    cov = np.asarray(getattr(recording, name), np.float64)
    _refuse_where((cov < 0) & np.eye(cov.shape[-1], dtype=bool), name, recording, "variances are at least 0.")
    tolerance = COVARIANCE_TOLERANCE * np.max(np.abs(cov), axis=(-2, -1))
    is_skew = np.abs(cov - cov.mT) > tolerance[..., None, None]
    _refuse_where(is_skew, name, recording, "differs from its mirror element; a covariance P is symmetric, (P + Pᵀ)/2.")
    smallest = np.atleast_1d(np.linalg.eigvalsh(cov)[..., 0])
    frames = np.flatnonzero(smallest < -tolerance)
    if len(frames):
        place = f"{name}[{frames[0]}]" if cov.ndim == 3 else name
        raise ValueError(
            f"Recording({place}) has the eigenvalue {smallest[frames[0]]:.3g}: a covariance has none below 0; "
            f"check its correlations, which lie in [-1, 1] ({len(frames)} such places)"
        )


def _refuse_where(is_bad: np.ndarray, name: str, recording: Recording, remedy: str) -> None:
    """Refuse the first place where `is_bad`, with its index and value."""
    places = np.argwhere(is_bad)
    if len(places):
        place = tuple(int(i) for i in places[0])
        value = np.asarray(getattr(recording, name))[place]
        raise ValueError(f"Recording({name}{list(place)} = {value}): {remedy} ({len(places)} such places)")
