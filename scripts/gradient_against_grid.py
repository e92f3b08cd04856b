"""Does the gradient find what a grid finds, and with how many runs? Both search; both are judged on seeds held out.

python scripts/gradient_against_grid.py thresholds --points 20 --out results/proof
"""

import dataclasses
import os
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import tyro

import vcjax as vc
from vcjax.report.landscape import landscape_figure
from vcjax.report.style import write_figure
from vcjax.report.tuning import write_search, write_tuning
from vcjax.storage import write_json
from vcjax.study.summary import mean_and_error, student_t
from vcjax.tuning.choice import Seeds
from vcjax.tuning.descent import Schedule
from vcjax.tuning.evaluate import evaluate
from vcjax.tuning.intervals import OSCILLATION, THRESHOLDS
from vcjax.tuning.landscape import as_grid, search
from vcjax.tuning.losses import WANTED
from vcjax.tuning.scenes import Scenes
from vcjax.tuning.tune import choice_of, tune


@dataclasses.dataclass(frozen=True)
class Study:
    """Search the same two numbers by a grid and by gradient, in all six dynamic scenes at once."""

    what: tyro.conf.Positional[Literal["thresholds", "oscillation"]]
    """Which numbers."""
    points: int = 20
    """Values along each axis of the grid."""
    grid_seeds: int = 10
    """Runs of each scene at every point of the grid."""
    starts: int = 3
    """Descents."""
    steps: int = 8
    """Steps of each."""
    learning_rate: float = 0.3
    """How far the first of them goes in the free numbers."""
    near: int = 0
    """Candidates from around the end of the smallest smoothed loss."""
    pairs: int = 4
    """Pairs of runs of each scene in a step."""
    choosing_seeds: int = 69
    """Runs of each scene by which the best descent is chosen."""
    held_out_seeds: int = 400
    """Runs of each scene on which the two are compared."""
    key: int = 0
    """Number of the random keys, of which each of the three parts has its own."""
    grid_key: int | None = None
    """Number of the grid's, where a grid that was searched before is compared with other descents; `key` if None."""
    seeds_by_scene: int = 100
    """Runs of each scene on which either end is compared with the setting before, scene by scene."""
    out: Path = Path("results/gradient_against_grid")
    """Directory; work that was stopped goes on there. Grids and descents have folders of their own, by their keys."""


def main(study: Study) -> None:
    scenarios, directory = Scenes().make(), study.out / study.what
    if study.what == "thresholds":
        intervals = THRESHOLDS
        axes = dict(
            zip(intervals, (np.geomspace(2, 64, study.points), np.geomspace(0.5, 64, study.points)), strict=True)
        )
    else:
        intervals = OSCILLATION
        axes = {path: np.linspace(i.low, i.high, study.points + 1)[1:] for path, i in intervals.items()}
    schedule = Schedule(num_steps=study.steps, pairs_per_step=study.pairs, learning_rate=study.learning_rate)
    config = vc.FilterConfig(gate=vc.VirtualCorrection(), smoothing="soft")
    of_grid = study.key if study.grid_key is None else study.grid_key
    numbers = (3 * study.key + 1, 3 * of_grid + 2, 3 * study.key + 3)
    gradient_key, grid_key, held_out_key = map(jax.random.key, numbers)
    gradient, grid = directory / f"gradient_{study.key}", directory / f"grid_{of_grid}"
    tuned = tune(
        scenarios,
        config,
        intervals,
        objective=WANTED,
        schedule=schedule,
        num_starts=study.starts,
        num_near=study.near,
        seeds=Seeds(study.choosing_seeds, study.seeds_by_scene),
        key=gradient_key,
        directory=gradient,
        progress=lambda *done: print("gradient:", *done, flush=True),
    )
    found = search(
        scenarios,
        config,
        axes,
        objective=WANTED,
        seeds=Seeds(study.grid_seeds, study.seeds_by_scene),
        key=grid_key,
        directory=grid,
        progress=lambda *done: print("grid:", *done, flush=True),
    )
    of_both = directory / f"gradient_{study.key}_against_grid_{of_grid}"
    both = choice_of(of_both, len(tuned.descents), study.near)  # as the gradient's choice
    write_tuning(tuned, {}, gradient)
    write_search(found, grid)
    settings = {"before": found.before, "gradient": tuned.choice.after, "grid": found.after}
    marks = {"before": found.before, "by gradient": tuned.choice.after, "the grid's best": found.after}
    title = f"Hard decisions, means over 6 scenes × {study.grid_seeds} runs at every point"
    ways = [[step.parameters for step in steps] for steps in tuned.descents]
    write_figure(landscape_figure(as_grid(found), title, marks, ways), both / "landscape")

    runs = evaluate(
        scenarios,
        config,
        {path: [setting[path] for setting in settings.values()] for path in intervals},
        objective=WANTED,
        num_seeds=study.held_out_seeds,
        key=held_out_key,
        directory=both / "held_out",
    )
    loss = runs.loss.mean("scene", skipna=False)
    loss = loss.where(loss.notnull().all("setting"))  # a seed that failed in one is in no mean
    difference = loss.sel(setting=1) - loss.sel(setting=2)
    counts = difference.notnull()
    mean, error = mean_and_error(difference, counts)
    half_width = float(error) * float(student_t(int(counts.sum())))
    grid_loss, num_gradient = float(loss.sel(setting=2).mean()), tuned.num_runs + tuned.choice.candidates.loss.size
    report = {
        "settings": settings,
        "loss": {name: float(loss.sel(setting=i).mean()) for i, name in enumerate(settings)},
        "gradient_minus_grid_percent": [
            100 * value / grid_loss for value in (float(mean), float(mean) - half_width, float(mean) + half_width)
        ],
        "held_out_seeds": int(counts.sum()),
        "runs": {"gradient": num_gradient, "grid": found.candidates.loss.size},
    }
    print(write_json(both / "report.json", report).read_text("utf-8"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # runs are shared between the cores
    main(tyro.cli(Study))
