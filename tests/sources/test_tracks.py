"""Track tables and the recordings made from them."""

import dataclasses
import json
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from test_recording import good_recording

from vcjax.recording import PER_FRAME, last_sightings, validate
from vcjax.sources import tracks as module
from vcjax.sources.calibration import Calibration, write_calibration
from vcjax.sources.odometry import AXES, from_velocities, unknown_motion
from vcjax.sources.table_file import write_table
from vcjax.sources.tracks import (
    Tracks,
    read_recording,
    read_times,
    read_tracks,
    recording_from_tracks,
    start_covariance,
    tracks_of,
    write_tracks,
)

CALIBRATION = Calibration(640, 480, 500.0, 500.0, 320.0, 240.0)
BENT = Calibration(640, 480, 500.0, 500.0, 320.0, 240.0, "radial_tangential", (-0.2, 0.05, 0.001, -0.001))


def drawn_tracks(seed, num_frames=12, num_tracks=9) -> Tracks:
    """Sightings at random, in no order."""
    rng = np.random.default_rng(seed)
    frame, track = np.nonzero(rng.random((num_frames, num_tracks)) < 0.4)
    order = rng.permutation(len(frame))
    ids = rng.choice(2**31, num_tracks, replace=False)
    return Tracks(frame[order], ids[track[order]], rng.uniform(0, 1, (len(frame), 2)) * [640, 480])


def in_order(tracks: Tracks) -> list[np.ndarray]:
    order = np.lexsort((tracks.track_id, tracks.frame))
    return [tracks.frame[order], tracks.track_id[order], tracks.uv_px[order]]


def assert_same(found: Tracks, expected: Tracks, atol=0.0):
    for one, other in zip(in_order(found), in_order(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=atol)


def make(tracks, calibration=CALIBRATION, num_frames=12):
    time_s = 0.1 * np.arange(num_frames)
    return recording_from_tracks(tracks, calibration, time_s=time_s, odometry=unknown_motion(time_s))


@given(st.integers(0, 2**32 - 1))
def test_tracks_make_a_recording_that_holds_them(seed):
    tracks = drawn_tracks(seed)
    recording = make(tracks)
    validate(recording)
    assert_same(tracks_of(recording), tracks)
    ids, is_valid = np.asarray(recording.track_id), np.asarray(recording.is_valid)
    np.testing.assert_array_equal(recording.is_last, last_sightings(ids, is_valid))
    # No more columns than the fullest frame needs, the first ones filled, by growing identity.
    assert is_valid.shape[1] == max(1, np.bincount(tracks.frame, minlength=1).max())
    for row, valid in zip(ids, is_valid, strict=True):
        assert np.all(valid[: valid.sum()]) and np.all(np.diff(row[valid]) > 0)


@given(st.integers(0, 2**32 - 1))
def test_pixels_of_a_bent_lens_come_back(seed):
    tracks = drawn_tracks(seed)
    recording = make(tracks, BENT)
    assert_same(tracks_of(recording, BENT), tracks, atol=1e-8)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
@given(st.integers(0, 2**32 - 1))
def test_table_there_and_back(tmp_path_factory, ending, seed):
    tracks = drawn_tracks(seed)
    found = read_tracks(write_tracks(tmp_path_factory.mktemp("tracks") / f"t.{ending}", tracks))
    for one, other in zip(found, tracks, strict=True):
        assert one.dtype == other.dtype and one.tobytes() == other.tobytes()


def test_recording_by_hand():
    tracks = Tracks(np.array([2, 0, 0]), np.array([7, 7, 4]), np.array([[1.0, 2], [3, 4], [5, 6]]))
    mount = (0.0, 0.0, 0.6, 1.0, 0.0, 0.0, 0.0)
    recording = make(tracks, dataclasses.replace(CALIBRATION, T_r_s=mount), 3)
    assert recording.track_id.tolist() == [[4, 7], [0, 0], [7, 0]]
    assert recording.is_valid.tolist() == [[True, True], [False, False], [True, False]]
    assert recording.is_last.tolist() == [[True, False], [False, False], [True, False]]
    assert recording.uv_px[0].tolist() == [[5, 6], [3, 4]] and recording.uv_px[2, 0].tolist() == [1, 2]
    assert recording.sensor_start.tolist() == list(mount)
    assert recording.robot_start.tolist() == [0, 0, 0, 1, 0, 0, 0]


def test_recording_without_any_sighting():
    recording = make(Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))), num_frames=2)
    assert recording.is_valid.tolist() == [[False], [False]]


def test_pixels_without_inverse_are_left_out():
    fish = Calibration(2000, 2000, 300.0, 300.0, 1000.0, 1000.0, "equidistant", (0.0,) * 4)
    tracks = Tracks(np.zeros(2, int), np.array([1, 2]), np.array([[1010.0, 990.0], [1990.0, 1000.0]]))
    assert tracks_of(make(tracks, fish, 1)).track_id.tolist() == [1]


def test_bad_recordings_are_refused(monkeypatch):
    tracks = Tracks(np.array([0, 12]), np.array([1, 1]), np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"recording_from_tracks\(tracks\): frame 12, but there are 12 frames"):
        make(tracks)
    with pytest.raises(ValueError, match="frame 0 has id 1 twice"):
        make(Tracks(np.array([0, 0]), np.array([1, 1]), np.zeros((2, 2))))
    monkeypatch.setattr(module, "MAX_BYTES", 2**12)
    with pytest.raises(ValueError, match="12 frames of up to 2 features need 0 MiB of memory, more than 0; number"):
        make(Tracks(np.array([0, 0]), np.array([1, 2]), np.zeros((2, 2))))


def test_a_far_frame_takes_no_memory(tmp_path):
    """42 bytes of a table: each frame that nothing is seen in takes its covariance, too."""
    (tmp_path / "a.csv").write_text("frame,track_id,u,v\n0,1,2,3\n33554430,1,2,3\n")
    write_calibration(tmp_path / "c.json", CALIBRATION)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"a\.csv: frame 33554430 is the last: 33554431 frames .* need 13632 MiB"):
        read_recording(tmp_path / "a.csv", tmp_path / "c.json", rate_hz=10.0)
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


def test_what_a_recording_takes_is_counted():
    """Per frame and per column, from the arrays themselves."""
    one, two = (make(Tracks(np.zeros(n, int), np.arange(n), np.zeros((n, 2)))) for n in (1, 2))
    needed = [sum(getattr(r, name).nbytes for name in PER_FRAME) / r.num_frames for r in (one, two)]
    assert needed[1] - needed[0] == module._ENTRY_BYTES
    assert needed[0] - module._ENTRY_BYTES <= module._FRAME_BYTES


HEADER = "frame,track_id,u,v\n"
BAD = {
    "negative id": ("0,1,2,3\n0,-1,2,3\n", "line 3, column track_id: -1 is below 0"),
    "negative frame": ("-4,1,2,3\n", "line 2, column frame: -4 is below 0"),
    "large id": (f"0,{2**31},2,3\n", "line 2, column track_id: 2147483648 does not fit in 31 bits"),
    "NaN": ("0,1,2,3\n1,1,2,nan\n", "line 3, column v: nan is not finite"),
    "word": ("0,1,2,3\n1,1,2,three\n", "line 3, column v: 'three' is not a finite number"),
    "twice": ("5,8,2,3\n4,8,2,3\n5,8,2,3\n5,8,1,1\n", r"line 4: track 8 is in frame 5 already; .*\(2 such rows\)"),
}


@pytest.mark.parametrize(("rows", "message"), BAD.values(), ids=BAD)
def test_bad_table_is_refused_by_line_column_and_value(tmp_path, rows, message):
    (tmp_path / "t.csv").write_text(HEADER + rows)
    with pytest.raises(ValueError, match=message) as refusal:
        read_tracks(tmp_path / "t.csv")
    assert str(tmp_path / "t.csv") in str(refusal.value)


def test_one_bad_row_in_a_million_is_found(tmp_path):
    """By the checks of values, in Parquet too, where nothing else could find it."""
    frame, track = np.divmod(np.arange(1_000_000), 100)
    table = {"frame": frame, "track_id": track, "u": 0.5 * track, "v": 0.25 * frame}
    table["v"][777_776] = np.inf
    path = write_table(tmp_path / "t.parquet", table)
    with pytest.raises(ValueError, match=r"t\.parquet, row 777777, column v: inf is not finite; .*\(1 such rows\)"):
        read_tracks(path)
    table["v"][777_776] = 0.0
    table["track_id"] = np.where(np.arange(1_000_000) == 777_776, 77, track)
    with pytest.raises(ValueError, match=r"t\.parquet, row 777778: track 77 is in frame 7777 already"):
        read_tracks(write_table(path, table))


def test_tables_of_times(tmp_path):
    path = write_table(tmp_path / "times.csv", {"frame": [33, 35, 36], "time_s": [1.5, 1.7, 1.8]})
    frames, time_s = read_times(path)
    assert frames.tolist() == [33, 35, 36] and time_s.tolist() == [1.5, 1.7, 1.8]
    (tmp_path / "t.csv").write_text(HEADER + "36,1,2,3\n33,1,2,3\n")
    assert read_tracks(tmp_path / "t.csv", frames).frame.tolist() == [2, 0]
    for frame in (34, 37, 0):
        (tmp_path / "t.csv").write_text(HEADER + f"36,1,2,3\n{frame},1,2,3\n")
        with pytest.raises(ValueError, match=f"line 3, column frame: {frame} is not in the table of times"):
            read_tracks(tmp_path / "t.csv", frames)
    for frame, time_s, message in (
        ([1, 2], [1.0, 1.0], "line 3, column time_s: 1.0 is not above the one before"),
        ([2, 2], [1.0, 2.0], "line 3, column frame: 2 is not above"),
        ([-1, 2], [1.0, 2.0], "line 2, column frame: -1 is below 0"),
        ([], [], "no row; give the time of each frame"),
    ):
        write_table(path, {"frame": np.array(frame, int), "time_s": np.array(time_s, float)})
        with pytest.raises(ValueError, match=message):
            read_times(path)


def test_recording_from_files(tmp_path):
    tracks = Tracks(np.array([10, 12]), np.array([3, 3]), np.array([[1.0, 2], [3, 4]]))
    odometry = {"frame": [10, 12]} | {axis: [0.0, 0.1 * i] for i, axis in enumerate(AXES)}
    odometry |= {f"std_{axis}": [0.0, 0.5] for axis in AXES}
    recording = read_recording(
        write_tracks(tmp_path / "t.csv", tracks),
        write_calibration(tmp_path / "c.json", CALIBRATION),
        write_table(tmp_path / "o.csv", odometry),
        write_table(tmp_path / "times.csv", {"frame": [10, 12], "time_s": [5.0, 5.5]}),
    )
    assert recording.time_s.tolist() == [5.0, 5.5] and recording.track_id.tolist() == [[3], [3]]
    np.testing.assert_allclose(recording.odometry[1], [0, 0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(recording.odometry_cov[1], 0.25 * np.eye(6))


def test_recording_from_fewest_files(tmp_path):
    files = (
        write_tracks(tmp_path / "t.csv", Tracks(np.array([0, 3]), np.array([3, 3]), np.zeros((2, 2)))),
        write_calibration(tmp_path / "c.json", CALIBRATION),
    )
    recording = read_recording(*files, rate_hz=20.0)
    np.testing.assert_allclose(recording.time_s, [0, 0.05, 0.1, 0.15])
    assert not recording.odometry.any() and np.all(recording.odometry_cov[1:, range(6), range(6)] > 0)
    for options, message in (
        ({}, "give times_file or rate_hz"),
        ({"rate_hz": 0.0}, r"rate_hz=0.0\): give a positive number"),
        ({"rate_hz": 1.0, "odometry_file": "o.csv", "odometry": unknown_motion(recording.time_s)}, "one of the two"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(*files, **options)
    write_tracks(files[0], Tracks(np.array([2**31 - 1]), np.array([3]), np.zeros((1, 2))))
    with pytest.raises(ValueError, match=r"t\.csv: frame 2147483647 is the last: .* number frames from 0"):
        read_recording(*files, rate_hz=1.0)


def test_simulated_recordings_have_tables_too():
    recording = good_recording()
    tracks = tracks_of(recording)
    assert len(tracks.frame) == np.sum(recording.is_valid)
    for frame, track_id, uv_px in zip(*tracks, strict=True):
        column = np.flatnonzero(recording.is_valid[frame] & (recording.track_id[frame] == track_id))[0]
        assert recording.uv_px[frame, column].tolist() == uv_px.tolist()


@pytest.mark.skipif("VCJAX_DATA" not in os.environ, reason="needs the real recordings of VCJAX_DATA")
def test_real_car(tmp_path):
    """Its velocities, integrated, end some 50 m from the truth after 695 m; its tracks make a recording."""
    data = np.load(Path(os.environ["VCJAX_DATA"]) / "kitti07_tracks" / "tracks.npz")
    odometry = from_velocities(data["time"], data["v_imu"], data["w_imu"], 0.5, 0.05)
    T_b_c = np.eye(4)  # the last column is the camera's place on the body, as in scripts/street_recording.py
    T_b_c[:3, :3], T_b_c[:3, 3] = data["cam_T_imu"][:3, :3].T, data["cam_T_imu"][:3, 3]
    turn = Rotation.from_matrix(T_b_c[:3, :3]).as_quat(scalar_first=True)
    K = data["K"]
    calibration = Calibration(1226, 370, K[0, 0], K[1, 1], K[0, 2], K[1, 2], T_r_s=(*T_b_c[:3, 3], *turn))
    path = write_tracks(tmp_path / "t.parquet", Tracks(data["frame"], data["track"], data["uv_left"].astype(float)))
    write_calibration(tmp_path / "c.json", calibration)
    write_table(tmp_path / "times.csv", {"frame": np.arange(1106), "time_s": data["time"]})
    recording = read_recording(path, tmp_path / "c.json", times_file=tmp_path / "times.csv", odometry=odometry)
    assert recording.num_frames == 1106 and recording.is_valid.sum() == 75647
    place, rotation = np.zeros(3), Rotation.identity()
    for increment in recording.odometry[:1101]:
        place, rotation = place + rotation.apply(increment[:3]), rotation * Rotation.from_rotvec(increment[3:])
    T_w_b = [np.vstack([T, [0, 0, 0, 1]]) @ np.linalg.inv(T_b_c) for T in data["T_w_cam0"]]
    true = (np.linalg.inv(T_w_b[0]) @ T_w_b[-1])[:3, 3]
    assert 40 < np.linalg.norm(place - true) < 60
    assert json.loads((tmp_path / "c.json").read_text())["width"] == 1226


def test_covariance_of_the_start():
    """Of the quaternion: that of many draws of a small turn before it."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("zyx", [0.7, -0.3, 1.1])
    q = turn.as_quat(scalar_first=True)
    cov = start_covariance(np.array([1.0, 2.0, 3.0, *q]), 0.1, 0.01)
    drawn = (Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.01, (200_000, 3))) * turn).as_quat(
        scalar_first=True
    )
    drawn *= np.sign(drawn @ q)[:, None]
    np.testing.assert_allclose(cov[3:7, 3:7], np.cov(drawn.T), atol=3e-7)
    np.testing.assert_allclose(cov[:3, :3], 0.01 * np.eye(3))
    assert not cov[7:].any() and not cov[:3, 3:].any() and np.abs(cov[3:7, 3:7] @ q).max() < 1e-15
