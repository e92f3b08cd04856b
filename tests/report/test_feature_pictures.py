"""Pictures of features: the colours are where the features are, and tell what was said of them."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import recorded

import vcjax as vc
from vcjax.recorded.verdicts import Verdicts, verdicts
from vcjax.report.feature_pictures import _LEGEND_PX, STATUSES, FeaturePictures
from vcjax.report.path_view import path_figure
from vcjax.sources.map_file import CLASS_COLOURS, LandmarkMap
from vcjax.sources.tracks import tracks_of


def passed() -> Verdicts:
    return verdicts(recorded.run().info)


def drawn(content=None) -> FeaturePictures:
    return FeaturePictures(content or recorded.content(), passed(), recorded.recording_path().parent, width_px=640)


def rgb(picture) -> np.ndarray:
    return np.asarray(picture.convert("RGB"))


def around(image, uv_px, scale) -> set:
    """Colours within 8 pixels of a feature."""
    u, v = np.rint((np.asarray(uv_px) + 0.5) * scale).astype(int)
    v += _LEGEND_PX
    return {tuple(map(int, c)) for c in image[max(v - 8, 0) : v + 9, max(u - 8, 0) : u + 9].reshape(-1, 3)}


def test_each_feature_has_the_colour_of_its_verdict():
    pictures, told = drawn(), passed()
    content = recorded.content()
    tracks = tracks_of(content.recording, content.calibration)
    seen = set()
    for t in range(30):
        image = rgb(pictures.picture(t))
        assert image.shape == (480 + _LEGEND_PX, 640, 3)
        for row in np.flatnonzero((told.frame == t) & (told.verdict < 3)):
            uv_px = tracks.uv_px[(tracks.frame == t) & (tracks.track_id == told.track_id[row])]
            if len(uv_px):
                name = STATUSES[told.verdict[row]]
                assert CLASS_COLOURS[name] in around(image, uv_px[0], 2), (t, name)
                seen.add(name)
    assert seen >= {"accepted", "dynamic"}


def test_what_was_called_dynamic_is_remembered():
    pictures, told = drawn(), passed()
    row = np.flatnonzero(told.verdict == 2)[0]
    t, track = int(told.frame[row]), told.track_id[row]
    tracks = tracks_of(recorded.content().recording)

    def of(frame):
        ids = np.sort(tracks.track_id[tracks.frame == frame])
        return pictures.seen(frame).was_dynamic[np.flatnonzero(ids == track)]

    assert not of(t).any() and of(t + 1).all()
    assert len(pictures.seen(t).status) == (tracks.frame == t).sum()


def test_the_image_is_there():
    """Greys of the picture are those of the image, where nothing is drawn."""
    picture = rgb(drawn().picture(0, 1.0))[_LEGEND_PX:]
    image = cv2.imread(recorded.content().image_paths[0], cv2.IMREAD_GRAYSCALE)
    is_grey = (picture[..., 0] == picture[..., 1]) & (picture[..., 1] == picture[..., 2])
    assert is_grey.mean() > 0.8
    assert np.mean(np.abs(picture[..., 0].astype(int) - image)[is_grey] <= 2) > 0.85


def test_plain_axes_without_images():
    content = recorded.content()._replace(image_paths=None)
    image = rgb(drawn(content).picture(0))
    assert image.shape == (480 + _LEGEND_PX, 640, 3) and np.median(image) == 255
    told = recorded.content()._replace(image_paths=("nowhere.png",) * 30)
    pictures = drawn(told)
    np.testing.assert_array_equal(rgb(pictures.picture(0)), image)
    assert pictures.unread == {0: f"{recorded.recording_path().parent / 'nowhere.png'}: no such image."}


def test_a_camera_of_any_shape_is_drawn_small():
    """No file asks for a picture that memory does not hold."""
    content = recorded.content()
    for size in ((1.0, 32768.0), (32768.0, 1.0)):
        recording = dataclasses.replace(content.recording, camera=vc.Camera(image_size_px=size))
        pictures = drawn(content._replace(recording=recording, image_paths=None, calibration=None))
        assert max(pictures.picture(0).size) <= 8192 + _LEGEND_PX
        assert max(pictures.picture(0, 640 / 32768).size) <= 640 + _LEGEND_PX


def test_images_that_cannot_be_read_are_told_and_the_others_drawn(tmp_path):
    small, damaged = tmp_path / "small.png", tmp_path / "damaged.png"
    cv2.imwrite(str(small), np.zeros((10, 20), np.uint8))
    damaged.write_bytes(Path(recorded.content().image_paths[2]).read_bytes()[:2000])
    good = recorded.content().image_paths
    pictures = drawn(recorded.content()._replace(image_paths=(good[0], str(small), str(damaged), *good[3:])))
    assert [np.median(rgb(pictures.picture(t))) == 255 for t in range(4)] == [False, True, True, False]
    assert set(pictures.unread) == {1, 2}
    assert pictures.unread[1].startswith(f"{small}: 20 × 10 pixels, but the calibration is of 320 × 240")
    assert pictures.unread[2].startswith(f"{damaged}: ")


def test_animations_hold_the_frames(tmp_path):
    pictures, done = drawn(), []
    path = pictures.write_animation(range(0, 30, 3), tmp_path / "a.gif", lambda *counts: done.append(counts))
    with PIL.Image.open(path) as gif:
        assert gif.n_frames == 10 and gif.size == (640, 480 + _LEGEND_PX) and gif.info["duration"] == 100
        gif.seek(9)
        colours = {tuple(map(int, c)) for c in np.unique(rgb(gif).reshape(-1, 3), axis=0)}
        assert CLASS_COLOURS["accepted"] in colours
    assert done[-1] == (10, 10)
    video = cv2.VideoCapture(str(pictures.write_animation(range(5), tmp_path / "a.mp4")))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 5 and video.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    video.release()
    with pytest.raises(ValueError, match=r"unknown ending '\.avi'"):
        pictures.write_animation([0], tmp_path / "a.avi")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gif", "a.mp4"]


def test_path_from_above_shows_what_there_is():
    path = np.tile([0.0, 0, 0, 1, 0, 0, 0], (5, 1))
    path[:, 0] = np.arange(5)
    places = np.array([[2.0, 1.0, 0.0], [4.0, -2.0, 0.0], [1e4, 0.0, 0.0]])
    cov = np.stack([0.01 * np.eye(3), 0.01 * np.eye(3), 1e8 * np.eye(3)])
    landmarks = LandmarkMap(np.arange(3), places, cov, ("accepted", "dynamic", "unused"))
    truth = path.copy()
    truth[2:] = np.nan
    axes = path_figure(path, landmarks, odometry=path, truth=truth).axes[0]
    assert axes.get_title() == "Path and landmarks from above\nfarther away: 1 unused"
    names = set(axes.get_legend_handles_labels()[1])
    lines = {"odometry alone", "truth", "filter", "start"}
    assert names == {"accepted (1)", "dynamic (1)", "unused (1)"} | lines
    assert axes.get_xlim()[0] < 0 and 4 < axes.get_xlim()[1] < 10 and axes.get_ylim()[0] < -2
    assert len(axes.patches) == 2
    far = landmarks._replace(place_m=places[[0, 2, 2]], cov=cov[[0, 2, 2]])
    axes = path_figure(path, far).axes[0]
    assert axes.get_title().endswith("farther away: 1 dynamic, 1 unused")
    assert "dynamic (1)" in axes.get_legend_handles_labels()[1]
    nothing = LandmarkMap(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)), ())
    assert path_figure(path, nothing).axes[0].get_title() == "Path and landmarks from above"
