"""What are settings of Th1, Th2, A and f worth? All of them on the same seeds, against the first, scene by scene.

python scripts/before_and_after.py --settings 9 9 0.05 3  2.4 10.7 0.05 3 --seeds 100 --out results/before_and_after
"""

import dataclasses
import os
from pathlib import Path

import jax
import tyro

import vcjax as vc
from vcjax.report.comparison import comparison, comparison_markdown
from vcjax.storage import write_file, write_json
from vcjax.tuning.choice import Choice
from vcjax.tuning.evaluate import evaluate
from vcjax.tuning.intervals import OSCILLATION, THRESHOLDS
from vcjax.tuning.losses import WANTED
from vcjax.tuning.scenes import Scenes


@dataclasses.dataclass(frozen=True)
class Study:
    """Run settings with hard decisions in the six dynamic scenes; write a comparison of each with the first."""

    settings: tuple[tuple[float, float, float, float], ...] = ((9.0, 9.0, 0.05, 3.0), (2.4, 10.7, 0.05, 3.0))
    """Th1, Th2, A in m and f in Hz of each; the first is what the others are compared with."""
    speeds_m_s: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Speeds of the dynamic features, m/s; they move sideways in one scene and towards the robot in another."""
    seeds: int = 100
    """Runs of each setting in each scene, the same seeds for all."""
    key: int = 0
    """Number of the base random key: another one than whatever the settings were chosen by."""
    out: Path = Path("results/before_and_after")
    """Directory; work that was stopped goes on there."""


def main(study: Study) -> None:
    paths = (*THRESHOLDS, *OSCILLATION)
    settings = [dict(zip(paths, values, strict=True)) for values in study.settings]
    if len(settings) < 2:
        raise SystemExit("--settings: give at least two, four numbers each.")
    runs = evaluate(
        Scenes(speeds_m_s=study.speeds_m_s).make(),
        vc.FilterConfig(gate=vc.VirtualCorrection()),
        {path: [setting[path] for setting in settings] for path in paths},
        objective=WANTED,
        num_seeds=study.seeds,
        key=jax.random.key(study.key),
        directory=study.out / "runs",
        progress=lambda done, total: print(f"{done} of {total} settings", flush=True),
    )
    for i, setting in enumerate(settings[1:], start=1):
        compared = comparison(Choice(settings[0], setting, runs, runs.isel(setting=[0, i]), {}))
        del compared["runs"]  # nothing was chosen
        text = comparison_markdown(compared)
        write_json(study.out / f"setting_{i}.json", compared)
        write_file(study.out / f"setting_{i}.md", text.encode())
        print(f"\n{text}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # runs are shared between the cores
    main(tyro.cli(Study))
