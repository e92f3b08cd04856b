"""What a choice of settings is worth: every figure before and after, and the differences paired by seed."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from vcjax.report.markup import counted, grid
from vcjax.study import roc
from vcjax.study.summary import mean_and_error, student_t
from vcjax.tuning.choice import ALL, COMPARED, FALSE_RATE, RECALL, Choice, by_scene, tracks_of

_DECIMALS = dict.fromkeys((*COMPARED, RECALL), 2) | {
    "loss": 3,
    "detection_f1": 3,
    "detection_auc": 3,
    RECALL: 3,
    "orientation_error_deg": 3,
    "camera_motion_m2_s2": 3,
}
_LABELS = COMPARED | {RECALL: "recall at 1 % static"}
_TABLES = (
    ("detection_f1", RECALL, "position_rmse_cm"),
    ("dynamic_found_per_run", "static_deleted_per_run", "detection_delay_frames"),
    ("detection_auc", "orientation_error_deg", "anees_position"),
    ("loss", "camera_motion_m2_s2"),
)
_INTRODUCTION = """\
Hard decisions, {seeds} held out for each scene. Each cell: before → after, and in brackets the 95 % interval of
the difference, paired by seed; bold where it excludes zero. *F1* = 2 found / (found + static deleted + movers) counts
the features deleted at least once, of the movers that were ever candidates or deleted; *recall at 1 % static* is the
share of the movers found if the largest margin of each feature, of gate or detector, is compared with the threshold at
which 1 % of the static ones are called dynamic (tracks of all runs pooled, intervals by bootstrap, from
{min_seeds} seeds on); *delay* counts the frames from the birth of a mover to its deletion, where it was found; over
all scenes a figure is of the seeds that have one in each of them; *camera motion* is the mean square speed of the
swing, (2πfA)²/2.
"""
_FAILED = """\
**{before} seeds before and {after} after have a run that went non-finite in some scene**: they are in no mean over all
scenes, and each failed run in none of its scene.
"""


def comparison(choice: Choice) -> dict[str, Any]:
    """A choice as plain values: `{"before": {...}, "after": {...}, "paired": {...}, "held_out_seeds": n}`.

    `before` and `after` hold `parameters`, the `loss` (mean and se over all scenes), `seeds_failed` (how many have a
    run that failed in some scene, and so are in no mean over all scenes) and by scene, the last of which is all of
    them, `metrics`: each figure with `mean` and `se`. `paired` holds by scene and figure the `mean` of after -
    before, its 95 % interval `lower` to `upper`, and `num_pairs`: how many seeds count, which are those that
    stayed finite and have the figure on both sides. Recall at 1 % static has its se and interval by bootstrap, from
    8 seeds on; the others are Student-t.
    """
    runs = [choice.held_out.isel(setting=i, drop=True) for i in (0, 1)]
    # Of both together, so that means over all scenes are of the same scenes.
    of_both = by_scene(choice.held_out)
    scenes = [{name: each.isel(setting=i, drop=True) for name, each in of_both.items()} for i in (0, 1)]
    tracks = [tracks_of(each) for each in runs]
    in_both = choice.held_out.is_finite.all("setting")
    metrics: list[dict[str, Any]] = [{}, {}]
    paired: dict[str, Any] = {}
    for name in scenes[0]:
        found = [_mean(scene[name]) for scene in scenes]
        paired[name] = _difference(scenes[0][name], scenes[1][name])
        for figures, track in zip(found, tracks, strict=True):
            value, samples = _recall(track[name])
            figures[RECALL] = {"mean": value, "se": float(np.std(samples))}
        is_pair = in_both.all("scene") if name == ALL else in_both.sel(scene=name)
        paired[name][RECALL] = _recall_difference([track[name] for track in tracks], is_pair.values)
        for part, figures in zip(metrics, found, strict=True):
            part[name] = figures
    last = list(paired)[-1]
    sides = {
        side: {
            "parameters": dict(setting),
            "loss": part[last]["loss"],
            "seeds_failed": int((~each.is_finite.all("scene")).sum()),
            "metrics": part,
        }
        for side, setting, part, each in zip(
            ("before", "after"), (choice.before, choice.after), metrics, runs, strict=True
        )
    }
    return sides | {
        "paired": paired,
        "held_out_seeds": int(choice.held_out.sizes["seed"]),
        "runs": {
            "choosing": int(choice.candidates.loss.size),
            "held_out": int(choice.held_out.loss.size),
            "failed": int((~choice.candidates.is_finite).sum() + (~choice.held_out.is_finite).sum()),
            "map_full": int((choice.held_out.map_full_frames > 0).sum()),
        },
    }


def comparison_markdown(compared: Mapping[str, Any]) -> str:
    """The same as Markdown."""
    before, after = compared["before"], compared["after"]
    rows = [
        [f"`{path}`", f"{value:.4g}", f"{after['parameters'][path]:.4g}"]
        for path, value in before["parameters"].items()
    ]
    introduction = _INTRODUCTION.format(seeds=counted(compared["held_out_seeds"], "seed"), min_seeds=roc.MIN_SEEDS)
    if before["seeds_failed"] or after["seeds_failed"]:
        introduction += _FAILED.format(before=before["seeds_failed"], after=after["seeds_failed"])
    sections = [grid(["parameter", "before", "after"], rows), introduction]
    if before["parameters"] == after["parameters"]:
        sections.insert(1, "No candidate is better than the setting before, which stays.\n")
    elif not (difference := list(compared["paired"].values())[-1]["loss"])["upper"] < 0:
        means = " → ".join(f"{compared[side]['loss']['mean']:.3f}" for side in ("before", "after"))
        judgement = "larger" if difference["lower"] > 0 else "not surely smaller"
        sections.insert(1, f"**On the seeds held out the objective is {judgement} after than before: {means}.**\n")
    scenes = [name for name in compared["paired"] if name != ALL or len(compared["paired"]) > 2]
    for figures in _TABLES:
        rows = [[scene, *(_cell(compared, scene, figure) for figure in figures)] for scene in scenes]
        sections.append(grid(["scene", *(_LABELS[figure] for figure in figures)], rows))
    return "\n".join(sections)


def _cell(compared: Mapping[str, Any], scene: str, figure: str) -> str:
    means = [compared[side]["metrics"][scene][figure]["mean"] for side in ("before", "after")]
    difference = compared["paired"][scene][figure]
    lower, upper, digits = difference["lower"], difference["upper"], _DECIMALS[figure]
    text = " → ".join("–" if not _is_finite(mean) else f"{mean:.{digits}f}" for mean in means)
    if not _is_finite(lower):
        return text
    text = f"{text} [{lower:+.{digits}f}, {upper:+.{digits}f}]".replace("-", "−")
    return f"**{text}**" if lower > 0 or upper < 0 else text


def _mean(figures: xr.Dataset) -> dict[str, Any]:
    """Mean and standard error of each figure over the seeds that have it."""
    found = {}
    for name in COMPARED:
        mean, error = mean_and_error(figures[name], figures[name].notnull())
        found[name] = {"mean": float(mean), "se": float(error)}
    return found


def _difference(before: xr.Dataset, after: xr.Dataset) -> dict[str, Any]:
    """Mean of after - before with its interval, of each figure over the seeds that have it in both."""
    found = {}
    for name in COMPARED:
        difference = after[name] - before[name]
        counts = difference.notnull()
        mean, error = mean_and_error(difference, counts)
        num = int(counts.sum())
        half_width = float(error) * float(student_t(num))
        mean = float(mean)
        found[name] = {"mean": mean, "lower": mean - half_width, "upper": mean + half_width, "num_pairs": num}
    return found


def _recall(tracks: roc.Tracks) -> tuple[float, np.ndarray]:
    """Recall at `FALSE_RATE`, and the same of every resample of the seeds."""
    rate = np.array([FALSE_RATE])
    return float(roc.recall_at(tracks, rate)[0, 0]), roc.resampled(roc.recall_at, tracks, rate)[:, 0]


def _recall_difference(tracks: Sequence[roc.Tracks], is_pair: np.ndarray) -> dict[str, Any]:
    """After - before of the seeds that stayed finite in both, with its interval by the same resamples of them."""
    mean = lower = upper = math.nan
    if np.any(is_pair):
        before, after = (_recall(roc.Tracks(each.score[is_pair], each.is_mover[is_pair])) for each in tracks)
        mean = after[0] - before[0]
        lower, upper = map(float, roc.interval(after[1] - before[1]))
    num = int(np.sum(is_pair)) if _is_finite(mean) else 0
    return {"mean": mean, "lower": lower, "upper": upper, "num_pairs": num}


def _is_finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)
