"""Recording files: bit for bit back, and every kind of bad file refused before it takes memory."""

import dataclasses
import io
import tracemalloc
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rendered import rendered
from test_recording import good_recording

import vcjax as vc
from vcjax.recording import Recording, Truth
from vcjax.sources.calibration import Calibration
from vcjax.sources.recording_file import (
    RecordingFile,
    TrackLabel,
    TrackLabels,
    load_recording,
    save_recording,
)


def assert_same(found, expected):
    """Equal bit for bit, NaN included, and of the same type."""
    for field in dataclasses.fields(expected):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if field.name == "camera":
            assert_same(one, other)
        else:
            one, other = np.asarray(one), np.asarray(other)
            assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes()), field.name


def poses(rng, num: int) -> np.ndarray:
    found = rng.normal(size=(num, 7))
    found[:, 3:] /= np.linalg.norm(found[:, 3:], axis=1, keepdims=True)
    return found


def truth(**changes) -> dict[str, bytes]:
    """The entries of the truth with others in place of some numbers, and two features."""
    known = full().truth
    arrays = {
        "robot": known.robot,
        "sensor": known.sensor,
        "landmarks_m": np.zeros((5, 2, 3)),
        "is_moving": [False] * 2,
    }
    for name, (place, value) in changes.items():
        arrays[name] = arrays[name].copy()
        arrays[name][place] = value
    return {f"truth_{name}.npy": npy(array) for name, array in arrays.items()}


def full() -> RecordingFile:
    recording = good_recording()
    num_frames = recording.num_frames
    rng = np.random.default_rng(1)
    truth = Truth(
        robot=np.where(np.arange(num_frames)[:, None] < 3, poses(rng, num_frames), np.nan),
        sensor=poses(rng, num_frames),
        landmarks_m=np.zeros((num_frames, 0, 3)),
        is_moving=np.zeros(0, bool),
    )
    labels = TrackLabels(np.array([0, 3, 7]), np.array([TrackLabel.MOVING, TrackLabel.UNKNOWN, TrackLabel.BAD]))
    paths = tuple(f"images/{t} ä.png" for t in range(num_frames))
    return RecordingFile(recording, truth, labels, paths, Calibration(640, 480, 320.0, 321.0, 319.5, 239.5))


def test_all_that_is_known_comes_back_bit_for_bit(tmp_path):
    content = full()
    found = load_recording(save_recording(tmp_path / "a.npz", content))
    assert_same(found.recording, content.recording)
    assert_same(found.truth, content.truth)
    np.testing.assert_array_equal(found.labels.track_id, content.labels.track_id)
    np.testing.assert_array_equal(found.labels.label, content.labels.label)
    assert (found.image_paths, found.calibration) == (content.image_paths, content.calibration)


def test_simulated_recording_comes_back(tmp_path):
    recording, truth = jax.tree.map(jnp.asarray, (rendered().simulated, rendered().truth))
    found = load_recording(save_recording(tmp_path / "a.npz", RecordingFile(recording, truth)))
    assert_same(found.recording, recording)
    assert_same(found.truth, truth)
    assert found.labels is found.image_paths is found.calibration is None


@given(st.integers(0, 2**32 - 1), st.sampled_from([np.float32, np.float64]), st.sampled_from([np.int32, np.int64]))
def test_round_trip_keeps_every_bit(tmp_path_factory, seed, real, whole):
    rng = np.random.default_rng(seed)
    T, V = rng.integers(1, 6, 2)
    recording = Recording(
        time_s=np.cumsum(rng.random(T) + 0.1).astype(real),
        odometry=rng.normal(size=(T, 6)).astype(real),
        odometry_cov=np.stack([np.eye(6, dtype=real)] * T),
        sensor_shift_m=rng.normal(size=(T, 3)).astype(real),
        track_id=np.stack([rng.permutation(V + 3)[:V] for _ in range(T)]).astype(whole),
        uv_px=rng.choice([np.nan, -np.inf, -0.0, 1e-40, 17.3], (T, V, 2)).astype(real),
        is_valid=np.zeros((T, V), bool),
        is_last=np.zeros((T, V), bool),
        camera=vc.Camera(distortion=(0.1,) * int(rng.integers(0, 3))),
        robot_start=np.array([0, 0, 0, 1, 0, 0, 0], real),
        sensor_start=np.array([0, 0, 0, 1, 0, 0, 0], real),
        start_cov=np.zeros((14, 14), real),
    )
    path = tmp_path_factory.mktemp("round") / "a.npz"
    assert_same(load_recording(save_recording(path, recording)).recording, recording)
    # Written again, the same file: nothing of time or place is in it.
    assert path.read_bytes() == save_recording(path.with_name("b"), recording).read_bytes()


def entries(path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def npy(array, version=(1, 0)) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array), version, allow_pickle=True)
    return buffer.getvalue()


def header(shape, dtype="<f8") -> bytes:
    """The header of an array alone, stating what is not there."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"shape": shape, "fortran_order": False, "descr": dtype})
    return buffer.getvalue()


def write(path, content: dict[str, bytes]):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path


@pytest.fixture
def good(tmp_path):
    return entries(save_recording(tmp_path / "good.npz", full()))


BAD = {
    "pickled objects": ({"uv_px.npy": npy(np.array([b"x", None], object))}, "uv_px has no readable header .*type obj"),
    "other schema": ({"schema.npy": npy(2)}, "schema 2, but this version reads 1"),
    "no schema": ({"schema.npy": None}, "schema None, but this version reads 1"),
    "lacking array": ({"odometry.npy": None, "is_last.npy": None}, "lacks is_last, odometry; write it"),
    "lacking camera": ({"camera_intrinsics_px.npy": None}, "lacks camera_intrinsics_px"),
    "half of the truth": ({"truth_sensor.npy": None}, "lacks truth_sensor"),
    "labels of nothing": ({"label_track_id.npy": None}, "lacks label_track_id"),
    "unknown array": ({"more.npy": npy(1)}, "'more.npy' is no array of this kind of file"),
    "no array": ({"read.me": b"hello"}, "'read.me' is no array"),
    "array without its ending": ({"time_s.npy": None, "time_s": npy([1.0])}, "'time_s' is no array"),
    "whole times": ({"time_s.npy": npy([1, 2, 3, 4, 5])}, "time_s is int64; floating-point numbers are needed"),
    "complex": ({"uv_px.npy": npy(np.zeros(2, complex))}, "uv_px is complex128; floating-point"),
    "mask of numbers": ({"is_valid.npy": npy(np.ones((5, 4)))}, "is_valid is float64; booleans"),
    "records": ({"uv_px.npy": npy(np.zeros(2, "f8,f8"))}, "uv_px has no readable header"),
    "wrong shape": ({"odometry.npy": npy(np.zeros((5, 3)))}, r"Recording\(odometry\) has shape \(5, 3\)"),
    "NaN": ({"odometry.npy": npy(np.full((5, 6), np.nan))}, r"odometry\[0, 0\] = nan\): must be finite"),
    "negative id": ({"track_id.npy": npy(np.full((5, 4), -1))}, r"track_id\[0, 1\] = -1\): .*ids start at 0"),
    "impossible camera": ({"camera_intrinsics_px.npy": npy([0.0, 0, -1, 1])}, r"Camera\(intrinsics_px.*positive"),
    "camera of no size": ({"camera_image_size_px.npy": npy([1e9, 240.0])}, r"image_size_px.*1 to 32768 px"),
    "camera without end": ({"camera_image_size_px.npy": npy([np.inf, 240.0])}, "image_size_px"),
    "truth of other frames": ({"truth_robot.npy": npy(np.zeros((4, 7)))}, r"Truth\(robot\) has shape \(4, 7\)"),
    "unknown label": ({"label.npy": npy([0, 1, 5])}, r"label\[2\] = 5; give one of -1 UNKNOWN, 0 STATIC"),
    "track labelled twice": ({"label_track_id.npy": npy([0, 3, 3])}, "names a track twice"),
    "labels too few": ({"label.npy": npy([0, 1])}, r"\(3,\) labelled tracks have \(2,\) labels"),
    "images too few": ({"image_path.npy": npy(["a.png"])}, "1 images for 5 frames"),
    "bad calibration": ({"calibration.npy": npy("{}")}, "calibration: lacks width, height, fx"),
    "text beyond Unicode": ({"calibration.npy": header((), "<U1") + b"\xff\xff\xff\x7f"}, "calibration is no text"),
    "endless distortion": ({"camera_distortion.npy": npy(np.zeros(9))}, r"Camera\(distortion\) has 9 coefficients"),
    "texts of no length": ({"image_path.npy": header((5,), "<U0")}, "image_path has no readable header"),
    "more than 64 bits": (
        {"truth_robot.npy": npy(np.zeros((5, 7), np.longdouble))},
        "truth_robot is float128; numbers",
    ),
    "empty header": ({"uv_px.npy": b""}, "uv_px has no readable header"),
    "words for a header": ({"uv_px.npy": b"\x93NUMPY\x01\x00\x10\x00" + b"import os".ljust(16)}, "no readable header"),
    "negative length": ({"uv_px.npy": header((-1, 2))}, r"no readable header .*shape \(-1, 2\)"),
    "less than stated": ({"uv_px.npy": header((5, 4, 2)) + b"\0" * 8}, "uv_px has 8 bytes, but shape .* has 320"),
    "far more than there is": ({"uv_px.npy": header((2**30, 2**9, 2))}, "uv_px has 0 bytes, but shape"),
}


BAD |= {
    "true quaternion of zeros": (truth(robot=((1, slice(3, 7)), 0.0)), r"Truth\(robot\[1\]\).* length 0\b"),
    "long true quaternion": (truth(sensor=((4, slice(3, 7)), 2.5)), r"Truth\(sensor\[4\]\).* length 5\b"),
    "true place without end": (truth(robot=((2, 1), np.inf)), r"Truth\(robot\[2, 1\] = inf\).*NaN"),
    "feature nowhere": (truth(landmarks_m=((3, 1, 2), np.nan)), r"Truth\(landmarks_m\[3, 1, 2\] = nan\)"),
    "label of a negative id": ({"label_track_id.npy": npy([0, -5, 7])}, r"label_track_id\[1\] = -5"),
    "label of a huge id": ({"label_track_id.npy": npy([0, 3, 2**50])}, r"label_track_id\[2\] = 1125899906842624"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("changes", "message"), BAD.values(), ids=BAD)
def test_bad_file_is_refused_by_name(tmp_path, good, changes, message):
    path = write(tmp_path / "bad.npz", {k: v for k, v in (good | changes).items() if v is not None})
    with pytest.raises(ValueError, match=message) as refusal:
        load_recording(path)
    assert str(path) in str(refusal.value)


def test_zip_bomb_takes_no_memory(tmp_path, good):
    """64 MB of zeros are 64 kB of archive."""
    path = tmp_path / "bomb.npz"
    write(path, good | {"uv_px.npy": header((2**22, 2)) + bytes(2**26)})
    assert path.stat().st_size < 2**20
    tracemalloc.start()
    with pytest.raises(
        ValueError, match=r"need 64 MiB of memory, more than the 8 MiB allowed; .*in Python with a larger max_bytes"
    ):
        load_recording(path, max_bytes=2**23)
    assert tracemalloc.get_traced_memory()[1] < 2**22
    tracemalloc.stop()


def test_truncated_and_altered_files_are_refused_everywhere(tmp_path, good):
    path = write(tmp_path / "good.npz", good)
    whole = path.read_bytes()
    load_recording(path)
    bad = tmp_path / "bad.npz"
    for length in np.linspace(0, len(whole) - 1, 40, dtype=int):
        bad.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"bad\.npz: not a sound \.npz file"):
            load_recording(bad)
    rng = np.random.default_rng(0)
    refused = 0
    for place in rng.integers(0, len(whole), 300):
        altered = bytearray(whole)
        altered[place] ^= 1 << int(rng.integers(8))
        bad.write_bytes(altered)
        try:
            load_recording(bad)  # what a date in the archive says does not matter
        except ValueError as error:
            assert "bad.npz" in str(error)
            refused += 1
    assert refused > 200


def test_array_twice_is_refused(tmp_path, good):
    path = write(tmp_path / "twice.npz", good)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("uv_px.npy", good["uv_px.npy"])
    with pytest.raises(ValueError, match=r"'uv_px\.npy' is no array of this kind of file, or is there twice"):
        load_recording(path)


def test_arrays_of_other_machines_and_of_fortran_are_read(tmp_path, good):
    recording = full().recording
    path = write(
        tmp_path / "other.npz",
        good
        | {
            "odometry.npy": npy(np.asfortranarray(recording.odometry)),
            "time_s.npy": npy(recording.time_s.astype(">f8")),
            "start_cov.npy": npy(recording.start_cov, (2, 0)),
        },
    )
    assert_same(load_recording(path).recording, recording)


def test_other_kinds_of_file_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.npz: no such file"):
        load_recording(tmp_path / "none.npz")
    for content in (b"", b"frame,track_id,u,v\n", b"PK\x03\x04"):
        (tmp_path / "a.npz").write_bytes(content)
        with pytest.raises(ValueError, match=r"not a sound \.npz file"):
            load_recording(tmp_path / "a.npz")


@pytest.mark.usefixtures("unchecked")
def test_what_cannot_be_read_is_not_written_and_the_old_file_stays(tmp_path):
    path = save_recording(tmp_path / "a.npz", full())
    before = path.read_bytes()
    bad = [
        dataclasses.replace(full().recording, odometry=np.full((5, 6), np.nan)),
        full()._replace(image_paths=("one.png",)),
        full()._replace(labels=TrackLabels(np.array([1]), np.array([9]))),
        "recording",
        RecordingFile(dataclasses.replace(full().recording, uv_px=None)),
    ]
    for recording in bad:
        with pytest.raises(ValueError, match=r"a\.npz|recording"):
            save_recording(path, recording)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.npz"]
