"""What the two thresholds of the VC gate do to detection and accuracy: a grid of Th1 and Th2 in one call.

python scripts/sweep_thresholds.py --seeds 25 --dynamic inverse_forward --out results/thresholds.nc
"""

import dataclasses
import os
from pathlib import Path
from typing import Literal

import jax
import tyro

import vcjax as vc
from vcjax.study.results import save


@dataclasses.dataclass(frozen=True)
class Study:
    """Sweep Th1 and Th2 in one of the paper's dynamic scenes; print a summary and save all runs."""

    th1: tuple[float, ...] = (6.0, 9.0, 12.0)
    """Values of Th1."""
    th2: tuple[float, ...] = (6.0, 9.0, 12.0)
    """Values of Th2."""
    dynamic: Literal["lateral", "inverse_forward"] = "lateral"
    """How the six dynamic features move."""
    speed_m_s: float = 0.5
    """Their speed, m/s."""
    amplitude_m: float = 0.05
    """Amplitude of the camera's oscillation, m; 0 is a steady camera."""
    seeds: int = 10
    """Runs for each pair of thresholds."""
    out: Path = Path("results/thresholds.nc")
    """File of the results (NetCDF-4)."""


def main(study: Study) -> None:
    scenario = vc.scenarios.paper(
        dynamic=study.dynamic, dynamic_speed_m_s=study.speed_m_s, oscillation_amplitude_m=study.amplitude_m
    )
    runs = vc.monte_carlo(
        scenario,
        vc.FilterConfig(gate=vc.VirtualCorrection()),
        num_seeds=study.seeds,
        key=jax.random.key(0),
        sweep={"config.gate.th1": study.th1, "config.gate.th2": study.th2},
    )
    print(vc.summarise(runs))
    print(f"wrote {save(runs, study.out)}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # runs are shared between the cores
    main(tyro.cli(Study))
