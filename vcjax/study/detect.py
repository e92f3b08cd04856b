"""Methods by what they find: filters with a gate and a detector, in the scenes with movers and without.

A directory holds, for each method in each scene, blocks of seeds as `reproduce` keeps them:
`runs/<method>/<scene>/seeds_00000-00024.nc`, and of other thresholds, for the operating curves, beside them
`curves/<method>/<threshold>/<scene>/…`. What is there is not run again, so a run that was stopped goes on where it was,
and more seeds, methods or scenes extend fewer. All see the same draws of noise, seed by seed.
"""

from collections.abc import Callable, Collection, Sequence
from numbers import Integral
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import PRNGKeyArray

from vcjax.fields import require_key
from vcjax.simulation.scenarios import DynamicMotion, DynamicSet
from vcjax.storage import check_writable, remove_leftovers
from vcjax.study.detection_methods import METHODS
from vcjax.study.detection_scenes import Scene, scenes_of
from vcjax.study.detection_scores import Counts, counts
from vcjax.study.operating_curves import Curves, added
from vcjax.study.reproduce import SEEDS_PER_BLOCK, blocks_in, joined_blocks, run_block
from vcjax.study.results import attributes, load, load_attributes, refuse_other_settings

Runs = dict[tuple[str, Scene], Any]
"""Method and scene → its runs, an `xarray.Dataset` as from `monte_carlo`."""


class Detection(NamedTuple):
    """What `detect` gives."""

    runs: Runs
    """Of each method at its own threshold in each scene."""
    curves: Curves
    """What each method counts at one threshold after another; empty unless asked for."""


class _Place(NamedTuple):
    """Where the runs of a method in a scene are kept."""

    method: str
    scene: Scene
    threshold: float | None = None
    """None: its own."""

    def folder(self, directory: str | Path) -> Path:
        """For its blocks of seeds."""
        if self.threshold is None:
            return Path(directory, "runs", self.method, self.scene.identifier)
        return Path(directory, "curves", self.method, f"threshold_{self.threshold!r}", self.scene.identifier)

    @property
    def label(self) -> str:
        """In words."""
        camera = f"A = {self.scene.amplitude_m:g} m"
        at = "" if self.threshold is None else f" at {self.threshold:g}"
        return f"{self.method}{at}, {self.scene.label}, {camera}"


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
    curves: bool = False,
    key: PRNGKeyArray,
    progress: Callable[[int, int, str], None] | None = None,
) -> Detection:
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
        curves: whether to run each method at other thresholds too (see `METHODS`), in the scenes with movers but the
            harder ones, which makes about four times as many runs.
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
    places = [place for name in METHODS if name in methods for place in _places(name, scenes, curves)]
    experiments = {place: METHODS[place.method].experiment(scenarios[place.scene], place.threshold) for place in places}
    check_writable(Path(directory, "detect.json"))
    missing = []
    for place, experiment in experiments.items():
        folder = place.folder(directory)
        remove_leftovers(folder, "seeds_*.nc")
        there = list(blocks_in(folder))
        for _, _, path in there:
            refuse_other_settings(path, load_attributes(path), attributes(experiment, key))
        for first in range(0, num_seeds, SEEDS_PER_BLOCK):
            end = min(first + SEEDS_PER_BLOCK, num_seeds)
            if not any(found == first and found_end >= end for found, found_end, _ in there):
                missing.append((place, first, end))
    for done, (place, first, end) in enumerate(missing, start=1):
        run_block(place.folder(directory), experiments[place], first, end, key)
        if progress is not None:
            progress(done, len(missing), place.label)

    def runs_at(place: _Place) -> Any:
        blocks = [load(path) for _, _, path in blocks_in(place.folder(directory))]
        return joined_blocks(blocks).sel(seed=np.arange(num_seeds))

    runs = {(place.method, place.scene): runs_at(place) for place in places if place.threshold is None}
    if not curves:
        return Detection(runs, {})
    # Of other thresholds the counts alone are kept: all their runs would fill the memory.
    parts: dict[tuple[str, float], dict[float, list[Counts]]] = {}
    for place in places:
        name, scene, threshold = place
        if scene.dynamic_motion is not None:
            points = parts.setdefault((name, scene.amplitude_m), {value: [] for value in METHODS[name].curve})
            own = METHODS[name].threshold
            points[own if threshold is None else threshold].append(
                counts(runs[name, scene] if threshold is None else runs_at(place))
            )
    return Detection(runs, {line: {v: added(each) for v, each in points.items()} for line, points in parts.items()})


def _places(name: str, scenes: Sequence[Scene], curves: bool) -> list[_Place]:
    """All runs of a method: at its own threshold, then at the others."""
    method, moving = METHODS[name], [scene for scene in scenes if scene.dynamic_motion is not None]
    others = [threshold for threshold in method.curve if threshold != method.threshold] if curves else []
    own = [_Place(name, scene) for scene in scenes]
    return own + [_Place(name, scene, threshold) for threshold in others for scene in moving]
