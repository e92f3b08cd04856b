"""What do movers cost before they are found? Position error against how long they were in the map, run by run.

python scripts/damage_before_detection.py results/detect --methods RE+velocity_glr

Reads what `vcjax detect` wrote. Of each run: the frames that a mover spent in the map, in the mean over the movers
mapped, and the position error beside the same seed's in the scene without movers. The last is what any remedy for the
frames before a detection, such as trusting new features less, can win at most.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
import xarray as xr
from scipy import stats

from vcjax.simulation.scenarios import HARDER
from vcjax.study.detection_scenes import Scene
from vcjax.study.reproduce import blocks_in, joined_blocks
from vcjax.study.results import load
from vcjax.study.summary import per_run


@dataclasses.dataclass(frozen=True)
class Study:
    """Print, for each scene with movers, the damage done and how it goes with the time in the map."""

    directory: Annotated[Path, tyro.conf.Positional]
    """Results of `vcjax detect`."""
    methods: tuple[str, ...] = ("RE+velocity_glr",)
    """Which of its methods."""


MIN_SEEDS = 6
"""Two for each third."""


def runs_in(folder: Path) -> xr.Dataset:
    """All seeds of one method in one scene."""
    blocks = [load(path) for _, _, path in blocks_in(folder)]
    if not blocks:
        raise SystemExit(f"{folder}: no runs here; give a directory and methods of `vcjax detect`.")
    return joined_blocks(blocks)


def static_of(folder: Path) -> Path:
    """The folder of the scene without movers of a scene with movers: its camera may be as badly known."""
    amplitude, _, what = folder.name.removeprefix("A_").partition("_forward_")
    scene = Scene(float(amplitude), harder=what if what in HARDER else None)
    return folder.with_name(scene.static.identifier)


def main(study: Study) -> None:
    for method in study.methods:
        place = study.directory / "runs" / method
        folders = sorted(path for path in place.glob("A_*") if path.is_dir() and "_static" not in path.name)
        if not folders:
            raise SystemExit(f"{place}: no scenes with movers here; give a directory and methods of `vcjax detect`.")
        print(f"{method}: damage = RMS position error less that of the static scene, same seeds; mean ± s.e.")
        for folder in folders:
            runs, static = xr.align(runs_in(folder), runs_in(static_of(folder)))
            error, without = (per_run(each).position_rmse_cm.values for each in (runs, static))
            frames = runs.frames_mapped.values[:, runs.is_moving.values].astype(float)
            frames[frames == 0] = np.nan
            is_told = np.isfinite(error) & np.isfinite(without) & np.isfinite(frames).any(axis=1)
            damage, exposure = (error - without)[is_told], np.nanmean(frames[is_told], axis=1)
            if len(damage) < MIN_SEEDS:
                print(f"  {folder.name}: too few seeds to tell ({len(damage)}; at least {MIN_SEEDS})")
                continue
            correlation, p_value = stats.spearmanr(exposure, damage)
            print(
                f"  {folder.name}: {len(damage)} seeds, static scene {without[is_told].mean():.2f} cm, "
                f"damage {_mean(damage)} cm; rank correlation with time in the map {correlation:+.2f} "
                f"(p = {p_value:.2f})"
            )
            for third in np.array_split(np.argsort(exposure), 3):
                print(f"    {exposure[third].mean():5.1f} frames in the map: {_mean(damage[third])} cm")


def _mean(values: np.ndarray) -> str:
    return f"{values.mean():+.2f} ± {values.std(ddof=1) / np.sqrt(len(values)):.2f}"


if __name__ == "__main__":
    main(tyro.cli(Study))
