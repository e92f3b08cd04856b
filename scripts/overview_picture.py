"""Draw the README's picture from the results of `vcjax reproduce`.

python scripts/overview_picture.py results/paper docs/overview.png
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro

from vcjax.study.paper import SPEEDS_M_S, Cell, Method
from vcjax.study.reproduce import load_results
from vcjax.study.summary import summarise

COLORS: dict[Method, str] = {
    ("RE", False): "#8c8c8c",
    ("VC", False): "#e69f00",
    ("RE", True): "#56b4e9",
    ("VC", True): "#009e73",
}
ROBOT, MOVING, STATIC = "#0072b2", "#d55e00", "#b3b3b3"


def main(results: tyro.conf.Positional[Path], picture: tyro.conf.Positional[Path]) -> None:
    """Scene, movers found and position error for features that come towards the robot."""
    runs = load_results(results, tables=list(SPEEDS_M_S))
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    figure, (scene, found, position) = plt.subplots(
        1, 3, figsize=(10, 3.6), layout="constrained", width_ratios=(3, 4, 4)
    )

    any_runs = runs[Cell(3, "forward", "inverse_forward", 1.0, "VC", True)]
    is_moving, places = any_runs.is_moving.values, any_runs.landmark_true.values[0, :, :2]
    path = any_runs.robot_true.values[:, :2]
    scene.plot(*places[~is_moving].T, ".", color=STATIC)
    scene.plot(*places[is_moving].T, "o", color=MOVING)
    for start in places[is_moving]:
        scene.annotate("", start - (2, 0), start, arrowprops={"arrowstyle": "-|>", "color": MOVING, "lw": 1.6})
    scene.plot(*path.T, color=ROBOT, lw=2)
    scene.annotate("", path[-1] + (0.8, 0), path[-1], arrowprops={"arrowstyle": "-|>", "color": ROBOT, "lw": 2})
    scene.plot(*path[0], "s", color=ROBOT)
    scene.annotate("robot", path[0], (0, 7), textcoords="offset points", color=ROBOT)
    scene.set(xticks=[], yticks=[], aspect="equal", title="six features come towards\nthe robot's camera")
    scene.spines[:].set_visible(False)

    for axes, name in ((found, "dynamic_found_per_run"), (position, "position_rmse_cm")):
        for i, method in enumerate(COLORS):
            cells = [Cell(table, "forward", "inverse_forward", v, *method) for table, v in SPEEDS_M_S.items()]
            mean, error = np.array([summarise(runs[cell])[name].values for cell in cells]).T
            x = np.arange(len(cells)) + 0.2 * (i - 1.5)
            bars = axes.bar(x, mean, 0.18, yerr=error, color=COLORS[method], label=cells[0].method, ecolor="#4d4d4d")
            axes.bar_label(bars, fmt="%.1f", fontsize=6, padding=1)  # a bar of height zero would not be seen
        axes.set_xticks(range(len(SPEEDS_M_S)), [f"{v:g} m/s" for v in SPEEDS_M_S.values()])
        axes.set_xlabel("their speed")
    found.set(title="movers found, of six (± 1 s.e.)", ylim=(0, 6.4))
    position.set(title="position error, cm RMS (± 1 s.e.)")
    handles, labels = found.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(picture, dpi=130)


if __name__ == "__main__":
    tyro.cli(main)
