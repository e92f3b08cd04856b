"""A scenario as a folder of images, in the plain layout, with its exact truth.

The path, the motion of camera and features and the noise of the odometry are those of `simulate`: a recording made from
the images differs from the simulated one in nothing but where its features come from.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from vcjax.recording import Recording, Truth
from vcjax.simulation.scenarios import Scenario
from vcjax.simulation.simulate import simulate
from vcjax.sources.calibration import Calibration, write_calibration
from vcjax.sources.image_sequence import ImageSequence, camera_of_robot
from vcjax.sources.layouts import plain_folder
from vcjax.sources.odometry import Odometry, write_odometry
from vcjax.sources.render import Surface, render, surfaces_of
from vcjax.sources.rendered_truth import Followed, what_tracks_follow
from vcjax.sources.table_file import write_table
from vcjax.sources.tracks import Tracks
from vcjax.sources.trajectory_file import write_tum
from vcjax.storage import write_file


class RenderedSequence(NamedTuple):
    """Images of a scenario, and all that is true of them."""

    sequence: ImageSequence
    """The images, with calibration, odometry and the camera's true poses, as they are read from the folder."""
    simulated: Recording
    """The simulated recording, of whose features the images show patches."""
    truth: Truth
    """Its truth."""
    surfaces: tuple[Surface, ...]
    """What the images show: a patch for each feature, then the walls."""

    def followed(self, tracks: Tracks) -> Followed:
        """What tracks in the images follow, and how exactly; see `rendered_truth.py`."""
        calibration, poses = self.sequence.calibration, camera_of_robot(self.truth.robot, self.truth.sensor)
        return what_tracks_follow(tracks, self.surfaces, calibration, poses, self.sequence.time_s)


def render_sequence(
    folder: str | os.PathLike,
    scenario: Scenario,
    key: PRNGKeyArray,
    *,
    patch_m: float = 0.3,
    room_margin_m: float | None = 4.0,
    seed: int = 0,
    rays_per_side: int = 3,
    progress: Callable[[int], None] | None = None,
) -> RenderedSequence:
    """Write the images of a scenario and what belongs to them.

    The folder gets `images/00000.png` …, `calibration.json`, `times.csv`, `odometry.csv` (noisy, with the commanded
    motion of the camera) and `groundtruth.txt`, the camera's true poses: what `layouts.plain_folder` reads.

    Args:
        folder: new, or empty.
        scenario: path, features, movers, camera, noise of the odometry; its pixel noise means nothing here.
        key: of the noise.
        patch_m: side of the patch that stands for a feature, m.
        room_margin_m: how far the walls are beyond the outermost features, m; None: no walls.
        seed: of the textures.
        rays_per_side: rays along each side of a pixel.
        progress: called with the number of images done after each.

    Raises:
        FileExistsError: if the folder holds something.
        ValueError: for a camera or a number that cannot be used.
    """
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()):
        raise FileExistsError(f"{folder}: not empty; give a new folder.")
    if not (np.isfinite(patch_m) and patch_m > 0):
        raise ValueError(f"render_sequence(patch_m={patch_m}): give a positive length, m.")
    if not 1 <= rays_per_side <= 16:
        raise ValueError(f"render_sequence(rays_per_side={rays_per_side}): give a whole number from 1 to 16.")
    recording, truth = simulate(scenario, key)
    recording, truth = (jax.tree.map(lambda x: np.array(x, np.float64) if x.dtype.kind == "f" else np.array(x), tree)
                        for tree in (recording, truth))  # fmt: skip
    calibration = Calibration.from_camera(scenario.camera, recording.sensor_start)
    surfaces = surfaces_of(scenario, truth, patch_m, room_margin_m, seed)
    poses = camera_of_robot(truth.robot, truth.sensor)
    import cv2

    for t, (pose, time_s) in enumerate(zip(poses, recording.time_s, strict=True)):
        image = render(surfaces, calibration, pose, float(time_s), rays_per_side=rays_per_side)
        write_file(folder / "images" / f"{t:05d}.png", cv2.imencode(".png", image)[1].tobytes())
        if progress is not None:
            progress(t + 1)
    write_calibration(folder / "calibration.json", calibration)
    write_table(folder / "times.csv", {"frame": np.arange(len(poses)), "time_s": recording.time_s})
    odometry = Odometry(recording.odometry, recording.odometry_cov, recording.sensor_shift_m)
    write_odometry(folder / "odometry.csv", odometry)
    write_tum(folder / "groundtruth.txt", recording.time_s, poses)
    return RenderedSequence(plain_folder(folder), recording, truth, surfaces)
