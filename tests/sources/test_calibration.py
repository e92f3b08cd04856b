"""Calibration files: there and back, and refused by key and value."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import vcjax as vc
from vcjax.models.camera import project
from vcjax.sources.calibration import Calibration, read_calibration, write_calibration
from vcjax.sources.distortion import denormalise

GOOD = {"width": 640, "height": 480, "fx": 500, "fy": 501.5, "cx": 320, "cy": 240}


def test_there_and_back(tmp_path):
    calibration = Calibration(
        640, 480, 1 / 3, 2e2, -5.0, 1e-9, "equidistant", (0.1, 0.2, 0.3, 0.4), (1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0)
    )
    assert read_calibration(write_calibration(tmp_path / "c.json", calibration)) == calibration


def test_shortest_file_is_a_pinhole_that_looks_forward(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps(GOOD))
    found = read_calibration(tmp_path / "c.json")
    assert (found.fx, found.cx, found.distortion_model) == (500.0, 320.0, "none")
    np.testing.assert_array_equal(found.matrix, [[500, 0, 320], [0, 501.5, 240], [0, 0, 1]])
    assert found.T_r_s == (0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5)


@pytest.mark.parametrize("distortion", [(), (-0.1,), (-0.1, 0.02), (-0.1, 0.02, 0.003)])
def test_camera_of_a_simulation_is_the_same_camera(distortion):
    camera = vc.Camera((300.0, 250.0, 400.0, 410.0), (640.0, 480.0), distortion)
    point = np.array([0.3, -0.2, 1.0])
    found = denormalise(Calibration.from_camera(camera), point[None, :2])
    np.testing.assert_allclose(found[0], project(camera, jnp.asarray(point)), atol=1e-10)


def test_more_radial_terms_than_models_have_are_refused():
    with pytest.raises(ValueError, match="4 coefficients of distortion; give at most 3"):
        Calibration.from_camera(vc.Camera(distortion=(0.1, 0.1, 0.1, 0.1)))


BAD = {
    "no JSON": ("{", r"no JSON \(.*line 1"),
    "deep": ("[" * 100_000, "no JSON"),
    "list": ("[1, 2]", "give one JSON object with width"),
    "lacks": ({"fx": None}, "lacks fx"),
    "unknown": ({"focal": 3}, "unknown key 'focal'; known are width"),
    "word": ({"fx": "wide"}, r"Calibration\(fx='wide'\): give a finite number"),
    "NaN": ({"cx": float("nan")}, r"Calibration\(cx=nan\): give a finite"),
    "huge": ({"cy": 10**400}, r"Calibration\(cy=1000.*\): give a finite"),
    "truth": ({"fy": True}, r"Calibration\(fy=True\): give a finite"),
    "negative": ({"fy": -3}, r"Calibration\(fy=-3.*\): a focal length is positive"),
    "no size": ({"width": 0}, r"Calibration\(width=0\): give a whole number of pixels from 1"),
    "half a pixel": ({"height": 480.5}, r"Calibration\(height=480.5\): give a whole number"),
    "gigantic": ({"height": 10**6}, r"Calibration\(height=1000000\): give a whole number .* to 32768"),
    "model": ({"distortion_model": "fov"}, r"distortion_model='fov'\): choose one of none, radial_tangential"),
    "list for model": ({"distortion_model": []}, r"distortion_model=\(\)\): choose"),
    "too few": ({"distortion_model": "equidistant", "distortion": [1, 2]}, r"\(1, 2\)\): give 4 finite numbers"),
    "coefficients of none": ({"distortion": [0.1]}, r"distortion=\(0.1,\)\): give 0 finite"),
    "not numbers": ({"distortion_model": "wide_angle", "distortion": ["a"]}, r"\('a',\)\): give 1 finite"),
    "matrix": ({"T_r_s": [[1, 0], [0, 1]]}, "give 7 finite numbers"),
    "quaternion": ({"T_r_s": [0, 0, 0, 1, 1, 0, 0]}, r"a quaternion \(w, x, y, z\) of length 1"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("content", "message"), BAD.values(), ids=BAD)
def test_bad_file_is_refused_by_key_and_value(tmp_path, content, message):
    path = tmp_path / "c.json"
    if isinstance(content, dict):
        content = json.dumps({k: v for k, v in (GOOD | content).items() if v is not None})
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as refusal:
        read_calibration(path)
    assert str(path) in str(refusal.value)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.json: no such calibration file"):
        read_calibration(tmp_path / "none.json")
    (tmp_path / "c.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"c\.json: .*utf-8"):
        read_calibration(tmp_path / "c.json")
    (tmp_path / "c.json").write_bytes(b" " * (2**20 + 1))
    with pytest.raises(ValueError, match="larger than a calibration can be"):
        read_calibration(tmp_path / "c.json")
