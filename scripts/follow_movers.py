"""What becomes of movers after they were flagged: followed outside the map, handed back when they stand, flagged again.

python scripts/follow_movers.py --seeds 24

Runs the filter of `vcjax detect` with the velocity test, with followers and without, where movers go for 4 s, stand for
4 s and go again, where they never stop, and prints what is handed back, how soon, and what it costs the position.
"""

import dataclasses
import os

import jax
import numpy as np
import tyro
from jax.tree_util import Partial

import vcjax as vc
from vcjax.recording import moves_in_frame
from vcjax.study.detection_methods import METHODS
from vcjax.study.monte_carlo import run_lanes, simulate_and_filter
from vcjax.study.sweep import Experiment

CONFIG = METHODS["RE+velocity_glr"].config


@dataclasses.dataclass(frozen=True)
class Study:
    """Run the scenes and print the counts; the robot goes forward, movers at 0.5 m/s."""

    seeds: int = 24
    """Runs of each scene."""
    amplitudes_m: tuple[float, ...] = (0.05, 0.10)
    """Of the camera's oscillation, m."""
    max_followed: int = 16
    """Features followed at a time, at most."""
    key: int = 0
    """Number of the random key."""


def work(experiment: Experiment, _, key) -> dict[str, jax.Array]:
    """One run: what was deleted, followed and handed back in each frame, what moved, how far off the robot was."""
    _, info, truth = simulate_and_filter(experiment, key)
    kept = {
        "deleted": info.inconsistent_id,
        "moves": moves_in_frame(truth),
        "error_m": info.vehicle[:, :3] - truth.robot[:, :3],
    }
    if info.followers is None:
        return kept
    velocity = info.followers.velocity_m_s
    return kept | {"followed": info.followers.track_id, "velocity_m_s": velocity, "handed_back": info.handed_back_id}


def runs_of(scenario: vc.Scenario, max_followed: int, study: Study) -> list[dict[str, np.ndarray]]:
    """All runs of a scene, one after another."""
    config = dataclasses.replace(CONFIG, following=vc.Following(max_followed=max_followed))
    seeds = np.arange(study.seeds)
    found = run_lanes(Partial(work, Experiment(scenario, config)), {}, seeds, jax.random.key(study.key))
    return [{name: values[seed] for name, values in found.items()} for seed in seeds]


def events(run: dict[str, np.ndarray], name: str, feature: int) -> np.ndarray:
    """Frames in which this befell a feature."""
    return np.flatnonzero((run[name] == feature).any(axis=1))


def stops(runs: list[dict[str, np.ndarray]]) -> str:
    """Of movers that stand for a while: who was followed then, handed back, flagged again."""
    num_followed, too_early, back_after, again_after, errors = 0, 0, [], [], []
    for run in runs:
        for mover in np.flatnonzero(run["moves"].any(axis=0)).tolist():
            stands = np.flatnonzero(~run["moves"][:, mover])
            stop, start = stands[0], stands[-1] + 1
            back = events(run, "handed_back", mover)
            too_early += int(run["moves"][back, mover].sum())
            if not (run["followed"][stop] == mover).any():
                continue
            num_followed += 1
            errors.append(run["velocity_m_s"][stop - 1][run["followed"][stop - 1] == mover])
            if not len(back := back[(back >= stop) & (back < start)]):
                continue
            back_after.append(back[0] - stop)
            deleted = events(run, "deleted", mover)
            again_after += [deleted[deleted >= start][0] - start] if (deleted >= start).any() else []
    told = f"{num_followed} followed when they stop"
    if errors:
        velocity = np.sqrt(np.mean((np.concatenate(errors) - [0.0, 0.5, 0.0]) ** 2, axis=0))
        told += f", their velocity off by {', '.join(f'{v:.2f}' for v in velocity)} m/s along x, y, z"
    told += f"; {len(back_after)} handed back while they stand{_median(back_after)}; {len(again_after)} of these "
    return told + f"flagged again{_median(again_after)} of their start; {too_early} handed back while they move"


def _median(frames: list[int]) -> str:
    return f", within {np.median(frames):.0f} frames (median)" if frames else ""


def never_stop(runs: list[dict[str, np.ndarray]]) -> str:
    """Of what was flagged, movers and others: how much was handed back."""
    flagged, back = {True: 0, False: 0}, {True: 0, False: 0}
    for run in runs:
        moves = np.any(run["moves"], axis=0)
        for name, counts in (("deleted", flagged), ("handed_back", back)):
            is_mover = np.take(moves, run[name][run[name] >= 0])
            counts[True] += int(is_mover.sum())
            counts[False] += int((~is_mover).sum())
    return f"{back[True]} of {flagged[True]} movers flagged and {back[False]} of {flagged[False]} others handed back"


def position_cm(runs: list[dict[str, np.ndarray]]) -> np.ndarray:
    """RMS position error of each run, cm."""
    return np.array([100 * np.sqrt(np.mean(np.sum(run["error_m"] ** 2, axis=1))) for run in runs])


def main(study: Study) -> None:
    for amplitude_m in study.amplitudes_m:
        print(f"A = {amplitude_m:g} m, {study.seeds} runs of each scene")
        scenes = {"stops and starts": vc.scenarios.harder("stops_and_starts", oscillation_amplitude_m=amplitude_m)}
        for motion in ("lateral", "inverse_forward"):
            scenes[motion.replace("_", " ")] = vc.scenarios.paper(
                dynamic=motion, dynamic_speed_m_s=0.5, oscillation_amplitude_m=amplitude_m
            )
        for name, scenario in scenes.items():
            runs, without = (runs_of(scenario, number, study) for number in (study.max_followed, 0))
            difference = position_cm(runs) - position_cm(without)
            error = difference.std(ddof=1) / np.sqrt(len(difference))
            print(f"  {name}: {stops(runs) if name.startswith('stops') else never_stop(runs)}")
            print(f"    position {difference.mean():+.2f} ± {error:.2f} cm against never handed back, paired by seed")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())  # runs are shared between the cores
    main(tyro.cli(Study))
