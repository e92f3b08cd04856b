"""Sightings that repeat the one before to the last bit."""

import dataclasses

import numpy as np
import pytest
import recorded

from vcjax.recording import validate
from vcjax.sources.repeats import cut_recording, cut_repeats, repeated_frames
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


def test_a_recording_is_cut_in_place():
    """Columns stay; pieces are told by whose they are, and end where they are cut."""
    recording = recorded.content().recording
    frame, column = np.nonzero(recording.is_valid)
    uv_px = np.array(recording.uv_px)
    ids = np.array(recording.track_id)
    # In frame 10 every track that goes on from frame 9 stands still.
    for c in np.flatnonzero(recording.is_valid[10]):
        if len(before := np.flatnonzero(recording.is_valid[9] & (ids[9] == ids[10, c]))):
            uv_px[10, c] = uv_px[9, before[0]]
    cut = cut_recording(dataclasses.replace(recording, uv_px=uv_px))
    assert validate(cut.recording) is None and cut.num_cuts > 20
    np.testing.assert_array_equal(cut.track_of(cut.recording.track_id)[frame, column], ids[frame, column])
    # Numbered by when they begin, the pieces of old tracks before tracks that are new there.
    pieces, first = np.unique(cut.recording.track_id[frame, column], return_index=True)
    assert pieces.tolist() == list(range(len(cut.origin))) and np.all(np.diff(frame[first]) >= 0)
    begun = cut.origin[frame[first] == 10]
    assert np.all(np.diff(begun) > 0) and (begun <= ids[:10].max()).sum() == cut.num_cuts
    going_on = np.isin(ids[9], ids[10][recording.is_valid[10]]) & recording.is_valid[9]
    assert cut.recording.is_last[9][going_on].all() and cut.track_of(np.array(-1)) == -1
    same = cut_recording(recording)
    assert same.num_cuts == 0
    np.testing.assert_array_equal(same.track_of(same.recording.track_id)[frame, column], ids[frame, column])
    np.testing.assert_array_equal(same.recording.is_last, recording.is_last)


def test_pieces_and_tracks_are_told_apart_by_number():
    """Tracks 900 and 5, the first cut in frame 1: no number of a piece is that of its track."""
    recording = recorded.content().recording
    ids, uv_px = np.zeros((30, 2), np.int64), np.zeros((30, 2, 2))
    ids[:] = 900, 5
    uv_px[:, 0], uv_px[:, 1] = 50.0 + np.arange(30)[:, None], 90.0 - np.arange(30)[:, None]
    uv_px[1, 0] = uv_px[0, 0]
    seen = np.ones((30, 2), bool)
    parts = {"track_id": ids, "uv_px": uv_px, "is_valid": seen, "is_last": np.zeros_like(seen)}
    cut = cut_recording(dataclasses.replace(recording, **parts))
    assert cut.origin.tolist() == [5, 900, 900] and cut.recording.track_id[:2].tolist() == [[1, 0], [2, 0]]
    assert cut.first_piece_of(np.array([900, 5])).tolist() == [1, 0]
    with pytest.raises(ValueError, match=r"first_piece_of\(track_id=7\): the recording has no such track"):
        cut.first_piece_of(np.array([900, 7]))
    with pytest.raises(ValueError, match=r"track_of\(piece=5\): there are 3 pieces"):
        cut.track_of(np.array([0, -1, 5]))
