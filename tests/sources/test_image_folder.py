"""Folders of images, by what lies in them."""

import numpy as np
import pytest
from pictures import CALIBRATION, write_images

from vcjax.sources.calibration import write_calibration
from vcjax.sources.image_folder import layout_of, read_sequence


def tum(folder):
    paths = [folder / "rgb" / f"{t}.png" for t in range(3)]
    write_images(paths)
    (folder / "rgb.txt").write_text("".join(f"{t / 10} rgb/{t}.png\n" for t in range(3)))


def kitti(folder):
    write_images([folder / "image_0" / f"{t:06d}.png" for t in range(3)])
    (folder / "times.txt").write_text("0\n0.1\n0.2\n")
    (folder / "calib.txt").write_text("P0: 50 0 32 0 0 51 24 0 0 0 1 0\n")


def euroc(folder):
    write_images([folder / "mav0" / "cam0" / "data" / f"{t}.png" for t in (0, 100000000)])
    (folder / "mav0" / "cam0" / "data.csv").write_text("#timestamp [ns],filename\n0,0.png\n100000000,100000000.png\n")
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(
        "resolution: [64, 48]\nintrinsics: [50, 51, 32, 24]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [0, 0, 0, 0]\nT_BS:\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    )


def plain(folder):
    write_images([folder / f"{t}.png" for t in range(3)])


@pytest.fixture
def calibration(tmp_path):
    return write_calibration(tmp_path / "calibration.json", CALIBRATION)


@pytest.mark.parametrize(
    ("layout", "make", "num"), [("tum", tum, 3), ("kitti", kitti, 3), ("euroc", euroc, 2), ("plain", plain, 3)]
)
def test_layout_is_found_out(tmp_path, calibration, layout, make, num):
    folder = tmp_path / "sequence"
    make(folder)
    assert layout_of(folder) == layout
    needs = {"calibration_file": calibration} if layout in ("tum", "plain") else {}
    needs |= {"rate_hz": 10.0} if layout == "plain" else {}
    found = read_sequence(folder, **needs)
    assert len(found) == num and found.calibration.fx == 50
    np.testing.assert_allclose(np.diff(found.time_s), 0.1)
    assert len(read_sequence(folder, layout, **needs)) == num
    if layout == "euroc":
        assert layout_of(folder / "mav0") == "euroc" and len(read_sequence(folder / "mav0")) == num


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (tum, {}, "the layout tum states no calibration; give a calibration file"),
        (tum, {"calibration_file": "c", "rate_hz": 3.0}, r"tum states the time of each image; leave out the rate 3\.0"),
        (tum, {"calibration_file": "c", "camera": 1}, "the layout tum has one camera, 0, and not 1"),
        (kitti, {"calibration_file": "c"}, "the layout kitti states its calibration itself; leave out"),
        (kitti, {"camera": 1}, "image_1: no such folder"),
        (euroc, {"rate_hz": 3.0}, "the layout euroc states the time of each image"),
        (plain, {"calibration_file": "c"}, r"give times\.csv in the folder or rate_hz"),
        (plain, {"rate_hz": 3.0}, r"calibration\.json: no such calibration file"),
        (plain, {"layout": "kitti"}, "image_0: no such folder"),
    ],
)
def test_what_a_layout_has_or_lacks_is_said(tmp_path, calibration, make, options, message):
    make(tmp_path / "sequence")
    options = options | ({"calibration_file": calibration} if "calibration_file" in options else {})
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        read_sequence(tmp_path / "sequence", **options)


def test_no_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        layout_of(tmp_path / "nowhere")
