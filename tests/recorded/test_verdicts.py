"""Verdicts worked out by hand, of each frame and of each track, and the summary of a run."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import recorded
from scipy import integrate, stats

import vcjax as vc
from vcjax.filter.info import FrameInfo
from vcjax.recorded.filtered import Filtered, LastPlaces
from vcjax.recorded.run_summary import first_failure, nis_moments, run_summary, run_summary_text
from vcjax.recorded.verdicts import VERDICTS, classes, track_verdicts, verdicts

nan = math.nan


def frame_info(ids, verdict, re1, re2, margin, deleted=(), is_finite=True, is_full=False, watched=()) -> dict:
    """What the info of a frame with candidates of given verdicts holds; "" where not measured."""
    word = np.array(verdict)
    return {
        "candidate_id": np.array(ids, np.int32),
        "is_measured": word != "",
        "re1": np.array(re1, float),
        "re2": np.array(re2, float),
        "is_accepted": word == "accepted",
        "is_recovered": word == "recovered",
        "is_dynamic": word == "dynamic",
        "is_suspect": word == "suspect",
        "dynamic_margin": np.array(margin, float),
        "inconsistent_id": np.array([*deleted, *[-1] * (2 - len(deleted))], np.int32),
        "watched_id": np.array([*(i for i, _ in watched), *[-1] * (2 - len(watched))], np.int32),
        "detector_margin": np.array([*(m for _, m in watched), *[nan] * (2 - len(watched))]),
        "map_is_full": np.array(is_full),
        "is_finite": np.array(is_finite),
    }


@pytest.fixture
def info(unchecked) -> FrameInfo:
    frames = [
        frame_info([4, 7, 9], ["accepted", "recovered", ""], [1.0, 12.0, 5.0], [nan, 11.0, nan], [-8.0, -7.0, nan],
                   watched=[(4, -3.0), (5, -1.0)]),
        frame_info([-1, 9, 7], ["", "dynamic", "accepted"], [nan, 30.0, 2.0], [nan, 4.0, nan], [nan, 17.0, -7.0], [4],
                   watched=[(4, 2.0), (7, nan)]),
        frame_info([7, 3, 5], ["rejected", "accepted", "suspect"], [10, 3, 1], [nan] * 3, [1, -6, nan], [8],
                   is_full=True),
    ]  # fmt: skip
    # The rest is that of some other run.
    return dataclasses.replace(recorded.run().info, **jax.tree.map(lambda *leaves: np.stack(leaves), *frames))


def test_rows_by_frame(info):
    found = verdicts(info)
    rows = [
        (0, 4, 1.0, nan, -8.0, "accepted"),
        (0, 7, 12.0, 11.0, -7.0, "recovered"),
        (1, 9, 30.0, 4.0, 17.0, "dynamic"),
        (1, 7, 2.0, nan, -7.0, "accepted"),
        (1, 4, nan, nan, nan, "deleted"),
        (2, 7, 10.0, nan, 1.0, "rejected"),
        (2, 3, 3.0, nan, -6.0, "accepted"),
        (2, 5, 1.0, nan, nan, "suspect"),
        (2, 8, nan, nan, nan, "deleted"),
    ]
    assert np.array(VERDICTS)[found.verdict].tolist() == [row[-1] for row in rows]
    for column, expected in zip(found[:-1], list(zip(*rows, strict=True))[:-1], strict=True):
        np.testing.assert_array_equal(column, expected)


def test_tracks_and_classes(info):
    found = track_verdicts(verdicts(info), info)
    assert found.track_id.tolist() == [3, 4, 5, 7, 8, 9]
    #                                  accepted, recovered, dynamic, rejected, suspect, deleted
    assert found.counts.tolist() == [
        [1, 0, 0, 0, 0, 0],
        [1, 0, 0, 0, 0, 1],
        [0, 0, 0, 0, 1, 0],
        [1, 1, 0, 1, 0, 0],
        [0, 0, 0, 0, 0, 1],
        [0, 0, 1, 0, 0, 0],
    ]
    np.testing.assert_array_equal(found.margin, [-6.0, -8.0, nan, 1.0, nan, 17.0])
    np.testing.assert_array_equal(found.detector_margin, [nan, 2.0, -1.0, nan, nan, nan])
    assert found.is_called.tolist() == [False, True, False, False, True, True]
    kinds = classes(np.array([9, 7, 5, 4, 3, 99]), found)
    assert kinds == ("dynamic", "recovered", "unused", "dynamic", "accepted", "unused")
    nothing = track_verdicts(type(verdicts(info))(*(column[:0] for column in verdicts(info))), info)
    assert classes(np.array([1]), nothing) == ("unused",)


@pytest.mark.parametrize("limit", [0.3, 9.0, 40.0, 5000.0])
def test_moments_of_what_the_gate_accepts(limit):
    """By integration of the density of χ²₂ below the limit."""

    def moment(power):
        return integrate.quad(lambda x: x**power * stats.chi2.pdf(x, 2), 0, min(limit, 200.0), epsabs=1e-13)[0]

    mean = moment(1) / moment(0)
    assert nis_moments(limit) == pytest.approx((mean, moment(2) / moment(0) - mean**2), rel=1e-8)
    assert nis_moments(math.inf) == (2.0, 4.0)


def test_summary_by_hand(info):
    filtered = Filtered(info, LastPlaces(np.array([4, 7]), np.zeros((2, 3)), np.zeros((2, 3, 3))), 12.5, 0.2)
    recording = SimpleNamespace(time_s=np.array([10.0, 10.5, 12.0]), num_frames=3)
    found = run_summary(
        vc.FilterConfig(gate=vc.VirtualCorrection(th1=9.0)), recording, filtered, track_verdicts(verdicts(info), info)
    )
    assert (found["frames"], found["duration_s"], found["times_real_time"]) == (3, 2.0, pytest.approx(10.0))
    assert [found[name] for name in VERDICTS] == [3, 1, 1, 1, 1, 2]
    assert (found["measured"], found["tracks_dynamic"], found["landmarks"], found["frames_map_full"]) == (7, 3, 2, 1)
    # The suspect is within the gate, though not corrected with.
    assert found["nis"] == pytest.approx(2.0) and found["beyond_gate"] == pytest.approx(3 / 7)
    mean, variance = nis_moments(9.0)
    assert found["nis_high"] - found["nis_low"] == pytest.approx(2 * 1.96 * math.sqrt(variance / 3))
    assert found["nis_high"] + found["nis_low"] == pytest.approx(2 * mean)
    assert found["beyond_gate_expected"] == pytest.approx(stats.chi2.sf(9.0, 2))
    assert found["first_failure"] is None and found["failures"] == 0
    assert found["frames_blind"] == 0  # the last accepts 3
    assert found["end_std_m"] == pytest.approx(np.sqrt(np.trace(recorded.run().info.vehicle_cov[-1, :3, :3])))
    text = run_summary_text(found)
    for words in (
        "0.2 s, 10 times real time; compilation 12.5 s",
        "3 accepted, 1 recovered of 7 measured",
        "1 rejected without a verdict, 1 suspect to the detector",
        "1 verdicts of the gate, 2 deletions by the detector, of 3 tracks",
        "full in 1 frames",
        "failures         none",
    ):
        assert words in text
    assert "place at the end known to " in text and " m, by the filter's own" in text
    assert "scale  " not in text and "cut at" not in text  # of the command alone
    more = run_summary_text(found | {"scale": "free", "scale_factor": 1.0, "tracks_cut": 7})
    assert "free: lengths are those of the priors" in more and " of the priors' lengths, by the filter's own" in more
    assert "cut at 7 sightings" in more
    assert "from 1 m; lengths are multiplied by 2.5" in run_summary_text(
        found | {"scale": "known from 1 m", "scale_factor": 2.5}
    )
    assert "which it is not" not in text and "which it is not" in run_summary_text(found | {"nis": 6.0})


def test_nothing_is_expected_of_a_gate_that_accepts_jointly(info):
    filtered = Filtered(info, LastPlaces(np.array([4, 7]), np.zeros((2, 3)), np.zeros((2, 3, 3))), 12.5, 0.2)
    recording = SimpleNamespace(time_s=np.array([10.0, 10.5, 12.0]), num_frames=3)
    config = vc.FilterConfig(gate=vc.OnePointRansac())
    found = run_summary(config, recording, filtered, track_verdicts(verdicts(info), info))
    assert all(math.isnan(found[name]) for name in ("nis_low", "nis_high", "beyond_gate_expected"))
    assert found["nis"] == pytest.approx(2.0) and found["beyond_gate"] == pytest.approx(3 / 7)
    text = run_summary_text(found)
    assert "2.000 of the accepted\n" in text and "42.86 % of the measured\n" in text


def test_first_failure_is_named(info):
    info.is_finite[1:] = False
    assert first_failure(info) == 1


def test_a_simulation_of_white_noise_lies_in_the_band():
    """Squared distances of a consistent filter, below the threshold: the band holds their mean in 95 of 100."""
    rng, inside = np.random.default_rng(0), 0
    mean, variance = nis_moments(9.0)
    for _ in range(400):
        nis = rng.chisquare(2, 500)
        nis = nis[nis < 9.0]
        inside += abs(nis.mean() - mean) < 1.96 * math.sqrt(variance / len(nis))
    assert stats.binomtest(int(inside), 400, 0.95).pvalue > 0.01


def test_rendered_run_has_a_verdict_for_each_measured_candidate():
    info = recorded.run().info
    found = verdicts(info)
    assert len(found.frame) == info.is_measured.sum() + (info.inconsistent_id >= 0).sum()
    assert np.all(np.diff(found.frame) >= 0) and set(np.unique(found.verdict)) >= {0, 2}
