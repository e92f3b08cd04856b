"""The commands for recordings: from images to tracks, run and evaluation, against exact truth."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
import recorded
from rendered import rendered, tracked
from told import assert_one_line, said

import vcjax as vc
from vcjax.cli import main
from vcjax.recording import last_sightings
from vcjax.sources.map_file import read_map
from vcjax.sources.odometry import dead_reckoning
from vcjax.sources.recording_file import load_recording, save_recording
from vcjax.sources.table_recording import write_labels
from vcjax.sources.tracks import write_tracks
from vcjax.sources.trajectory_file import read_tum, write_kitti, write_tum

pytestmark = pytest.mark.usefixtures("unchecked")  # as people have it


def test_images_become_a_recording(folder, tmp_path, capsys):
    out = tmp_path / "tracks.npz"
    assert main(["track", str(folder), "--out", str(out)]) == 0
    printed, told = said(capsys)
    assert "frames          30 in 2.9 s" in printed and f"wrote {out}" in told
    found, expected = load_recording(out), recorded.content()
    np.testing.assert_array_equal(found.recording.track_id, expected.recording.track_id)
    np.testing.assert_array_equal(found.recording.uv_px, expected.recording.uv_px)
    np.testing.assert_allclose(found.truth.robot, expected.truth.robot, atol=1e-9)
    assert found.image_paths == expected.image_paths and found.calibration == expected.calibration
    options = ["--first", "10", "--last", "20", "--max-features", "20", "--out", str(out)]
    assert main(["track", str(folder), *options]) == 0
    part = load_recording(out)
    assert part.recording.num_frames == 10 and part.recording.is_valid.sum(axis=1).max() <= 20


def test_images_without_anything_need_calibration_and_rate(folder, tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    for path in rendered().sequence.paths[:4]:
        shutil.copy(path, images)
    calibration = folder / "calibration.json"
    command = ["track", str(images), "--out", str(tmp_path / "a.npz")]
    assert main([*command, "--calibration", str(calibration)]) == 1
    assert_one_line(said(capsys)[1], "give times.csv in the folder or rate_hz")
    assert main([*command, "--calibration", str(calibration), "--rate-hz", "20", "--speed-std-m-s", "0.3"]) == 0
    recording = load_recording(tmp_path / "a.npz").recording
    np.testing.assert_allclose(np.diff(recording.time_s), 0.05)
    np.testing.assert_allclose(recording.odometry_cov[1:, 0, 0], (0.3 * 0.05) ** 2)


def test_start_at_the_truth(folder, tmp_path, capsys):
    """Without odometry, where the first image is the start: the pose of the truth there."""
    copy = tmp_path / "sequence"
    shutil.copytree(folder, copy)
    command = ["track", str(copy), "--start", "truth", "--out", str(tmp_path / "a.npz")]
    assert main(command) == 1
    assert_one_line(said(capsys)[1], "the odometry moves before the first image")
    (copy / "odometry.csv").unlink()
    assert main(command) == 0
    found = load_recording(tmp_path / "a.npz")
    np.testing.assert_array_equal(found.recording.robot_start, found.truth.robot[0])
    (copy / "groundtruth.txt").unlink()
    said(capsys)
    assert main(command) == 1
    assert_one_line(said(capsys)[1], "has no true pose of the first image")


def test_tables_become_a_recording(folder, tmp_path, capsys):
    tracks = write_tracks(tmp_path / "tracks.csv", tracked())
    known = ["--calibration", str(folder / "calibration.json"), "--out", str(tmp_path / "a.npz")]
    assert main(["record", str(tracks), *known]) == 1
    assert_one_line(said(capsys)[1], "give --times or --rate-hz, one of the two")
    known += ["--times", str(folder / "times.csv"), "--odometry", str(folder / "odometry.csv"), "--truth-of", "camera"]
    labels = write_labels(tmp_path / "labels.csv", recorded.content().labels)
    assert (
        main(["record", str(tracks), *known, "--truth", str(folder / "groundtruth.txt"), "--labels", str(labels)]) == 0
    )
    assert "poses of 30 frames" in said(capsys)[0]
    found = load_recording(tmp_path / "a.npz")
    np.testing.assert_array_equal(found.recording.uv_px, recorded.content().recording.uv_px)
    np.testing.assert_allclose(found.truth.robot, recorded.content().truth.robot, atol=1e-9)
    np.testing.assert_array_equal(found.labels.label, recorded.content().labels.label)


def test_inspect_prints_and_draws(tmp_path, capsys):
    path = tmp_path / "a.npz"
    shutil.copy(recorded.recording_path(), path)
    assert main(["inspect", str(path)]) == 0
    printed, told = said(capsys)
    assert "truth           poses of 30 frames" in printed and "moving" in printed
    assert (tmp_path / "a_overview.png").stat().st_size > 10_000 and f"wrote {tmp_path / 'a_overview.png'}" in told
    assert main(["inspect", str(path), "--picture", str(tmp_path / "b" / "c.png")]) == 0
    assert (tmp_path / "b" / "c.png").exists()
    said(capsys)
    image = tmp_path / "image.png"
    image.write_bytes(b"mine")
    save_recording(path, load_recording(path)._replace(image_paths=("image.png",) * 30))
    assert main(["inspect", str(path), "--picture", str(image)]) == 1 and image.read_bytes() == b"mine"
    assert_one_line(said(capsys)[1], "image.png", "one of the files that are read")


def test_run_writes_all_that_there_is_to_see(results, capsys):
    names = set(recorded.contents(results))
    assert names == {
        "robot_tum.txt", "robot_kitti.txt", "camera_tum.txt", "camera_kitti.txt", "landmarks.ply", "landmarks.csv",
        "verdicts.csv", "tracks.csv", "summary.json", "path.png", "features.gif", "features/000014.png",
        "features/000029.png",
    }  # fmt: skip
    summary = json.loads((results / "summary.json").read_text(), parse_constant=pytest.fail)  # no Infinity, no NaN
    assert (
        summary["config"]["blacklist_frames"] is None
        and summary["recording"] == str(recorded.recording_path())
        and summary["failures"] == 0
    )
    assert summary["config"]["gate"]["th1"] == 9.0 and summary["frames"] == 30
    # The truth is exact, and the path nearer to it than that of the odometry.
    _, robot = read_tum(results / "robot_tum.txt")
    alone = recorded.position_rms(dead_reckoning(recorded.content().recording))
    assert recorded.position_rms(robot) < 0.75 * alone
    # The camera of the rendered sequence swings on the robot by 10 cm; so does the estimate.
    _, camera = read_tum(results / "camera_tum.txt")
    assert 0.08 < np.ptp(camera[:, 1] - robot[:, 1]) < 0.12


def test_evaluate_finds_the_movers_and_names_every_alignment(results, tmp_path, capsys):
    assert main(["evaluate", str(results), "--out", str(tmp_path / "a.txt")]) == 0
    printed, _ = said(capsys)
    assert (tmp_path / "a.txt").read_text() == printed
    own, alone, movers = printed.split("\n\n")
    assert own.startswith(
        "poses of                   the robot\ncompared                   30 poses"
    ) and alone.startswith("odometry alone")
    error = np.linalg.norm(read_tum(results / "robot_tum.txt")[1][:, :3] - rendered().truth.robot[:, :3], axis=1)
    assert f"APE, not aligned           {np.sqrt(np.mean(error**2)):.4g} m RMS" in own
    words = movers.splitlines()[0].split()
    auc = next(line for line in movers.splitlines() if line.startswith("AUC, gate")).removeprefix("AUC, gate")
    assert int(words[1]) >= 3 and float(auc.split()[0]) > 0.9
    # The same by a trajectory file and by true poses in a file, in both formats.
    truth = np.asarray(rendered().truth.robot)
    write_tum(tmp_path / "true.txt", recorded.content().recording.time_s, truth)
    write_kitti(tmp_path / "true_kitti.txt", truth)
    for estimate, true in (("robot_tum.txt", "true.txt"), ("robot_kitti.txt", "true_kitti.txt"), (".", "true.txt")):
        assert main(["evaluate", str(results / estimate), "--truth", str(tmp_path / true)]) == 0
        assert said(capsys)[0].splitlines()[:6] == own.splitlines()[:6]


def test_run_and_simulate_meet(tmp_path, capsys):
    """A seed's recording on disk, run by itself, gives what the batch gave."""
    # As small as in test_commands.py, which compiles the same.
    options = "--num-frames 12 --max-landmarks 24 --max-updates 6 --dynamic lateral --seeds 3"
    runs, recording = tmp_path / "runs.nc", tmp_path / "first.npz"
    assert main(["simulate", *options.split(), "--out", str(runs), "--recording", str(recording), "--key", "7"]) == 0
    assert f"wrote {recording}" in said(capsys)[1]
    content = load_recording(recording)
    scenario = vc.scenarios.paper(dynamic="lateral", num_frames=12)
    expected, truth = vc.simulate(scenario, jax.random.fold_in(jax.random.key(7), 0))
    np.testing.assert_allclose(content.recording.uv_px, expected.uv_px, atol=1e-9)
    np.testing.assert_allclose(content.truth.robot, truth.robot, atol=1e-12)
    from vcjax.study.results import load

    command = ["run", str(recording), "--max-landmarks", "24", "--max-updates", "6", "--out", str(tmp_path / "run")]
    assert main([*command, "--animation", "none", "--pictures", "1"]) == 0
    _, robot = read_tum(tmp_path / "run" / "robot_tum.txt")
    np.testing.assert_allclose(robot, load(runs).robot.values[0], atol=1e-9)
    assert main(["evaluate", str(tmp_path / "run")]) == 0
    assert "(6 labelled)" in said(capsys)[0]


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """The recording without odometry or commanded motion of the camera: nothing gives it a scale."""
    content = recorded.content()
    nothing = {"odometry": np.zeros((30, 6)), "sensor_shift_m": np.zeros((30, 3))}
    recording = dataclasses.replace(content.recording, **nothing)
    return save_recording(tmp_path_factory.mktemp("bare") / "bare.npz", content._replace(recording=recording))


def test_scale_by_a_distance_by_points_or_free(bare, tmp_path, capsys):
    out, points = tmp_path / "run", tmp_path / "points.csv"
    command = ["run", str(bare), *recorded.OPTIONS, "--motion", "constant_velocity", "--inverse-depth-mean", "0.3"]
    command += ["--acceleration", "0.5", "--cut-repeats", "--out", str(out), "--pictures", "0", "--animation", "none"]
    assert main(command) == 0
    printed, told = said(capsys)
    assert "scale            free: lengths are those of the priors" in printed and "no odometry" not in told
    summary = json.loads((out / "summary.json").read_text())
    assert summary["config"]["motion"]["acceleration"] == 0.5 and summary["tracks_cut"] == 0
    free = read_map(out / "landmarks.csv")
    i, j = np.argsort(np.trace(free.cov, axis1=1, axis2=2))[:2]
    pair = [str(free.track_id[i]), str(free.track_id[j])]
    assert main([*command, "--known-distance", *pair, "1.3"]) == 0
    printed = said(capsys)[0]
    assert f"scale            known from 1.3 m between tracks {pair[0]} and {pair[1]}; lengths are mult" in printed
    without = ["run", str(bare), *recorded.OPTIONS, "--out", str(tmp_path / "b"), "--pictures", "0"]
    assert main([*without, "--animation", "none"]) == 0
    assert "no odometry: run with --motion constant_velocity; the scale is free" in said(capsys)[1]
    scaled = read_map(out / "landmarks.csv")
    assert np.linalg.norm(scaled.place_m[i] - scaled.place_m[j]) == pytest.approx(1.3)
    x, y, z = recorded.run().landmarks.place_m[0]
    points.write_text(f"track_id,x,y,z\n{recorded.run().landmarks.track_id[0]},{x},{y},{z}\n")
    assert main([*command, "--known", str(points), "--known-std-m", "0.02"]) == 0
    assert "scale            known from 1 known landmark\n" in said(capsys)[0]
    before = recorded.contents(out)
    assert main([*command, "--known", str(points), "--known-distance", *pair, "1"]) == 1
    assert_one_line(said(capsys)[1], "is known from 1 known landmark; leave one of the two out")
    assert main([*command, "--known-distance", "0", "99999", "1"]) == 1
    assert_one_line(said(capsys)[1], "known distance from track 99999: the recording has no such track")
    assert recorded.contents(out) == before


def test_known_points_keep_their_tracks_where_tracks_are_cut(tmp_path, capsys):
    """Ids that are nothing like the numbers of pieces, and tracks that are cut all around the known one."""
    content, found = recorded.content(), recorded.run().landmarks
    recording, uv_px = content.recording, np.array(content.recording.uv_px)
    is_valid, ids = np.asarray(recording.is_valid), np.asarray(recording.track_id)
    for column in np.flatnonzero(is_valid[20]):
        if len(before := np.flatnonzero(is_valid[19] & (ids[19] == ids[20, column]))):
            uv_px[20, column] = uv_px[19, before[0]]
    ends = {int(track): np.flatnonzero((is_valid & (ids == track)).any(axis=1)) for track in found.track_id}
    is_whole = [ends[int(track)][0] == 0 and ends[int(track)][-1] < 19 for track in found.track_id]
    best = np.argmin(np.where(is_whole, np.trace(found.cov, axis1=1, axis2=2), np.inf))
    ids = np.where(is_valid, 1000 - ids, 0)
    changed = {"track_id": ids, "uv_px": uv_px, "is_last": last_sightings(ids, is_valid)}
    recording = dataclasses.replace(recording, **changed)
    path = save_recording(tmp_path / "a.npz", content._replace(recording=recording, labels=None, image_paths=None))
    points, known, (x, y, z) = tmp_path / "points.csv", 1000 - int(found.track_id[best]), found.place_m[best]
    points.write_text(f"track_id,x,y,z\n{known},{x},{y},{z}\n")
    command = ["run", str(path), *recorded.OPTIONS, "--cut-repeats", "--known", str(points), "--pictures", "0"]
    assert main([*command, "--animation", "none", "--out", str(tmp_path / "run")]) == 0
    mapped = read_map(tmp_path / "run" / "landmarks.csv")
    distance = np.linalg.norm(mapped.place_m - [x, y, z], axis=1)
    assert int(mapped.track_id[np.argmin(distance)]) == known and distance.min() < 0.02
    assert mapped.kind[np.argmin(distance)] == "accepted"
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["scale"] == "known from odometry" and summary["tracks_cut"] > 20


def test_missing_images_are_told_and_drawn_without(tmp_path, capsys):
    path = save_recording(tmp_path / "a.npz", recorded.content()._replace(image_paths=("gone.png",) * 30))
    command = ["run", str(path), *recorded.OPTIONS, "--animation", "none", "--out", str(tmp_path / "run")]
    assert main(command) == 0
    told = said(capsys)[1]
    assert f"drawn on plain axes: 8 frames, first frame 4: {tmp_path / 'gone.png'}: no such image." in told


def test_damaged_image_is_told_and_the_results_are_written(results, tmp_path, capsys):
    (tmp_path / "bad.png").write_bytes(b"no picture")
    paths = (*recorded.content().image_paths[:29], "bad.png")
    path = save_recording(tmp_path / "a.npz", recorded.content()._replace(image_paths=paths))
    out = tmp_path / "run"
    assert main(["run", str(path), *recorded.OPTIONS, "--out", str(out), "--pictures", "2"]) == 0
    assert f"drawn on plain axes: frame 29: {tmp_path / 'bad.png'}: no image that can be read" in said(capsys)[1]
    found, expected = recorded.contents(out), recorded.contents(results)
    assert set(found) == set(expected) and found["features/000014.png"] == expected["features/000014.png"]
    assert all(found[name] == expected[name] for name in expected if name.endswith((".csv", ".txt", ".ply")))


def test_evaluate_the_path_of_the_camera(results, folder, tmp_path, capsys):
    """The camera's true poses are another path; the run, its file and the recording's truth say the same of it."""
    evaluate = ["evaluate", "--truth-of", "camera"]
    assert main([*evaluate, str(results)]) == 0
    whole, alone, _ = said(capsys)[0].split("\n\n")
    assert alone.startswith("odometry alone")
    for estimate, truth in (
        (results, folder / "groundtruth.txt"),
        (results / "camera_tum.txt", folder / "groundtruth.txt"),
        (results / "camera_tum.txt", recorded.recording_path()),
    ):
        assert main([*evaluate, str(estimate), "--truth", str(truth)]) == 0
        assert said(capsys)[0].splitlines()[:6] == whole.splitlines()[:6]
    error = read_tum(results / "camera_tum.txt")[1][:, :3] - read_tum(folder / "groundtruth.txt")[1][:, :3]
    assert f"APE, not aligned           {np.sqrt(np.mean(np.sum(error**2, axis=1))):.4g} m RMS" in whole
    assert main(["evaluate", str(results / "camera_tum.txt"), "--truth", str(recorded.recording_path())]) == 0
    assert said(capsys)[0].startswith("poses of                   the robot\n")


def test_evaluate_knows_a_recording_that_was_replaced(results, tmp_path, capsys):
    """By the recording itself: truth and labels may be better known today."""
    copy, path = tmp_path / "run", tmp_path / "a.npz"
    shutil.copytree(results, copy)
    summary = json.loads((copy / "summary.json").read_text())
    (copy / "summary.json").write_text(json.dumps(summary | {"recording": str(path)}))
    content = recorded.content()
    save_recording(path, content._replace(labels=None))
    assert main(["evaluate", str(copy)]) == 0
    said(capsys)
    odometry = np.array(content.recording.odometry)
    odometry[5, 0] += 1e-9
    save_recording(path, content._replace(recording=dataclasses.replace(content.recording, odometry=odometry)))
    assert main(["evaluate", str(copy)]) == 1
    assert_one_line(said(capsys)[1], "a.npz is not the recording that was run any more", "or give --truth")
    assert main(["evaluate", str(copy), "--truth", str(path)]) == 0
