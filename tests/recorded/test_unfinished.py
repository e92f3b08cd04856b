"""A run that is stopped goes on where it was, to the same numbers; another run is refused."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import recorded

import vcjax as vc
from vcjax.recorded.filtered import filter_recording
from vcjax.recorded.unfinished import Unfinished


class Stopped(Exception):
    pass


def stop_after(num_frames):
    def progress(done, total):
        if done >= num_frames:
            raise Stopped

    return progress


def unfinished(folder, recording=None, **options) -> Unfinished:
    recording = recorded.content().recording if recording is None else recording
    return Unfinished(folder, recorded.config(**options), recording, every_s=0.0)


def run(folder, progress=None, **options):
    return filter_recording(
        recorded.config(**options),
        recorded.content().recording,
        progress,
        unfinished=unfinished(folder, **options),
        length=8,
    )


def assert_same(one, other):
    for a, b in zip(jax.tree.leaves(one[:2]), jax.tree.leaves(other[:2]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.usefixtures("unchecked")
def test_stopped_and_gone_on_is_the_same_to_the_bit(tmp_path):
    whole = filter_recording(recorded.config(), recorded.content().recording)
    folder = tmp_path / "unfinished"
    for until in (16, 24):
        with pytest.raises(Stopped):
            run(folder, stop_after(until))
    begun = unfinished(folder).read()
    settings = json.loads((folder / "settings.json").read_text(), parse_constant=pytest.fail)
    assert settings["config"]["blacklist_frames"] is None  # JSON knows no infinity
    assert begun.next_frame == 16 and begun.run_s > 0  # the last stretch was not written when it was stopped
    done = []
    assert_same(run(folder, lambda *counts: done.append(counts)), whole)
    assert done == [(24, 30), (30, 30)]  # nothing was done again
    assert_same(run(folder), whole)  # all was done, and only results were not written
    unfinished(folder).remove()
    assert not folder.exists() and unfinished(folder).read() is None


@pytest.mark.usefixtures("unchecked")
def test_another_run_is_refused_and_damage_is_said(tmp_path):
    folder = tmp_path / "unfinished"
    with pytest.raises(Stopped):
        run(folder, stop_after(24))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ValueError, match=r"unfinished has other settings \(config\..*give another directory"):
        run(folder, gate=vc.VirtualCorrection(th1=5.0))
    with pytest.raises(ValueError, match=r"unfinished has other settings \(config.*give another directory"):
        run(folder, blacklist_frames=50.0, blacklist_capacity=8)
    recording = recorded.content().recording
    uv_px = np.array(recording.uv_px)
    uv_px[3, 2] += 0.25
    with pytest.raises(ValueError, match=r"other settings \(recording and known landmarks"):
        unfinished(folder, dataclasses.replace(recording, uv_px=uv_px)).read()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    (folder / "frames_000008.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"frames_000008\.npz: no such file"):
        run(folder)
    state = folder / "state.npz"
    state.write_bytes(state.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"state\.npz: not a sound \.npz file"):
        run(folder)
    for content in ("{", "[" * 100_000):
        (folder / "settings.json").write_text(content)
        with pytest.raises(ValueError, match=r"settings\.json: not what a run left"):
            run(folder)


_CHILD = f"""
import sys
sys.path.insert(0, {str(Path(recorded.__file__).parent)!r})
import recorded
from vcjax.recorded import filtered, unfinished
unfinished.Unfinished.__init__.__defaults__ = (None, 0.0)
filtered.filter_recording.__kwdefaults__["length"] = 2
from vcjax.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_killed_again_and_again_ends_the_same(tmp_path):
    """SIGKILL at any moment of `vcjax run`; what an earlier run wrote stays until the new one is complete."""
    out, alone = tmp_path / "killed", tmp_path / "alone"
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}

    def command(folder):
        arguments = ["run", str(recorded.recording_path()), *recorded.OPTIONS, "--out", str(folder), "--pictures", "1"]
        return subprocess.Popen(
            [sys.executable, "-c", _CHILD, *arguments, "--animation", "none"],
            env=os.environ | cache | {"PYTHONWARNINGS": "ignore"},
            stdout=subprocess.DEVNULL,
        )

    def results(folder):
        names = ("robot_tum.txt", "landmarks.csv", "verdicts.csv", "tracks.csv", "path.png")
        return {name: (folder / name).read_bytes() for name in names}

    assert command(alone).wait() == 0 and not (alone / "unfinished").exists()
    out.mkdir()
    (out / "robot_tum.txt").write_text("of an earlier run")
    (out / "summary.json").write_text(json.dumps({"recording": "a.npz", "frames": 30, "first_failure": None}))
    rng, where = np.random.default_rng(0), []
    for _ in range(3):
        child, seen = command(out), len(list(out.glob("unfinished/frames_*")))
        while len(list(out.glob("unfinished/frames_*"))) == seen and child.poll() is None:
            time.sleep(0.002)
        time.sleep(rng.uniform(0.0, 0.02))
        child.send_signal(signal.SIGKILL)
        if child.wait() == 0:
            break  # it was faster
        where.append(len(list(out.glob("unfinished/frames_*"))))
        assert (out / "robot_tum.txt").read_text() == "of an earlier run"
        assert json.loads((out / "summary.json").read_text())["recording"] == "a.npz"
    assert len(where) >= 2 and where == sorted(where) and where[0] > 0  # nothing was lost
    assert command(out).wait() == 0
    assert results(out) == results(alone) and not (out / "unfinished").exists()
