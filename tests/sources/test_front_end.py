"""The front end: its tracks against the exact truth of rendered images, and what it makes of bad ones."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import recorded
from rendered import rendered, tracked

from vcjax.recorded.filtered import filter_recording
from vcjax.recorded.run_folder import robot_poses
from vcjax.sources import front_end
from vcjax.sources.calibration import Calibration
from vcjax.sources.front_end import FrontEnd, track_images
from vcjax.sources.image_sequence import record
from vcjax.sources.layouts import plain_folder
from vcjax.sources.odometry import dead_reckoning
from vcjax.sources.recording_file import TrackLabel, load_recording, save_recording
from vcjax.sources.tracks import tracks_of


def ages(tracks) -> np.ndarray:
    """How many sightings of its track come before each."""
    order = np.lexsort((tracks.frame, tracks.track_id))
    ids, age = tracks.track_id[order], np.empty(len(order), int)
    age[order] = np.arange(len(order)) - np.searchsorted(ids, ids)
    return age


def labels_of_sightings(followed, tracks) -> np.ndarray:
    return followed.labels.label[np.searchsorted(followed.track_id, tracks.track_id)]


def test_tracks_stay_on_their_points_below_a_pixel():
    """Against exact projections: 0.1 px from image to image, and under half a pixel after twenty."""
    tracks = tracked()
    followed = rendered().followed(tracks)
    label, age = labels_of_sightings(followed, tracks), ages(tracks)
    assert np.mean(followed.labels.label == TrackLabel.BAD) < 0.1
    error = np.linalg.norm(followed.error_px, axis=1)
    for kind in (TrackLabel.STATIC, TrackLabel.MOVING):
        step = error[(label == kind) & (age == 1)]
        assert len(step) > 10 and np.median(step) < 0.2 and np.quantile(step, 0.9) < 0.8
    late = error[(label == TrackLabel.STATIC) & (age == 20)]
    assert len(late) > 20 and np.median(late) < 0.5
    # No common drift: the mean of the errors is within what their scatter explains.
    young = followed.error_px[(label == TrackLabel.STATIC) & (age == 1)]
    assert np.all(np.abs(young.mean(axis=0)) < 4 * young.std(axis=0) / np.sqrt(len(young)))


def test_ids_are_new_and_sightings_without_gaps():
    tracks = tracked()
    ids, first = np.unique(tracks.track_id, return_index=True)
    np.testing.assert_array_equal(ids, np.arange(len(ids)))
    assert np.all(np.diff(tracks.frame[first]) >= 0)
    for track in ids:
        frames = tracks.frame[tracks.track_id == track]
        np.testing.assert_array_equal(frames, np.arange(frames[0], frames[0] + len(frames)))


def test_of_tracks_that_run_together_the_oldest_stays(monkeypatch):
    def all_to_one_place(before, image, points, options):
        return np.full_like(points, 50.0), np.arange(len(points)) > 0

    monkeypatch.setattr(front_end, "_follow", all_to_one_place)
    tracks = track_images([rendered().sequence.read(t) for t in range(2)])
    first, second = (set(tracks.track_id[tracks.frame == t].tolist()) for t in range(2))
    assert len(first) > 100 and first & second == {1}


def test_the_same_images_give_the_same_tracks():
    images = [rendered().sequence.read(t) for t in range(6)]
    one, other = track_images(images), track_images(iter(images))
    for first, second in zip(one, other, strict=True):
        assert first.tobytes() == second.tobytes()


def test_corners_are_spread_over_the_grid():
    """One side of the image is far richer: it does not take the places of the other."""
    rng = np.random.default_rng(0)
    image = np.full((240, 320), 100, np.uint8)
    for left, contrast in ((0, 100), (160, 12)):
        noise = cv2.resize(rng.uniform(-contrast, contrast, (24, 16)), (160, 240), interpolation=cv2.INTER_NEAREST)
        image[:, left : left + 160] = np.clip(128 + noise, 0, 255)
    tracks = track_images([image], FrontEnd(max_features=48, grid=(8, 6), quality=1e-4))
    cell = (tracks.uv_px[:, 0] // 40).astype(int) + 8 * (tracks.uv_px[:, 1] // 40).astype(int)
    # The refinement may carry a corner over the border of its cell.
    assert np.bincount(cell, minlength=48).max() <= 2 and len(np.unique(cell)) > 36
    apart = np.linalg.norm(tracks.uv_px[:, None] - tracks.uv_px, axis=-1) + 100 * np.eye(len(cell))
    assert apart.min() > 5.0


def test_a_shift_is_measured_below_a_pixel():
    """A smooth picture, shifted by a known part of a pixel in its spectrum."""
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), 3)
    picture = 128 + 100 * picture / np.abs(picture).max()
    shift = np.array([3.37, -1.62])
    fu, fv = np.fft.fftfreq(320), np.fft.fftfreq(240)[:, None]
    moved = np.fft.ifft2(np.fft.fft2(picture) * np.exp(-2j * np.pi * (fu * shift[0] + fv * shift[1]))).real
    tracks = track_images([np.rint(image).astype(np.uint8) for image in (picture, moved)])
    in_frame = [tracks.frame == t for t in (0, 1)]
    before, after = (dict(zip(tracks.track_id[now], tracks.uv_px[now], strict=True)) for now in in_frame)
    common = sorted(set(before) & set(after))
    error = np.array([after[i] - before[i] for i in common]) - shift
    inner = np.array([np.all((before[i] > 25) & (before[i] < [295, 215])) for i in common])
    assert inner.sum() > 50
    assert np.abs(np.median(error[inner], axis=0)).max() < 0.02 and np.quantile(np.abs(error[inner]), 0.95) < 0.1


def test_tracks_end_where_the_scene_ends():
    images = [rendered().sequence.read(0), np.full((240, 320), 128, np.uint8), rendered().sequence.read(0)]
    tracks = track_images(images)
    assert not np.any(tracks.frame == 1)
    assert not set(tracks.track_id[tracks.frame == 0]) & set(tracks.track_id[tracks.frame == 2])


def test_images_without_a_corner_make_a_recording_without_a_feature():
    tracks = track_images([np.full((48, 64), 9, np.uint8)] * 3)
    assert len(tracks.frame) == 0 and tracks.uv_px.shape == (0, 2)


@pytest.mark.usefixtures("unchecked")
def test_bad_images_are_refused_by_their_frame():
    good = np.zeros((48, 64), np.uint8)
    for bad, message in (
        (np.zeros((48, 65), np.uint8), "frame 2 has 65 × 48 pixels, but those before have 64 × 48"),
        (np.zeros((48, 64, 3), np.uint8), r"frame 2 is uint8\[48, 64, 3\]; give grey images"),
        (np.zeros((48, 64)), r"frame 2 is float64\[48, 64\]; give grey"),
        (None, "frame 2 is NoneType; give grey"),
        (np.zeros((0, 64), np.uint8), r"frame 2 is uint8\[0, 64\]"),
    ):
        with pytest.raises(ValueError, match=message):
            track_images([good, good, bad])
    with pytest.raises(ValueError, match="no image; give at least one"):
        track_images([])


BAD = {
    "none": ({"max_features": 0}, r"FrontEnd\(max_features=0\): give a whole number from 1"),
    "even": ({"window_px": 16}, r"window_px=16\): give an odd number"),
    "flag": ({"num_levels": True}, r"num_levels=True\): give a whole number from 0"),
    "grid": ({"grid": (8, 0)}, r"grid=\(8, 0\)\): give columns and rows"),
    "list": ({"grid": [8, 6, 4]}, r"grid=\[8, 6, 4\]\): give columns"),
    "quality": ({"quality": 1.5}, r"quality=1.5\): give a positive number, at most 1"),
    "NaN": ({"max_return_px": float("nan")}, r"max_return_px=nan\): give a positive number\."),
    "negative": ({"min_distance_px": -1.0}, r"min_distance_px=-1.0\): give a positive"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("options", "message"), BAD.values(), ids=BAD)
def test_bad_options_are_refused_by_name_and_value(options, message):
    with pytest.raises(ValueError, match=message):
        FrontEnd(**options)


def test_recording_of_images_feeds_the_filter(tmp_path):
    """Images to tracks to file to filter: nearer the truth than odometry, nothing not finite, and the movers found."""
    world = rendered()
    done = []
    content = record(world.sequence, progress=done.append, robot_start=world.simulated.robot_start)
    assert done == list(range(1, 31))
    np.testing.assert_allclose(content.truth.robot, world.truth.robot, atol=1e-9)
    np.testing.assert_allclose(content.truth.sensor, world.truth.sensor, atol=1e-12)
    recording = load_recording(save_recording(tmp_path / "a.npz", content)).recording
    assert len(tracks_of(recording).frame) == len(tracked().frame)
    info = filter_recording(recorded.config(), recording).info
    assert np.all(info.is_finite)
    # Over several odometries: `recorded/test_filtered.py`.
    assert recorded.position_rms(robot_poses(info)) < 0.75 * recorded.position_rms(dead_reckoning(recording))
    # What the gate calls dynamic are movers, and tracks that slide along an edge, but nothing that stands.
    label = world.followed(tracked()).labels
    called = label.label[np.isin(label.track_id, info.candidate_id[info.is_dynamic])]
    assert np.sum(called == TrackLabel.MOVING) >= 3 and np.sum(called == TrackLabel.STATIC) <= 1


@pytest.mark.skipif("VCJAX_DATA" not in os.environ, reason="needs the real images of VCJAX_DATA")
def test_real_desk():
    """300 hand-held images: tracks of the length of another tracker's, that agree with it where both follow a point."""
    folder = Path(os.environ["VCJAX_DATA"]) / "monoslam_desk"
    calibration = Calibration(320, 240, 195.0, 195.0, 162.0, 125.0, "wide_angle", (9e-6,))
    tracks = track_images(plain_folder(folder / "frames", calibration, 30.0).images(), FrontEnd(max_features=100))
    length = np.bincount(tracks.track_id)
    assert np.bincount(tracks.frame, minlength=300).min() > 40 and length.mean() > 40
    other = np.load(folder / "klt_tracks.npz")
    frame, track, uv = other["frame"] - other["frame"].min(), other["track"], other["uv"].astype(float)
    # Pairs that start within 1.5 px of each other in one frame, twenty frames later.
    differences = []
    for t in range(0, 280, 20):
        ours, theirs = ({i: p for i, p, f in zip(*x, strict=True) if f == t} for x in (
            (tracks.track_id, tracks.uv_px, tracks.frame), (track, uv, frame)))  # fmt: skip
        ours_later = {i: p for i, p, f in zip(tracks.track_id, tracks.uv_px, tracks.frame, strict=True) if f == t + 20}
        theirs_later = {i: p for i, p, f in zip(track, uv, frame, strict=True) if f == t + 20}
        for i in set(ours) & set(ours_later):
            for j in set(theirs) & set(theirs_later):
                if np.linalg.norm(ours[i] - theirs[j]) < 1.5:
                    differences.append((ours_later[i] - ours[i]) - (theirs_later[j] - theirs[j]))
    size = np.linalg.norm(differences, axis=1)
    assert len(size) > 50 and np.median(size) < 0.5
