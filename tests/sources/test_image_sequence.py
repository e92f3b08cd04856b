"""Image sequences: images as they were taken or refused by file, and the truth in each frame."""

import numpy as np
import pytest
from pictures import CALIBRATION, picture, poses_at, write_images
from scipy.spatial.transform import Rotation

from vcjax.sources.image_sequence import (
    ImageSequence,
    PoseTruth,
    camera_of_robot,
    interpolated,
    record,
    robot_of_camera,
)
from vcjax.sources.layouts import plain_folder


def test_images_of_changing_size_are_refused_by_file(tmp_path):
    write_images([tmp_path / f"{t}.png" for t in range(3)])
    write_images([tmp_path / "x" / "0.png"], shape=(48, 65))
    (tmp_path / "x" / "0.png").rename(tmp_path / "1.png")
    with pytest.raises(ValueError, match=r"1\.png: 65 × 48 pixels, but the calibration is of 64 × 48"):
        record(plain_folder(tmp_path, CALIBRATION, 10.0))


def test_bad_images_are_refused_by_file(tmp_path):
    write_images([tmp_path / "0.png"])
    sequence = plain_folder(tmp_path, CALIBRATION, 10.0)
    whole = sequence.paths[0].read_bytes()
    for content, message in (
        (b"", r"0\.png: no image that can be read"),
        (b"hello", r"0\.png: no image that can be read"),
        (whole[:200], r"0\.png: the image is damaged"),
    ):
        sequence.paths[0].write_bytes(content)
        with pytest.raises(ValueError, match=message):
            sequence.read(0)
    sequence.paths[0].unlink()
    with pytest.raises(FileNotFoundError, match=r"0\.png: no such image"):
        sequence.read(0)


def test_image_that_states_a_huge_size_is_not_decoded(tmp_path):
    write_images([tmp_path / "0.png"])
    path = tmp_path / "0.png"
    content = bytearray(path.read_bytes())
    content[16:24] = (30_000).to_bytes(4, "big") * 2
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"0\.png: (30000 × 30000 pixels, but|no image that can be read)"):
        plain_folder(tmp_path, CALIBRATION, 10.0).read(0)


@pytest.mark.parametrize("options", [{"dtype": np.uint16}, {"shape": (48, 64, 3)}, {"shape": (48, 64, 4)}])
def test_deep_and_coloured_images_become_grey(tmp_path, options):
    write_images([tmp_path / "0.png"], **options)
    image = plain_folder(tmp_path, CALIBRATION, 10.0).read(0)
    assert image.dtype == np.uint8 and image.shape == (48, 64)
    if "dtype" in options:
        np.testing.assert_allclose(image.astype(int), picture(0), atol=1)


def test_truth_between_its_poses():
    known = np.array([0.0, 1.0, 2.0, 9.0])
    truth = PoseTruth(known, poses_at(known), "robot")
    at = np.array([-0.1, 0.0, 0.25, 1.5, 5.0, 9.0, 9.1])
    found = interpolated(truth, at, 1.0)
    is_known = np.array([False, True, True, True, False, True, False])
    expected = poses_at(at[is_known])
    np.testing.assert_allclose(found[is_known, :3], expected[:, :3], atol=1e-12)
    same = np.abs(np.sum(found[is_known, 3:] * expected[:, 3:], axis=1))  # q and -q are one rotation
    np.testing.assert_allclose(same, 1.0, atol=1e-12)
    assert np.all(np.isnan(found[~is_known]))


def test_sequences_that_do_not_fit_are_refused(tmp_path):
    paths = (tmp_path / "a.png", tmp_path / "b.png")
    with pytest.raises(ValueError, match="2 images, but 3 times"):
        ImageSequence(paths, np.arange(3.0), CALIBRATION)
    with pytest.raises(ValueError, match=r"0\.0 s, of .*b\.png, is not above"):
        ImageSequence(paths, np.zeros(2), CALIBRATION)


def test_poses_of_camera_and_robot_are_each_others():
    """By matrices, and back; what is not known stays so."""
    turns = Rotation.random(8, rng=0).as_quat(scalar_first=True)
    poses = np.column_stack([np.arange(24.0).reshape(8, 3), turns])
    robot, mount = poses[:4], poses[4:]
    robot[2] = np.nan

    def matrix(pose):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix(), pose[:3]
        return T

    camera = camera_of_robot(robot, mount)
    for t in (0, 1, 3):
        np.testing.assert_allclose(matrix(camera[t]), matrix(robot[t]) @ matrix(mount[t]), atol=1e-12)
    assert np.isnan(camera[2]).all()
    back = robot_of_camera(camera, mount)
    back[:, 3:] *= np.sign(np.sum(back[:, 3:] * robot[:, 3:], axis=1, keepdims=True))
    np.testing.assert_allclose(back, robot, atol=1e-12)
