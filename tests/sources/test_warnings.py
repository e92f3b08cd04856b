"""What is to be known of a recording before it is run, by recordings with one fault each."""

import dataclasses

import numpy as np
import recorded
from rendered import rendered, tracked

from vcjax.recording import last_sightings
from vcjax.sources.distortion import straighten
from vcjax.sources.odometry import Odometry
from vcjax.sources.overview import summary
from vcjax.sources.tracks import recording_from_tracks
from vcjax.sources.warnings import empty_frames, time_jumps, unfollowed_frames, warnings


def changed(**fields):
    return dataclasses.replace(recorded.content().recording, **fields)


def test_a_sound_recording_has_none():
    assert warnings(recorded.content().recording) == [] and "warning" not in summary(recorded.content())


def test_jumps_in_time():
    time_s = np.array(recorded.content().recording.time_s)
    time_s[7:] += 0.06  # a step of 0.16 s among those of 0.1 s
    time_s[20:] += 1.0
    jumped = changed(time_s=time_s)
    assert time_jumps(jumped).tolist() == [7, 20] and "before 2 frames (7, 20), by 1.5 times" in warnings(jumped)[0]
    time_s[7:] -= 0.03  # 0.13 s is none
    assert time_jumps(changed(time_s=time_s)).tolist() == [20]


def test_frames_without_features_or_without_a_common_one():
    is_valid, ids = np.array(recorded.content().recording.is_valid), np.array(recorded.content().recording.track_id)
    is_valid[[4, 5]] = False
    ids[15:] += 10_000  # new tracks from there on
    found = changed(is_valid=is_valid, track_id=ids, is_last=last_sightings(ids, is_valid))
    assert empty_frames(found).tolist() == [4, 5] and unfollowed_frames(found).tolist() == [15]
    told = summary(found)
    assert "warning         2 frames (4, 5): no feature is seen" in told
    assert "warning         frame 15: no track goes on from the frame before" in told


def test_repeats_and_no_odometry():
    recording = recorded.content().recording
    arrays = {n: np.array(getattr(recording, n)) for n in ("track_id", "uv_px", "is_valid")}
    for array in arrays.values():
        array[12] = array[11]  # the same image again
    found = changed(**arrays, is_last=last_sightings(arrays["track_id"], arrays["is_valid"]))
    told = warnings(dataclasses.replace(found, odometry=np.zeros((30, 6))))
    assert told[0].startswith("frame 12: most tracks repeat the frame before") and "--cut-repeats" in told[0]
    assert told[-1].startswith("no odometry: run with --motion constant_velocity")


def test_pixels_outside_the_image():
    """As a calibration of a smaller image makes them; up to a pixel beyond the border nothing is said."""
    uv_px, is_valid = np.array(recorded.content().recording.uv_px), np.array(recorded.content().recording.is_valid)
    u = uv_px[..., 0]  # a view
    u[is_valid] = u[is_valid].clip(0, 319)
    u[3, np.flatnonzero(is_valid[3])[:2]], u[9, np.flatnonzero(is_valid[9])[0]] = (400.0, -50.0), 320.5
    u[4, np.flatnonzero(~is_valid[4])] = 1000.0  # is no pixel
    assert warnings(changed(uv_px=uv_px)) == [
        "2 sightings of " + str(is_valid.sum()) + " lie outside the image (320 × 240 px): is this the calibration "
        "of these images?"
    ]


def test_sightings_that_the_lens_has_no_place_for():
    """They stay out of the recording, and are counted."""
    tracks, straight = tracked(), rendered().sequence.calibration
    # No ray beyond 158 px from the centre.
    lens = dataclasses.replace(straight, distortion_model="wide_angle", distortion=(2e-5,))
    recording = recorded.content().recording
    odometry = Odometry(recording.odometry, recording.odometry_cov)
    found = recording_from_tracks(tracks, lens, time_s=recording.time_s, odometry=odometry)
    num = int(np.sum(np.isnan(straighten(lens, tracks.uv_px)[:, 0])))
    assert 0 < num < len(tracks.frame) == num + found.is_valid.sum()
    assert warnings(found) == [
        f"{num} sightings are left out, as the lens of the calibration has no place for their pixels"
    ]
