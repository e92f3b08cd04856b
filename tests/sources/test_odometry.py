"""Odometry: against motion along known screws, its covariance against noise drawn, tables there and back."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from test_recording import good_recording

from vcjax.models.frames import rotation_matrix
from vcjax.models.motion import move_by_odometry
from vcjax.sources.odometry import (
    AXES,
    Odometry,
    dead_reckoning,
    from_poses,
    from_velocities,
    read_odometry,
    unknown_motion,
    write_odometry,
)
from vcjax.sources.table_file import write_table


def driven(odometry):
    """Poses along the increments, from the origin."""
    pose, poses = jnp.array([0.0, 0, 0, 1, 0, 0, 0]), []
    for increment in odometry.increment:
        pose = move_by_odometry(pose, jnp.asarray(increment))
        poses.append(np.asarray(pose))
    return np.array(poses)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-9, 1e-5, 1e-3, 0.1, 2.0]))
def test_constant_velocity_is_the_exponential_of_its_twist(seed, rate):
    rng = np.random.default_rng(seed)
    v, w = rng.normal(size=3), rate * rng.normal(size=3)
    times = np.array([5.0, 5.7])
    found = from_velocities(times, np.stack([v, v]), np.stack([w, w]), 0.0, 0.0)
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = np.cross(w, np.eye(3)).T, v
    expected = expm(0.7 * twist)
    pose = move_by_odometry(jnp.array([0.0, 0, 0, 1, 0, 0, 0]), jnp.asarray(found.increment[1]))
    np.testing.assert_allclose(pose[:3], expected[:3, 3], atol=1e-10)
    np.testing.assert_allclose(rotation_matrix(pose[3:]), expected[:3, :3], atol=1e-10)
    assert not found.increment[0].any() and not found.cov[0].any()


def test_a_circle_closes():
    """2 m/s and 0.5 rad/s: a circle of 4 m radius in 4π s, on the left."""
    times = np.linspace(0.0, 4 * np.pi, 101)
    found = driven(from_velocities(times, np.tile([2.0, 0, 0], (101, 1)), np.tile([0.0, 0, 0.5], (101, 1)), 0.1, 0.01))
    np.testing.assert_allclose(found[-1, :3], 0.0, atol=1e-10)
    np.testing.assert_allclose(found[50, :3], [0.0, 8.0, 0.0], atol=1e-10)


def test_the_mean_of_two_measurements_counts():
    found = from_velocities(np.array([0.0, 2.0]), np.array([[1.0, 0, 0], [2.0, 0, 4]]), np.zeros((2, 3)), 1.0, 1.0)
    np.testing.assert_allclose(found.increment[1], [3.0, 0, 4, 0, 0, 0])


def test_covariance_of_the_sum_is_that_of_the_noise():
    """2500 drives with white noise of different size on each axis: the variance of the place at the end."""
    rng, num_frames, step_s = np.random.default_rng(0), 40, 0.1
    stds = np.array([0.5, 0.2, 0.1])
    times = step_s * np.arange(num_frames)
    end = np.zeros((2500, 3))
    for drive in end:
        velocity = [3.0, 0, 0] + stds * rng.normal(size=(num_frames, 3))
        found = from_velocities(times, velocity, np.zeros((num_frames, 3)), stds, 0.05)
        drive[:] = found.increment[:, :3].sum(axis=0)
    claimed = found.cov[:, range(3), range(3)].sum(axis=0)
    np.testing.assert_allclose(end.var(axis=0) / claimed, 1.0, atol=0.12)  # 2.8 % standard error, 1.3 % for the ends
    np.testing.assert_allclose(found.cov[7], np.diag([*(stds * step_s) ** 2, *[0.005**2] * 3]), atol=1e-15)


@given(st.integers(0, 2**32 - 1))
def test_odometry_from_poses_leads_along_them(seed):
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(6, 7))
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    found = from_poses(poses, np.array([1.0, 2, 3, 4, 5, 6]))
    pose = jnp.asarray(poses[0])
    for expected, increment in zip(poses[1:], found.increment[1:], strict=True):
        pose = move_by_odometry(pose, jnp.asarray(increment))
        np.testing.assert_allclose(pose[:3], expected[:3], atol=1e-9)
        np.testing.assert_allclose(abs(pose[3:] @ expected[3:]), 1.0, atol=1e-9)
    np.testing.assert_array_equal(found.cov[3], np.diag([1.0, 4, 9, 16, 25, 36]))
    assert not found.increment[0].any() and not found.cov[0].any()


def test_unknown_motion_is_doubt_alone():
    found = unknown_motion(np.array([0.0, 0.1, 0.3]), 2.0, 3.0)
    assert not found.increment.any()
    np.testing.assert_allclose(found.cov[2], np.diag([0.4**2] * 3 + [0.6**2] * 3))


BAD = {
    "short": ({"velocity_m_s": np.zeros((2, 3))}, r"velocity_m_s\) has shape \(2, 3\), but \(3, 3\)"),
    "flat": ({"rate_rad_s": np.zeros(3)}, r"rate_rad_s\) has shape \(3,\)"),
    "NaN": ({"rate_rad_s": np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, 0]])}, r"rate_rad_s\[1, 1\] = nan\): must"),
    "back": ({"time_s": np.array([0.0, 2.0, 1.0])}, r"time_s\[2\] = 1.0\): times must grow"),
    "NaN time": ({"time_s": np.array([0.0, np.nan, 1.0])}, r"time_s\[1\] = nan\): times must grow"),
    "negative": ({"velocity_std_m_s": -1.0}, "velocity_std_m_s=-1.0.* at least 0"),
    "infinite": ({"rate_std_rad_s": np.array([0.0, np.inf, 0.0])}, "rate_std_rad_s=.*inf.* at least 0"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("changes", "message"), BAD.values(), ids=BAD)
def test_bad_velocities_are_refused_by_name_and_place(changes, message):
    good = {
        "time_s": np.arange(3.0),
        "velocity_m_s": np.zeros((3, 3)),
        "rate_rad_s": np.zeros((3, 3)),
        "velocity_std_m_s": 0.0,
        "rate_std_rad_s": 0.0,
    }
    with pytest.raises(ValueError, match=message):
        from_velocities(**(good | changes))


FRAMES = np.array([3, 5, 9])


def columns(**changes):
    rng = np.random.default_rng(0)
    names = [*AXES, *(f"std_{axis}" for axis in AXES)]
    return {"frame": np.array([9, 3, 5])} | {name: rng.random(3) for name in names} | changes


def test_table_with_standard_deviations(tmp_path):
    given = columns()
    found = read_odometry(write_table(tmp_path / "o.csv", given), FRAMES)
    order = [1, 2, 0]
    np.testing.assert_array_equal(found.increment, np.column_stack([given[a] for a in AXES])[order])
    np.testing.assert_array_equal(found.cov[0], np.diag([given[f"std_{a}"][1] ** 2 for a in AXES]))


def test_table_with_covariance(tmp_path):
    A = np.random.default_rng(0).normal(size=(3, 6, 6))
    cov = A @ A.mT
    given = {name: column for name, column in columns().items() if not name.startswith("std")}
    given |= {f"cov_{AXES[i]}_{AXES[j]}": cov[:, i, j] for i in range(6) for j in range(i, 6)}
    found = read_odometry(write_table(tmp_path / "o.parquet", given), FRAMES)
    np.testing.assert_allclose(found.cov, cov[[1, 2, 0]], rtol=1e-15)


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_table_there_and_back(tmp_path_factory, seed, is_shifted):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 6, 6))
    odometry = Odometry(rng.normal(size=(3, 6)), A + A.mT, rng.normal(size=(3, 3)) if is_shifted else None)
    path = write_odometry(tmp_path_factory.mktemp("odometry") / "o.csv", odometry, FRAMES)
    found = read_odometry(path, FRAMES)
    assert found.increment.tobytes() == odometry.increment.tobytes() and found.cov.tobytes() == odometry.cov.tobytes()
    assert (found.sensor_shift_m is None) == (not is_shifted)
    if is_shifted:
        assert found.sensor_shift_m.tobytes() == odometry.sensor_shift_m.tobytes()


BAD_TABLES = {
    "half a shift": ({"shift_y": np.zeros(3)}, "1 of shift_x, shift_y, shift_z; give all three or none"),
    "no uncertainty": ({f"std_{axis}": None for axis in AXES}, "0 of 6 standard deviations .* and 0 of 21"),
    "five of six": ({"std_ry": None}, "5 of 6 standard deviations"),
    "two kinds": ({"cov_dx_dx": np.ones(3)}, "6 of 6 standard deviations .* and 1 of 21"),
    "negative": ({"std_dz": np.array([1.0, -2, 3])}, "line 3, column std_dz: -2.0 is negative"),
    "NaN": ({"rx": np.array([1.0, 2, np.nan])}, "line 4, column rx: nan is not finite"),
    "other frame": ({"frame": np.array([9, 3, 4])}, "line 4, column frame: 4 is no frame of the recording"),
    "beyond": ({"frame": np.array([10, 3, 5])}, "line 2, column frame: 10 is no frame"),
    "frame twice": ({"frame": np.array([9, 3, 9])}, "line 4, column frame: 9 is there twice"),
    "no such column": ({"rz": None}, "no column rz"),
}


@pytest.mark.parametrize(("changes", "message"), BAD_TABLES.values(), ids=BAD_TABLES)
def test_bad_table_is_refused_by_line_and_column(tmp_path, changes, message):
    path = write_table(tmp_path / "o.csv", {k: v for k, v in columns(**changes).items() if v is not None})
    with pytest.raises(ValueError, match=message):
        read_odometry(path, FRAMES)


def test_frame_without_odometry_is_named(tmp_path):
    path = write_table(tmp_path / "o.csv", {name: column[:2] for name, column in columns().items()})
    with pytest.raises(ValueError, match=r"o\.csv: no row for frame 5 \(1 such frames\)"):
        read_odometry(path, FRAMES)


def test_dead_reckoning_by_hand():
    """A step along x, a quarter turn to the left on the spot, a step along what is now y; from a start of its own."""
    recording = good_recording()
    odometry = np.zeros((5, 6))
    odometry[0, 0], odometry[1, 5], odometry[2, 0] = 1.0, np.pi / 2, 2.0
    start = np.array([10.0, 20.0, 30.0, 1.0, 0.0, 0.0, 0.0])
    poses = dead_reckoning(dataclasses.replace(recording, odometry=odometry, robot_start=start))
    np.testing.assert_allclose(poses[:, :3], [[11, 20, 30], [11, 20, 30], [11, 22, 30], [11, 22, 30], [11, 22, 30]])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(poses[[0, 4], 3:], [[1, 0, 0, 0], [half, 0, 0, half]], atol=1e-12)
