"""Recordings: the good one is accepted, each kind of bad one is refused by field, place and value."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcjax.models.camera import Camera
from vcjax.recording import Recording, last_sightings, validate

T, V = 5, 4


def good_recording() -> Recording:
    """A good recording in NumPy: anything may stand where nothing is valid."""
    rng = np.random.default_rng(0)
    is_valid = np.arange(V) != np.arange(T)[:, None]
    uv_px = np.where(is_valid[..., None], rng.uniform(0, 480, (T, V, 2)), np.nan)
    track_id = np.where(is_valid, [7, 0, 3, 12], [-9, 0, 0, 0])
    return Recording(
        time_s=0.1 * np.arange(1, T + 1),
        odometry=rng.normal(size=(T, 6)),
        odometry_cov=np.stack([1e-6 * np.eye(6)] * T),
        sensor_shift_m=np.zeros((T, 3)),
        track_id=track_id,
        uv_px=uv_px,
        is_valid=is_valid,
        is_last=last_sightings(track_id, is_valid),
        camera=Camera(),
        robot_start=np.array([1.0, 2.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
        sensor_start=np.array([0.0, 0.0, 0.6, 0.5, -0.5, 0.5, -0.5]),
        start_cov=np.zeros((14, 14)),
    )


@pytest.fixture
def recording():
    return good_recording()


def changed(recording, name, value, place=None):
    """The recording with another field, or another value at one place of it."""
    if place is not None:
        value, old = getattr(recording, name).copy(), value
        value[place] = old
    return dataclasses.replace(recording, **{name: value})


def test_good_recording_is_accepted(recording):
    validate(recording)
    validate(jax.tree.map(jnp.asarray, recording))


def test_traced_recording_is_not_looked_at(recording):
    bad = changed(recording, "time_s", np.nan, 0)
    assert jax.jit(lambda r: validate(r) or r.time_s[1])(bad) == 0.2


def test_frame_is_a_row_of_every_field(recording):
    frame = jax.jit(Recording.frame)(recording, 3)
    for name in ("odometry", "odometry_cov", "sensor_shift_m", "track_id", "uv_px", "is_valid", "is_last"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(recording, name)[3])
    np.testing.assert_array_equal(frame.camera.intrinsics_px, recording.camera.intrinsics_px)
    assert recording.num_frames == T
    assert frame.time_step_s == recording.time_s[3] - recording.time_s[2] and recording.frame(0).time_step_s == 0


BAD_VALUES = {
    "infinite time": ("time_s", np.inf, 2, r"Recording\(time_s\[2\] = inf\): must be finite"),
    "NaN odometry": ("odometry", np.nan, (3, 5), r"Recording\(odometry\[3, 5\] = nan\): must be finite"),
    "NaN covariance": ("odometry_cov", np.nan, (1, 0, 2), r"odometry_cov\[1, 0, 2\] = nan"),
    "NaN shift": ("sensor_shift_m", np.nan, (0, 1), r"sensor_shift_m\[0, 1\] = nan"),
    "NaN start": ("robot_start", np.nan, 0, r"robot_start\[0\] = nan"),
    "NaN mount": ("sensor_start", np.nan, 6, r"sensor_start\[6\] = nan"),
    "NaN start covariance": ("start_cov", np.nan, (4, 4), r"start_cov\[4, 4\] = nan"),
    "NaN pixel marked valid": ("uv_px", np.nan, (2, 3, 1), r"uv_px\[2, 3, 1\] = nan\): is marked valid; clear"),
    "id too large": ("track_id", 2**31, (1, 2), r"track_id\[1, 2\] = 2147483648\): is marked valid; .* end before"),
    "negative id": ("track_id", -2, (1, 2), r"track_id\[1, 2\] = -2\): is marked valid; ids start at 0"),
    "last seen too early": ("is_last", True, (0, 1), r"is_last\[0, 1\] = True\): its track is seen again"),
    "repeated id": ("track_id", 12, (1, 2), r"Recording\(track_id\): frame 1 has id 12 twice"),
    "time standing still": ("time_s", 0.2, 2, r"time_s\[2\] = 0.2\): times must grow"),
    "negative odometry variance": ("odometry_cov", -1.0, (4, 5, 5), r"odometry_cov\[4, 5, 5\] = -1.0\): variances"),
    "negative start variance": ("start_cov", -1.0, (13, 13), r"start_cov\[13, 13\] = -1.0\): variances"),
    "skew odometry covariance": (
        "odometry_cov",
        1e-8,
        (3, 4, 5),
        r"odometry_cov\[3, 4, 5\] = 1e-08\): differs from its mirror element; .* symmetric",
    ),
    "skew start covariance": ("start_cov", 1e-3, (2, 0), r"start_cov\[0, 2\] = 0.0\): differs from its mirror element"),
    "long quaternion": ("robot_start", 2.0, 3, r"Recording\(robot_start\): the quaternion has length 2.0"),
    "short quaternion": ("sensor_start", 0.0, 4, r"Recording\(sensor_start\): the quaternion has length 0.866"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("name", "value", "place", "message"), BAD_VALUES.values(), ids=BAD_VALUES)
def test_bad_value_is_refused_with_its_place(recording, name, value, place, message):
    with pytest.raises(ValueError, match=message):
        validate(changed(recording, name, value, place))


BAD_FIELDS = {
    "no frames": ("time_s", np.zeros(0), r"Recording\(time_s=\[\]\): the recording is empty"),
    "times in a table": ("time_s", np.zeros((T, 1)), r"Recording\(time_s\) has shape \(5, 1\)"),
    "odometry too short": ("odometry", np.zeros((T - 1, 6)), r"odometry\) has shape \(4, 6\), but \(5, 6\)"),
    "planar odometry": ("odometry", np.zeros((T, 3)), r"odometry\) has shape \(5, 3\), but \(5, 6\)"),
    "one covariance": ("odometry_cov", np.zeros((6, 6)), r"odometry_cov\) has shape \(6, 6\), but \(5, 6, 6\)"),
    "flat shift": ("sensor_shift_m", np.zeros((T, 2)), r"sensor_shift_m\) has shape \(5, 2\)"),
    "ids of one frame": ("track_id", np.zeros(V, int), r"track_id\) has shape \(4,\)"),
    "pixels too few": ("uv_px", np.zeros((T, V - 1, 2)), r"uv_px\) has shape \(5, 3, 2\), but \(5, 4, 2\)"),
    "mask too wide": ("is_valid", np.zeros((T, V + 1), bool), r"is_valid\) has shape \(5, 5\)"),
    "last too wide": ("is_last", np.zeros((T, V + 1), bool), r"is_last\) has shape \(5, 5\)"),
    "planar start": ("robot_start", np.zeros(3), r"robot_start\) has shape \(3,\), but \(7,\)"),
    "planar mount": ("sensor_start", np.zeros(3), r"sensor_start\) has shape \(3,\)"),
    "robot's covariance only": ("start_cov", np.zeros((7, 7)), r"start_cov\) has shape \(7, 7\), but \(14, 14\)"),
    "no column": (
        "track_id",
        np.zeros((T, 0), int),
        r"track_id\) has shape \(5, 0\): no column .*give one column that is marked invalid",
    ),
    "list of odometry": ("odometry", [[0.0] * 6] * T, r"Recording\(odometry\) is a list; give a NumPy or JAX array"),
    "no times": ("time_s", None, r"Recording\(time_s\) is a NoneType; give a NumPy or JAX array"),
    "name for pixels": ("uv_px", "pixels.npy", r"Recording\(uv_px\) is a str; give a NumPy or JAX array"),
    "words for times": ("time_s", np.array(["a"] * T), r"Recording\(time_s\) is <U1; give floating-point numbers"),
    "objects for odometry": (
        "odometry",
        np.zeros((T, 6), object),
        r"Recording\(odometry\) is object; give floating-point",
    ),
    "complex shift": ("sensor_shift_m", np.zeros((T, 3), complex), r"Recording\(sensor_shift_m\) is complex128; give"),
    "no camera": ("camera", None, r"Recording\(camera=None\): give a vcjax.Camera"),
    "camera's numbers": ("camera", (320.0, 240.0), r"Recording\(camera=\(320.0, 240.0\)\): give a vcjax.Camera"),
    "fractional ids": ("track_id", np.zeros((T, V)), r"track_id\) is float64; ids are integers"),
    "mask of numbers": ("is_valid", np.ones((T, V), int), r"is_valid\) is int64; give booleans"),
    "last of numbers": ("is_last", np.ones((T, V)), r"is_last\) is float64; give booleans"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("name", "value", "message"), BAD_FIELDS.values(), ids=BAD_FIELDS)
def test_bad_field_is_refused_with_what_is_needed(recording, name, value, message):
    with pytest.raises(ValueError, match=message):
        validate(changed(recording, name, value))


def test_impossible_covariance_is_refused_with_its_frame_and_eigenvalue(recording):
    bad = recording.odometry_cov.copy()
    bad[3, :2, :2] = [[1e-6, 2e-6], [2e-6, 1e-6]]
    with pytest.raises(ValueError, match=r"odometry_cov\[3\]\) has the eigenvalue -1e-06: .* none below 0; check its"):
        validate(changed(recording, "odometry_cov", bad))
    start = np.zeros((14, 14))
    start[:2, :2] = [[1.0, 1.1], [1.1, 1.0]]
    with pytest.raises(ValueError, match=r"Recording\(start_cov\) has the eigenvalue -0.1"):
        validate(changed(recording, "start_cov", start))


@given(st.integers(0, 2**32 - 1), st.floats(1e-9, 1e6), st.integers(1, 14))
def test_covariances_with_rounding_are_accepted(seed, scale, rank):
    """Of any rank and size, also as float32."""
    A = np.random.default_rng(seed).normal(size=(14, rank))
    for dtype in (np.float64, np.float32):
        start_cov = (scale * A @ A.T).astype(dtype)
        odometry_cov = np.stack([start_cov[:6, :6]] * T)
        validate(dataclasses.replace(good_recording(), odometry_cov=odometry_cov, start_cov=start_cov))


@given(st.integers(0, 2**32 - 1))
def test_last_sightings_are_those_that_nothing_follows(seed):
    rng = np.random.default_rng(seed)
    track_id = np.stack([rng.permutation(7)[:V] for _ in range(T)])
    is_valid = rng.random((T, V)) < 0.6
    expected = np.zeros((T, V), bool)
    for t in range(T):
        for j in range(V):
            expected[t, j] = is_valid[t, j] and not np.any(is_valid[t + 1 :] & (track_id[t + 1 :] == track_id[t, j]))
    np.testing.assert_array_equal(last_sightings(track_id, is_valid), expected)
    np.testing.assert_array_equal(last_sightings(jnp.array(track_id), jnp.array(is_valid)), expected)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("name", [None, "uv_px", "odometry_cov", "sensor_shift_m", "time_s"])
def test_frames_are_in_working_precision_whatever_is_stored(recording, name, dtype):
    """One field in another precision, as OpenCV gives pixels, or all: the filter sees none of it."""
    names = [field.name for field in dataclasses.fields(recording) if field.name != "camera"]
    stored = {n: np.asarray(getattr(recording, n)) for n in names if name in (None, n)}
    stored = {n: a.astype(dtype) if a.dtype.kind == "f" else a for n, a in stored.items()}
    found, expected = dataclasses.replace(recording, **stored).frame(1), recording.frame(1)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=2 * np.finfo(dtype).eps, atol=1e-3)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.skipif(np.longdouble(0).itemsize == 8, reason="there is no larger number here")
def test_numbers_of_more_than_64_bits_are_refused(recording):
    bad = changed(recording, "uv_px", np.asarray(recording.uv_px, np.longdouble))
    with pytest.raises(ValueError, match=r"Recording\(uv_px\) is float128; give numbers of at most 64 bits"):
        validate(bad)
