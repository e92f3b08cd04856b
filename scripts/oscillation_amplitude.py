"""How far must the camera swing? Movers found and position error against the amplitude, for RE and VC.

python scripts/oscillation_amplitude.py --seeds 25 --speed-m-s 0.25 --out results/amplitude
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
    """Sweep the amplitude of the oscillation for both gates; print summaries and save all runs."""

    amplitudes_m: tuple[float, ...] = (0.0, 0.02, 0.05, 0.1)
    """Amplitudes, m; 0 is a steady camera."""
    dynamic: Literal["lateral", "inverse_forward"] = "inverse_forward"
    """How the six dynamic features move."""
    speed_m_s: float = 0.5
    """Their speed, m/s."""
    seeds: int = 10
    """Runs for each amplitude and gate."""
    out: Path = Path("results/amplitude")
    """Folder of the results, one NetCDF-4 file per gate."""


def main(study: Study) -> None:
    scenario = vc.scenarios.paper(dynamic=study.dynamic, dynamic_speed_m_s=study.speed_m_s)
    for name, gate in (("RE", vc.ReprojectionError()), ("VC", vc.VirtualCorrection())):
        runs = vc.monte_carlo(
            scenario,
            vc.FilterConfig(gate=gate),
            num_seeds=study.seeds,
            key=jax.random.key(0),
            sweep={"scenario.oscillation.amplitude_m": study.amplitudes_m},
        )
        print(f"{name}\n{vc.summarise(runs)}")
        print(f"wrote {save(runs, study.out / f'{name}.nc')}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # runs are shared between the cores
    main(tyro.cli(Study))
