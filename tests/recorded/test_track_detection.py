"""Detection scores of one run by hand, and their intervals."""

import math

import numpy as np
import pytest
import recorded
from hypothesis import given
from hypothesis import strategies as st

import vcjax as vc
from vcjax.recorded.track_detection import labels_of, track_detection, track_detection_text
from vcjax.recorded.verdicts import DELETED, DYNAMIC, VERDICTS, TrackVerdicts, track_verdicts, verdicts
from vcjax.sources.recording_file import RecordingFile, TrackLabel, TrackLabels
from vcjax.study import roc


def judged(margin, called, detector_margin=None) -> TrackVerdicts:
    """Tracks 0, 1, … with their margins, some of which were called dynamic."""
    counts = np.zeros((len(margin), len(VERDICTS)), np.int64)
    counts[:, DYNAMIC] = called
    detector = margin if detector_margin is None else detector_margin
    return TrackVerdicts(np.arange(len(margin)), counts, np.array(margin, float), np.array(detector, float))


def test_counts_and_figures_by_hand():
    """Tracks 0–3 move, 4–7 stand, 8 is bad, 9 unknown and 10 is not labelled; 11 moves and was never looked at."""
    by_detector = [np.nan, 1, 1, 2, 2, 0, np.nan, 0, 9, 9, 9]
    tracks = judged([5, 4, -1, np.nan, 3, -2, -3, -4, 9, 9, 9], [1, 1, 0, 0, 1, 0, 0, 0, 1, 1, 1], by_detector)
    labels = TrackLabels(np.array([11, *range(10)]), np.array([1, 1, 1, 1, 1, 0, 0, 0, 0, 2, -1]))
    found = track_detection(tracks, labels)
    assert found[:5] == (5, 4, 4, 2, 1)
    assert (found.precision[0], found.recall[0], found.f1[0]) == pytest.approx((2 / 3, 1 / 2, 4 / 7))
    assert found.auc[0] == pytest.approx((4 + 4 + 3) / 12)  # three movers have a margin
    assert found.detector_auc[0] == pytest.approx((2 + 2 + 2.5) / 9)
    for value, low, high in found[5:]:
        assert low <= value <= high
    text = track_detection_text(found)
    assert "2 found of 4 judged (5 labelled)" in text and "1 called dynamic or deleted of 4 judged" in text


def test_deleted_by_the_detector_counts_as_found():
    tracks = judged([1.0, 1.0], [0, 0])
    tracks.counts[0, DELETED] = 1
    found = track_detection(tracks, TrackLabels(np.array([0, 1]), np.array([1, 0])))
    assert (found.num_found, found.num_false) == (1, 0)


def test_perfect_scores_have_an_interval_of_themselves_and_nobody_none():
    labels = TrackLabels(np.arange(40), (np.arange(40) < 10).astype(int))
    found = track_detection(judged(np.where(np.arange(40) < 10, 5.0, -5.0), np.arange(40) < 10), labels)
    assert all(figure == (1.0, 1.0, 1.0) for figure in found[5:])
    static = track_detection(judged([1.0, 2.0], [0, 0]), TrackLabels(np.array([0, 1]), np.array([0, 0])))
    assert math.isnan(static.recall[0]) and math.isnan(static.auc[0]) and "not defined" in track_detection_text(static)
    none = track_detection(judged([], []), labels)
    assert none.num_movers == 0 and math.isnan(none.f1[0])


def test_interval_of_recall_is_that_of_draws():
    """50 of 100 movers found: the bootstrap's interval is close to the normal one."""
    tracks = judged(np.zeros(200), np.arange(200) % 4 == 0)
    found = track_detection(tracks, TrackLabels(np.arange(200), (np.arange(200) % 2 == 0).astype(int)))
    value, low, high = found.recall
    assert value == 0.5 and (low, high) == pytest.approx((0.5 - 1.96 * 0.05, 0.5 + 1.96 * 0.05), abs=0.015)


@given(st.lists(st.tuples(st.sampled_from([-1.0, 0.0, 1.0, 2.0, np.nan]), st.booleans()), min_size=1, max_size=12))
def test_area_is_the_share_of_pairs_in_order(entries):
    score, is_mover = (np.array(x) for x in zip(*entries, strict=True))
    pairs = [
        (a > b) + 0.5 * (a == b)
        for a in score[is_mover & ~np.isnan(score)]
        for b in score[~is_mover & ~np.isnan(score)]
    ]
    found = roc.area(roc.Tracks(score[:, None], is_mover[:, None]))
    expected = np.mean(pairs) if pairs else np.nan
    np.testing.assert_allclose(found, [expected], atol=1e-12)


def test_labels_of_a_simulation_are_its_features():
    truth = vc.Truth(np.zeros((2, 7)), np.zeros((2, 7)), np.zeros((2, 3, 3)), np.array([False, True, False]))
    recording = recorded.content().recording
    labels = labels_of(RecordingFile(recording, truth))
    assert labels.track_id.tolist() == [0, 1, 2] and labels.label.tolist() == [0, 1, 0]
    kept = TrackLabels(np.array([5]), np.array([int(TrackLabel.BAD)]))
    assert labels_of(RecordingFile(recording, truth, kept)) is kept
    assert labels_of(RecordingFile(recording)) is None
    assert labels_of(recorded.content()) is recorded.content().labels


def test_rendered_movers_are_found():
    info = recorded.run().info
    found = track_detection(track_verdicts(verdicts(info), info), recorded.content().labels)
    assert found.num_movers >= 3 and found.num_found >= 3 and found.auc[0] > 0.7
