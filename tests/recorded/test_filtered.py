"""Recordings filtered in stretches: the numbers of one scan, and the map that a scan forgets."""

import dataclasses
import os
import tracemalloc
from pathlib import Path

import jax
import numpy as np
import pytest
import recorded
from quick import QUICK
from rendered import scenario
from scipy import stats
from scipy.spatial.transform import Rotation
from tiny_runs import compilations

import vcjax as vc
from vcjax.filter.motion_model import BiasedOdometry
from vcjax.filter.state import landmark_cov
from vcjax.filter.stretches import STRETCH
from vcjax.recorded.filtered import filter_recording
from vcjax.recorded.run_folder import robot_poses
from vcjax.recorded.track_detection import track_detection
from vcjax.recorded.verdicts import track_verdicts, verdicts
from vcjax.recording import PER_FRAME, last_sightings
from vcjax.sources.calibration import Calibration
from vcjax.sources.odometry import dead_reckoning, from_velocities
from vcjax.sources.repeats import cut_recording
from vcjax.sources.tracks import Tracks, recording_from_tracks

run_once = jax.jit(vc.run, compiler_options=QUICK)


def test_infos_and_map_are_those_of_one_scan():
    recording, found = recorded.content().recording, recorded.run()
    state, info = run_once(recorded.config(), recording)
    left_out = {f.name for f in dataclasses.fields(info) if getattr(found.info, f.name) is None}
    assert left_out == {
        "carried", "carried_std", "pixel", "innovation", "innovation_cov", "re1_prior", "p_dynamic", "detector",
        "p_detector", "departed", "followers", "handed_back_id",
    }  # fmt: skip
    for name in {f.name for f in dataclasses.fields(info)} - left_out:
        one, other = (jax.tree.leaves(getattr(x, name)) for x in (found.info, info))
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-8, err_msg=name)
    # Those that the map still holds, worked out anew: p₀ + m/ρ, and its covariance by differences.
    held = np.flatnonzero(np.asarray(state.track_id) >= 0)
    landmarks, cov = np.asarray(state.landmarks)[held], np.asarray(landmark_cov(state))[held]

    def point(x):
        return x[:3] + x[3:6] / x[6]

    places = dict(zip(found.landmarks.track_id.tolist(), found.landmarks.place_m, strict=True))
    covs = dict(zip(found.landmarks.track_id.tolist(), found.landmarks.cov, strict=True))
    assert len(held) > 5
    for track, x, P in zip(np.asarray(state.track_id)[held].tolist(), landmarks, cov, strict=True):
        J = np.stack([(point(x + step) - point(x - step)) / 2e-6 for step in 1e-6 * np.eye(7)], axis=1)
        np.testing.assert_allclose(places[track], point(x), atol=1e-8 * np.abs(point(x)).max())
        np.testing.assert_allclose(covs[track], J @ P @ J.T, atol=1e-4 * np.abs(covs[track]).max())


def test_memory_grows_by_what_is_kept_of_each_frame_alone():
    """Nothing is held twice, and nothing that no result is made of."""
    recorded.run()
    recording, peaks, kept = recorded.content().recording, [], 0

    def begin(done, _):
        if done <= STRETCH:
            tracemalloc.reset_peak()  # what it took to check the recording is free again

    for laps in (20, 60):
        many = {name: np.concatenate([np.asarray(getattr(recording, name))] * laps) for name in PER_FRAME}
        many["time_s"] = 0.1 * np.arange(30 * laps)
        many["is_last"] = last_sightings(many["track_id"], many["is_valid"])
        long = dataclasses.replace(recording, **many)
        tracemalloc.start()
        found = filter_recording(recorded.config(), long, begin)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        kept = sum(leaf.nbytes for leaf in jax.tree.leaves(found.info)) / (30 * laps)
    per_frame = (peaks[1] - peaks[0]) / (30 * 40)
    assert kept < 5000 and per_frame < 1.2 * kept


def test_landmarks_that_left_the_map_stay_known():
    """Near to where a run over the frames that held them has them: all that came after is the frame they left in."""
    recording, found = recorded.content().recording, recorded.run()
    ids = found.info.track_id
    born = np.unique(ids[ids >= 0])
    np.testing.assert_array_equal(found.landmarks.track_id, born)
    gone = [track for track in born.tolist() if track not in ids[-1]]
    last = {track: int(np.flatnonzero(np.any(ids == track, axis=1))[-1]) for track in gone}
    track = next(track for track in gone if 5 < last[track] < 20)
    cut = {name: getattr(recording, name)[: last[track] + 1] for name in PER_FRAME}
    until = filter_recording(recorded.config(), dataclasses.replace(recording, **cut))
    index, end = (np.flatnonzero(x.landmarks.track_id == track)[0] for x in (found, until))
    moved = found.landmarks.place_m[index] - until.landmarks.place_m[end]
    before, after = until.landmarks.cov[end], found.landmarks.cov[index]
    assert moved @ np.linalg.solve(before, moved) < 9  # a correction's worth
    assert 0.2 * np.trace(before) < np.trace(after) < 2.0 * np.trace(before)


def test_another_threshold_compiles_nothing_and_progress_ends_with_the_last_frame():
    recorded.run()
    done = []
    with compilations() as compiled:
        strict = recorded.config(gate=vc.VirtualCorrection(th1=2.0, th2=1.0))
        found = filter_recording(strict, recorded.content().recording, lambda *counts: done.append(counts))
    assert compiled.num == 0 and done[-1] == (30, 30)
    assert found.info.is_dynamic.sum() > recorded.run().info.is_dynamic.sum()
    assert found.compile_s >= 0 and found.run_s > 0


def test_images_tell_more_than_odometry():
    """The same images with twelve draws of odometry, paired: the mean position error is below odometry's.

    And of the four movers that are looked at three are found, with two static tracks of forty called dynamic at most.
    """
    content, differences = recorded.content(), []
    for seed in range(12):
        drawn, _ = vc.simulate(scenario(), jax.random.key(seed))
        recording = dataclasses.replace(content.recording, odometry=np.asarray(drawn.odometry))
        found = filter_recording(recorded.config(), recording)
        alone = recorded.position_rms(dead_reckoning(recording))
        differences.append(recorded.position_rms(robot_poses(found.info)) - alone)
        scores = track_detection(track_verdicts(verdicts(found.info), found.info), content.labels)
        assert scores.num_found >= 3 and scores.num_false <= 2 and scores.auc[0] > 0.95
    half = stats.t.ppf(0.975, 11) * np.std(differences, ddof=1) / np.sqrt(12)
    assert np.mean(differences) + half < -0.002  # m; a filter that does nothing has 0


@pytest.mark.usefixtures("unchecked")
def test_what_cannot_be_run_is_refused():
    recording = recorded.content().recording
    with pytest.raises(ValueError, match=r"birth_order='random'\): births of recordings go by id"):
        filter_recording(recorded.config(birth_order="random"), recording)
    with pytest.raises(ValueError, match=r"odometry\[3, 2\] = nan"):
        odometry = np.array(recording.odometry)
        odometry[3, 2] = np.nan
        filter_recording(recorded.config(), dataclasses.replace(recording, odometry=odometry))


@pytest.mark.slow
@pytest.mark.skipif("VCJAX_DATA" not in os.environ, reason="needs the real recordings of VCJAX_DATA")
def test_real_car_is_led_better_than_by_its_odometry():
    """695 m with the settings of docs/real_recordings.md: a third of odometry's position error at most, all finite."""
    data = np.load(Path(os.environ["VCJAX_DATA"]) / "kitti07_tracks" / "tracks.npz")
    K, T_r_s = data["K"], np.eye(4)
    T_r_s[:3, :3], T_r_s[:3, 3] = data["cam_T_imu"][:3, :3].T, data["cam_T_imu"][:3, 3]
    mount = (*T_r_s[:3, 3], *Rotation.from_matrix(T_r_s[:3, :3]).as_quat(scalar_first=True))
    lens = Calibration(1226, 370, K[0, 0], K[1, 1], K[0, 2], K[1, 2], T_r_s=mount)
    odometry = from_velocities(data["time"], data["v_imu"], data["w_imu"], 0.5, 0.05)
    tracks = Tracks(data["frame"], data["track"], data["uv_left"].astype(float))
    recording = recording_from_tracks(tracks, lens, time_s=data["time"], odometry=odometry)
    config = vc.FilterConfig(
        gate=vc.VirtualCorrection(),
        motion=BiasedOdometry(rate_bias_std_rad_s=0.005),
        errors="invariant",
        max_updates=20,
        births_first_frame=20,
        births_per_frame=5,
        choose_among="measured",
    )
    found = filter_recording(config, cut_recording(recording).recording)
    assert np.all(found.info.is_finite) and all(np.isfinite(part).all() for part in found.landmarks)
    T_w_r = [np.vstack([T, [0, 0, 0, 1]]) @ np.linalg.inv(T_r_s) for T in data["T_w_cam0"]]
    true = (np.linalg.inv(T_w_r[0]) @ T_w_r)[:, :3, 3]

    def rms(path):
        return np.sqrt(np.mean(np.sum((path[: len(true), :3] - true) ** 2, axis=1)))

    alone, led = rms(dead_reckoning(recording)), rms(robot_poses(found.info))
    print(f"position RMS {alone:.1f} m by odometry, {led:.1f} m by the filter")
    assert led < alone / 3
