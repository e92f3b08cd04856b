"""Stereo tracks of a car (KITTI odometry, with a noisy inertial unit) as a recording of its left camera.

python scripts/street_recording.py tracks.npz --out kitti07.npz

`tracks.npz` holds arrays as they are published for inertial SLAM courses, with true poses added:

| array | shape | |
|---|---|---|
| `time` | (T,) | s |
| `v_imu`, `w_imu` | (T, 3) | velocity, m/s, and rate of turn, rad/s, of the body: x forward, y left, z up |
| `K`, `cam_T_imu` | (3, 3), (4, 4) | left camera; its place on the body (last column) and body to camera (rotation) |
| `frame`, `track`, `uv_left` | (N,), (N,), (N, 2) | one row for each sighting |
| `T_w_cam0` | (T', 3, 4) | true poses of the left camera in the first T' frames |
| `track_label` | (number of tracks,) | 0 static, 1 moving, others unknown |
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import vcjax as vc
from vcjax.sources.calibration import Calibration
from vcjax.sources.odometry import from_velocities
from vcjax.sources.recording_file import RecordingFile, TrackLabels, save_recording
from vcjax.sources.tracks import Tracks, recording_from_tracks


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Make the recording."""

    tracks: tyro.conf.Positional[Path]
    """The arrays."""
    out: Path = Path("kitti07.npz")
    """The recording."""
    size_px: tuple[int, int] = (1226, 370)
    """Size of the images, px."""
    velocity_std_m_s: float = 0.5
    """White noise of `v_imu` on each axis, m/s."""
    rate_std_rad_s: float = 0.05
    """White noise of `w_imu` on each axis, rad/s."""


def main(given: Arguments) -> None:
    with np.load(given.tracks, allow_pickle=False) as file:
        arrays = dict(file)
    mount = np.eye(4)  # camera to body
    mount[:3, :3], mount[:3, 3] = arrays["cam_T_imu"][:3, :3].T, arrays["cam_T_imu"][:3, 3]
    K, time_s = arrays["K"], arrays["time"]
    lens = Calibration(*given.size_px, K[0, 0], K[1, 1], K[0, 2], K[1, 2], T_r_s=tuple(_poses(mount[None])[0]))
    odometry = from_velocities(time_s, arrays["v_imu"], arrays["w_imu"], given.velocity_std_m_s, given.rate_std_rad_s)
    tracks = Tracks(arrays["frame"], arrays["track"], arrays["uv_left"].astype(float))
    recording = recording_from_tracks(tracks, lens, time_s=time_s, odometry=odometry)

    camera = np.zeros((len(arrays["T_w_cam0"]), 4, 4))
    camera[:, :3], camera[:, 3, 3] = arrays["T_w_cam0"], 1.0
    body = camera @ np.linalg.inv(mount)
    robot = np.full((len(time_s), 7), np.nan)
    robot[: len(body)] = _poses(np.linalg.inv(body[0]) @ body)  # in the world of the first
    nothing = np.zeros((len(time_s), 0, 3))
    truth = vc.Truth(robot, np.tile(lens.T_r_s, (len(time_s), 1)), nothing, np.zeros(0, bool))
    labels = TrackLabels(np.arange(len(arrays["track_label"])), arrays["track_label"])
    print(save_recording(given.out, RecordingFile(recording, truth, labels, None, lens)))


def _poses(transforms: np.ndarray) -> np.ndarray:
    """Place and quaternion (w, x, y, z) of transforms (T, 4, 4)."""
    turn = Rotation.from_matrix(transforms[:, :3, :3]).as_quat(scalar_first=True)
    return np.column_stack([transforms[:, :3, 3], turn])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(tyro.cli(Arguments))
