"""Trajectory files: there and back, by hand, and as another tool reads them."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vcjax.sources.trajectory_file import read_kitti, read_tum, write_kitti, write_tum


def drawn(seed, num=7):
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.normal(size=(num, 3)) * 100, Rotation.random(num, rng).as_quat(scalar_first=True)])
    return 1.4e9 + np.cumsum(rng.random(num) + 1e-3), poses


@given(st.integers(0, 2**32 - 1))
def test_tum_comes_back_bit_for_bit(tmp_path_factory, seed):
    time_s, poses = drawn(seed)
    found = read_tum(write_tum(tmp_path_factory.mktemp("tum") / "t.txt", time_s, poses))
    assert found[0].tobytes() == time_s.tobytes() and found[1].tobytes() == poses.tobytes()


@given(st.integers(0, 2**32 - 1))
def test_kitti_comes_back_but_for_the_sign_of_quaternions(tmp_path_factory, seed):
    _, poses = drawn(seed)
    found = read_kitti(write_kitti(tmp_path_factory.mktemp("kitti") / "t.txt", poses))
    np.testing.assert_array_equal(found[:, :3], poses[:, :3])
    np.testing.assert_allclose(np.abs(np.sum(found[:, 3:] * poses[:, 3:], axis=1)), 1.0, atol=1e-12)


def test_formats_by_hand(tmp_path):
    """A quarter turn to the left about z, at (1, 2, 3)."""
    poses = np.array([[1.0, 2.0, 3.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]])
    words = write_tum(tmp_path / "t.txt", np.array([5.5]), poses).read_text().split()
    np.testing.assert_allclose([float(word) for word in words], [5.5, 1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    words = write_kitti(tmp_path / "k.txt", poses).read_text().split()
    np.testing.assert_allclose([float(word) for word in words], [0, -1, 0, 1, 1, 0, 0, 2, 0, 0, 1, 3], atol=1e-15)


def test_comments_and_spaces_are_left_out(tmp_path):
    (tmp_path / "t.txt").write_text("# time x y z\n\n 1 0 0 0  0 0 0 1 \r\n#\n2\t0 0 0 0 0 0.0001 1\n")
    time_s, poses = read_tum(tmp_path / "t.txt")
    assert time_s.tolist() == [1, 2] and poses[0].tolist() == [0, 0, 0, 1, 0, 0, 0]
    assert np.linalg.norm(poses[1, 3:]) == pytest.approx(1.0, abs=1e-12)


BAD = {
    "word": ("1 0 0 0 0 0 0 1\n2 0 zero 0 0 0 0 1\n", "line 2, column 3: 'zero' is not a finite number"),
    "NaN": ("# x\n1 0 0 0 0 0 0 nan\n", "line 2, column 8: 'nan' is not a finite"),
    "short": ("1 0 0 0 0 0 0\n", "line 1: 7 words, but 8 numbers are needed"),
    "back": ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", r"line 2: time 1\.0 is not above the one before"),
    "long": ("2 0 0 0 0 0 0 1\n\n3 0 0 0 0 0 1 1\n", r"line 3: the quaternion has length 1\.41, not 1"),
    "no text": (b"\xff\xfe\xfa", "no text"),
}


@pytest.mark.parametrize(("content", "message"), BAD.values(), ids=BAD)
def test_bad_trajectory_is_refused_by_line_and_column(tmp_path, content, message):
    path = tmp_path / "t.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as refusal:
        read_tum(path)
    assert str(path) in str(refusal.value)


def test_bad_matrices_are_refused(tmp_path):
    path = tmp_path / "k.txt"
    for R in ("1 0 0 0 0 1 0 0 0 0 -1 0", "2 0 0 0 0 2 0 0 0 0 2 0", "0 " * 12):
        path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" + R)
        with pytest.raises(ValueError, match=r"k\.txt, line 2: its 3 × 3 part is no rotation"):
            read_kitti(path)
    with pytest.raises(FileNotFoundError, match=r"none\.txt: no such file"):
        read_kitti(tmp_path / "none.txt")


@pytest.mark.usefixtures("unchecked")
def test_what_is_no_trajectory_is_not_written(tmp_path):
    time_s, poses = drawn(0)
    path = write_tum(tmp_path / "t.txt", time_s, poses)
    before = path.read_bytes()
    poses[3, 4] = np.nan
    with pytest.raises(ValueError, match=r"write_tum\(T_a_b\[3, 4\] = nan\): must be finite"):
        write_tum(path, time_s, poses)
    with pytest.raises(ValueError, match=r"write_kitti\(T_a_b\[3, 4\] = nan\)"):
        write_kitti(path, poses)
    with pytest.raises(ValueError, match=r"write_tum\(time_s\) has shape \(6,\); give the time of each of 7"):
        write_tum(path, time_s[1:], np.nan_to_num(poses))
    assert path.read_bytes() == before


def test_evo_reads_both(tmp_path):
    """In a process of its own: it writes settings into the home folder and changes those of matplotlib."""
    pytest.importorskip("evo", reason="needs evo")
    time_s, poses = drawn(0, 20)
    write_tum(tmp_path / "t.txt", time_s, poses)
    write_kitti(tmp_path / "k.txt", poses)
    script = """
import json, sys
from evo.tools import file_interface
tum = file_interface.read_tum_trajectory_file(sys.argv[1])
kitti = file_interface.read_kitti_poses_file(sys.argv[2])
print(json.dumps([tum.check()[0], kitti.check()[0], tum.timestamps.tolist(), tum.positions_xyz.tolist(),
                  tum.orientations_quat_wxyz.tolist(), [pose.tolist() for pose in kitti.poses_se3]]))
"""
    command = [sys.executable, "-c", script, str(tmp_path / "t.txt"), str(tmp_path / "k.txt")]
    environment = os.environ | {"HOME": str(tmp_path), "MPLBACKEND": "agg"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    is_tum, is_kitti, times, places, quaternions, matrices = json.loads(done.stdout.splitlines()[-1])
    assert is_tum and is_kitti
    np.testing.assert_array_equal(times, time_s)
    np.testing.assert_array_equal(places, poses[:, :3])
    np.testing.assert_array_equal(quaternions, poses[:, 3:])
    R = Rotation.from_quat(poses[:, 3:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(np.array(matrices)[:, :3, :3], R, atol=1e-12)
    np.testing.assert_array_equal(np.array(matrices)[:, :3, 3], poses[:, :3])
