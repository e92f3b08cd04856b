"""How should the camera swing? Amplitude and frequency by gradient, and what they cost in motion.

python scripts/tune_oscillation.py --motion-weight 0.1 --max-amplitude-m 0.1 --held-out-seeds 100
"""

import dataclasses
import os
from pathlib import Path
from typing import Literal

import jax
import tyro

import vcjax as vc
from vcjax.report.tuning import write_tuning
from vcjax.tuning.choice import Seeds
from vcjax.tuning.descent import Schedule
from vcjax.tuning.intervals import Interval
from vcjax.tuning.losses import Objective
from vcjax.tuning.scenes import Scenes
from vcjax.tuning.tune import tune


@dataclasses.dataclass(frozen=True)
class Study:
    """Tune A and f in the paper's dynamic scenes, compare with before on other seeds, write tables and figures."""

    amplitude_m: float = 0.05
    """A before, m."""
    frequency_hz: float = 3.0
    """f before, Hz."""
    max_amplitude_m: float = 0.15
    """Largest A allowed, m."""
    frequency_band_hz: tuple[float, float] = (0.5, 4.5)
    """Where f may go, Hz; below half of the 10 frames per second."""
    motions: tuple[Literal["lateral", "inverse_forward"], ...] = ("inverse_forward",)
    """How the dynamic features move, a scene for each motion and speed."""
    speeds_m_s: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Their speeds, m/s."""
    motion_weight: float = 0.02
    """What 1 m²/s² of the camera's mean square speed costs beside 1 - F1."""
    starts: int = 3
    """Descents, the first from A and f before."""
    steps: int = 15
    """Steps of each."""
    pairs: int = 6
    """Pairs of runs of each scene in a step."""
    choosing_seeds: int = 48
    """Runs of each scene that choose among the ends of the descents."""
    held_out_seeds: int = 100
    """Runs of each scene that compare the choice with before."""
    out: Path = Path("results/tune_oscillation")
    """Folder of the results. Work that was stopped goes on there."""


def main(study: Study) -> None:
    scenes = Scenes(study.motions, study.speeds_m_s, amplitude_m=study.amplitude_m, frequency_hz=study.frequency_hz)
    tuned = tune(
        scenes.make(),
        vc.FilterConfig(gate=vc.VirtualCorrection(), smoothing="soft"),
        {
            "scenario.oscillation.amplitude_m": Interval(0.0, study.max_amplitude_m),
            # A run ripples with f: its gradient is that of a mean over a wide neighbourhood.
            "scenario.oscillation.frequency_hz": Interval(*study.frequency_band_hz, spread=0.4),
        },
        objective=Objective(track_f1=1.0, camera_motion=study.motion_weight),
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
