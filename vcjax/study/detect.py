"""Methods by what they find: filters with a gate and a detector, in the scenes with movers and without.

A directory holds, for each method in each scene, blocks of seeds as `reproduce` keeps them:
`runs/<method>/<scene>/seeds_00000-00024.nc`. What is there is not run again, so a run that was stopped goes on where it
was, and more seeds, methods or scenes extend fewer. All see the same draws of noise, seed by seed.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import PRNGKeyArray

from vcjax.fields import require_key
from vcjax.filter.config import FilterConfig
from vcjax.gates.cusum import Cusum
from vcjax.gates.gate import AbstractDetector, AbstractGate
from vcjax.gates.immediate import Immediate
from vcjax.gates.one_point_ransac import OnePointRansac
from vcjax.gates.reprojection import ReprojectionError
from vcjax.gates.velocity_glr import VelocityGLR
from vcjax.gates.velocity_likelihood_ratio import VelocityLikelihoodRatio
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.gates.windowed_nis import WindowedNIS
from vcjax.simulation.scenarios import DynamicMotion, DynamicSet
from vcjax.storage import check_writable, remove_leftovers
from vcjax.study.detection_scenes import Scene, scenes_of
from vcjax.study.reproduce import SEEDS_PER_BLOCK, blocks_in, joined_blocks, run_block
from vcjax.study.results import attributes, load, load_attributes, refuse_other_settings
from vcjax.study.summary import mean_and_error, per_run
from vcjax.study.sweep import Experiment

MIN_FRAMES_MAPPED = 20
"""In `found_fraction` a mover counts if it was in the map for so many frames, or was flagged."""


def _with(gate: AbstractGate, detector: AbstractDetector) -> FilterConfig:
    """A filter in which what is flagged never comes back, and what was made too distant stays in view of the test.

    It corrects with up to 20 landmarks in a frame: with 10, those that are known well are hardly ever among them, and
    nothing more is learned of whether they move.
    """
    return FilterConfig(gate=gate, detector=detector, max_updates=20, blacklist_capacity=64, see_beyond_infinity=True)


# A gate that leaves out less keeps tests of the innovations as they come closer to their χ² (see `left_out`).
_WIDE_TH1 = 12.0
_GLR = VelocityGLR(threshold=17.0)
METHODS: Mapping[str, FilterConfig] = {
    "VC": FilterConfig(gate=VirtualCorrection()),
    "RE": FilterConfig(gate=ReprojectionError()),
    "one_point_ransac": FilterConfig(gate=OnePointRansac()),
    "RE+velocity_glr": _with(ReprojectionError(), _GLR),
    "VC+velocity_glr": _with(VirtualCorrection(), _GLR),
    "RE+velocity_likelihood_ratio": _with(ReprojectionError(th1=_WIDE_TH1), VelocityLikelihoodRatio()),
    "RE+windowed_nis": _with(ReprojectionError(th1=_WIDE_TH1), WindowedNIS()),
    "RE+cusum": _with(ReprojectionError(th1=_WIDE_TH1), Cusum()),
    "RE+immediate": _with(ReprojectionError(th1=_WIDE_TH1), Immediate()),
}
"""What is compared, by name: one setting each for all scenes. VC and RE are the paper's, with the deletion rule of its
toolbox, and so is the field's 1-point RANSAC; the others have the detector's own threshold, correct with more
landmarks, and flag for good."""


Runs = dict[tuple[str, Scene], Any]
"""Method and scene → its runs, an `xarray.Dataset` as from `monte_carlo`."""


def detect(
    directory: str | Path,
    methods: Collection[str] = tuple(METHODS),
    *,
    amplitudes_m: Sequence[float] = (0.0, 0.05, 0.10),
    motions: Sequence[DynamicMotion] = ("lateral", "inverse_forward"),
    speeds_m_s: Sequence[float] = (1.0, 0.5, 0.25),
    dynamic_sets: Sequence[DynamicSet] = ("ahead",),
    harder_scenes: Sequence[str] = (),
    num_frames: int = 160,
    num_seeds: int = 25,
    key: PRNGKeyArray,
    progress: Callable[[int, int, str], None] | None = None,
) -> Runs:
    """Run methods in the scenes with movers, and in the static ones of the robot's three motions.

    Args:
        directory: where runs are kept; made if needed. Blocks of seeds that are there are read, not run.
        methods: names among `METHODS`.
        amplitudes_m: of the camera's oscillation, m; 0 is the steady camera.
        motions: how the movers move.
        speeds_m_s: their speeds, m/s, positive.
        dynamic_sets: which features move.
        harder_scenes: names in `scenarios.HARDER`, beside them.
        num_frames: frames in a run.
        num_seeds: runs of each method in each scene, at least 1.
        key: base key.
        progress: called with (blocks done, blocks in all, what was run) after each block that had to be run.

    Returns: the runs over the seeds 0 … num_seeds - 1.

    Raises:
        ValueError: for arguments that make no sense, before anything compiles; or if the directory holds runs of other
            settings.
        OSError: if the directory cannot be written.
    """
    require_key("detect", key)
    if not isinstance(num_seeds, Integral) or num_seeds < 1:
        raise ValueError(f"detect(num_seeds={num_seeds!r}): give at least one seed, a whole number.")
    if isinstance(methods, str) or not methods or not set(methods) <= set(METHODS):
        raise ValueError(f"detect(methods={methods!r}): give at least one of {', '.join(METHODS)}.")
    scenes = scenes_of(amplitudes_m, motions, speeds_m_s, dynamic_sets, harder_scenes)
    scenarios = {scene: scene.scenario(num_frames) for scene in scenes}
    # Method by method, since each compiles once.
    experiments = {(name, scene): Experiment(scenarios[scene], METHODS[name]) for name in METHODS for scene in scenes}
    experiments = {place: experiment for place, experiment in experiments.items() if place[0] in methods}
    folders = {(name, scene): Path(directory, "runs", name, scene.identifier) for name, scene in experiments}
    check_writable(Path(directory, "detect.json"))
    missing = []
    for place, folder in folders.items():
        remove_leftovers(folder, "seeds_*.nc")
        there = list(blocks_in(folder))
        for _, _, path in there:
            refuse_other_settings(path, load_attributes(path), attributes(experiments[place], key))
        for first in range(0, num_seeds, SEEDS_PER_BLOCK):
            end = min(first + SEEDS_PER_BLOCK, num_seeds)
            if not any(found == first and found_end >= end for found, found_end, _ in there):
                missing.append((place, first, end))
    for done, (place, first, end) in enumerate(missing, start=1):
        run_block(folders[place], experiments[place], first, end, key)
        if progress is not None:
            name, scene = place
            progress(done, len(missing), f"{name}, {scene.label}, A = {scene.amplitude_m:g} m")
    return {
        place: joined_blocks([load(path) for _, _, path in blocks_in(folder)]).sel(seed=np.arange(num_seeds))
        for place, folder in folders.items()
    }


def scores(runs: xr.Dataset, static: xr.Dataset) -> dict[str, Any]:
    """What a method found in a scene, and what its movers cost against the same scene without them.

    Shares and delays are of features pooled over the runs: with aᵢ and bᵢ the sums of run i, r = Σ aᵢ / Σ bᵢ with the
    standard error √(n/(n − 1) Σ (aᵢ − r bᵢ)²) / Σ bᵢ, since the features of a run depend on each other.

    Args:
        runs: runs of the scene, dimensions (seed, frame, feature).
        static: runs of the scene without movers, of the same seeds.

    Returns: with `mean` and `se`: `found_fraction`, unique movers flagged of those in the map for at least
        `MIN_FRAMES_MAPPED` frames or flagged, which flatters: one that was mapped for less counts if it was found and
        not if it was missed; `found_of_mapped_fraction`, of all movers ever mapped, and `found_per_run`, unique movers
        flagged in a run; `static_flagged_fraction`, static features ever flagged of those ever mapped; `delay_frames`,
        from first birth to first deletion of the movers found; `position_rmse_cm`, `orientation_error_deg` and
        `anees_position` of a run; `velocity_error_m_s` and `velocity_nees` (over 3) of the movers whose velocity was
        known when they were flagged; and `position_ratio`, position error against the static scene's over the seeds
        finite in both. Counts: `movers`, `movers_mapped`, `movers_found`, `static_mapped`, `static_flagged`, `runs`,
        `runs_failed` and `runs_map_full`. Failed runs are left out. NaN where there is nothing to count.

    References: Cochran 1977, *Sampling Techniques*, section 2.11, for the standard error of a ratio.
    """
    figures, static_figures = per_run(runs), per_run(static)
    is_finite = runs.is_finite.values.astype(bool)
    is_moving, frames = runs.is_moving.values, runs.frames_mapped.values[is_finite]
    is_flagged = (runs.dynamic_deletions + runs.inconsistent_deletions).values[is_finite] > 0
    is_found, is_static = is_moving & is_flagged, ~is_moving & (frames > 0)
    velocity = {name: runs[name].values[is_finite] for name in ("velocity_error_m_s", "velocity_nees")}
    is_known = is_found & ~np.isnan(velocity["velocity_error_m_s"])
    error, nees = (np.where(is_known, each, 0).sum(axis=1) for each in velocity.values())
    delay = np.where(is_found, (runs.first_deleted - runs.first_mapped).values[is_finite], 0)
    found, movers_mapped = is_found.sum(axis=1), (is_moving & (frames > 0)).sum(axis=1)
    movers = (is_found | is_moving & (frames >= MIN_FRAMES_MAPPED)).sum(axis=1)
    false, mapped = (is_static & is_flagged).sum(axis=1), is_static.sum(axis=1)
    both = (runs.is_finite & static.is_finite).values
    rmse = [each.position_rmse_cm.values[both] for each in (figures, static_figures)]
    return {
        "found_fraction": pooled(found, movers),
        "found_of_mapped_fraction": pooled(found, movers_mapped),
        "found_per_run": pooled(found, np.ones(len(found))),
        "static_flagged_fraction": pooled(false, mapped),
        "delay_frames": pooled(delay.sum(axis=1), found),
        "velocity_error_m_s": pooled(error, is_known.sum(axis=1)),
        "velocity_nees": pooled(nees / 3, is_known.sum(axis=1)),
        **{name: _mean(figures[name]) for name in ("position_rmse_cm", "orientation_error_deg", "anees_position")},
        "position_ratio": pooled(*rmse),
        "movers": int(movers.sum()),
        "movers_mapped": int(movers_mapped.sum()),
        "movers_found": int(found.sum()),
        "static_mapped": int(mapped.sum()),
        "static_flagged": int(false.sum()),
        "runs": len(is_finite),
        "runs_failed": int((~is_finite).sum()),
        "runs_map_full": int((runs.map_full_frames > 0).sum()),
    }


def pooled(part: np.ndarray, whole: np.ndarray) -> dict[str, float]:
    """Σ part / Σ whole over runs with its standard error (see `scores`); NaN where there is no whole, or one run."""
    num, total = len(whole), float(np.sum(whole))
    if total == 0:
        return {"mean": np.nan, "se": np.nan}
    ratio = float(np.sum(part)) / total
    square = float(np.sum((part - ratio * whole) ** 2))
    return {"mean": ratio, "se": np.sqrt(num / (num - 1) * square) / total if num > 1 else np.nan}


def _mean(values: xr.DataArray) -> dict[str, float]:
    """Mean and standard error over the runs that have it."""
    mean, error = mean_and_error(values, values.notnull())
    return {"mean": float(mean), "se": float(error)}
