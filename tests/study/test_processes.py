"""Several processes that work together: the numbers of one, each part written by who ran it, and a death survived."""

import os
import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tiny_runs
import xarray as xr
from tiny_runs import NUM_CELLS, NUM_SEEDS, assert_same_runs, make_tiny, run_strict

from vcjax.study.reproduce import load_results, reproduce

ROUNDING = {"rtol": 1e-9, "atol": 1e-10}  # another compilation rounds differently

_SET_UP = f"""
import sys
sys.path.insert(0, {str(Path(tiny_runs.__file__).parent)!r})
number, port, out = int(sys.argv[1]), sys.argv[2], sys.argv[3]
import jax
from vcjax.devices import Devices
Devices(2, True, "127.0.0.1:" + port, 2, number).start()
assert (jax.process_count(), jax.local_device_count(), jax.device_count()) == (2, 2, 4)
import tiny_runs
"""
_MONTE_CARLO = """
import numpy as np
from tiny_runs import MEASURES, run_strict
runs = run_strict(num_seeds=5)
np.savez(f"{out}/{number}.npz", seed=runs.seed, **{name: runs[name] for name in MEASURES})
"""
_REPRODUCE = """
import time
from pytest import MonkeyPatch
from tiny_runs import make_tiny
from vcjax.study import reproduce as module
make_tiny(MonkeyPatch())
def slowly(done, total, cell):
    print(f"\\n{number} {done} {total}", flush=True)  # on a line of its own, whatever JAX is printing
    time.sleep(float(sys.argv[4]))
results = module.reproduce(out, num_seeds=tiny_runs.NUM_SEEDS, tables=(2,), progress=slowly)
print(f"\\n{number} found {len(results)}", flush=True)
"""

_REFUSED = """
from vcjax.study.reproduce import reproduce
try:
    reproduce(f"{out}/{number}", num_seeds=1)
except (ValueError, OSError) as error:
    print(error, flush=True)
"""


def start_two(script: str, *arguments) -> list[subprocess.Popen]:
    """Two processes that know of each other through a free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return [
        subprocess.Popen(
            [sys.executable, "-c", _SET_UP + script, str(number), str(port), *map(str, arguments)],
            env=os.environ | {"PYTHONWARNINGS": "ignore"},
            stdout=subprocess.PIPE,
            text=True,
        )
        for number in range(2)
    ]


def test_two_processes_give_the_numbers_of_one(tmp_path):
    """Four devices, five lanes: every process has them all in the end."""
    for process in start_two(_MONTE_CARLO, tmp_path):
        process.communicate(timeout=600)
        assert process.returncode == 0
    expected = run_strict(num_seeds=5)
    for number in range(2):
        with np.load(tmp_path / f"{number}.npz") as found:
            np.testing.assert_array_equal(found["seed"], expected.seed)
            assert_same_runs(found, expected, **ROUNDING)


@pytest.mark.slow
def test_a_late_process_is_waited_for(tmp_path):
    """Longer than the 30 s in which JAX's processes must connect: they have connected before."""
    late = "import time; time.sleep(40 * number)" + _MONTE_CARLO
    for process in start_two(late, tmp_path):
        process.communicate(timeout=600)
        assert process.returncode == 0


def test_what_one_process_is_refused_stops_all(tmp_path):
    (tmp_path / "0").mkdir()
    (tmp_path / "1").write_text("no folder")
    told = [process.communicate(timeout=600)[0] for process in start_two(_REFUSED, tmp_path)]
    assert "process 1 was refused, so all stop" in told[0]
    assert f"{tmp_path / '1'}" in told[1] and "was refused" not in told[1]
    assert not list((tmp_path / "0").rglob("*.nc"))


def test_different_options_are_refused_by_all(tmp_path):
    script = _REFUSED.replace("num_seeds=1", "num_seeds=1 + number").replace("/{number}", "")
    for process in start_two(script, tmp_path):
        assert "the processes were given different options; give all the same" in process.communicate(timeout=600)[0]
    assert not list(tmp_path.rglob("*.nc"))


@pytest.fixture
def alone(tmp_path, monkeypatch):
    """The same work by one process."""
    make_tiny(monkeypatch)
    return reproduce(tmp_path / "alone", num_seeds=NUM_SEEDS, tables=(2,))


def test_each_process_writes_its_part(tmp_path, alone):
    processes = start_two(_REPRODUCE, tmp_path, 0)
    told = [process.communicate(timeout=600)[0].splitlines() for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    for number, lines in enumerate(told):
        assert [line for line in lines if re.fullmatch(rf"{number} \d \d", line)] == [f"{number} 1 2", f"{number} 2 2"]
        assert f"{number} found {NUM_CELLS}" in lines  # each waits for the other's part
    results = load_results(tmp_path, tables=(2,))
    for cell, runs in alone.items():
        xr.testing.assert_allclose(results[cell], runs, **ROUNDING)


def test_a_process_that_dies_leaves_what_is_finished_and_a_restart_completes_it(tmp_path, alone):
    """Process 1 is killed after its first block; process 0 does its part to the end."""
    processes = start_two(_REPRODUCE.replace("(sys.argv[4])", "(sys.argv[4]) * number"), tmp_path, 600)
    deadline = time.monotonic() + 600

    def wait_for(num_blocks, pattern):
        while len(list(tmp_path.glob(pattern))) < num_blocks:
            assert time.monotonic() < deadline
            time.sleep(0.05)

    wait_for(1, "runs/*VC*/*.nc")
    processes[1].kill()
    wait_for(3, "runs/*/*.nc")
    for process in processes:
        process.kill()
        process.communicate()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("runs/*/*.nc")}
    results = reproduce(tmp_path, num_seeds=NUM_SEEDS, tables=(2,))
    assert {path: path.stat().st_mtime_ns for path in before} == before and len(before) == 3
    for cell, runs in alone.items():
        xr.testing.assert_allclose(results[cell], runs, **ROUNDING)
