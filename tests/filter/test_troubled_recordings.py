"""What real recordings do: nothing to see, lost frames, jumping clocks, tracks that lie. A run goes on, and says so."""

import dataclasses

import jax
import numpy as np
import pytest
from filter_runs import filtered, frame_of, head, part, recorded, simulate_once, start, step

from vcjax.filter.config import FilterConfig
from vcjax.filter.known_landmarks import KnownLandmarks
from vcjax.filter.motion_model import ConstantVelocity, Odometry
from vcjax.filter.run import run
from vcjax.recording import PER_FRAME, last_sightings
from vcjax.simulation.scenarios import paper

GONE = range(12, 18)
MOTIONS = {"odometry": Odometry(), "constant velocity": ConstantVelocity(acceleration=0.5, angular_acceleration=0.5)}


def config_of(motion: str, **choices) -> FilterConfig:
    return FilterConfig(motion=MOTIONS[motion], max_landmarks=11, max_updates=4, **choices)


def without_features(recording, frames):
    is_valid = np.array(recording.is_valid)
    is_valid[list(frames)] = False
    return dataclasses.replace(recording, is_valid=is_valid, is_last=last_sightings(recording.track_id, is_valid))


def spread(info) -> float:
    return float(np.sqrt(np.trace(info.vehicle_cov[:3, :3])))


def infos(config, recording):
    return [info for _, info in filtered(config, recording)]


@pytest.mark.parametrize("motion", MOTIONS)
def test_frames_without_features(motion):
    recording = head(recorded(0, robot="curved"), 25)
    whole, holed = infos(config_of(motion), recording), infos(config_of(motion), without_features(recording, GONE))
    assert [t for t, info in enumerate(holed) if info.is_blind] == [0, *GONE]
    growing = [spread(holed[t]) for t in range(GONE[0] - 1, GONE[-1] + 1)]
    assert np.all(np.diff(growing) > 0)
    assert all(info.is_finite for info in holed) and not holed[GONE[-1] + 1].is_blind
    # Odometry good to millimetres grows by √6 · 5 mm along each axis; without it the gap costs far more.
    assert spread(holed[GONE[-1]]) > (1.1 if motion == "odometry" else 1.5) * spread(whole[GONE[-1]])
    if motion == "constant velocity":  # features are found again: it knows its place better than before
        assert spread(holed[-1]) < spread(holed[GONE[-1]])


def test_lost_frames_are_a_longer_step():
    recording = head(recorded(0, robot="curved"), 25)
    kept = [t for t in range(25) if t not in GONE]
    lost = dataclasses.replace(recording, **{name: np.asarray(getattr(recording, name))[kept] for name in PER_FRAME})
    config = config_of("constant velocity")
    after, before = infos(config, lost), infos(config, recording)
    first = kept.index(GONE[-1] + 1)
    assert all(info.is_finite for info in after)
    # 0.7 s at 0.5 m/s: it has gone on by its velocity, and is not where it was.
    step = np.linalg.norm(after[first].vehicle[:2] - after[first - 1].vehicle[:2])
    expected = np.linalg.norm(before[GONE[-1] + 1].vehicle[:2] - before[GONE[0] - 1].vehicle[:2])
    assert 0.5 * expected < step < 2 * expected
    assert after[first].carried_std[0] > after[first - 1].carried_std[0]


@pytest.mark.parametrize("motion", MOTIONS)
def test_wrong_tracks_are_left_out_and_the_run_goes_on(motion):
    """From one frame to the next every track follows another point, for good."""
    recording = head(recorded(0, robot="curved"), 30)
    track_id = np.array(recording.track_id)
    ids = np.unique(track_id[recording.is_valid])
    other = np.arange(track_id.max() + 2)
    other[ids] = np.roll(ids, 7)
    track_id[15:] = np.where(recording.is_valid[15:], other[track_id[15:]], track_id[15:])
    wrong = dataclasses.replace(recording, track_id=track_id, is_last=last_sightings(track_id, recording.is_valid))
    found = infos(config_of(motion), wrong)
    assert all(info.is_finite for info in found)
    shares = [info.is_accepted.sum() / max(info.is_measured.sum(), 1) for info in found]
    # Left out at first; after three frames VC has deleted what lies, and others have been born in its place.
    assert np.mean(shares[5:15]) > 0.9 and np.mean(shares[15:18]) < 0.5 and np.mean(shares[18:20]) > 0.9


def test_a_full_map_says_how_many_wait():
    recording = head(recorded(0, robot="curved"), 12)
    *_, info = infos(config_of("odometry"), recording)
    visible = set(np.asarray(recording.track_id)[-1][np.asarray(recording.is_valid)[-1]].tolist())
    assert info.map_is_full and 0 < info.num_waiting <= len(visible - set(info.track_id.tolist()))


def test_known_landmarks_give_the_scale():
    recording, truth = jax.device_get(simulate_once(paper(robot="curved"), jax.random.key(5)))
    recording = head(recording, 40)
    ids = np.asarray(recording.track_id[0])[np.asarray(recording.is_valid[0])][:6]
    known = KnownLandmarks(ids, np.asarray(truth.landmarks_m)[0, ids], 0.01)
    config = dataclasses.replace(
        config_of("constant velocity", births_per_frame=2, errors="invariant"), max_landmarks=23, max_updates=10
    )
    assert not config.motion.gives_scale
    state, _ = start(config, head(recording, 1), None, known)
    held = np.asarray(state.track_id)[np.asarray(state.track_id) >= 0]
    assert len(np.unique(held)) == len(held) and set(ids) <= set(held)  # none is born a second time
    place = np.asarray(state.landmarks)[:6, :3]
    np.testing.assert_array_equal(place, known.place_m)

    ends = {}
    for name, points in (("known", known), ("free", None)):
        state, info = start(config, head(recording, 1), None, points)
        for t in range(1, recording.num_frames):
            state, info = step(config, state, frame_of(recording, t))
        ends[name] = jax.device_get(info)
    error = np.linalg.norm(ends["known"].vehicle[:3] - truth.robot[39, :3])
    assert error < 3 * spread(ends["known"]) < 0.3
    assert spread(ends["free"]) > 2 * spread(ends["known"])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(track_id=np.array([1, 1])), r"track_id=\[1, 1\]"),
        (dict(place_m=np.zeros((3, 3))), r"\(2,\) and place_m \(3, 3\)"),
        (dict(place_m=np.full((2, 3), np.nan)), "must be finite"),
        (dict(std_m=0.0), r"std_m=0.0"),
    ],
)
def test_known_landmarks_that_make_no_map_are_refused(fields, message, unchecked):
    known = KnownLandmarks(np.array([0, 1]), np.zeros((2, 3)), 0.01)._replace(**fields)
    with pytest.raises(ValueError, match=message):
        run(config_of("odometry"), part(recorded(0, robot="curved"), 0, 2), known=known)
