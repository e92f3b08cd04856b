"""The filter against the independent NumPy EKF-SLAM of `tests/reference`, frame by frame, on simulated recordings.

They agree in every choice and verdict, and in every number to 1e-8: rounding grows to 1e-11 in squared distances of
1e3, and to 1e-13 in states; a wrong formula would show from 1e-6 on. Numbers above one are compared relatively.
The long runs retire landmarks, as the paper's cells do; the reference never does.
"""

import dataclasses

import numpy as np
import pytest
from filter_runs import CAPACITY, filtered, head, ids, joint, landmarks, recorded
from reference.ekf_slam import EkfSlam, Frame, Options

from vcjax.filter.config import FilterConfig
from vcjax.filter.state import VEHICLE
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.reprojection import ReprojectionError
from vcjax.gates.virtual_correction import VirtualCorrection


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-8)


def reference_results(options, recording):
    """The reference's result of every frame."""
    r = recording
    slam = EkfSlam(options, r.camera.intrinsics_px, r.robot_start, r.sensor_start, r.start_cov)
    for t in range(r.num_frames):
        seen = r.is_valid[t]
        yield slam.step(
            Frame(r.odometry[t], r.odometry_cov[t], r.sensor_shift_m[t], r.track_id[t, seen], r.uv_px[t, seen])
        )


def agree(config, options, recording):
    """Compare the two in all frames; how many verdicts, deletions, births and conversions there were in all."""
    counts = dict.fromkeys(("accepted", "recovered", "dynamic", "inconsistent", "born", "reparametrised"), 0)
    frames = enumerate(zip(filtered(config, recording), reference_results(options, recording), strict=True))
    for t, ((state, info), result) in frames:
        close(info.vehicle, np.concatenate([result.robot, result.sensor]))
        close(info.vehicle_cov, result.P)
        compare_candidates(info, result.candidates, counts)
        assert sorted(ids(info.inconsistent_id)) == sorted(result.deleted_inconsistent)
        assert ids(info.born_id) == result.born
        assert not info.map_is_full  # else the capacity, not the method, would decide
        counts["inconsistent"] += len(result.deleted_inconsistent)
        counts["born"] += len(result.born)
        if t % 20 == 19:
            compare_maps(
                landmarks(state), result.landmarks, ended=ids(recording.track_id[: t + 1][recording.is_last[: t + 1]])
            )
    kept = [i for i in result.landmarks if i in landmarks(state)]
    mean, cov = joint(state, kept)
    rows = reference_rows(result.landmarks, kept)
    close(mean, result.full_x[rows])
    close(cov, result.full_P[np.ix_(rows, rows)])
    return counts


def reference_rows(theirs, kept):
    """Where vehicle and some landmarks are in the reference's state, which holds its landmarks one after another."""
    first = VEHICLE + np.cumsum([0] + [len(mean) for _, mean, _ in theirs.values()])
    place = dict(zip(theirs, first, strict=False))
    return np.concatenate([np.arange(VEHICLE), *(place[i] + np.arange(len(theirs[i][1])) for i in kept)])


def compare_candidates(info, candidates, counts):
    """The same candidates in the same order, with the same numbers and verdicts."""
    assert ids(info.candidate_id) == [c["id"] for c in candidates]
    for k, c in enumerate(candidates):
        verdict = {v: bool(getattr(info, f"is_{v}")[k]) for v in ("accepted", "recovered", "dynamic")}
        assert verdict == {v: c[v] for v in verdict}
        assert info.is_measured[k] == c["matched"]
        if c["matched"]:
            for ours, theirs in (("pixel", "e"), ("innovation", "z"), ("innovation_cov", "Z"), ("re1", "re1")):
                close(getattr(info, ours)[k], c[theirs])
        # NaN on both sides where nothing was judged
        close(info.re1_prior[k], c["re1_prior"])
        close(info.re2[k], c["re2"])
        for name in ("accepted", "recovered", "dynamic", "reparametrised"):
            counts[name] += c[name]


def compare_maps(ours, theirs, ended):
    """The same landmarks in the same form, with the same mean and covariance; only what has ended may be retired."""
    assert set(ours) <= set(theirs)
    assert set(theirs) - set(ours) <= set(ended)
    for i, (kind, mean, cov) in ours.items():
        assert kind == theirs[i][0]
        close(mean, theirs[i][1])
        close(cov, theirs[i][2])


GATES = {"RE": ReprojectionError(), "VC": VirtualCorrection(), "VC_predicted": VirtualCorrection(prior="predicted")}
NAMES = {"pixel_std": "pixel_std_px", "oscillation_std": "oscillation_std_m"}
DETECTOR_NAMES = {"min_match_ratio": "min_measured_ratio", "min_inlier_ratio": "min_corrected_ratio"}


def both(gate, detector, retire=False, **numbers):
    """The same choices for both filters; `detector` and `numbers` are the reference's names of what is no default."""
    config = FilterConfig(
        gate=GATES[gate],
        detector=InlierRatio(**{DETECTOR_NAMES.get(k, k): v for k, v in detector.items()}),
        retire=retire,
        max_landmarks=FilterConfig().max_landmarks if retire else CAPACITY,
        **{NAMES[k]: v for k, v in numbers.items()},
    )
    return config, Options(gate=gate[:2], prior=GATES[gate].prior, **detector, **numbers)


STEADY, OSCILLATING = 0.0, 0.05


@pytest.mark.parametrize(
    ("gate", "amplitude_m", "dynamic"),
    [
        ("RE", STEADY, None),
        ("RE", STEADY, "lateral"),
        ("RE", OSCILLATING, None),
        ("RE", OSCILLATING, "inverse_forward"),
        ("VC", STEADY, None),
        ("VC", STEADY, "inverse_forward"),
        ("VC", OSCILLATING, "lateral"),
        ("VC", OSCILLATING, "inverse_forward"),
    ],
)
def test_160_frames_forward(gate, amplitude_m, dynamic):
    recording = recorded(seed=3, robot="forward", dynamic=dynamic, oscillation_amplitude_m=amplitude_m)
    counts = agree(*both(gate, {}, retire=True), recording)
    assert counts["reparametrised"] > 30  # the comparison met every kind of event
    if gate == "VC":
        assert counts["recovered"] > 5
        assert counts["dynamic"] > 0
    elif dynamic:
        assert counts["inconsistent"] > 0


@pytest.mark.parametrize(
    ("gate", "scenario", "numbers"),
    [
        ("VC", {"robot": "curved", "dynamic": "lateral"}, {}),
        ("RE", {"robot": "lateral", "dynamic": "inverse_forward", "noise": "six_axis"}, {}),
        ("VC", {"oscillation_amplitude_m": 0.05, "dynamic": "lateral"}, {"oscillation_std": 0.003}),
        ("VC", {"robot": "curved", "noise": "six_axis", "oscillation_amplitude_m": 0.08}, {"pixel_std": 0.5}),
        ("VC_predicted", {"dynamic": "lateral", "dynamic_set": "near_path", "oscillation_amplitude_m": 0.05}, {}),
    ],
)
def test_60_frames_of_other_scenarios(gate, scenario, numbers):
    counts = agree(*both(gate, {}, **numbers), head(recorded(seed=4, **scenario), 60))
    assert counts["born"] > 60
    assert counts["accepted"] > 300
    if gate != "RE":
        assert counts["recovered"] > 0
        assert counts["dynamic"] > 0


def test_a_strict_detector_deletes_the_same():
    """So strict that every visible landmark goes that was once not found or not accepted, after three searches."""
    strict = {"min_searches": 3, "min_match_ratio": 1.0, "min_inlier_ratio": 1.0}
    recording = head(recorded(seed=4, robot="lateral", dynamic="lateral", oscillation_amplitude_m=0.05), 50)
    assert agree(*both("RE", strict), recording)["inconsistent"] > 5


def test_an_uncertain_start():
    """Robot and sensor poses known to 0.1 m and 0.01 in each quaternion coordinate, length included."""
    recording = head(recorded(seed=5), 20)
    start_cov = np.diag(np.tile([0.1] * 3 + [0.01] * 4, 2)) ** 2
    agree(*both("VC", {}), dataclasses.replace(recording, start_cov=start_cov))
