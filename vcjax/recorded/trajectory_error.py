"""Errors of a trajectory against the truth, absolute and relative, each alignment named. The work is evo's.

The absolute pose error (APE) of a frame is the distance from the true place, and the angle from the true orientation.
It depends on how the two worlds are laid on each other, and so it is given for each way to do that: not at all, by the
first pose, by the rigid motion that fits best (Umeyama 1991), and by the best similarity, where a scale is free too.
The relative pose error (RPE) compares motions, from each pose to the one a given way further on, and needs no common
world; a wrong scale it sees. It does not step over gaps, where time steps by `warnings.JUMP` times the median or more.

Sources: Sturm et al., IROS 2012; Grupp 2017, *evo*.
"""

import contextlib
import copy
import itertools
import math
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from vcjax import extras
from vcjax.sources.warnings import JUMP

Alignment = Literal["none", "first pose", "rigid", "similarity"]
ALIGNMENTS: tuple[Alignment, ...] = ("none", "first pose", "rigid", "similarity")
DRIFT_M = 100.0
"""Length of the stretches over which drift is measured, m, where the path is long enough."""
LEAST_STRETCH_M = 5.0
"""Shortest stretches of which drift is told, m: per 100 m those below show the noise of two poses, many times over."""
_NO_RIGID = "not determined: the places lie on a line"
_NO_DRIFT = "not determined: the path is too short"
MAX_TIME_DIFFERENCE_S = 0.01
"""How far apart the times of a pose and the true pose that it is compared with may be, s."""


class Trajectory(NamedTuple):
    """Poses, with times if they are known."""

    poses: Float[np.ndarray, "T 7"]
    """Position (m) and quaternion (w, x, y, z)."""
    time_s: Float[np.ndarray, " T"] | None = None
    """Of each pose, s; None: poses belong together by their number."""


class AbsoluteError(NamedTuple):
    """APE over a trajectory."""

    rmse_m: float
    mean_m: float
    max_m: float
    rmse_deg: float
    scale: float
    """By which the estimate was multiplied; 1 but for the similarity."""


class TrajectoryError(NamedTuple):
    """All errors of a trajectory."""

    num_poses: int
    """How many poses have a true one."""
    path_m: float
    """Length of the true path, without gaps, m."""
    absolute: dict[Alignment, AbsoluteError]
    """NaN where an alignment is not determined."""
    step: float
    """Median step from each compared pose to the next: s, or where poses have no times, their numbers."""
    step_unit: Literal["s", "poses"]
    step_rmse_m: float
    """RMS of the RPE from each compared pose to the next, m."""
    step_rmse_deg: float
    """The same of the angle, deg."""
    drift_m_per_100_m: float
    """Mean over all stretches of the RPE's distance, scaled to 100 m of true path; NaN for a path too short."""
    drift_deg_per_100_m: float
    """The same of the angle."""
    stretch_m: float
    """Length of those stretches, m."""


def trajectory_error(estimate: Trajectory, truth: Trajectory) -> TrajectoryError:
    """Compare a trajectory with the truth.

    Args:
        estimate: of any length.
        truth: poses with NaN do not count.

    Raises:
        ModuleNotFoundError: if evo is not installed, with the remedy.
        ValueError: if fewer than two poses can be compared.
    """
    found, true = _associated(estimate, truth)
    pieces = _without_gaps(found, true)
    length = float(sum(piece.path_length for _, piece in pieces))
    metrics, units = extras.load("evo.core.metrics", "Evaluations", "images"), _evo("evo.core.units")
    parts = (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg)
    absolute: dict[Alignment, AbsoluteError] = {
        alignment: _absolute(found, true, alignment, parts) for alignment in ALIGNMENTS
    }
    step = [_relative(pieces, metrics.RPE(part, 1, units.Unit.frames)) for part in parts]
    stretch, drift = min(DRIFT_M, length / 4.0), [math.nan] * 2
    if stretch > 0:
        options = {"all_pairs": True, "pairs_from_reference": True}
        along = [_relative(pieces, metrics.RPE(part, stretch, units.Unit.meters, **options)) for part in parts]
        drift = [float(np.mean(error)) * 100.0 / stretch if len(error) else math.nan for error in along]
    return TrajectoryError(
        num_poses=true.num_poses,
        path_m=length,
        absolute=absolute,
        step=float(np.median(np.diff(true.timestamps))),
        step_unit="poses" if estimate.time_s is None or truth.time_s is None else "s",
        step_rmse_m=_rms(step[0]),
        step_rmse_deg=_rms(step[1]),
        drift_m_per_100_m=drift[0],
        drift_deg_per_100_m=drift[1],
        stretch_m=stretch,
    )


def trajectory_error_text(found: TrajectoryError) -> str:
    """The errors in words; what is aligned says so in each line."""
    names = {
        "none": "not aligned",
        "first pose": "first pose aligned",
        "rigid": "aligned, rigid",
        "similarity": "aligned, with scale",
    }
    rows = [("compared", f"{found.num_poses} poses, true path {found.path_m:.4g} m")]
    for alignment, error in found.absolute.items():
        scale = f", scale {error.scale:.4g}" if alignment == "similarity" else ""
        text = f"{error.rmse_m:.4g} m RMS (mean {error.mean_m:.4g}, most {error.max_m:.4g}), {error.rmse_deg:.4g}° RMS"
        rows.append(
            (
                f"APE, {names[alignment]}",
                _NO_RIGID if math.isnan(error.rmse_m) else text + scale,
            )
        )
    step = f"steps of {found.step:.3g} {found.step_unit}"
    rows.append((f"RPE, {step}", f"{found.step_rmse_m:.4g} m, {found.step_rmse_deg:.4g}° RMS; not aligned"))
    drift = (
        f"{found.drift_m_per_100_m:.4g} m, {found.drift_deg_per_100_m:.4g}° on average, from stretches of "
        f"{found.stretch_m:.4g} m; not aligned"
    )
    is_short = math.isnan(found.drift_m_per_100_m) or found.stretch_m < LEAST_STRETCH_M
    rows.append(("drift per 100 m", _NO_DRIFT if is_short else drift))
    return "\n".join(f"{name:26s} {text}" for name, text in rows)


def _evo(module: str) -> Any:
    return extras.load(module, "Evaluations", "images")


def _associated(estimate: Trajectory, truth: Trajectory) -> tuple[Any, Any]:
    """The poses of both that belong together, as evo's trajectories: those of known truth, by time or by number."""
    trajectory, sync = _evo("evo.core.trajectory"), _evo("evo.core.sync")

    def make(poses, time_s):
        return trajectory.PoseTrajectory3D(poses[:, :3], poses[:, 3:], timestamps=time_s)

    if (estimate.time_s is None) != (truth.time_s is None) or estimate.time_s is None:
        if len(estimate.poses) != len(truth.poses):
            raise ValueError(
                f"{len(estimate.poses)} poses, but {len(truth.poses)} true ones, and one of the two has no times: give "
                "both with times, or as many of one as of the other."
            )
        times = [np.arange(len(estimate.poses), dtype=float)] * 2
    else:
        times = [np.asarray(estimate.time_s, float), np.asarray(truth.time_s, float)]
    poses = [np.array(x.poses, np.float64) for x in (estimate, truth)]
    for i, known in enumerate([np.isfinite(p).all(axis=1) for p in poses]):
        poses[i], times[i] = poses[i][known], times[i][known]
    if min(map(len, poses)) >= 2:
        with contextlib.suppress(sync.SyncException):
            true, found = sync.associate_trajectories(
                make(poses[1], times[1]), make(poses[0], times[0]), max_diff=MAX_TIME_DIFFERENCE_S
            )
            if found.num_poses >= 2:
                return found, true
    raise ValueError(
        f"fewer than two poses have a true one at most {MAX_TIME_DIFFERENCE_S} s away: the estimate is of "
        f"{_span(times[0])}, the truth of {_span(times[1])}."
    )


def _span(time_s: np.ndarray) -> str:
    return f"{time_s[0]} to {time_s[-1]} s" if len(time_s) else "no time"


def _absolute(found: Any, true: Any, alignment: Alignment, parts: tuple) -> AbsoluteError:
    """APE with one alignment."""
    metrics, geometry = _evo("evo.core.metrics"), _evo("evo.core.geometry")
    found, scale = copy.deepcopy(found), 1.0
    try:
        if alignment == "first pose":
            found.align_origin(true)
        elif alignment != "none":
            scale = float(found.align(true, correct_scale=alignment == "similarity")[2])
    except geometry.GeometryException:  # places on a line leave a turn about it free
        return AbsoluteError(*[math.nan] * 5)
    errors = []
    for part in parts:
        ape = metrics.APE(part)
        ape.process_data((true, found))
        errors.append(np.asarray(ape.error))
    distance, angle = errors
    return AbsoluteError(_rms(distance), float(distance.mean()), float(distance.max()), _rms(angle), scale)


def _without_gaps(found: Any, true: Any) -> list[tuple[Any, Any]]:
    """The pieces of both trajectories between gaps in time."""
    step = np.diff(true.timestamps)
    ends = [0, *(np.flatnonzero(step >= JUMP * np.median(step)) + 1).tolist(), true.num_poses]
    pieces = []
    for first, until in itertools.pairwise(ends):
        piece = copy.deepcopy(found), copy.deepcopy(true)
        for trajectory in piece:
            trajectory.reduce_to_ids(np.arange(first, until))
        pieces.append(piece)
    return pieces


def _relative(pieces: list[tuple[Any, Any]], rpe: Any) -> np.ndarray:
    """All RPE of the pieces of a trajectory; empty where none is long enough."""
    errors = [np.zeros(0)]
    for found, true in pieces:
        with contextlib.suppress(_evo("evo.core.filters").FilterException):
            rpe.process_data((true, found))
            errors.append(np.asarray(rpe.error))
    return np.concatenate(errors)


def _rms(error: Any) -> float:
    return float(np.sqrt(np.mean(np.square(error))))
