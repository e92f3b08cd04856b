"""Images on disk with their times and calibration: what every layout of a data set is read into.

Images are read when they are asked for, one at a time. The size that a file states is compared with the calibration
before it is decoded, so that no file can demand more memory than an image of the sequence takes.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from vcjax import extras
from vcjax.recording import AnyArray, Truth
from vcjax.sources.calibration import Calibration
from vcjax.sources.front_end import FrontEnd, track_images
from vcjax.sources.odometry import Odometry, unknown_motion
from vcjax.sources.recording_file import RecordingFile
from vcjax.sources.tracks import recording_from_tracks

MAX_GAP_S = 0.1
"""Longest time to the nearest true pose on either side that a pose is interpolated over, s, unless told otherwise."""


@dataclasses.dataclass(frozen=True)
class PoseTruth:
    """True poses, at times of their own."""

    time_s: Float[np.ndarray, " N"]
    """Of each pose, s, growing."""
    T_w_x: Float[np.ndarray, "N 7"]
    """Poses in some world, quaternions (w, x, y, z)."""
    of: Literal["camera", "robot"]
    """Whose poses they are."""


@dataclasses.dataclass(frozen=True)
class ImageSequence:
    """Images, with all that is known of them."""

    paths: tuple[Path, ...]
    """The file of each image."""
    time_s: Float[np.ndarray, " T"]
    """The time of each image, s, growing."""
    calibration: Calibration
    """Of the camera."""
    truth: PoseTruth | None = None
    """True poses, if they are known."""
    odometry: Odometry | None = None
    """Motion that leads to each image, if it was measured."""

    def __post_init__(self):
        if not self.paths:
            raise ValueError("ImageSequence(paths=()): no image; give at least one.")
        if len(self.paths) != len(self.time_s):
            raise ValueError(f"ImageSequence: {len(self.paths)} images, but {len(self.time_s)} times.")
        if len(bad := np.flatnonzero(~(np.diff(self.time_s) > 0))):
            image, time = self.paths[bad[0] + 1], self.time_s[bad[0] + 1]
            raise ValueError(f"ImageSequence(time_s): {time} s, of {image}, is not above that of the image before.")

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, t: int) -> UInt8[np.ndarray, "height width"]:
        """Image t, grey.

        Raises:
            FileNotFoundError: if its file is not there.
            ValueError: naming the file, if it is no image, or of another size than the calibration states.
        """
        return read_image(self.paths[t], self.calibration.width, self.calibration.height)

    def images(self) -> Iterator[UInt8[np.ndarray, "height width"]]:
        """All images, one after another."""
        return (self.read(t) for t in range(len(self)))

    def part(self, first: int = 0, last: int | None = None, step: int = 1) -> "ImageSequence":
        """Images first ≥ 0, first + step, … before last; the start is that of the image before the first.

        Raises:
            ValueError: if odometry would have to be summed up, or no image is left.
        """
        if self.odometry is not None and step != 1:
            raise ValueError(f"part(step={step}): this sequence has odometry from image to image; give step 1.")
        taken, odometry, calibration = slice(first, last, step), self.odometry, self.calibration
        if odometry is not None:
            shift = odometry.sensor_shift_m
            if shift is not None:
                place = np.array(calibration.T_r_s[:3]) + shift[:first].sum(axis=0)
                calibration = dataclasses.replace(calibration, T_r_s=(*place.tolist(), *calibration.T_r_s[3:]))
                shift = shift[taken]
            odometry = Odometry(odometry.increment[taken], odometry.cov[taken], shift)
        return ImageSequence(self.paths[taken], self.time_s[taken], calibration, self.truth, odometry)

    def true_robot_poses(self, max_gap_s: float = MAX_GAP_S) -> Float[np.ndarray, "T 7"] | None:
        """True pose T_w_r of the robot at each image; NaN where it is not known, None if there is no truth.

        Between two true poses less than `max_gap_s` from the image positions are interpolated linearly and rotations
        along the shortest way.
        """
        if self.truth is None:
            return None
        poses = interpolated(self.truth, self.time_s, max_gap_s)
        if self.truth.of == "robot":
            return poses
        return robot_of_camera(poses, self.mounts())

    def mounts(self) -> Float[np.ndarray, "T 7"]:
        """Pose T_r_s of the camera in the robot at each image, with its commanded displacement."""
        mounts = np.tile(self.calibration.T_r_s, (len(self), 1))
        if self.odometry is not None and self.odometry.sensor_shift_m is not None:
            mounts[:, :3] += np.cumsum(self.odometry.sensor_shift_m, axis=0)
        return mounts


def record(
    sequence: ImageSequence,
    options: FrontEnd | None = None,
    odometry: Odometry | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    robot_start: Float[np.ndarray, "7"] | None = None,
    start_cov: Float[np.ndarray, "14 14"] | None = None,
) -> RecordingFile:
    """A recording of an image sequence, with the tracks of `front_end.track_images`, and what is known beside it.

    True poses are those of the sequence, in the world that they are given in: the start of the recording is another
    one unless it is given, and nothing is aligned.

    Args:
        sequence: the images.
        options: of the front end.
        odometry: motion that leads to each image; that of the sequence; without either, the motion is unknown.
        progress: called with the number of images done after each.
        robot_start: pose T_w_r before the first image; the origin.
        start_cov: covariance of robot and sensor pose there; zero.

    Returns:
        The recording with true poses, as far as there are, paths of the images, and their calibration.

    Raises:
        ModuleNotFoundError, FileNotFoundError, ValueError: as reading and tracking do.
    """
    tracks = track_images(sequence.images(), options, progress)
    odometry = odometry or sequence.odometry or unknown_motion(sequence.time_s)
    recording = recording_from_tracks(
        tracks,
        sequence.calibration,
        time_s=sequence.time_s,
        odometry=odometry,
        robot_start=robot_start,
        start_cov=start_cov,
    )
    robot, truth = sequence.true_robot_poses(), None
    if robot is not None:
        truth = Truth(robot, sequence.mounts(), np.zeros((len(sequence), 0, 3)), np.zeros(0, bool))
    paths = tuple(str(path.absolute()) for path in sequence.paths)
    return RecordingFile(recording, truth, None, paths, sequence.calibration)


def read_image(path: Path, width: int, height: int) -> UInt8[np.ndarray, "height width"]:
    """A grey image from a file, whose size is known; colours become grey, and 16 bits 8.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming the file, if it is no image, or of another size.
    """
    cv2 = extras.load("cv2", "Images", "images")
    found = image_size(path)
    if found != (width, height):
        raise ValueError(
            f"{path}: {found[0]} × {found[1]} pixels, but the calibration is of {width} × {height}; "
            "all images need the size that was calibrated."
        )
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or image.shape != (height, width):
        raise ValueError(f"{path}: the image is damaged.")
    return image


def image_size(path: Path) -> tuple[int, int]:
    """Width and height that an image file states, without decoding it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming the file, if it is no image.
    """
    pillow = extras.load("PIL.Image", "Images", "images")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image.")
    try:
        with pillow.open(path) as image:
            return image.size
    except (OSError, SyntaxError, ValueError, pillow.DecompressionBombError) as error:
        raise ValueError(f"{path}: no image that can be read ({str(error).splitlines()[0][:100]}).") from error


def interpolated(
    truth: PoseTruth, time_s: Float[np.ndarray, " T"], max_gap_s: float = MAX_GAP_S
) -> Float[np.ndarray, "T 7"]:
    """True poses at other times; NaN where one of the two neighbours is farther than `max_gap_s`, or there is none."""
    from scipy.spatial.transform import Rotation, Slerp

    known, poses = np.array(truth.time_s, np.float64), np.array(truth.T_w_x, np.float64)
    found = np.full((len(time_s), 7), np.nan)
    if len(known) < 2:
        return found
    after = np.searchsorted(known, time_s).clip(1, len(known) - 1)
    gap = np.maximum(np.abs(time_s - known[after - 1]), np.abs(known[after] - time_s))
    is_exact = np.min(np.abs(np.stack([known[after - 1], known[after]]) - time_s), axis=0) < 1e-9
    is_known = (gap <= max_gap_s) & (time_s >= known[0]) & (time_s <= known[-1]) | is_exact
    at = np.clip(time_s[is_known], known[0], known[-1])
    for axis in range(3):
        found[is_known, axis] = np.interp(at, known, poses[:, axis])
    turns = Slerp(known, Rotation.from_quat(poses[:, 3:], scalar_first=True))(at)
    found[is_known, 3:] = turns.as_quat(scalar_first=True)
    return found


def camera_of_robot(T_w_r: Float[AnyArray, "T 7"], T_r_s: Float[AnyArray, "T 7"]) -> Float[np.ndarray, "T 7"]:
    """Poses of the camera from those of its robot, T_w_c = T_w_r T_r_s; NaN stays NaN."""
    from scipy.spatial.transform import Rotation

    T_w_r, T_r_s = np.array(T_w_r, np.float64), np.array(T_r_s, np.float64)
    is_known, found = np.isfinite(T_w_r).all(axis=1), np.full(T_w_r.shape, np.nan)
    if np.any(is_known):
        robot = Rotation.from_quat(T_w_r[is_known, 3:], scalar_first=True)
        turn = robot * Rotation.from_quat(T_r_s[is_known, 3:], scalar_first=True)
        found[is_known, :3] = T_w_r[is_known, :3] + robot.apply(T_r_s[is_known, :3])
        found[is_known, 3:] = turn.as_quat(scalar_first=True)
    return found


def robot_of_camera(T_w_c: Float[np.ndarray, "T 7"], T_r_s: Float[np.ndarray, "T 7"]) -> Float[np.ndarray, "T 7"]:
    """Poses of the robot from those of its camera, T_w_r = T_w_c T_r_s⁻¹; NaN stays NaN."""
    from scipy.spatial.transform import Rotation

    is_known = np.isfinite(T_w_c[:, 0])
    if not np.any(is_known):
        return np.full_like(T_w_c, np.nan)
    mount = Rotation.from_quat(T_r_s[is_known, 3:], scalar_first=True)
    turn = Rotation.from_quat(T_w_c[is_known, 3:], scalar_first=True) * mount.inv()
    found = np.full_like(T_w_c, np.nan)
    found[is_known, :3] = T_w_c[is_known, :3] - turn.apply(T_r_s[is_known, :3])
    found[is_known, 3:] = turn.as_quat(scalar_first=True)
    return found
