"""Layouts of data sets: small ones made here are read as they were meant, bad ones refused by file and line."""

import tracemalloc

import cv2
import numpy as np
import pytest
from pictures import CALIBRATION, picture, poses_at, write_images
from scipy.spatial.transform import Rotation

from vcjax.sources.calibration import write_calibration
from vcjax.sources.layouts import euroc, kitti_odometry, plain_folder, tum_rgbd
from vcjax.sources.table_file import write_table
from vcjax.sources.trajectory_file import write_kitti, write_tum


@pytest.fixture
def tum(tmp_path):
    write_images([tmp_path / f"rgb/{t}.png" for t in range(4)], shape=(48, 64, 3))
    rows = "".join(f"{100 + 0.1 * t:.4f} rgb/{t}.png\n" for t in range(4))
    (tmp_path / "rgb.txt").write_text("# color images\n# file: 'a.bag'\n# timestamp filename\n" + rows)
    time_s = 100 + np.arange(-5, 30) * 0.01
    write_tum(tmp_path / "groundtruth.txt", time_s, poses_at(time_s))
    return tmp_path


def test_tum_rgbd(tum):
    sequence = tum_rgbd(tum, CALIBRATION)
    np.testing.assert_allclose(sequence.time_s, [100.0, 100.1, 100.2, 100.3])
    expected = cv2.cvtColor(picture(2, (48, 64, 3)), cv2.COLOR_BGR2GRAY)
    np.testing.assert_allclose(sequence.read(2).astype(int), expected, atol=1)
    assert sequence.truth is not None and sequence.truth.of == "camera"
    # The camera looks along the robot's x axis: turned back by the mount it is where the camera is.
    robot = sequence.true_robot_poses()
    np.testing.assert_allclose(robot[:3, :3], poses_at(sequence.time_s)[:3, :3], atol=1e-9)
    mount = Rotation.from_quat(CALIBRATION.T_r_s[3:], scalar_first=True)
    found = Rotation.from_quat(robot[:3, 3:], scalar_first=True) * mount
    expected = Rotation.from_rotvec(np.outer(sequence.time_s[:3], [0, 0, 0.5]))
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-9)
    assert np.all(np.isnan(robot[3]))  # the truth ended 0.01 s before
    (tum / "groundtruth.txt").unlink()
    assert tum_rgbd(tum, CALIBRATION).true_robot_poses() is None


BAD_TUM = {
    "words": ("100.0 rgb/0.png more\n", r"rgb\.txt, line 1: 3 words; a time and a file are needed"),
    "time": ("noon rgb/0.png\n", r"rgb\.txt, line 1: 'noon' is not a finite number"),
    "NaN": ("# a\nnan rgb/0.png\n", r"rgb\.txt, line 2: 'nan' is not"),
    "out": ("100.0 ../secret.png\n", r"line 1: '\.\./secret\.png' leads out of the data set"),
    "absolute": ("100.0 /etc/passwd\n", "line 1: '/etc/passwd' leads out"),
    "back": ("100.0 rgb/0.png\n# a\n99.0 rgb/1.png\n", r"rgb\.txt, line 3: time 99\.0 s is not above the one before"),
    "none": ("# nothing\n", r"rgb\.txt: no line; give the time of each image"),
}


@pytest.mark.parametrize(("content", "message"), BAD_TUM.values(), ids=BAD_TUM)
def test_bad_list_of_images_is_refused_by_line(tum, content, message):
    (tum / "rgb.txt").write_text(content)
    with pytest.raises(ValueError, match=message):
        tum_rgbd(tum, CALIBRATION)


SENSOR = """
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02,
         1.0, 0.0, 0.0, -0.06,
         0.0, 0.0, 1.0, 0.01,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51, 32.0, 24.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
STATES = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], "
    "q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]\n"
)


@pytest.fixture
def asl(tmp_path):
    times = [1403636579763555584 + 50_000_000 * t for t in range(4)]
    write_images([tmp_path / f"mav0/cam0/data/{time}.png" for time in times])
    rows = "".join(f"{time},{time}.png\r\n" for time in times)
    (tmp_path / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\r\n" + rows, newline="")
    (tmp_path / "mav0/cam0/sensor.yaml").write_text(SENSOR)
    states = tmp_path / "mav0/state_groundtruth_estimate0/data.csv"
    states.parent.mkdir()
    time_s = np.arange(0.05, 0.2, 0.005)
    rows = [
        f"{times[0] + round(t * 1e9)},{','.join(map(str, p))},7.0\n"
        for t, p in zip(time_s, poses_at(time_s), strict=True)
    ]
    states.write_text(STATES + "".join(rows))
    return tmp_path


def test_euroc(asl):
    for folder in (asl, asl / "mav0"):
        sequence = euroc(folder)
        np.testing.assert_allclose(np.diff(sequence.time_s), 0.05, atol=1e-6)
        np.testing.assert_array_equal(sequence.read(1), picture(1))
        calibration = sequence.calibration
        assert (calibration.fx, calibration.fy, calibration.width) == (50.0, 51.0, 64)
        assert calibration.distortion_model == "radial_tangential" and calibration.distortion[0] == -0.28340811
        np.testing.assert_allclose(calibration.T_r_s, [-0.02, -0.06, 0.01, *np.sqrt([0.5, 0, 0, 0.5])], atol=1e-12)
        robot = sequence.true_robot_poses()
        assert np.all(np.isnan(robot[0]))  # the estimate begins later
        np.testing.assert_allclose(robot[1:], poses_at(np.array([0.05, 0.1, 0.15])), atol=1e-6)


BAD_EUROC = {
    "no resolution": ("resolution: [64, 48]", "", r"sensor\.yaml: KeyError 'resolution'; needed are resolution"),
    "other model": ("radial-tangential", "omnidirectional", "KeyError 'omnidirectional'"),
    "word": ("[50.0,", "[wide,", "could not convert string to float"),
    "no rotation": ("0.0, -1.0, 0.0", "0.0, -2.0, 0.0", r"sensor\.yaml, T_BS: its 3 × 3 part is no rotation"),
    "no YAML": ("resolution: [64", "resolution: [64 }", "needed are resolution"),
    "object": ("cam0 (MT9M034)", "\nx: !!python/object/apply:os.system ['false']", "ConstructorError"),
    "aliases": ("  cols: 4\n", "  cols: &a [0.0]\n  rest: [*a, *a]\n", r"sensor\.yaml: ValueError an alias \(\*\)"),
    "coefficients": (", 0.00019359, 1.76187114e-05", "", r"Calibration\(distortion=.*: give 4 or 5 or 8"),
}


@pytest.mark.parametrize(("old", "new", "message"), BAD_EUROC.values(), ids=BAD_EUROC)
def test_bad_sensor_file_is_refused_by_its_key(asl, old, new, message):
    assert old in SENSOR
    (asl / "mav0/cam0/sensor.yaml").write_text(SENSOR.replace(old, new))
    with pytest.raises(ValueError, match=message) as refusal:
        euroc(asl)
    assert "sensor.yaml" in str(refusal.value)


def test_bad_euroc_tables_are_refused_by_line(asl):
    states = asl / "mav0/state_groundtruth_estimate0/data.csv"
    good = states.read_text()
    for bad, message in (
        (STATES + "1403636579763555584,0,0,0,1,0,0,x,0\n", r"line 2, column q_RS_z \[\]: 'x' is not a finite"),
        (STATES + "1403636579763555584,0,0,0,2,0,0,0,0\n", r"line 2, column q_RS_w \[\]: 2\.0 begins a quaternion"),
    ):
        states.write_text(bad)
        with pytest.raises(ValueError, match=message):
            euroc(asl)
    states.write_text(good)
    (asl / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n14036.5,a.png\n")
    with pytest.raises(ValueError, match=r"cam0/data\.csv, line 2: a time in ns and a file are needed"):
        euroc(asl)
    for content, message in (
        (f"{'9' * 400},a.png\n", "data\\.csv, line 1: a time in ns and a file are needed"),
        ("2000000000,a.png\n# a\n1000000000,b.png\n", "data\\.csv, line 3: time 1.0 s is not above the one before"),
        ("# nothing\n", "data\\.csv: no line; give the time of each image"),
    ):
        (asl / "mav0/cam0/data.csv").write_text(content)
        with pytest.raises(ValueError, match=message):
            euroc(asl)


def test_nested_aliases_take_no_memory(asl):
    """Ten lines of ten aliases each stand for 10¹⁰ numbers."""
    nested = "".join(f"k{i}: &k{i} [{', '.join([f'*k{i - 1}'] * 10)}]\n" for i in range(1, 10))
    bomb = (
        "k0: &k0 [1.0, 1.0]\n"
        + nested
        + SENSOR.replace(SENSOR[SENSOR.index("[0.0, -1.0") : SENSOR.index("rate")], "*k9\n")
    )
    (asl / "mav0/cam0/sensor.yaml").write_text(bomb)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"sensor\.yaml: ValueError an alias"):
        euroc(asl)
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


@pytest.fixture
def kitti(tmp_path):
    folder = tmp_path / "sequences" / "07"
    for camera in (0, 1):
        write_images([folder / f"image_{camera}" / f"{t:06d}.png" for t in range(3)])
    (folder / "times.txt").write_text("0.0\n1.038e-01\n2.08e-01\n")
    row = "50 0 32 {} 0 51 24 0 0 0 1 0"
    (folder / "calib.txt").write_text(f"P0: {row.format(0)}\nP1: {row.format(-27)}\nTr: {row.format(0)}\n")
    (tmp_path / "poses").mkdir()
    write_kitti(tmp_path / "poses" / "07.txt", poses_at(np.array([0.0, 1, 2, 3])))
    return folder


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("calib.txt", "P0: 50", "P0: 0", r"calib\.txt, line 1: Calibration\(fx=0\.0\): a focal length is positive"),
        ("times.txt", "2.08e-01", "0.1", r"times\.txt, line 3: time 0\.1 s is not above the one before"),
    ],
)
def test_bad_kitti_files_are_refused_by_line(kitti, name, old, new, message):
    (kitti / name).write_text((kitti / name).read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        kitti_odometry(kitti)


def test_kitti_odometry(kitti):
    sequence = kitti_odometry(kitti)
    assert sequence.time_s.tolist() == [0.0, 0.1038, 0.208]
    assert (sequence.calibration.width, sequence.calibration.height, sequence.calibration.fy) == (64, 48, 51.0)
    np.testing.assert_allclose(sequence.truth.T_w_x, poses_at(np.array([0.0, 1, 2])), atol=1e-12)
    right = kitti_odometry(kitti, camera=1)
    offset = Rotation.from_rotvec([0, 0, 1.0]).apply([27 / 50, 0, 0])  # half a metre to the right, turned by 1 rad
    np.testing.assert_allclose(right.truth.T_w_x[2, :3], [2.0 + offset[0], offset[1], offset[2]], atol=1e-12)
    assert kitti_odometry(kitti, poses=kitti / "none.txt").truth is None
    (kitti / "times.txt").write_text("0.0\n0.1\n")
    with pytest.raises(ValueError, match=r"times\.txt: 2 times for 3 images"):
        kitti_odometry(kitti)
    with pytest.raises(FileNotFoundError, match="image_2: no such folder"):
        kitti_odometry(kitti, camera=2)
    (kitti / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(ValueError, match=r"calib\.txt, line 1: 3 numbers; P0 has 12"):
        kitti_odometry(kitti)


@pytest.mark.parametrize("inner", ["", "images"])
def test_plain_folder(tmp_path, inner):
    write_images([tmp_path / inner / f"{t:03d}.png" for t in range(3)])
    write_calibration(tmp_path / "calibration.json", CALIBRATION)
    with pytest.raises(ValueError, match=r"give times\.csv in the folder or rate_hz"):
        plain_folder(tmp_path)
    assert plain_folder(tmp_path, rate_hz=10.0).time_s.tolist() == [0.0, 0.1, 0.2]
    write_table(tmp_path / "times.csv", {"frame": [4, 5, 9], "time_s": [1.0, 1.5, 2.0]})
    sequence = plain_folder(tmp_path)
    assert sequence.time_s.tolist() == [1.0, 1.5, 2.0] and sequence.calibration == CALIBRATION
    assert [image.tobytes() for image in sequence.images()] == [picture(t).tobytes() for t in range(3)]
    part = sequence.part(1)
    assert len(part) == 2 and part.read(0).tobytes() == picture(1).tobytes()
    write_table(tmp_path / "times.csv", {"frame": [4, 5], "time_s": [1.0, 1.5]})
    with pytest.raises(ValueError, match=r"times\.csv: 2 times for 3 images"):
        plain_folder(tmp_path)


@pytest.mark.parametrize(
    "names",
    [
        [f"{t}.png" for t in range(12)],
        [f"b2_{t:02d}.png" for t in range(9, 12)],
        ["1305031102.175304.png", "1305031102.500000.png", "1305031103.000000.png"],  # times
        ["1403636579763555584.png", "1403636579763555585.png", "1403636580000000000.png"],
        ["01.jpg", "1.PNG", "1a.png", "a.png"],
        ["left-1.png", "left-2.png", "left-10.png", "right-1.png"],
    ],
)
def test_images_come_in_the_order_of_the_numbers_in_their_names(tmp_path, names):
    for name in (*reversed(names), ".hidden.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    found = [path.name for path in plain_folder(tmp_path, CALIBRATION, 1.0).paths]
    assert found == names


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ([f"cam0.{t}.png" for t in range(12)], r"cam0\.2\.png or cam0\.10\.png\?"),
        (["1305031102.175304.png", "1305031102.5.png"], r"1305031102\.5\.png or 1305031102\.175304\.png\?"),
    ],
)
def test_an_order_that_the_names_leave_open_is_refused(tmp_path, names, words):
    """A point between two whole numbers, or before decimals: nobody can tell."""
    for name in names:
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(ValueError, match=f"which comes first, {words} .* same count of digits") as refusal:
        plain_folder(tmp_path, CALIBRATION, 1.0)
    assert str(tmp_path) in str(refusal.value)


def test_folders_without_what_is_needed(tmp_path):
    with pytest.raises(FileNotFoundError, match="none: no such folder"):
        plain_folder(tmp_path / "none", CALIBRATION, 1.0)
    with pytest.raises(FileNotFoundError, match="no image in it"):
        plain_folder(tmp_path, CALIBRATION, 1.0)
    write_images([tmp_path / "a.png"])
    with pytest.raises(FileNotFoundError, match=r"calibration\.json: no such calibration"):
        plain_folder(tmp_path, rate_hz=1.0)
    with pytest.raises(FileNotFoundError, match=r"rgb\.txt: no such file"):
        tum_rgbd(tmp_path, CALIBRATION)
    with pytest.raises(FileNotFoundError, match=r"cam0/data\.csv: no such file"):
        euroc(tmp_path)
