"""Sightings that repeat the one before to the last bit."""

import numpy as np

from vcjax.sources.repeats import cut_repeats, repeated_frames
from vcjax.sources.tracks import Tracks

MOVES = np.array([[10.0, 20.0], [11.5, 20.5], [13.0, 21.0], [14.5, 21.5], [16.0, 22.0]])


def test_a_track_is_cut_where_it_stands_still():
    #       frame, track, at which of MOVES
    rows = [(0, 4, 0), (1, 4, 1), (2, 4, 1), (3, 4, 2), (4, 4, 2), (0, 7, 0), (1, 7, 1), (3, 7, 1), (4, 7, 3)]
    rng = np.random.default_rng(0)
    frame, track_id, place = np.array(rows)[rng.permutation(len(rows))].T
    tracks = Tracks(frame, track_id, MOVES[place])
    cut = cut_repeats(tracks)
    found = {(int(f), int(old)): int(new) for f, old, new in zip(frame, track_id, cut.track_id, strict=True)}
    # Track 7 was not seen in frame 2: it came back to where it was, which is another matter.
    assert found == {(0, 4): 4, (1, 4): 4, (2, 4): 8, (3, 4): 8, (4, 4): 9} | {(f, 7): 7 for f in (0, 1, 3, 4)}
    np.testing.assert_array_equal(cut.frame, frame)
    np.testing.assert_array_equal(cut.uv_px, tracks.uv_px)


def test_new_ids_are_in_order_of_time():
    frame, track_id = np.array([0, 1, 2, 0, 1]), np.array([0, 0, 0, 1, 1])
    uv_px = MOVES[[0, 1, 1, 2, 2]]
    np.testing.assert_array_equal(cut_repeats(Tracks(frame, track_id, uv_px)).track_id, [0, 0, 3, 1, 2])


def test_frames_that_mostly_repeat():
    frame, track_id = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
    uv_px = np.stack([MOVES[:3], MOVES[:3], MOVES[:3]]).reshape(-1, 2).copy()
    uv_px[5] += 1e-13  # one of three moves in frame 1
    uv_px[7:] += 1.0  # two of three in frame 2
    tracks = Tracks(frame, track_id, uv_px)
    np.testing.assert_array_equal(repeated_frames(tracks), [1])
    nothing = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    assert len(repeated_frames(nothing)) == len(cut_repeats(nothing).frame) == 0
