"""In single precision the filter runs as it does in double: finite, and as near as rounding allows.

JAX's precision is one switch for a process, so that this run has one of its own.
"""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
from filter_runs import CAPACITY, QUICK, filtered, head, recorded

from vcjax.filter.config import FilterConfig
from vcjax.filter.run import run

NUM_FRAMES = 30
ROOT = Path(__file__).parents[2]

IN_FLOAT32 = """
import json, sys
import jax, numpy as np
from vcjax.filter.config import FilterConfig
from vcjax.filter.run import run
from vcjax.models.camera import Camera
from vcjax.recording import Recording

path, capacity, options = sys.argv[1:]
with np.load(path) as arrays:
    recording = Recording(camera=Camera(), **arrays)
config = FilterConfig(max_landmarks=int(capacity), retire=False)
state, info = jax.jit(run, compiler_options=json.loads(options))(config, recording)
print(json.dumps({
    "dtypes": sorted({str(leaf.dtype) for leaf in jax.tree.leaves((state, info))}),
    "is_finite": bool(np.all(info.is_finite)),
    "vehicle": np.asarray(info.vehicle, float).tolist(),
    "vehicle_cov": np.asarray(info.vehicle_cov, float).tolist(),
    "num_accepted": int(np.sum(info.is_accepted)),
}))
"""


def test_float32_is_near_float64(tmp_path):
    """Rounding of 6e-8 in pixels of 600 is 4e-5 px beside a noise of 1 px; what hundreds of updates make of it stays
    far below what the filter knows: a twentieth of a standard deviation.
    """
    recording = head(recorded(seed=6, dynamic="lateral", oscillation_amplitude_m=0.05), NUM_FRAMES)
    arrays = {name: value for name, value in vars(recording).items() if name != "camera"}
    single = {name: np.float32(a) if a.dtype == np.float64 else a for name, a in arrays.items()}
    np.savez(tmp_path / "recording.npz", **single)
    finished = subprocess.run(
        [sys.executable, "-c", IN_FLOAT32, str(tmp_path / "recording.npz"), str(CAPACITY), json.dumps(QUICK)],
        env=os.environ | {"JAX_ENABLE_X64": "0", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    ours = json.loads(finished.stdout)
    assert ours["dtypes"] == ["bool", "float32", "int32"]
    assert ours["is_finite"]

    infos = [info for _, info in filtered(FilterConfig(max_landmarks=CAPACITY, retire=False), recording)]
    theirs = jax.tree.map(lambda *leaves: np.stack(leaves), *infos)
    std = np.sqrt(np.diagonal(theirs.vehicle_cov, axis1=1, axis2=2))
    error = np.abs(np.array(ours["vehicle"]) - theirs.vehicle)
    np.testing.assert_array_less(error, 0.05 * std + 1e-6)
    std32 = np.sqrt(np.maximum(np.diagonal(ours["vehicle_cov"], axis1=1, axis2=2), 0))
    np.testing.assert_allclose(std32, std, rtol=0, atol=1e-4)
    assert abs(ours["num_accepted"] - theirs.is_accepted.sum()) <= 3


def test_recordings_in_single_precision_run_in_double():
    """Each field by itself, and all: traced only, as the types tell."""
    recording = head(recorded(seed=6, dynamic="lateral", oscillation_amplitude_m=0.05), 2)
    single = {name: np.float32(a) for name, a in vars(recording).items() if name != "camera" and a.dtype == np.float64}
    config = FilterConfig(max_landmarks=CAPACITY, retire=False)
    expected = jax.eval_shape(lambda r: run(config, r), recording)
    for fields in ({"uv_px"}, {"robot_start"}, {"odometry", "time_s"}, {*single}):
        changed = dataclasses.replace(recording, **{name: single[name] for name in fields})
        assert jax.eval_shape(lambda r: run(config, r), changed) == expected, fields
