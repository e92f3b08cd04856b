"""The commands, in this process and tiny: what they write and what they say."""

import json

import jax
import numpy as np
import pytest
import tiny_runs
import xarray as xr
from fake_runs import fake_runs
from tiny_runs import NUM_SEEDS, compilations
from told import assert_one_line, said

import vcjax as vc
from vcjax.cli import main
from vcjax.study import benchmark
from vcjax.study import monte_carlo as monte_carlo_module
from vcjax.study import reproduce as reproduce_module
from vcjax.study.paper import cells
from vcjax.study.results import SCHEMA, load, save
from vcjax.study.summary import FIGURES, summary_text

pytestmark = pytest.mark.usefixtures("unchecked")  # as people have it
SMALL = ["--num-frames", "12", "--seeds", "3", "--max-landmarks", "24", "--max-updates", "6"]


@pytest.mark.parametrize("gate", ["RE", "VC"])
def test_simulate_prints_a_summary_and_saves_the_runs(gate, tmp_path, capsys):
    out = tmp_path / "[bold]folder" / "runs.nc"
    options = ["--gate", gate, "--th1", "4", "--dynamic", "lateral", "--key", "5", "--out", str(out)]
    assert main(["simulate", *SMALL, *options, "--oscillation-amplitude-m", "0.05"]) == 0
    printed, told = said(capsys)
    runs = load(out)
    assert printed == f"{vc.summarise(runs)}\n" and printed.strip() == summary_text(vc.summarise(runs)).strip()
    assert all(label in printed for label in FIGURES.values()) and "3, 0 failed" in printed
    assert f"wrote {out}" in told
    config = tiny_runs.config({"RE": vc.ReprojectionError, "VC": vc.VirtualCorrection}[gate](th1=4.0))
    scenario = tiny_runs.scenario(dynamic_set="ahead", oscillation_amplitude_m=0.05)
    with compilations() as compiled:
        expected = vc.monte_carlo(scenario, config, num_seeds=NUM_SEEDS, key=jax.random.key(5))
    xr.testing.assert_identical(runs, expected)
    assert compiled.num == 0


def test_reproduce_then_report(tmp_path, capsys, monkeypatch):
    whole = reproduce_module.cell_experiment
    monkeypatch.setattr(reproduce_module, "cells", lambda tables=(2, 3, 4, 5): cells(tables)[:4])
    monkeypatch.setattr(reproduce_module, "cell_experiment", lambda cell: tiny_runs.tiny_experiment(whole(cell)))
    monkeypatch.setattr(monte_carlo_module, "LANES_PER_CALL", NUM_SEEDS)
    out = tmp_path / "paper"
    assert main(["reproduce", "--seeds", "3", "--tables", "2", "--out", str(out)]) == 0
    _, told = said(capsys)
    written = ["tables.json", "tables.md", "figures/figure_3.png", "figures/figure_3.svg"]
    assert all(f"wrote {out / name}" in told for name in written)
    before = {name: (out / name).read_bytes() for name in written}
    report = json.loads(before["tables.json"])
    assert report["seeds"] == NUM_SEEDS and len(report["cells"]) == 4

    for name in written:
        (out / name).unlink()
    assert main(["report", str(out)]) == 0
    assert {name: (out / name).read_bytes() for name in written} == before
    assert main(["reproduce", "--seeds", "3", "--tables", "2", "--key", "1", "--out", str(out)]) == 1
    assert_one_line(said(capsys)[1].splitlines()[-1], "has other settings (key: ")


def test_reproduce_reports_all_that_the_directory_holds(tmp_path, capsys, monkeypatch):
    """Tables run before, too: as `report` does."""
    whole = reproduce_module.cell_experiment
    monkeypatch.setattr(reproduce_module, "cells", lambda tables=(2, 3, 4, 5): [cells([table])[0] for table in tables])
    monkeypatch.setattr(reproduce_module, "cell_experiment", lambda cell: tiny_runs.tiny_experiment(whole(cell)))
    out = tmp_path / "paper"
    for table in (2, 3):
        assert main(["reproduce", "--seeds", "3", "--tables", str(table), "--out", str(out)]) == 0
    written = (out / "tables.json").read_bytes()
    assert [cell["table"] for cell in json.loads(written)["cells"]] == [2, 3]
    assert main(["report", str(out)]) == 0
    assert (out / "tables.json").read_bytes() == written


def test_damaged_results_get_one_clear_line(tmp_path, capsys):
    path = tmp_path / "runs" / cells([2])[0].identifier / "seeds_00000-00001.nc"
    save(fake_runs(num_seeds=2).assign_attrs(schema=SCHEMA), path)
    path.write_bytes(path.read_bytes()[:3000])
    assert main(["report", str(tmp_path)]) == 1
    assert_one_line(said(capsys)[1], str(path), "not a readable NetCDF-4 file")


def test_only_the_first_process_saves_the_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("vcjax.commands.simulate.monte_carlo", lambda *_, **__: fake_runs(num_seeds=2))
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    assert main(["simulate", "--out", str(tmp_path / "runs.nc")]) == 0
    assert said(capsys)[0] == "" and not list(tmp_path.iterdir())


def test_bench_saves_each_part_as_it_is_measured_and_tells_what_became_worse(tmp_path, monkeypatch, capsys):
    def fail():
        raise OSError("no more of this")

    parts = {"cell": lambda: {"cell_warm_s": 1.25, "ratio_to_floor": np.pi}, "seeds": fail}
    monkeypatch.setattr(benchmark, "PARTS", parts)
    numbers, baseline = tmp_path / "bench.json", tmp_path / "baseline.json"
    assert main(["bench", "--only", "cell", "seeds", "--json", str(numbers)]) == 1
    saved = json.loads(numbers.read_text())
    assert (saved["cell_warm_s"], saved["ratio_to_floor"]) == (1.25, np.pi)
    assert {"device", "num_devices", "dtype", "jax"} <= set(saved)
    baseline.write_text(json.dumps({"ratio_to_floor": 2.0}))
    said(capsys)
    assert main(["bench", "--only", "cell", "--baseline", str(baseline)]) == 1
    out, told = said(capsys)
    assert "cell_warm_s" in out and "more than 1.5 times the accepted 2.00" in told
