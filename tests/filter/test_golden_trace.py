"""The filter replays the golden run: same controls and pixels, hence the same choices, numbers and map for 60 frames.

Tolerance: the two implementations order their sums differently; rounding of 1e-16 grows with pixels of 1e3 and through
60 frames to 1e-11 or so. A wrong formula shows from 1e-6 on. 1e-8 lies between.
"""

import jax
import numpy as np
import pytest
from filter_runs import filtered, ids, landmarks

from vcjax.filter import slam
from vcjax.filter.config import FilterConfig
from vcjax.gates.reprojection import ReprojectionError
from vcjax.models.camera import Camera
from vcjax.recording import Recording, last_sightings


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8)


@pytest.fixture(scope="module")
def trace(golden):
    return golden("trace_static_re.json")


@pytest.fixture(scope="module")
def replay(trace):
    """Of every frame its info, and the map: kind, mean and covariance by id, and the detector's counts by id."""
    init, frames = trace["init"], trace["frames"]
    shape = len(frames), max(len(f["raw_ids"]) for f in frames)
    track_id, is_valid, uv_px = np.full(shape, -1, np.int32), np.zeros(shape, bool), np.full((*shape, 2), np.nan)
    for t, f in enumerate(frames):
        n = len(f["raw_ids"])
        track_id[t, :n], is_valid[t, :n], uv_px[t, :n] = f["raw_ids"], True, f["raw_pix"]
    start_cov = np.zeros((14, 14))
    start_cov[:7, :7], start_cov[7:, 7:] = init["rob_P"], init["sen_P"]
    recording = Recording(
        time_s=0.1 * np.arange(len(frames)),
        odometry=np.array([f["u"] for f in frames]),
        odometry_cov=np.tile(np.array(init["U"]), (len(frames), 1, 1)),
        sensor_shift_m=np.zeros((len(frames), 3)),
        track_id=track_id,
        uv_px=uv_px,
        is_valid=is_valid,
        is_last=last_sightings(track_id, is_valid),
        camera=Camera(),
        robot_start=np.array(init["rob_x"], float),
        sensor_start=np.array(init["sen_x"]),
        start_cov=start_cov,
    )
    config = FilterConfig(gate=ReprojectionError(9.0), max_landmarks=96, retire=False, toolbox_parity=True)
    frames = filtered(config, recording, start=jax.jit(slam.start), step=jax.jit(slam.step))  # compiled as for users
    return [(info, landmarks(state), counts_by_id(state)) for state, info in frames]


def counts_by_id(state):
    """How often each landmark was searched, measured and used in a correction."""
    return {int(i): counts for i, counts in zip(state.track_id, np.stack(state.detector, axis=-1), strict=True)}


def test_every_frame_ends_in_the_same_state(replay, trace):
    for (info, *_), f in zip(replay, trace["frames"], strict=True):
        close(info.vehicle, f["rob_x"] + f["sen_x"])
        close(info.vehicle_cov[:7, :7], f["rob_P"])
        close(info.vehicle_cov[7:, 7:], f["sen_P"])
        assert info.is_finite
        assert not info.map_is_full


def test_the_same_candidates_are_chosen_measured_and_accepted(replay, trace):
    for (info, *_), f in zip(replay, trace["frames"], strict=True):
        n = len(f["candidates"])
        assert ids(info.candidate_id) == [c["id"] for c in f["candidates"]]
        assert info.is_measured[:n].tolist() == [c["matched"] for c in f["candidates"]]
        assert info.is_accepted[:n].tolist() == [c["updated"] for c in f["candidates"]]
        for flags in (info.is_measured[n:], info.is_accepted[n:], info.is_recovered, info.is_dynamic):
            assert not flags.any()


def test_innovations_and_their_distances_are_the_same(replay, trace):
    num_compared = 0
    for (info, *_), f in zip(replay, trace["frames"], strict=True):
        for k, c in enumerate(f["candidates"]):
            if c["matched"]:
                close(info.pixel[k], c["e"])
                close(info.innovation[k], c["z"])
                close(info.innovation_cov[k], c["Z"])
                close(info.innovation_cov[k] - np.eye(2), c["E"])
                close(info.re1[k], c["MD2"])
                num_compared += 1
    assert num_compared > 550


def test_the_same_landmarks_become_euclidean(replay, trace):
    before = set()
    for (_, ours, _), f in zip(replay, trace["frames"], strict=True):
        after = {i for i, (kind, _, _) in ours.items() if kind == "euclidean"}
        assert after - before == {c["id"] for c in f["candidates"] if c["reparam"]}
        before = after
    assert before


def test_births_and_deletions_are_the_same(replay, trace):
    for (info, *_), f in zip(replay, trace["frames"], strict=True):
        assert ids(info.born_id) == f["born"]
        assert sorted(ids(info.inconsistent_id)) == sorted(f["deleted"])


def test_the_map_is_the_same(replay, trace):
    for (_, ours, counts), f in zip(replay, trace["frames"], strict=True):
        assert sorted(ours) == sorted(g["id"] for g in f["landmarks"])
        for g in f["landmarks"]:
            kind, mean, cov = ours[g["id"]]
            assert kind == g["kind"]
            close(mean, g["x"])
            close(np.diag(cov), g["Pdiag"])
            assert counts[g["id"]].tolist() == g["counters"]
