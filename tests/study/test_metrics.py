"""Metrics of a run against plain NumPy: errors, consistency, and counts by Python loops."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_runs
from scipy.spatial.transform import Rotation

from vcjax.study.metrics import map_nees, run_metrics, trajectory_errors


@pytest.fixture(scope="module")
def whole_run():
    """A run in which features were recovered and called dynamic, and some more invented deletions."""
    recording, truth = tiny_runs.simulate_once(tiny_runs.scenario(), jax.random.key(3))
    state, info = tiny_runs.run_once(tiny_runs.config(tiny_runs.STRICT), recording)
    state, info, truth = jax.device_get((state, info, truth))
    random = np.random.default_rng(0)
    ids = np.where(random.random(info.inconsistent_id.shape) < 0.1, random.integers(0, 20, info.track_id.shape), -1)
    return state, eqx.tree_at(lambda i: i.inconsistent_id, info, ids.astype(np.int32)), truth


@pytest.fixture(scope="module")
def run_and_truth(whole_run):
    """Its info and truth."""
    return whole_run[1:]


@pytest.fixture(scope="module")
def metrics(whole_run):
    return jax.device_get(run_metrics(*as_jax(whole_run)))


def as_jax(tree):
    return jax.tree.map(jnp.asarray, tree)


def rotation(pose: np.ndarray) -> Rotation:
    return Rotation.from_quat(pose[3:7], scalar_first=True)


def rotation_of_all(truth) -> Rotation:
    return Rotation.from_quat(truth.robot[:, 3:7], scalar_first=True)


def errors_of(info, truth):
    return trajectory_errors(*as_jax((info, truth)))


def yaw_of(quaternion: np.ndarray) -> float:
    return Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX")[0]


def yaw_gradient(quaternion: np.ndarray) -> np.ndarray:
    """By central differences; the step balances truncation against rounding."""
    step = 1e-5
    return np.array([(yaw_of(quaternion + d) - yaw_of(quaternion - d)) / (2 * step) for d in step * np.eye(4)])


def with_robot(info_or_truth, name: str, rotations: Rotation):
    """The same with other orientations of the robot."""
    poses = np.array(getattr(info_or_truth, name))
    poses[:, 3:7] = rotations.as_quat(scalar_first=True)
    return eqx.tree_at(lambda tree: getattr(tree, name), info_or_truth, poses)


def test_errors_equal_those_of_rotation_matrices(run_and_truth, metrics):
    info, truth = run_and_truth
    for t, (estimate, true) in enumerate(zip(info.vehicle, truth.robot, strict=True)):
        position = np.hypot(estimate[0] - true[0], estimate[1] - true[1])
        angle = np.rad2deg((rotation(true).inv() * rotation(estimate)).magnitude())
        yaw = np.rad2deg(abs(yaw_of(estimate[3:7]) - yaw_of(true[3:7])))
        found = [metrics[name][t] for name in ("position_error_m", "orientation_error_deg", "yaw_error_deg")]
        np.testing.assert_allclose(found, [position, angle, yaw], rtol=1e-9, atol=1e-12)
    assert metrics["position_error_m"].max() > 1e-3
    np.testing.assert_array_equal(metrics["robot"], info.vehicle[:, :7])


def test_nees_equals_the_inverse_covariance(run_and_truth, metrics):
    info, truth = run_and_truth
    for t, (estimate, true, cov) in enumerate(zip(info.vehicle, truth.robot, info.vehicle_cov, strict=True)):
        error = estimate[:2] - true[:2]
        np.testing.assert_allclose(metrics["nees_position"][t], error @ np.linalg.inv(cov[:2, :2]) @ error, rtol=1e-9)
        G = np.zeros((3, 7))
        G[0, 0] = G[1, 1] = 1.0
        G[2, 3:] = yaw_gradient(estimate[3:7])
        error = np.append(error, yaw_of(estimate[3:7]) - yaw_of(true[3:7]))
        expected = error @ np.linalg.inv(G @ cov[:7, :7] @ G.T) @ error
        np.testing.assert_allclose(metrics["nees_pose"][t], expected, rtol=1e-6)  # of the differences


def test_orientation_error_is_the_angle_between_orientations(run_and_truth):
    info, truth = run_and_truth
    num_frames = len(truth.robot)
    degrees = np.linspace(0.0, 180.0, num_frames)
    axes = np.random.default_rng(0).normal(size=(num_frames, 3))
    axes *= np.deg2rad(degrees)[:, None] / np.linalg.norm(axes, axis=1, keepdims=True)
    turned = rotation_of_all(truth) * Rotation.from_rotvec(axes)
    found = errors_of(with_robot(info, "vehicle", turned), truth)["orientation_error_deg"]
    np.testing.assert_allclose(found, degrees, atol=1e-9)


def test_yaw_error_goes_the_short_way_round(run_and_truth):
    info, truth = run_and_truth
    num_frames = len(truth.robot)

    def turned(degrees):
        return Rotation.from_euler("z", np.full((num_frames, 1), degrees), degrees=True)

    def errors(estimate_deg, true_deg):
        return errors_of(
            with_robot(info, "vehicle", turned(estimate_deg)), with_robot(truth, "robot", turned(true_deg))
        )

    across = errors(179.9, -179.8)
    np.testing.assert_allclose(across["yaw_error_deg"], 0.3, rtol=1e-9)
    np.testing.assert_allclose(across["orientation_error_deg"], 0.3, rtol=1e-9)
    # The sign counts in the normalised error: estimate and truth a step apart give the same wherever yaw is cut.
    np.testing.assert_allclose(errors(-179.8, 179.9)["yaw_error_deg"], 0.3, rtol=1e-9)
    rotated = rotate_cov(info, turned(180.0)[0].as_quat(scalar_first=True))
    same = errors_of(
        with_robot(rotated, "vehicle", turned(180.0) * Rotation.from_quat(info.vehicle[:, 3:7], scalar_first=True)),
        with_robot(truth, "robot", turned(180.0) * rotation_of_all(truth)),
    )
    plain = errors_of(info, truth)
    np.testing.assert_allclose(same["yaw_error_deg"], plain["yaw_error_deg"], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(same["nees_pose"], plain["nees_pose"], rtol=1e-7)


def rotate_cov(info, quaternion: np.ndarray):
    """The same run with the robot's quaternion multiplied from the left, its covariance accordingly."""
    w, x, y, z = quaternion
    T = np.eye(14)
    T[3:7, 3:7] = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return eqx.tree_at(lambda i: i.vehicle_cov, info, T @ info.vehicle_cov @ T.T)


def test_counts_equal_python_loops(run_and_truth, metrics):
    info, truth = run_and_truth
    num_frames, num_features = len(truth.robot), len(truth.is_moving)
    deletions = {name: np.zeros(num_features, int) for name in ("dynamic", "inconsistent")}
    mapped = np.zeros(num_features, int)
    for t in range(num_frames):
        counts = {"updates": 0, "recovered": 0, "dynamic": 0}
        nis = 0.0
        for k, feature in enumerate(info.candidate_id[t]):
            counts["recovered"] += int(info.is_recovered[t, k])
            if info.is_accepted[t, k]:
                counts["updates"] += 1
                nis += info.re1[t, k]
            if info.is_dynamic[t, k]:
                counts["dynamic"] += 1
                deletions["dynamic"][feature] += 1
        flagged = [feature for feature in info.inconsistent_id[t] if feature >= 0]
        held = [feature for feature in info.track_id[t] if feature >= 0]
        for feature in flagged:
            deletions["inconsistent"][feature] += 1
        for feature in held:
            mapped[feature] += 1
        counts |= {"inconsistent": len(flagged), "landmarks": len(held), "births": int((info.born_id[t] >= 0).sum())}
        assert {name: metrics[f"num_{name}"][t] for name in counts} == counts
        np.testing.assert_allclose(metrics["nis_sum"][t], nis, rtol=1e-12)
    np.testing.assert_array_equal(metrics["dynamic_deletions"], deletions["dynamic"])
    np.testing.assert_array_equal(metrics["inconsistent_deletions"], deletions["inconsistent"])
    np.testing.assert_array_equal(metrics["frames_mapped"], mapped)
    np.testing.assert_array_equal(metrics["is_moving"], np.isin(np.arange(num_features), tiny_runs.MOVERS))
    for name in ("num_updates", "num_recovered", "num_dynamic", "num_inconsistent", "num_births"):
        assert metrics[name].sum() > 0, name  # there was something to count


def test_flags_sum_up_the_frames(whole_run, metrics):
    state, info, truth = whole_run
    assert metrics["is_finite"] and metrics["map_full_frames"] == info.map_is_full.sum()
    num_frames = len(truth.robot)
    flags = eqx.tree_at(
        lambda i: (i.is_finite, i.map_is_full), info, (np.arange(num_frames) != 4, np.arange(num_frames) < 3)
    )
    flagged = run_metrics(*as_jax((state, flags, truth)))
    assert not flagged["is_finite"] and flagged["map_full_frames"] == 3


def test_nees_is_not_defined_where_the_covariance_is_singular(run_and_truth, metrics):
    """All of it zero, without odometry noise; of x; of yaw; or x and y known up to one direction, rounding included."""
    info, truth = run_and_truth
    cov = np.array(info.vehicle_cov)
    cov[1], cov[2, :, 0], cov[2, 0], cov[3, :, 3:7], cov[3, 3:7] = 0, 0, 0, 0, 0
    cov[4, :2, :2] = np.outer([0.1, 0.3], [0.1, 0.3])
    cov[5, :2, :2] = np.outer([0.1, 0.3], [0.1, 0.3]) + 1e-18 * np.eye(2)
    found = errors_of(eqx.tree_at(lambda i: i.vehicle_cov, info, cov), truth)
    for name, undefined in (("nees_position", [1, 2, 4, 5]), ("nees_pose", [1, 2, 3, 4, 5])):
        assert np.flatnonzero(np.isnan(found[name])).tolist() == undefined
        others = np.setdiff1d(np.arange(len(cov)), [1, 2, 3, 4, 5])
        np.testing.assert_allclose(found[name][others], metrics[name][others], rtol=1e-9)


def test_map_nees_is_of_the_static_euclidean_landmarks(whole_run):
    """By NumPy's inverse of what each slot holds; of movers, and of points whose depth is not settled, none counts."""
    state, _, truth = whole_run
    rng, num_slots = np.random.default_rng(0), len(state.track_id)
    ids = np.concatenate([[-1, -1], tiny_runs.MOVERS, np.arange(40, 40 + num_slots - 8)]).astype(np.int32)
    is_euclidean = np.arange(num_slots) % 3 > 0
    mean, root = rng.normal(size=state.landmarks.shape), rng.normal(size=state.P_mm.shape)
    mean[:, 3:] = [0, 0, 0, 1]
    turned = np.broadcast_to(np.diag([1.0, 1, 1, 0, 0, 0, 0]), state.to_coordinates.shape)
    state = eqx.tree_at(
        lambda s: (s.track_id, s.is_euclidean, s.landmarks, s.to_coordinates, s.P_mm),
        state,
        (ids, is_euclidean, mean, turned, root @ root.T),
    )
    expected = []
    for slot, feature in enumerate(state.track_id):
        if feature >= 0 and is_euclidean[slot] and not truth.is_moving[feature]:
            P = state.P_mm[7 * slot : 7 * slot + 3, 7 * slot : 7 * slot + 3]
            error = mean[slot, :3] - truth.landmarks_m[-1, feature]
            expected.append(error @ np.linalg.inv(P) @ error)
    found = float(map_nees(*as_jax((state, truth))))
    assert 3 < len(expected) < is_euclidean.sum() - 2 and found == pytest.approx(np.mean(expected), rel=1e-9)
    none = eqx.tree_at(lambda s: s.is_euclidean, state, np.zeros_like(is_euclidean))
    assert np.isnan(map_nees(*as_jax((none, truth))))
