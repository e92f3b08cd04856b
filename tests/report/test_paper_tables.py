"""Tables: the JSON format, values against the summaries, partial sets of cells, verdicts, and whole files or none."""

import json
import math
import os
import re

import numpy as np
import pytest
from fake_runs import fake_results, fake_runs, with_failed_seed

from vcjax.report.paper_tables import REPORTED, tables, write_file, write_tables
from vcjax.study.paper import Cell, cells
from vcjax.study.summary import paired_difference, summarise

RE = Cell(2, "forward", None, None, "RE", False)
VC = Cell(2, "forward", None, None, "VC", False)


@pytest.fixture(scope="module")
def results():
    return fake_results(num_seeds=4)


@pytest.fixture(scope="module")
def found(results):
    return tables(results)


def strict(text: str):
    """Parse JSON without the NaN and Infinity that Python's parser lets through."""

    def refuse(constant):
        raise ValueError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def written(results, directory) -> tuple[dict, str]:
    as_json, as_markdown = write_tables(results, directory)
    assert (as_json, as_markdown) == (directory / "tables.json", directory / "tables.md")
    return strict(as_json.read_text()), as_markdown.read_text()


def test_json_has_every_cell_and_difference(found):
    assert set(found) == {"seeds", "cells", "paired"} and found["seeds"] == 4
    assert len(found["cells"]) == 36 and len(found["paired"]) == 45
    experiment = {"table", "robot_motion", "dynamic_motion", "dynamic_speed_m_s"}
    for cell in found["cells"]:
        assert set(cell) == experiment | {"gate", "oscillating", *REPORTED, "anees_position", "runs_failed"}
        assert all(set(cell[name]) == {"mean", "se", "paper"} for name in REPORTED)
    for pair in found["paired"]:
        assert set(pair) == experiment | {"difference", "pairs", *REPORTED}
        assert all(set(pair[name]) == {"mean", "se", "interval_95"} for name in REPORTED)
    first = found["cells"][0]
    assert first.items() >= {"robot_motion": "forward", "dynamic_motion": None, "dynamic_speed_m_s": None}.items()
    assert first.items() >= {"table": 2, "gate": "RE", "oscillating": False}.items()


def test_json_holds_the_summaries_and_the_papers_numbers(results, found):
    cell = Cell(4, "forward", "inverse_forward", 0.5, "VC", True)
    entry = found["cells"][cells().index(cell)]
    summary = summarise(results[cell])
    for name in REPORTED:
        assert [entry[name]["mean"], entry[name]["se"]] == summary[name].values.tolist()
    papers = {name: entry[name]["paper"] for name in REPORTED if entry[name]["paper"] is not None}
    assert papers == {"position_rmse_cm": 12.517, "orientation_error_deg": 0.1251, "dynamic_events_per_run": 18}
    pair = next(
        pair
        for pair in found["paired"]
        if pair["difference"] == "VC oscillating - RE steady"
        and (pair["table"], pair["dynamic_motion"]) == (4, "inverse_forward")
    )
    steady = Cell(4, "forward", "inverse_forward", 0.5, "RE", False)
    difference = paired_difference(results[cell], results[steady]).position_rmse_cm.values
    values = pair["position_rmse_cm"]
    assert [values["mean"], values["se"], *values["interval_95"]] == difference.tolist()


def test_files_hold_the_same_whatever_the_order_of_the_cells(tmp_path):
    results = {cell: fake_runs(cell, 2) for cell in cells([2])[:4]}
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    backwards = dict(reversed(list(results.items())))
    assert written(results, tmp_path / "a") == written(backwards, tmp_path / "b")
    assert sorted(os.listdir(tmp_path / "a")) == ["tables.json", "tables.md"]


def test_one_seed_is_null_in_json_and_decides_nothing(tmp_path):
    found, text = written(fake_results((2,), num_seeds=1), tmp_path)
    assert found["seeds"] == 1
    assert found["cells"][0]["position_rmse_cm"]["se"] is None
    assert found["paired"][0]["position_rmse_cm"]["interval_95"] == [None, None]
    assert "support 0, contradict 0 and do not decide" in text
    assert "nan" not in text and "\n1 run per cell." in text


def test_figure_that_is_not_defined_is_null_in_json_and_a_dash_in_text(tmp_path):
    runs = fake_runs(VC, 3)
    found, text = written({VC: runs.assign(nees_position=np.nan * runs.nees_position), RE: fake_runs(RE, 3)}, tmp_path)
    assert found["cells"][1]["anees_position"] is None and found["cells"][1]["runs_failed"] == 0
    row = next(line for line in text.splitlines() if line.startswith("| forward | VC, steady camera |"))
    assert row.endswith("| – | 3, 0 failed |") and "nan" not in text


def test_failed_seeds_are_counted_and_left_out(tmp_path):
    results = {RE: fake_runs(RE, 5), VC: with_failed_seed(fake_runs(VC, 5), 3)}
    found, text = written(results, tmp_path)
    assert [cell["runs_failed"] for cell in found["cells"]] == [0, 1]
    assert found["paired"][0]["pairs"] == 4
    assert all(math.isfinite(cell["anees_position"]) for cell in found["cells"])
    assert "5, 1 failed" in text


def test_a_cell_with_no_finite_run_is_null(tmp_path):
    runs = with_failed_seed(with_failed_seed(fake_runs(VC, 2), 0), 1)
    found, _ = written({VC: runs, RE: fake_runs(RE, 2)}, tmp_path)
    failed = found["cells"][1]
    assert failed["runs_failed"] == 2 and failed["anees_position"] is None
    assert failed["position_rmse_cm"] == {"mean": None, "se": None, "paper": 5.6966}


def test_one_table_alone(tmp_path):
    found, text = written(fake_results((4,), num_seeds=3), tmp_path)
    assert {cell["table"] for cell in found["cells"]} == {4}
    assert re.findall(r"^## Table (\d)", text, re.M) == ["4"]
    assert "than at 1 m/s" not in text  # needs Table 3


def test_files_hold_all_tables_well_formed(results, found, tmp_path):
    as_json, text = written(results, tmp_path)
    assert as_json == found
    for grid in re.findall(r"(?:^\|.*\n)+", text, re.M):
        assert len({line.count("|") for line in grid.splitlines()}) == 1
    for number in ("(5.7318)", "(0.1130)", "(15.1492)", "(48)"):
        assert number in text
    assert len(re.findall(r"^\*\*Of the paper's \d+ statements", text, re.M)) == 4
    assert text.count("| VC oscillating has more dynamic events than at 1 m/s |") == 2


def test_missing_cells_leave_out_what_needs_them(tmp_path):
    found, text = written({VC: fake_runs(VC)}, tmp_path)
    assert len(found["cells"]) == 1 and found["paired"] == []
    assert "VC steady recovers 16–17 features" in text and "lower position error" not in text
    lone = Cell(2, "forward", None, None, "RE", True)
    _, text = written({lone: fake_runs(lone)}, tmp_path)
    assert "None of the paper's statements about Table 2 can be judged" in text


def test_nothing_to_report_and_unequal_seeds_are_refused():
    with pytest.raises(ValueError, match="run at least one cell"):
        tables({})
    with pytest.raises(ValueError, match=r"different numbers of seeds.*table2_forward_static_RE_steady': 3"):
        tables({RE: fake_runs(RE, 3), VC: fake_runs(VC, 4)})


@pytest.mark.parametrize(("shift_m", "verdict"), [(-0.05, "supported"), (0.05, "contradicted"), (0.0, "undecided")])
def test_verdicts_follow_the_intervals(tmp_path, shift_m, verdict):
    runs = fake_runs(RE, 6)
    noise = 0.001 * np.random.default_rng(3).normal(size=6) * (shift_m == 0.0)
    base = 0.2 + 0 * runs.position_error_m
    better = base + shift_m + (noise - noise.mean())[:, None]
    results = {RE: runs.assign(position_error_m=base), VC: runs.assign(position_error_m=better)}
    _, text = written(results, tmp_path)
    claim = "VC has a lower position error than RE (steady camera)"
    row = next(line for line in text.splitlines() if f"| {claim} |" in line)
    assert row.endswith(f"| {verdict} |")
    bullet = next(line for line in text.splitlines() if line.startswith(f"- {verdict.capitalize()}:"))
    assert f"{claim} (forward)" in bullet


@pytest.mark.parametrize(
    ("recovered", "verdict"),
    [
        ([16, 17, 16, 17], "supported"),
        ([12, 13, 12, 13], "contradicted"),
        ([19, 20, 19, 20], "contradicted"),
        ([15, 16, 15, 16], "undecided"),
        ([17, 18, 17, 18], "undecided"),
        ([10, 23, 10, 23], "undecided"),
    ],
)
def test_verdicts_on_a_range(tmp_path, recovered, verdict):
    runs = fake_runs(VC, 4)
    counts = np.zeros(runs.num_recovered.shape, int)
    counts[:, 0] = recovered
    _, text = written({VC: runs.assign(num_recovered=(runs.num_recovered.dims, counts))}, tmp_path)
    row = next(line for line in text.splitlines() if "| VC steady recovers 16–17 features |" in line)
    assert row.endswith(f"| {verdict} |")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "tables.json"
    write_file(path, b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["tables.json"]
