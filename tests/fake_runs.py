"""Invented Monte-Carlo results in the form that `monte_carlo` gives, for tests of what is made from them."""

import json

import numpy as np
import xarray as xr

from vcjax.study.paper import Cell, cells

_MOVERS = [(4.0, y, z) for y in (-2.0, 0.0, 2.0) for z in (0.0, 1.0)]
_STATIC = [(x, y, z) for x in np.arange(-8.0, 9.0, 2.0) for y in np.arange(-8.0, 9.0, 2.0) for z in (0.0, 1.0)]
_START = {"forward": (-8.0, 0.0), "curved": (-8.0, -8.0), "lateral": (-4.0, -4.0)}


def fake_runs(cell: Cell | None = None, num_seeds: int = 4, num_frames: int = 20) -> xr.Dataset:
    """Runs of a cell: random walks whose size and counts follow the paper's story, with noise shared by all cells."""
    cell = cell or Cell(2, "forward", None, None, "VC", False)
    is_inverse = cell.dynamic_motion == "inverse_forward"
    scale = 1.0 if not cell.oscillating else (1.8 if is_inverse else 0.75)
    rng = np.random.default_rng(0)
    shared = rng.normal(size=(5, num_seeds, num_frames))
    own = np.random.default_rng(sum(map(ord, cell.identifier)))
    frames = np.arange(1, num_frames + 1)
    walk = np.cumsum(shared[:2], axis=-1) * 0.08 / np.sqrt(num_frames)
    walk = scale * (walk + 0.002 * own.normal(size=walk.shape))
    yaw = np.abs(0.1 * np.cumsum(shared[2], axis=-1) / np.sqrt(num_frames)) * (0.9 if cell.oscillating else 1.0)

    features = np.array(_MOVERS + [p for p in _STATIC if p not in _MOVERS])
    is_moving = np.zeros(len(features), bool)
    landmarks = np.repeat(features[None], num_frames, axis=0)
    if cell.dynamic_motion is not None:
        is_moving[:6] = True
        direction = np.array([-1.0, 0.0, 0.0]) if is_inverse else np.array([0.0, 1.0, 0.0])
        landmarks[:, :6] += 0.1 * frames[:, None, None] * float(cell.dynamic_speed_m_s or 0.0) * direction
    num_found = 0 if not is_moving.any() or (is_inverse and not cell.oscillating) else 5
    dynamic_deletions = np.zeros((num_seeds, len(features)), int)
    dynamic_deletions[:, :num_found] = own.integers(1, 6, size=(num_seeds, num_found))
    inconsistent_deletions = np.zeros_like(dynamic_deletions)
    inconsistent_deletions[:, -1] = own.integers(0, 2, size=num_seeds)

    def events(per_run: np.ndarray) -> np.ndarray:
        counts = np.zeros((num_seeds, num_frames), int)
        counts[:, num_frames // 2] = per_run
        return counts

    x, y = _START[cell.robot_motion]
    robot_true = np.zeros((num_frames, 7))
    robot_true[:, 3] = 1.0
    step = 0.05 * 160 / num_frames * frames
    heading = np.deg2rad(0.5 * 160 / num_frames * frames) if cell.robot_motion == "curved" else 0.0 * step
    robot_true[:, 0] = x + (0 if cell.robot_motion == "lateral" else 1) * step * np.cos(heading)
    robot_true[:, 1] = y + (step if cell.robot_motion == "lateral" else step * np.sin(heading))
    robot = np.repeat(robot_true[None], num_seeds, axis=0)
    robot[..., :2] += np.moveaxis(walk, 0, -1)
    sensor_true = np.tile([0.0, 0.0, 0.6, 0.5, -0.5, 0.5, -0.5], (num_frames, 1))

    per_frame = ("seed", "frame")
    recovered = own.poisson(16.5, size=num_seeds) if cell.gate == "VC" else np.zeros(num_seeds, int)
    return xr.Dataset(
        {
            "position_error_m": (per_frame, np.hypot(*walk)),
            "orientation_error_deg": (per_frame, 1.05 * yaw),
            "yaw_error_deg": (per_frame, yaw),
            "nees_position": (per_frame, np.sum(shared[:2] ** 2, axis=0)),
            "nees_pose": (per_frame, np.sum(shared[:3] ** 2, axis=0)),
            "nees_map": ("seed", np.sum(shared[:3, :, -1] ** 2, axis=0)),
            "nis_sum": (per_frame, 2.0 * shared[3] ** 2 * 8),
            "num_updates": (per_frame, np.full((num_seeds, num_frames), 8)),
            "num_recovered": (per_frame, events(recovered)),
            "num_dynamic": (per_frame, events(dynamic_deletions.sum(1))),
            "num_inconsistent": (per_frame, events(inconsistent_deletions.sum(1))),
            "num_births": (per_frame, np.ones((num_seeds, num_frames), int)),
            "num_landmarks": (per_frame, np.tile(9 + frames, (num_seeds, 1))),
            "num_coordinates": (per_frame, np.tile(77 + 7 * frames, (num_seeds, 1))),
            "dynamic_deletions": (("seed", "feature"), dynamic_deletions),
            "inconsistent_deletions": (("seed", "feature"), inconsistent_deletions),
            "velocity_error_m_s": (("seed", "feature"), np.full(dynamic_deletions.shape, np.nan)),
            "velocity_nees": (("seed", "feature"), np.full(dynamic_deletions.shape, np.nan)),
            "frames_mapped": (("seed", "feature"), np.full((num_seeds, len(features)), num_frames)),
            "first_mapped": (("seed", "feature"), np.ones((num_seeds, len(features)), int)),
            "first_deleted": (
                ("seed", "feature"),
                np.where(dynamic_deletions + inconsistent_deletions > 0, num_frames // 2, 0),
            ),
            "dynamic_margin": (("seed", "feature"), dynamic_deletions - 0.5),
            "detector_margin": (("seed", "feature"), inconsistent_deletions - 0.5),
            "detector_auc": ("seed", np.full(num_seeds, 0.5 if is_moving.any() else np.nan)),
            "detection_auc": ("seed", np.full(num_seeds, 0.75 if is_moving.any() else np.nan)),
            "is_moving": ("feature", is_moving),
            "is_finite": ("seed", np.ones(num_seeds, bool)),
            "map_full_frames": ("seed", np.zeros(num_seeds, int)),
            "robot": (("seed", "frame", "pose"), robot),
            "robot_true": (("frame", "pose"), robot_true),
            "sensor_true": (("frame", "pose"), sensor_true),
            "landmark_true": (("frame", "feature", "axis"), landmarks),
        },
        coords={
            "seed": np.arange(num_seeds),
            "frame": frames,
            "feature": np.arange(len(features)),
            "pose": ["x", "y", "z", "qw", "qx", "qy", "qz"],
            "axis": ["x", "y", "z"],
        },
        attrs={"scenario": json.dumps({"name": cell.identifier}), "config": "{}"},
    )


def fake_results(tables: tuple[int, ...] = (2, 3, 4, 5), num_seeds: int = 4, **kwargs) -> dict[Cell, xr.Dataset]:
    """`fake_runs` of every cell of the given tables."""
    return {cell: fake_runs(cell, num_seeds, **kwargs) for cell in cells(tables)}


def with_failed_seed(runs: xr.Dataset, index: int) -> xr.Dataset:
    """The same runs, one of which went non-finite."""
    runs = runs.copy(deep=True)
    runs.is_finite[index] = False
    runs.position_error_m[index, 3:] = np.nan
    runs.nees_position[index, 3:] = np.inf
    return runs
