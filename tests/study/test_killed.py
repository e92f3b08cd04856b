"""SIGKILL, which nothing can prepare for, at any moment of `reproduce`: nothing is lost, broken or done twice."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny_runs
from tiny_runs import NUM_CELLS, NUM_SEEDS, make_tiny

from vcjax.report.paper_tables import write_tables
from vcjax.study import reproduce as module
from vcjax.study.results import load

NUM_KILLS = 20
NUM_BLOCKS = 30
"""Of each cell."""

_CHILD = f"""
import sys
sys.path.insert(0, {str(Path(tiny_runs.__file__).parent)!r})
out, cache = sys.argv[1:]
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", cache)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
from pytest import MonkeyPatch
from tiny_runs import NUM_SEEDS, make_tiny
from vcjax.report.paper_tables import write_tables
from vcjax.study import reproduce as module
make_tiny(MonkeyPatch())
module.SEEDS_PER_BLOCK = NUM_SEEDS
results = module.reproduce(out, num_seeds={NUM_BLOCKS} * NUM_SEEDS, tables=(2,))
write_tables(results, out)
"""


def finished(directory: Path) -> dict[Path, int]:
    """The blocks there are and when they were written."""
    return {path: path.stat().st_mtime_ns for path in directory.glob("runs/*/*.nc")}


@pytest.mark.slow
def test_killed_again_and_again_ends_the_same(tmp_path, monkeypatch):
    out, cache, alone = (tmp_path / name for name in ("killed", "cache", "alone"))
    rng = np.random.default_rng(0)
    num_kills, where = 0, []
    while True:
        before = finished(out)
        command = [sys.executable, "-c", _CHILD, str(out), str(cache)]
        child = subprocess.Popen(command, env=os.environ | {"PYTHONWARNINGS": "ignore"})
        if num_kills == NUM_KILLS:
            assert child.wait(timeout=600) == 0
            break
        # Half of the kills come while it starts and compiles, half among the blocks.
        if num_kills % 2:
            while finished(out) == before and child.poll() is None:
                time.sleep(0.005)
        time.sleep(rng.uniform(0.0, 0.3 if num_kills % 2 else 6.0))
        assert child.poll() is None, "finished before it could be killed: give it more to do"
        child.send_signal(signal.SIGKILL)
        assert child.wait() == -signal.SIGKILL
        num_kills += 1
        after = finished(out)
        assert {path: after[path] for path in before} == before  # nothing lost, nothing done twice
        for path in set(after) - set(before):
            load(path)  # complete
        where.append(len(after))
    assert finished(out).items() >= after.items() and len(finished(out)) == NUM_CELLS * NUM_BLOCKS
    assert len(set(where)) > NUM_KILLS // 3  # the kills were spread over the work

    make_tiny(monkeypatch)
    monkeypatch.setattr(module, "SEEDS_PER_BLOCK", NUM_SEEDS)
    write_tables(module.reproduce(alone, num_seeds=NUM_BLOCKS * NUM_SEEDS, tables=(2,), key=jax.random.key(0)), alone)
    for name in ("tables.json", "tables.md"):
        assert (out / name).read_bytes() == (alone / name).read_bytes()
