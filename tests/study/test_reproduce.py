"""The paper's experiments on disk: stopped, extended, refused; with tiny versions of four cells of Table 2."""

import json
import os
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from tiny_runs import NUM_CELLS, NUM_SEEDS, make_tiny, some_cells, tiny_experiment

import vcjax as vc
from vcjax.study import monte_carlo as monte_carlo_module
from vcjax.study import reproduce as module
from vcjax.study.paper import METHODS, Cell, cells
from vcjax.study.reproduce import cell_experiment, load_results, reproduce


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """Tiny experiments; gives the blocks that were run, as they are run."""
    worked = []

    def monte_carlo(scenario, config, *, first_seed, num_seeds, **options):
        worked.append((first_seed, num_seeds))
        return monte_carlo_module.monte_carlo(scenario, config, first_seed=first_seed, num_seeds=num_seeds, **options)

    make_tiny(monkeypatch)
    monkeypatch.setattr(module, "monte_carlo", monte_carlo)
    return worked


def stop_after(num_blocks: int):
    """Progress that stops the work like Ctrl-C."""

    def progress(done, total, cell):
        if done == num_blocks:
            raise KeyboardInterrupt

    return progress


def files(directory: Path) -> dict[str, tuple[int, bytes]]:
    """Every file below a directory with its time of writing and content."""
    return {
        str(path.relative_to(directory)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


def assert_identical(found: dict[Cell, xr.Dataset], expected: dict[Cell, xr.Dataset]) -> None:
    assert list(found) == list(expected)
    for cell, runs in expected.items():
        xr.testing.assert_identical(found[cell], runs)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Work that was never stopped: the directory and what it gave."""
    directory = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        return directory, reproduce(directory, num_seeds=NUM_SEEDS, tables=(2,))


def test_runs_every_cell_with_the_same_seeds(whole, tmp_path, tiny):
    _, results = whole
    assert [(cell.gate, cell.oscillating) for cell in results] == list(METHODS)
    for cell, runs in results.items():
        assert runs.seed.values.tolist() == list(range(NUM_SEEDS))
        assert json.loads(runs.attrs["config"])["gate"]["class"].startswith(cell.gate[0])
    first_frame = np.stack([runs.robot[:, 0] for runs in results.values()])  # before any correction
    assert (first_frame == first_frame[0]).all()
    done = []
    again = reproduce(
        tmp_path, num_seeds=NUM_SEEDS, tables=(2,), progress=lambda *told: done.append(told), key=jax.random.key(0)
    )
    assert_identical(again, results)
    assert [told[:2] for told in done] == [(i, NUM_CELLS) for i in range(1, NUM_CELLS + 1)]
    assert [told[2].gate for told in done] == ["RE", "RE", "VC", "VC"]  # each gate compiles once
    assert {told[2] for told in done} == set(results) and len(tiny) == NUM_CELLS


def test_cells_are_those_of_single_calls(whole):
    _, results = whole
    cell = Cell(2, "forward", None, None, "VC", True)
    experiment = tiny_experiment(cell_experiment(cell))
    alone = vc.monte_carlo(experiment.scenario, experiment.config, num_seeds=NUM_SEEDS, key=jax.random.key(0))
    xr.testing.assert_identical(results[cell], alone)


@pytest.mark.parametrize("num_blocks", [1, 3])
def test_stopped_and_started_again_ends_the_same(whole, tmp_path, tiny, num_blocks):
    with pytest.raises(KeyboardInterrupt):
        reproduce(tmp_path, num_seeds=NUM_SEEDS, tables=(2,), progress=stop_after(num_blocks))
    before = files(tmp_path)
    assert len(tiny) == num_blocks and len(before) == num_blocks + 1
    last = Cell(2, "forward", None, None, "VC", True)
    leftover = tmp_path / "runs" / last.identifier / ".seeds_00000-00002.nc.x1y2.tmp"
    leftover.parent.mkdir(exist_ok=True)
    leftover.write_bytes(b"half a file")
    os.utime(leftover, (0, 0))

    results = reproduce(tmp_path, num_seeds=NUM_SEEDS, tables=(2,))
    assert_identical(results, whole[1])
    assert len(tiny) == NUM_CELLS  # in both together
    after = files(tmp_path)
    assert {name: after[name] for name in before if name.startswith("runs")} == {
        name: file for name, file in before.items() if name.startswith("runs")
    }
    assert not leftover.exists()
    reproduce(tmp_path, num_seeds=NUM_SEEDS, tables=(2,))
    assert len(tiny) == NUM_CELLS


def test_more_seeds_extend_fewer(whole, tmp_path, tiny, monkeypatch):
    """Within a block, which is run anew, and by further blocks, where what is there stays."""
    monkeypatch.setattr(module, "SEEDS_PER_BLOCK", 6)
    reproduce(tmp_path, num_seeds=NUM_SEEDS, tables=(2,))
    six = reproduce(tmp_path, num_seeds=6, tables=(2,))
    assert {path.name for path in tmp_path.rglob("*.nc")} == {"seeds_00000-00005.nc"}
    before, worked = files(tmp_path / "runs"), len(tiny)
    nine = reproduce(tmp_path, num_seeds=9, tables=(2,))
    assert tiny[worked:] == [(6, 3)] * NUM_CELLS
    after = files(tmp_path / "runs")
    assert {name: after[name] for name in before} == before
    for cell in nine:
        assert nine[cell].seed.values.tolist() == list(range(9))
        xr.testing.assert_identical(nine[cell].sel(seed=slice(0, 5)), six[cell])
        xr.testing.assert_identical(six[cell].sel(seed=slice(0, 2)), whole[1][cell])
    worked = len(tiny)
    assert_identical(reproduce(tmp_path, num_seeds=NUM_SEEDS, tables=(2,)), whole[1])  # fewer are read, not run
    assert len(tiny) == worked


def test_reads_seeds_that_all_cells_have(whole, tmp_path, tiny, monkeypatch):
    monkeypatch.setattr(module, "SEEDS_PER_BLOCK", NUM_SEEDS)
    with pytest.raises(KeyboardInterrupt):
        reproduce(tmp_path, num_seeds=2 * NUM_SEEDS, tables=(2,), progress=stop_after(3))
    results = load_results(tmp_path)
    assert [runs.sizes["seed"] for runs in results.values()] == [NUM_SEEDS] * 2
    cell = next(iter(results))
    (tmp_path / "runs" / cell.identifier / "seeds_00000-00002.nc").unlink()
    with pytest.raises(ValueError, match="no seed in common; run `vcjax reproduce` again"):
        load_results(tmp_path)


def test_leftovers_are_removed_beside_finished_blocks_and_nothing_else_is(whole, tmp_path, tiny):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    cell = tmp_path / "runs" / some_cells()[0].identifier
    leftover, other = cell / ".seeds_00000-00002.nc.x1y2.tmp", cell / ".notes.txt.tmp"
    for path in (leftover, other):
        path.write_bytes(b"half a file")
        os.utime(path, (0, 0))
    reproduce(tmp_path, num_seeds=NUM_SEEDS, tables=(2,))
    assert not tiny and not leftover.exists() and other.exists()


@pytest.mark.parametrize("tables", [(2,), (3,)])
def test_directory_of_another_key_is_refused_before_any_work(whole, tiny, tables):
    """Whatever the tables: cells of one directory are compared with each other."""
    directory, _ = whole
    before = files(directory)
    with pytest.raises(ValueError, match=r"seeds_00000-00002.nc has other settings \(key: .*; give another directory"):
        reproduce(directory, num_seeds=NUM_SEEDS, tables=tables, key=jax.random.key(1))
    assert not tiny and files(directory) == before


def test_directory_of_other_settings_is_refused(whole, tiny, monkeypatch):
    monkeypatch.setattr(module, "GATES", {"RE": vc.ReprojectionError, "VC": lambda: vc.VirtualCorrection(th2=8.0)})
    monkeypatch.setattr(module, "cell_experiment", lambda cell: tiny_experiment(cell_experiment(cell)))
    with pytest.raises(ValueError, match=r"VC_steady.*has other settings \(config\."):
        reproduce(whole[0], num_seeds=NUM_SEEDS, tables=(2,))
    assert not tiny


def test_damaged_block_is_named(whole, tmp_path, tiny):
    block = tmp_path / "runs" / cells([2])[0].identifier / "seeds_00000-00002.nc"
    block.parent.mkdir(parents=True)
    source = whole[0] / block.relative_to(tmp_path)
    block.write_bytes(source.read_bytes()[:2000])
    for read in (lambda: reproduce(tmp_path, num_seeds=NUM_SEEDS, tables=(2,)), lambda: load_results(tmp_path)):
        with pytest.raises(ValueError, match=r"seeds_00000-00002.nc: not a readable NetCDF-4 file .* remove it"):
            read()
    assert not tiny


def test_bad_arguments_leave_no_trace(tmp_path, tiny):
    directory = tmp_path / "results"
    for arguments, message in (
        ({"num_seeds": 0}, r"num_seeds=0\): give at least one seed"),
        ({"tables": (2, 6)}, r"no table 6; choose among \(2, 3, 4, 5\)"),
        ({"tables": ()}, r"tables=\(\)\): give at least one of \(2, 3, 4, 5\)"),
    ):
        with pytest.raises(ValueError, match=message):
            reproduce(directory, **arguments)
    assert not tiny and not directory.exists()


def test_unwritable_directory_is_told_before_any_work(tmp_path, tiny):
    (tmp_path / "file").write_text("not a folder")
    for directory in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OSError, match="file"):
            reproduce(directory, num_seeds=NUM_SEEDS)
    assert not tiny


def test_nothing_to_read_is_told(tmp_path):
    for directory in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(FileNotFoundError, match="run `vcjax reproduce` first"):
            load_results(directory)
