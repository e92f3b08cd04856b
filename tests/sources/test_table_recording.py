"""Recordings from tables with truth and labels: what comes in comes out, and bad cells are refused by their place."""

import numpy as np
import pytest
import recorded
from rendered import rendered, tracked

from vcjax.sources.calibration import write_calibration
from vcjax.sources.odometry import write_odometry
from vcjax.sources.recording_file import TrackLabels
from vcjax.sources.table_file import write_table
from vcjax.sources.table_recording import read_labels, record_tables, write_labels
from vcjax.sources.tracks import write_tracks
from vcjax.sources.trajectory_file import write_kitti, write_tum


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Tables of the rendered sequence."""
    folder, sequence, content = tmp_path_factory.mktemp("tables"), rendered().sequence, recorded.content()
    return {
        "tracks": write_tracks(folder / "tracks.parquet", tracked()),
        "calibration": write_calibration(folder / "c.json", sequence.calibration),
        "odometry": write_odometry(folder / "odometry.csv", sequence.odometry),
        "times": write_table(folder / "times.csv", {"frame": np.arange(30), "time_s": sequence.time_s}),
        "robot": write_tum(folder / "robot.txt", sequence.time_s, np.asarray(rendered().truth.robot)),
        "camera": write_kitti(folder / "camera.txt", sequence.truth.T_w_x),
        "labels": write_labels(folder / "labels.csv", content.labels),
    }


@pytest.mark.parametrize("of", ["robot", "camera"])
def test_tables_give_what_the_images_gave(files, of):
    needed = [files[name] for name in ("tracks", "calibration", "odometry", "times")]
    found = record_tables(*needed, truth_file=files[of], truth_of_camera=of == "camera", labels_file=files["labels"])
    expected = recorded.content()
    for name in ("time_s", "odometry", "odometry_cov", "sensor_shift_m", "track_id", "is_valid", "is_last", "uv_px"):
        np.testing.assert_array_equal(getattr(found.recording, name), getattr(expected.recording, name))
    np.testing.assert_allclose(found.truth.robot[:, :3], expected.truth.robot[:, :3], atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(found.truth.robot[:, 3:] * expected.truth.robot[:, 3:], axis=1)), 1.0)
    np.testing.assert_allclose(found.truth.sensor, expected.truth.sensor, atol=1e-12)
    for one, other in zip(found.labels, expected.labels, strict=True):
        np.testing.assert_array_equal(one, other)
    assert found.calibration == expected.calibration


def test_what_is_not_given_is_not_known(files):
    found = record_tables(files["tracks"], files["calibration"], rate_hz=10.0)
    assert found.truth is found.labels is found.image_paths is None and not np.any(found.recording.odometry)


def test_truth_of_other_frames_is_refused(files, tmp_path):
    short = write_kitti(tmp_path / "k.txt", np.asarray(rendered().truth.robot)[:7])
    with pytest.raises(ValueError, match=r"k\.txt: 7 poses without times for 30 frames"):
        record_tables(files["tracks"], files["calibration"], rate_hz=10.0, truth_file=short)
    (tmp_path / "t.txt").write_text("1 2 3\n")
    with pytest.raises(ValueError, match=r"t\.txt: 3 words in its first line; TUM's format has 8 numbers, KITTI's 12"):
        record_tables(files["tracks"], files["calibration"], rate_hz=10.0, truth_file=tmp_path / "t.txt")


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_labels_come_back(tmp_path, ending):
    labels = TrackLabels(np.array([5, 0, 2**31 - 1]), np.array([-1, 1, 2]))
    found = read_labels(write_labels(tmp_path / f"l.{ending}", labels))
    for one, other in zip(found, labels, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("3,0\n-1,0\n", "line 3, column track_id: -1 is no identity"),
        ("2147483648,0\n", "line 2, column track_id: 2147483648 is no identity"),
        ("3,4\n", "line 2, column label: 4 is none; give one of -1 UNKNOWN, 0 STATIC, 1 MOVING, 2 BAD"),
        ("3,1\n4,0\n3,1\n", "line 4, column track_id: 3 is there twice"),
        ("3,moving\n", "line 2, column label: 'moving' is not a whole number"),
        ("3,\n", "line 2, column label: '' is not a whole number"),
        ("3,nan\n", "line 2, column label: 'nan' is not"),
        ("3\n", "line 2: 1 cells, but the header names 2 columns"),
    ],
)
def test_bad_labels_are_refused_by_their_place(tmp_path, rows, message):
    (tmp_path / "l.csv").write_text(f"track_id,label\n{rows}")
    with pytest.raises(ValueError, match=message):
        read_labels(tmp_path / "l.csv")
