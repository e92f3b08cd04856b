"""Where lengths come from, and a free scale settled by one distance."""

import dataclasses

import numpy as np
import pytest
import recorded

import vcjax as vc
from vcjax.filter.known_landmarks import KnownLandmarks
from vcjax.filter.motion_model import ConstantVelocity, Odometry
from vcjax.recorded.filtered import filter_recording
from vcjax.recorded.run_folder import camera_poses
from vcjax.recorded.scale import KnownDistance, check_known_distance, found_distance, scale_source, scaled

STILL = dataclasses.replace(recorded.content().recording, sensor_shift_m=np.zeros((30, 3)))
"""The recording, its camera taken for fixed."""
BARE = dataclasses.replace(STILL, odometry=np.zeros((30, 6)))
"""The same without odometry."""


def test_what_gives_the_scale():
    known = KnownLandmarks(np.array([1, 2]), np.eye(3)[:2], 0.01)
    assert scale_source(Odometry(), STILL) == "odometry"
    assert scale_source(Odometry(), BARE) is None and scale_source(ConstantVelocity(), STILL) is None
    assert scale_source(ConstantVelocity(), STILL, known) == "2 known landmarks"
    one = KnownLandmarks(np.array([1]), np.eye(3)[:1], 0.01)
    assert scale_source(ConstantVelocity(), STILL, one) == "1 known landmark"
    assert scale_source(ConstantVelocity(), recorded.content().recording) == "the commanded motion of the camera"


def test_scaling_multiplies_what_the_camera_sees_from_its_first_place():
    """Pixels stay: directions from every camera to every landmark are those before, and the mount is as it was."""
    filtered = recorded.run()
    found = scaled(filtered, 2.5)
    before, after = camera_poses(filtered.info), camera_poses(found.info)
    np.testing.assert_allclose(after[0], before[0], atol=1e-12)
    np.testing.assert_allclose(after[:, 3:], before[:, 3:])
    np.testing.assert_allclose(found.info.vehicle[:, 7:], filtered.info.vehicle[:, 7:])
    one = filtered.landmarks.place_m[None] - before[:, None, :3]
    other = found.landmarks.place_m[None] - after[:, None, :3]
    np.testing.assert_allclose(other, 2.5 * one, atol=1e-9 * np.abs(one).max())
    np.testing.assert_allclose(found.landmarks.cov, 6.25 * filtered.landmarks.cov)
    np.testing.assert_allclose(found.info.vehicle_cov[:, 0, 0], 6.25 * filtered.info.vehicle_cov[:, 0, 0])
    np.testing.assert_allclose(found.info.vehicle_cov[:, 0, 4], 2.5 * filtered.info.vehicle_cov[:, 0, 4])
    np.testing.assert_array_equal(found.info.vehicle_cov[:, 4, 4], filtered.info.vehicle_cov[:, 4, 4])


def test_distance_after_scaling_is_the_known_one():
    filtered = recorded.run()
    first, second = filtered.landmarks.track_id[[0, 3]].tolist()
    known = KnownDistance((first, second), 1.7)
    factor = 1.7 / found_distance(known, filtered.landmarks)
    assert found_distance(known, scaled(filtered, factor).landmarks) == pytest.approx(1.7)
    with pytest.raises(ValueError, match="track 99999: it was never in the map"):
        found_distance(KnownDistance((first, 99999), 1.0), filtered.landmarks)


@pytest.mark.parametrize(
    ("tracks", "length", "source", "message"),
    [
        ((0, 1), -1.0, None, "known distance -1.0: give a positive"),
        ((0, 1), float("nan"), None, "known distance nan"),
        ((1, 1), 1.0, None, "track 1 and itself"),
        ((0, 99999), 1.0, None, "track 99999: the recording has no such track"),
        ((0, 1), 1.0, "odometry", "is known from odometry; leave one of the two out"),
    ],
)
def test_what_settles_nothing_is_refused(tracks, length, source, message):
    with pytest.raises(ValueError, match=message):
        check_known_distance(KnownDistance(tracks, length), BARE, source)


def test_scale_of_a_run_without_it_is_free_and_its_shape_is_not():
    """With priors of twice the length a run is itself at twice the size, which is what scaling takes for granted."""
    motion = ConstantVelocity(0.5, 0.5, 0.3, 0.3)
    twice = ConstantVelocity(1.0, 0.5, 0.6, 0.3)
    known = {"choose_among": "measured", "births_per_frame": 2, "inverse_depth_mean": 0.4, "inverse_depth_std": 0.4}
    halved = known | {"inverse_depth_mean": 0.2, "inverse_depth_std": 0.2, "inverse_depth_min": 0.0005}
    recording = dataclasses.replace(BARE, sensor_start=np.array([0, 0, 0, *np.asarray(BARE.sensor_start)[3:]]))
    one = filter_recording(vc.FilterConfig(motion=motion, max_landmarks=40, **known), recording)
    other = filter_recording(vc.FilterConfig(motion=twice, max_landmarks=40, **halved), recording)
    np.testing.assert_allclose(other.info.vehicle[:, :3], 2 * one.info.vehicle[:, :3], atol=1e-6)
    np.testing.assert_allclose(other.info.vehicle[:, 3:7], one.info.vehicle[:, 3:7], atol=1e-6)
