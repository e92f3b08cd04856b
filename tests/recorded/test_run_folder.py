"""The folder of a run: read back as it was written, refused where it is damaged, and never half of two runs."""

import json

import numpy as np
import pytest
import recorded

from vcjax.recorded.run_folder import camera_poses, check_place, new_run, read_run, robot_poses
from vcjax.recorded.run_summary import run_summary
from vcjax.recorded.verdicts import track_verdicts, verdicts
from vcjax.sources.map_file import read_map
from vcjax.sources.trajectory_file import read_kitti, read_tum


def write(folder, table="csv", **changes):
    """Write the rendered run."""
    filtered, recording = recorded.run(), recorded.content().recording
    passed = verdicts(filtered.info)
    tracks = track_verdicts(passed, filtered.info)
    summary = run_summary(recorded.config(), recording, filtered, tracks) | {"recording": "a.npz"} | changes
    with new_run(folder, recording, filtered, passed, tracks, summary, table) as new:
        (new / "features").mkdir()
        (new / "features" / "000003.png").write_bytes(b"picture")
    return passed, tracks


@pytest.mark.parametrize("table", ["csv", "parquet"])
def test_all_comes_back(tmp_path, table):
    passed, tracks = write(tmp_path / "run", table)
    found = read_run(tmp_path / "run")
    info, recording = recorded.run().info, recorded.content().recording
    np.testing.assert_array_equal(found.time_s, recording.time_s)
    np.testing.assert_allclose(found.robot, info.vehicle[:, :7], atol=1e-12)
    for one, other in zip(found.tracks, tracks, strict=True):
        np.testing.assert_array_equal(one, other)
    assert found.summary["recording"] == "a.npz" and found.summary["frames"] == 30
    landmarks = read_map(tmp_path / "run" / f"landmarks.{table}")
    np.testing.assert_array_equal(landmarks.track_id, recorded.run().landmarks.track_id)
    called = set(tracks.track_id[tracks.is_called].tolist())
    for track, kind in zip(landmarks.track_id.tolist(), landmarks.kind, strict=True):
        assert (kind == "dynamic") == (track in called)
    if table == "csv":
        lines = (tmp_path / "run" / "verdicts.csv").read_text().splitlines()
        assert (
            lines[0].replace('"', "") == "frame,track_id,re1,re2,margin,verdict" and len(lines) == len(passed.frame) + 1
        )


def test_trajectories_are_of_robot_and_camera(tmp_path):
    write(tmp_path)
    info = recorded.run().info
    for name, poses in (("robot", robot_poses(info)), ("camera", camera_poses(info))):
        time_s, tum = read_tum(tmp_path / f"{name}_tum.txt")
        kitti = read_kitti(tmp_path / f"{name}_kitti.txt")
        assert len(time_s) == 30
        np.testing.assert_allclose(tum, poses, atol=1e-12)
        np.testing.assert_allclose(kitti[:, :3], poses[:, :3], atol=1e-12)
        assert np.allclose(np.abs(np.sum(kitti[:, 3:] * poses[:, 3:], axis=1)), 1.0)
    # Camera centre by the rotation matrix of the robot's quaternion, written out.
    w, x, y, z = info.vehicle[-1, 3:7]
    R = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    centre = info.vehicle[-1, :3] + R @ info.vehicle[-1, 7:10]
    np.testing.assert_allclose(camera_poses(info)[-1, :3], centre, atol=1e-9)


def contents(folder) -> dict:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.usefixtures("unchecked")
def test_a_run_that_fails_leaves_the_one_before(tmp_path):
    folder = tmp_path / "run"
    write(folder)
    before = contents(folder)
    with pytest.raises(ValueError, match=r"not finite from frame 7 on; nothing is written to .*run"):
        write(folder, first_failure=7)
    filtered, recording = recorded.run(), recorded.content().recording
    passed = verdicts(filtered.info)
    with pytest.raises(RuntimeError), new_run(
        folder, recording, filtered, passed, track_verdicts(passed, filtered.info), {"first_failure": None}, "csv"
    ):  # fmt: skip
        raise RuntimeError("no more of this")
    assert contents(folder) == before and [p.name for p in tmp_path.iterdir()] == ["run"]


def test_files_of_an_earlier_run_give_way_and_others_stay(tmp_path):
    write(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "features" / "000099.png").write_bytes(b"of a longer run")
    (tmp_path / "features.gif").write_bytes(b"of an earlier run")
    write(tmp_path, "parquet")
    found = contents(tmp_path)
    assert found["notes.txt"] == b"mine" and "features/000003.png" in found
    assert not {"features/000099.png", "features.gif", "tracks.csv", "verdicts.csv", "landmarks.csv"} & set(found)
    assert not [name for name in found if "tmp" in name]


@pytest.mark.parametrize("name", ["tracks.csv", "tracks.parquet", "path.png", "features/000003.png", "summary.json"])
def test_files_that_no_run_has_written_are_in_the_way(tmp_path, name):
    """Until they are a run's: by its summary, or by what is left of one that was stopped."""
    (tmp_path / "features").mkdir()
    (tmp_path / "features" / "1_mine.png").write_bytes(b"mine")
    check_place(tmp_path)
    (tmp_path / name).write_text("{}")
    with pytest.raises(FileExistsError, match=rf"{name} is in the way of the run's, and no run has written it"):
        check_place(tmp_path)
    (tmp_path / "unfinished").mkdir()
    (tmp_path / "unfinished" / "state.npz").write_bytes(b"")
    check_place(tmp_path)
    (tmp_path / "unfinished" / "state.npz").unlink()
    (tmp_path / ".filling.abc.tmp").mkdir()
    check_place(tmp_path)
    write(tmp_path)
    check_place(tmp_path)
    assert (tmp_path / "features" / "1_mine.png").read_bytes() == b"mine"


@pytest.mark.parametrize("name", ["features", "unfinished"])
def test_a_file_in_place_of_a_folder_is_found_before_the_run(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(NotADirectoryError, match=f"{name} is a file"):
        check_place(tmp_path)


BAD = {
    "no summary": ("summary.json", None, "no complete run here"),
    "half a summary": ("summary.json", b'{"frames": 3', "no summary of a run"),
    "a list": ("summary.json", b"[1]", "no JSON object"),
    "no text": ("summary.json", b"\xff\xfe", "no summary of a run"),
    "no path": ("robot_tum.txt", None, "no such file"),
    "half a path": ("robot_tum.txt", b"1 2 3 4\n", "4 words, but 8 numbers"),
    "NaN in the path": ("robot_tum.txt", b"1 nan 0 0 0 0 0 1\n", "'nan' is not a finite number"),
    "no tracks": ("tracks.csv", None, r"tracks\.csv: no such file"),
    "other columns": ("tracks.csv", b"track_id,margin\n1,2\n", "no column accepted"),
    "negative id": ("tracks.csv", b"{head}-1,0,0,0,0,0,0,1,1\n", "line 2, column track_id: -1 is below 0"),
    "negative count": ("tracks.csv", b"{head}1,0,0,-2,0,0,0,1,1\n", "line 2, column dynamic: -2 is below 0"),
    "track twice": (
        "tracks.csv",
        b"{head}1,0,0,0,0,0,0,1,1\n1,0,0,0,0,0,0,1,1\n",
        "line 3, .*not above the one before",
    ),
    "infinite": ("tracks.csv", b"{head}1,0,0,0,0,0,0,inf,1\n", "line 2, column margin: inf"),
    "half a count": ("tracks.csv", b"{head}1,0,0.5,0,0,0,0,1,1\n", "'0.5' is not a whole number"),
}


@pytest.mark.parametrize(("name", "content", "message"), BAD.values(), ids=BAD)
def test_damaged_folder_is_refused_by_file_and_place(tmp_path, name, content, message):
    write(tmp_path)
    head = b"track_id,accepted,recovered,dynamic,rejected,suspect,deleted,margin,detector_margin\n"
    if content is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_bytes(content.replace(b"{head}", head))
    with pytest.raises((ValueError, FileNotFoundError), match=message) as refusal:
        read_run(tmp_path)
    assert str(tmp_path) in str(refusal.value)


def test_summary_is_json_without_what_json_does_not_know(tmp_path):
    write(tmp_path, nis=float("nan"))
    assert json.loads((tmp_path / "summary.json").read_text())["nis"] is None
