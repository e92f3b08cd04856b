"""The paper's Tables 2–5 made again: as JSON for programs and as Markdown beside the paper's numbers for people.

Both take the runs of any set of cells; what the missing cells would have shown is left out.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import xarray as xr

from vcjax.report.markup import grid
from vcjax.storage import with_nulls, write_file
from vcjax.study.paper import SPEEDS_M_S, TABLES, Cell, Claim, cells, claims, pairs, paper_figures
from vcjax.study.summary import DECIMALS, FIGURES, format_mean, paired_difference, runs_text, student_t, summarise

REPORTED = (
    "position_rmse_cm",
    "orientation_error_deg",
    "yaw_error_deg",
    "recovered_per_run",
    "dynamic_events_per_run",
    "dynamic_found_per_run",
    "static_deleted_per_run",
)
"""The figures that a cell and a paired difference report."""

_INTRODUCTION = """\
# Tables 2–5 beside the paper

{seeds} {runs} per cell. Each figure is the mean over runs ± its standard error, followed by the paper's own number in
brackets where it has one; RE with the oscillating camera is not in the paper. Counts are events per run, except
*movers found* and *static deleted*, which count distinct features. ANEES is 1 for a consistent filter; the brackets
beside it hold the 95 % interval of χ² with 2 degrees of freedom per run (the frames of a run are correlated and add
none).

Differences are paired by seed, with 95 % Student-t intervals; those that exclude zero are bold. An interval supports a
statement of the paper if it lies wholly where the statement says, contradicts it if it lies wholly elsewhere, and
otherwise does not decide. There is no correction for the number of statements.
"""


class _Report(NamedTuple):
    """All that JSON and Markdown show, computed once."""

    seeds: int
    summaries: dict[Cell, xr.Dataset]
    differences: dict[tuple[Cell, Cell], xr.Dataset]


def tables(results: Mapping[Cell, xr.Dataset]) -> dict:
    """Every figure of every cell beside the paper's, and the differences paired by seed.

    Args:
        results: runs (seed, frame, feature) of any of the paper's cells, all with the same number of seeds.

    Returns:
        `{"seeds": n, "cells": [...], "paired": [...]}` of plain Python values. A cell holds its experiment and method,
        `{"mean", "se", "paper"}` for each figure of `REPORTED`, and `anees_position` and `runs_failed`; a paired
        difference its experiment, the name of the `difference` (first minus second), the number of `pairs`, and
        `{"mean", "se", "interval_95"}` for each figure. What is not known (a standard error from one seed) is NaN.

    Raises:
        ValueError: if there are no results, or their numbers of seeds differ.
    """
    return _as_json(_report(results))


def write_tables(results: Mapping[Cell, xr.Dataset], directory: str | os.PathLike) -> list[Path]:
    """Write `tables.json` (what is not finite as null) and `tables.md` into an existing directory; return their paths.

    Raises:
        ValueError: as `tables`.
        OSError: if the directory cannot be written to.
    """
    report = _report(results)
    as_json = json.dumps(with_nulls(_as_json(report)), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    contents = {"tables.json": as_json, "tables.md": _as_markdown(report)}
    return [write_file(Path(directory) / name, text.encode()) for name, text in contents.items()]


def _report(results: Mapping[Cell, xr.Dataset]) -> _Report:
    numbers = {cell.identifier: runs.sizes["seed"] for cell, runs in results.items()}
    if not numbers:
        raise ValueError("results={}: there is nothing to report; run at least one cell.")
    if len(set(numbers.values())) > 1:
        raise ValueError(f"results: the cells have different numbers of seeds, {numbers}; run all with the same.")
    ordered = [cell for cell in cells() if cell in results]
    wanted = {(a, b) for _, a, b in pairs(ordered)}
    wanted |= {(claim.minuend, claim.subtrahend) for table in TABLES for claim in claims(table) if claim.subtrahend}
    return _Report(
        seeds=next(iter(numbers.values())),
        summaries={cell: summarise(results[cell]) for cell in ordered},
        differences={
            (a, b): paired_difference(results[a], results[b]) for a, b in wanted if a in results and b in results
        },
    )


def _as_json(report: _Report) -> dict:
    entries = []
    for cell, summary in report.summaries.items():
        paper = paper_figures(cell) or {}
        entry = {**_experiment(cell), "gate": cell.gate, "oscillating": cell.oscillating}
        for name in REPORTED:
            mean, error = _values(summary, name)
            entry[name] = {"mean": mean, "se": error, "paper": paper.get(name)}
        anees_position, _ = _values(summary, "anees_position")
        entries.append({**entry, "anees_position": anees_position, "runs_failed": int(summary.runs_failed)})
    paired = []
    for name, a, b in pairs(report.summaries):
        difference = report.differences[a, b]
        entry = {**_experiment(a), "difference": name, "pairs": int(difference.num_pairs)}
        for figure in REPORTED:
            mean, error, lower, upper = _values(difference, figure)
            entry[figure] = {"mean": mean, "se": error, "interval_95": [lower, upper]}
        paired.append(entry)
    return {"seeds": report.seeds, "cells": entries, "paired": paired}


def _experiment(cell: Cell) -> dict:
    return dict(zip(("table", "robot_motion", "dynamic_motion", "dynamic_speed_m_s"), cell.experiment, strict=True))


def _values(summary: xr.Dataset, name: str) -> list[float]:
    return [float(value) for value in summary[name].values]


def _as_markdown(report: _Report) -> str:
    sections = [_INTRODUCTION.format(seeds=report.seeds, runs="run" if report.seeds == 1 else "runs")]
    for table in sorted({cell.table for cell in report.summaries}):
        title = "static scene" if table == 2 else f"movers at {SPEEDS_M_S[table]:g} m/s, robot forward"
        motion = "Robot motion" if table == 2 else "Mover motion"
        heads = [FIGURES[name][0].upper() + FIGURES[name][1:] for name in REPORTED]
        verdicts = [(claim, *_judge(claim, report)) for claim in claims(table) if _can_judge(claim, report)]
        sections += [
            f"## Table {table}: {title}\n",
            grid([motion, "Method", *heads, "ANEES position", "Runs"], _cell_rows(table, report)),
            _conclusion(table, verdicts),
        ]
        if differences := _difference_rows(table, report):
            sections += ["Differences, paired by seed:\n", grid([motion, "Difference", *heads], differences)]
        if verdicts:
            rows = [[claim.minuend.case, claim.text, interval, verdict] for claim, interval, verdict in verdicts]
            head = [motion, "The paper's statement", "Our figure or difference", "Verdict"]
            sections += ["The paper's statements one by one:\n", grid(head, rows)]
    return "\n".join(sections)


def _cell_rows(table: int, report: _Report) -> list[list[str]]:
    rows = []
    for cell, summary in report.summaries.items():
        if cell.table == table:
            paper = paper_figures(cell) or {}
            figures = [
                format_mean(name, *_values(summary, name)) + (f" ({_printed(paper[name])})" if name in paper else "")
                for name in REPORTED
            ]
            anees = format_mean("anees_position", *_values(summary, "anees_position"))
            if math.isfinite(summary.anees_position_bounds[0]):
                anees += " [{:.2f}, {:.2f}]".format(*_values(summary, "anees_position_bounds"))
            rows.append([cell.case, cell.method, *figures, anees, runs_text(summary)])
    return rows


def _printed(number: int | float) -> str:
    """As the paper prints it: counts whole, errors with four decimals."""
    return f"{number:.4f}" if isinstance(number, float) else f"{number}"


def _difference_rows(table: int, report: _Report) -> list[list[str]]:
    return [
        [a.case, name.replace(" - ", " − "), *(_interval(f, _values(report.differences[a, b], f)) for f in REPORTED)]
        for name, a, b in pairs(report.summaries)
        if a.table == table
    ]


def _interval(name: str, values: Sequence[float], is_difference: bool = True) -> str:
    mean, error, lower, upper = values
    if not math.isfinite(mean):
        return "–"
    form = f"{'+' * is_difference}.{DECIMALS[name]}f"
    text = f"{mean:{form}}"
    if math.isfinite(error):
        text += f" [{lower:{form}}, {upper:{form}}]"
    text = text.replace("-", "−")
    return f"**{text}**" if is_difference and (lower > 0 or upper < 0) else text


def _can_judge(claim: Claim, report: _Report) -> bool:
    if claim.subtrahend is None:
        return claim.minuend in report.summaries
    return (claim.minuend, claim.subtrahend) in report.differences


def _judge(claim: Claim, report: _Report) -> tuple[str, str]:
    """The claim's figure with its interval as text, and the verdict."""
    if claim.subtrahend is None:
        summary = report.summaries[claim.minuend]
        mean, error = _values(summary, claim.figure)
        half_width = error * student_t(int(summary.num_runs - summary.runs_failed))
        values = [mean, error, mean - half_width, mean + half_width]
    else:
        values = _values(report.differences[claim.minuend, claim.subtrahend], claim.figure)
    text, (_, _, lower, upper) = _interval(claim.figure, values, claim.subtrahend is not None), values
    if claim.low < lower and upper < claim.high:
        return text, "supported"
    return text, "contradicted" if upper < claim.low or lower > claim.high else "undecided"


def _conclusion(table: int, verdicts: Sequence[tuple[Claim, str, str]]) -> str:
    if not verdicts:
        return f"**None of the paper's statements about Table {table} can be judged from the cells at hand.**\n"
    grouped: dict[str, dict[str, list[str]]] = {"supported": {}, "contradicted": {}, "undecided": {}}
    for claim, _, verdict in verdicts:
        grouped[verdict].setdefault(claim.text, []).append(claim.minuend.case)
    num = {verdict: sum(map(len, texts.values())) for verdict, texts in grouped.items()}
    lines = [
        f"**Of the paper's {len(verdicts)} statements about Table {table}, our intervals support {num['supported']}, "
        f"contradict {num['contradicted']} and do not decide {num['undecided']}.**\n"
    ]
    for verdict, texts in grouped.items():
        if texts:
            where = "; ".join(f"{text} ({', '.join(cases)})" for text, cases in texts.items())
            lines.append(f"- {verdict.capitalize()}: {where}.")
    return "\n".join(lines) + "\n"
