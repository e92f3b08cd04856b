"""Which thresholds should the VC gate have? Th1 and Th2 by gradient, for several scenes at once.

python scripts/tune_thresholds.py --position-weight 2 --starts 3 --held-out-seeds 100 --out results/tune_thresholds
"""

import dataclasses
import os
from pathlib import Path

import jax
import tyro

import vcjax as vc
from vcjax.report.tuning import write_tuning
from vcjax.tuning.choice import Seeds
from vcjax.tuning.descent import Schedule
from vcjax.tuning.intervals import THRESHOLDS
from vcjax.tuning.losses import Objective
from vcjax.tuning.scenes import Scenes
from vcjax.tuning.tune import tune


@dataclasses.dataclass(frozen=True)
class Study:
    """Tune Th1 and Th2 in the paper's dynamic scenes, compare with before on other seeds, write tables and figures."""

    th1: float = 9.0
    """Th1 before."""
    th2: float = 9.0
    """Th2 before."""
    speeds_m_s: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Speeds of the dynamic features, m/s; they move sideways in one scene and towards the robot in another."""
    position_weight: float = 2.0
    """What 1 m of position error costs beside 1 - F1; 0: detection alone."""
    starts: int = 3
    """Descents, the first from the thresholds before."""
    steps: int = 15
    """Steps of each."""
    pairs: int = 3
    """Pairs of runs of each scene in a step."""
    choosing_seeds: int = 48
    """Runs of each scene that choose among the ends of the descents."""
    held_out_seeds: int = 100
    """Runs of each scene that compare the choice with before."""
    out: Path = Path("results/tune_thresholds")
    """Folder of the results. Work that was stopped goes on there."""


def main(study: Study) -> None:
    tuned = tune(
        Scenes(speeds_m_s=study.speeds_m_s).make(),
        vc.FilterConfig(gate=vc.VirtualCorrection(th1=study.th1, th2=study.th2), smoothing="soft"),
        THRESHOLDS,
        objective=Objective(track_f1=1.0, position=study.position_weight),
        schedule=Schedule(num_steps=study.steps, pairs_per_step=study.pairs),
        num_starts=study.starts,
        seeds=Seeds(study.choosing_seeds, study.held_out_seeds),
        key=jax.random.key(0),
        directory=study.out,
        progress=lambda name, done, total: print(f"{name}: {done} of {total}", flush=True),
    )
    for path in write_tuning(tuned, {}, study.out):
        print(f"wrote {path}")
    print((study.out / "tune.md").read_text("utf-8"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # runs are shared between the cores
    main(tyro.cli(Study))
