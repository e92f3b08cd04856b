"""Trajectory errors against NumPy's own: alignments, steps, drift; and what cannot be compared."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vcjax.recorded.trajectory_error import Trajectory, trajectory_error, trajectory_error_text


def path(num=400) -> Trajectory:
    """A winding path of some 290 m."""
    s = np.linspace(0.0, 1.0, num)
    places = np.column_stack([100 * s, 40 * np.sin(9 * s), 5 * s**2])
    turn = Rotation.from_rotvec(np.column_stack([0 * s, 0.1 * s, np.sin(3 * s)]))
    return Trajectory(np.column_stack([places, turn.as_quat(scalar_first=True)]), 10 + 0.1 * np.arange(num))


def moved(trajectory: Trajectory, turn: Rotation, shift, scale=1.0) -> Trajectory:
    poses = trajectory.poses
    places = scale * turn.apply(poses[:, :3]) + shift
    q = (turn * Rotation.from_quat(poses[:, 3:], scalar_first=True)).as_quat(scalar_first=True)
    return Trajectory(np.column_stack([places, q]), trajectory.time_s)


def disturbed(trajectory: Trajectory, size: float) -> Trajectory:
    noise = size * np.random.default_rng(0).normal(size=(len(trajectory.poses), 3))
    poses = trajectory.poses.copy()
    poses[:, :3] += noise
    return Trajectory(poses, trajectory.time_s)


def test_no_alignment_is_none():
    true = path()
    estimate = disturbed(true, 0.5)
    error = np.linalg.norm(estimate.poses[:, :3] - true.poses[:, :3], axis=1)
    found = trajectory_error(estimate, true).absolute["none"]
    assert found.rmse_m == pytest.approx(np.sqrt(np.mean(error**2)))
    assert (found.mean_m, found.max_m) == pytest.approx((error.mean(), error.max()))
    assert found.rmse_deg == pytest.approx(0.0, abs=1e-5) and found.scale == 1.0


def test_each_alignment_takes_away_what_it_says():
    true, turn = path(), Rotation.from_rotvec([0.2, -0.4, 1.0])
    rigid = trajectory_error(moved(true, turn, [5.0, -3.0, 2.0]), true).absolute
    assert rigid["none"].rmse_m > 5 and rigid["none"].rmse_deg > 20
    for alignment in ("first pose", "rigid", "similarity"):
        assert rigid[alignment].rmse_m < 1e-6 and rigid[alignment].rmse_deg < 1e-4
    scaled = trajectory_error(moved(true, turn, [5.0, -3.0, 2.0], 2.0), true).absolute
    assert scaled["rigid"].rmse_m > 5 and scaled["similarity"].rmse_m < 1e-6
    assert scaled["similarity"].scale == pytest.approx(0.5) and scaled["rigid"].scale == 1.0


def test_rigid_alignment_is_kabschs():
    """Kabsch's least squares by NumPy's SVD; and no other motion near it does better."""
    true = path()
    estimate = disturbed(moved(true, Rotation.from_rotvec([0.1, 0.3, -0.5]), [1.0, 2.0, 3.0]), 0.8)
    a, b = estimate.poses[:, :3], true.poses[:, :3]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    d = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    best = np.sqrt(np.mean(np.sum((a @ u @ d @ vt - b) ** 2, axis=1)))
    assert trajectory_error(estimate, true).absolute["rigid"].rmse_m == pytest.approx(best)


def test_drift_of_a_wrong_scale():
    """An odometer that reads 2 % too much drifts by at most 2 m in 100 m, by just that where the path is straight."""
    true = path()
    found = trajectory_error(moved(true, Rotation.identity(), 0.0, 1.02), true)
    step = np.linalg.norm(np.diff(true.poses[:, :3], axis=0), axis=1)
    assert found.path_m == pytest.approx(step.sum())
    assert found.step_rmse_m == pytest.approx(0.02 * np.sqrt(np.mean(step**2)))
    along = np.concatenate([[0], np.cumsum(step)])
    stretch = found.path_m / 4
    expected = []
    for i in range(len(along)):
        j = np.argmin(np.abs(along - along[i] - stretch))
        if abs(along[j] - along[i] - stretch) < 0.1 * stretch:
            expected.append(0.02 * np.linalg.norm(true.poses[j, :3] - true.poses[i, :3]))
    assert found.stretch_m == pytest.approx(min(100.0, stretch))
    assert found.drift_m_per_100_m == pytest.approx(np.mean(expected) * 100 / stretch, rel=0.02)
    assert 0.5 < found.drift_m_per_100_m <= 2.0 and found.drift_deg_per_100_m == pytest.approx(0, abs=1e-4)


def test_poses_are_compared_by_time_where_there_is_one_and_by_number_where_not():
    true = path()
    late = Trajectory(true.poses[50:], true.time_s[50:] + 0.004)
    found = trajectory_error(late, true)
    assert found.num_poses == 350 and found.absolute["none"].max_m < 1e-9
    unknown = true.poses.copy()
    unknown[::2] = np.nan
    assert trajectory_error(true, Trajectory(unknown, true.time_s)).num_poses == 200
    by_number = trajectory_error(Trajectory(true.poses), true)
    assert by_number.num_poses == 400 and by_number.absolute["none"].max_m < 1e-9


def test_gaps_in_the_truth_are_not_stepped_over():
    """Steps, path length and stretches are those of the parts that are known, here by evaluating each by itself."""
    true = path()
    estimate = moved(true, Rotation.identity(), 0.0, 1.02)
    unknown = true.poses.copy()
    unknown[150:180] = unknown[[299, 301]] = np.nan  # frame 300 is alone
    found = trajectory_error(estimate, Trajectory(unknown, true.time_s))
    step = np.linalg.norm(np.diff(true.poses[:, :3], axis=0), axis=1)
    known = np.concatenate([step[:149], step[180:298], step[302:]])
    assert found.step_rmse_m == pytest.approx(0.02 * np.sqrt(np.mean(known**2)))
    assert found.path_m == pytest.approx(known.sum()) and found.num_poses == 368
    assert found.drift_m_per_100_m <= 2.02  # per 100 m of the path; what spans the gap is not of that length
    without = [np.r_[0:150], np.r_[180:299], [300], np.r_[302:400]]
    file = Trajectory(*(np.concatenate([x[part] for part in without]) for x in true))  # rows that lack, in place of NaN
    assert trajectory_error(estimate, file) == found


def test_truth_of_every_other_frame_is_no_gap():
    true = path()
    found = trajectory_error(moved(true, Rotation.identity(), 0.0, 1.02), Trajectory(true.poses[::2], true.time_s[::2]))
    step = np.linalg.norm(np.diff(true.poses[::2, :3], axis=0), axis=1)
    assert found.num_poses == 200 and found.step_rmse_m == pytest.approx(0.02 * np.sqrt(np.mean(step**2)))
    assert "\nRPE, steps of 0.2 s " in trajectory_error_text(found)


def test_steps_are_as_long_as_the_truth_is_sparse():
    true, sparse = path(), path().poses.copy()
    sparse[np.arange(400) % 10 != 0] = np.nan
    for times, step in ((true.time_s, "1 s"), (None, "10 poses")):
        found = trajectory_error(Trajectory(true.poses, times), Trajectory(sparse, times))
        assert f"\nRPE, steps of {step} " in trajectory_error_text(found)


def test_what_cannot_be_compared_is_refused():
    true = path()
    with pytest.raises(ValueError, match=r"fewer than two poses .* the estimate is of 1010\.0 to .*truth of 10\.0 to"):
        trajectory_error(Trajectory(true.poses, true.time_s + 1000), true)
    with pytest.raises(ValueError, match="399 poses, but 400 true ones, and one of the two has no times"):
        trajectory_error(Trajectory(true.poses[1:]), true)
    with pytest.raises(ValueError, match="fewer than two poses"):
        trajectory_error(true, Trajectory(np.full((400, 7), np.nan), true.time_s))


def test_a_straight_path_has_no_best_turn():
    poses = np.zeros((20, 7))
    poses[:, 0], poses[:, 3] = np.arange(20), 1.0
    found = trajectory_error(Trajectory(poses), Trajectory(poses))
    assert math.isnan(found.absolute["rigid"].rmse_m) and found.absolute["first pose"].rmse_m < 1e-9
    text = trajectory_error_text(found)
    assert "APE, aligned, rigid        not determined: the places lie on a line" in text


def test_every_line_says_what_is_aligned():
    lines = trajectory_error_text(trajectory_error(disturbed(path(), 0.1), path())).splitlines()
    assert [line[:26].strip() for line in lines] == [
        "compared", "APE, not aligned", "APE, first pose aligned", "APE, aligned, rigid", "APE, aligned, with scale",
        "RPE, steps of 0.1 s", "drift per 100 m",
    ]  # fmt: skip
    assert "scale" in lines[4] and all(line.endswith("not aligned") for line in lines[5:])


def test_a_robot_that_stands_has_no_drift():
    poses = np.tile([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0], (5, 1))
    found = trajectory_error(Trajectory(poses), Trajectory(poses))
    assert math.isnan(found.drift_m_per_100_m) and found.absolute["none"].rmse_m == 0.0
    assert trajectory_error_text(found).splitlines()[-1].endswith("not determined: the path is too short")


def test_drift_of_a_short_path_is_noise_and_not_told():
    poses = path(20).poses
    short = Trajectory(poses * np.array([0.005, 0.005, 0.005, 1, 1, 1, 1]))
    text = trajectory_error_text(trajectory_error(disturbed(short, 1e-3), short))
    assert text.splitlines()[-1].endswith("not determined: the path is too short")
