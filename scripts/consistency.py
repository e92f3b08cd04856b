"""Is the filter as sure as it may be? ANEES and error with additive and with invariant errors, on two paths.

python scripts/consistency.py --seeds 200
"""

import dataclasses
import json
import os
from pathlib import Path

import jax
import numpy as np
import tyro

import vcjax as vc
from vcjax.report.markup import grid
from vcjax.storage import write_file
from vcjax.study.summary import paired_difference

LOOP_M, LOOP_FRAMES = 100.0, 1000
COLUMNS = ("position, cm", "orientation, deg", "ANEES position", "ANEES pose", "… in the last frame")


@dataclasses.dataclass(frozen=True)
class Study:
    """Run the same seeds with both kinds of errors, on the paper's 8 m and around a loop of 100 m; nothing moves."""

    seeds: int = 200
    """Runs of each."""
    yaw_std_deg: tuple[float, ...] = (0.05,)
    """Noise of the odometry's rotation per frame, deg (the paper: 0.05)."""
    out: Path = Path("results/consistency")
    """Folder of the results."""


def loop() -> vc.Scenario:
    """Once around a circle of 100 m, among features 4 m apart; in 1000 frames of 0.1 m."""
    return vc.scenarios.paper(
        start=(0.0, -LOOP_M / (2 * np.pi), 0.0),
        increment=(LOOP_M / LOOP_FRAMES, 0.0, 360.0 / LOOP_FRAMES),
        num_frames=LOOP_FRAMES,
        grid_low_m=-24.0,
        grid_high_m=24.0,
        grid_per_side=13,
    )


def main(study: Study) -> None:
    paths = {"8 m": vc.scenarios.paper(), "loop of 100 m": loop()}
    rows, report = [], {}
    for name, path in paths.items():
        for yaw_std in study.yaw_std_deg:
            scenario = dataclasses.replace(path, odometry_std=(0.005, 0.005, 0.0, 0.0, 0.0, yaw_std))
            slots = 107 if path.num_frames < LOOP_FRAMES else 251
            runs = {
                errors: vc.monte_carlo(
                    scenario,
                    vc.FilterConfig(gate=vc.ReprojectionError(), errors=errors, max_landmarks=slots),
                    num_seeds=study.seeds,
                    key=jax.random.key(0),
                )
                for errors in ("additive", "invariant")
            }
            difference = paired_difference(runs["invariant"], runs["additive"])
            for errors, found in runs.items():
                summary = vc.summarise(found)
                figures = {
                    figure: {part: float(summary[figure].sel(statistic=part)) for part in ("mean", "se")}
                    for figure in ("position_rmse_cm", "orientation_error_deg", "anees_position", "anees_pose")
                }
                last = found.nees_pose.isel(frame=-1).mean().item() / 3
                report[f"{name}, yaw {yaw_std} deg, {errors}"] = figures | {
                    "anees_pose_at_the_end": last,
                    "map_full_runs": int((found.map_full_frames > 0).sum()),
                }
                text = [f"{each['mean']:.3f} ± {each['se']:.3f}" for each in figures.values()]
                rows.append([name, f"{yaw_std:g}", errors, *text, f"{last:.2f}"])
            position = difference["position_rmse_cm"]
            low, high = (float(position.sel(statistic=part)) for part in ("lower", "upper"))
            print(f"{name}, yaw {yaw_std:g} deg: invariant − additive: [{low:+.3f}, {high:+.3f}] cm", flush=True)
    print(grid(("path", "yaw noise, deg", "errors", *COLUMNS), rows))
    write_file(study.out / "consistency.json", f"{json.dumps(report, indent=1)}\n".encode())


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # runs are shared between the cores
    main(tyro.cli(Study))
