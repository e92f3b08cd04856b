"""Is the filter as sure as it may be? ANEES and error of gates with additive and with invariant errors, on two paths.

python scripts/consistency.py --seeds 200
"""

import dataclasses
import os
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro

import vcjax as vc
from vcjax.report.markup import grid
from vcjax.storage import write_file, write_json
from vcjax.study.reproduce import GATES
from vcjax.study.summary import DEGREES_OF_FREEDOM, paired_difference

LOOP_M, LOOP_FRAMES = 100.0, 1000
FIGURES = ("position_rmse_cm", "orientation_error_deg", *DEGREES_OF_FREEDOM)
COLUMNS = (
    "position, cm",
    "orientation, deg",
    *(f"ANEES {name.removeprefix('anees_')}" for name in DEGREES_OF_FREEDOM),
    "ANEES pose, last frame",
    "runs, failed",
    "position, invariant − additive, cm",
)


BOUNDS = """\
In brackets the bounds in which 95 % of averages of consistent filters lie, by the χ² of so many runs; of the
difference, paired by seed, its 95 % interval.
"""


@dataclasses.dataclass(frozen=True)
class Study:
    """Run the same seeds with both kinds of errors, on the paper's 8 m and around a loop of 100 m; nothing moves."""

    seeds: int = 200
    """Runs of each."""
    gates: tuple[Literal["RE", "VC", "one_point_ransac"], ...] = ("RE",)
    """Which."""
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
            for gate in study.gates:
                found = compared(scenario, gate, study.seeds)
                for errors, cell in found.items():
                    report[f"{name}, yaw {yaw_std} deg, {gate}, {errors}"] = cell
                    rows.append([name, f"{yaw_std:g}", gate, errors, *texts(cell)])
    table = grid(("path", "yaw noise, deg", "gate", "errors", *COLUMNS), rows)
    print(table)
    write_json(study.out / "consistency.json", report)
    write_file(study.out / "consistency.md", f"{BOUNDS}\n{table}".encode())


def compared(scenario: vc.Scenario, gate: str, num_seeds: int) -> dict[str, dict[str, Any]]:
    """Figures of both kinds of errors, their bounds, and the difference, paired by seed."""
    slots = 107 if scenario.num_frames < LOOP_FRAMES else 251
    runs = {
        errors: vc.monte_carlo(
            scenario,
            vc.FilterConfig(gate=GATES[gate](), errors=errors, max_landmarks=slots),
            num_seeds=num_seeds,
            key=jax.random.key(0),
        )
        for errors in ("additive", "invariant")
    }
    difference = paired_difference(runs["invariant"], runs["additive"])
    result = {}
    for errors, found in runs.items():
        summary = vc.summarise(found)
        result[errors] = {
            **{name: {part: float(summary[name].sel(statistic=part)) for part in ("mean", "se")} for name in FIGURES},
            "anees_bounds": {
                name: {bound: float(summary[f"{name}_bounds"].sel(bound=bound)) for bound in ("lower", "upper")}
                for name in DEGREES_OF_FREEDOM
            },
            "anees_pose_at_the_end": found.nees_pose.isel(frame=-1).where(found.is_finite).mean().item() / 3,
            **{name: int(summary[name]) for name in ("num_runs", "runs_failed", "runs_map_full")},
        }
    result["invariant"]["less_additive"] = {
        name: {part: float(difference[name].sel(statistic=part)) for part in ("mean", "lower", "upper")}
        for name in FIGURES
    } | {"num_pairs": int(difference.num_pairs)}
    return result


def texts(cell: dict[str, Any]) -> list[str]:
    """A row's figures: means with standard errors, bounds, and the paired difference where there is one."""
    means = [f"{cell[name]['mean']:.3f} ± {cell[name]['se']:.3f}" for name in FIGURES]
    bounds = [""] * 2 + [" [{lower:.2f}, {upper:.2f}]".format(**each) for each in cell["anees_bounds"].values()]
    difference = cell.get("less_additive", {}).get("position_rmse_cm")
    return [
        *(mean + bound for mean, bound in zip(means, bounds, strict=True)),
        f"{cell['anees_pose_at_the_end']:.2f}",
        f"{cell['num_runs']}, {cell['runs_failed']}",
        "" if difference is None else "{mean:+.3f} [{lower:+.3f}, {upper:+.3f}]".format(**difference),
    ]


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # runs are shared between the cores
    main(tyro.cli(Study))
