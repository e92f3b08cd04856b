"""How long the work takes, beside what it could take at least.

All times are wall-clock seconds of one session on this machine, the median of several repeats where a repeat is cheap.
Machines differ and are shared, so what may be compared between sessions are ratios measured within one.
"""

import contextlib
import functools
import importlib
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from scipy.linalg import get_blas_funcs
from threadpoolctl import threadpool_limits

from vcjax.filter.config import FilterConfig
from vcjax.simulation.scenarios import Scenario, paper
from vcjax.simulation.simulate import simulate
from vcjax.study.monte_carlo import ONE_THREAD_PER_LANE, monte_carlo, run_one
from vcjax.study.sweep import Experiment, replace_at

NUM_SEEDS = 25
"""Runs of the cell: the paper's."""
PARAMETERS = {
    "config.gate.th1": 9.0,
    "config.gate.th2": 9.0,
    "scenario.oscillation.amplitude_m": 0.05,
    "scenario.oscillation.frequency_hz": 3.0,
}
"""What the gradients are by, and where."""
RATIOS = ("ratio_to_floor", "gradient_forward_ratio", "gradient_reverse_ratio")
"""What may be compared between sessions: the smaller the better."""
TOLERANCE = 1.5
"""How much worse a ratio may be than the accepted one: shared machines are noisy."""


def measure_cell(repeats: int = 5) -> dict[str, Any]:
    """The paper's forward VC cell, 25 runs of 160 frames: compilation, warm time, the floor, peak memory.

    The floor is what one core needs for the least that a frame must do: one symmetric update P - UᵀU of the state's
    covariance, by BLAS `dsyrk`, with the size and rank that every frame of every run really had.
    """
    scenario, key = paper(), jax.random.key(0)
    first, runs = timed(lambda: monte_carlo(scenario, num_seeds=NUM_SEEDS, key=key))
    warm = statistics.median(
        timed(lambda: monte_carlo(scenario, num_seeds=NUM_SEEDS, key=key))[0] for _ in range(repeats)
    )
    floor = floor_s(runs)
    return {
        "cell_compile_s": first - warm,
        "cell_warm_s": warm,
        "frames_per_second": NUM_SEEDS * scenario.num_frames / warm,
        "floor_s": floor,
        "ratio_to_floor": warm / floor,
        "peak_memory_mib": peak_memory_mib(),
    }


def floor_s(runs: xr.Dataset) -> float:
    """Seconds of one core for `dsyrk` on the state's covariance, once for every frame of every run."""
    sizes = runs.num_coordinates.values.ravel()
    ranks = 2 * (runs.num_updates + runs.num_recovered).values.ravel()
    largest, rng = int(sizes.max()), np.random.default_rng(0)
    P = rng.standard_normal((largest, largest))
    U = rng.standard_normal((largest, max(int(ranks.max()), 1)))
    (syrk,) = get_blas_funcs(("syrk",), (P,))
    seconds = 0.0
    with threadpool_limits(1):
        for size, rank in zip(sizes, ranks, strict=True):
            block, rows = np.asfortranarray(P[:size, :size]), np.asfortranarray(U[:size, :rank])
            if rank:
                seconds += timed(lambda block=block, rows=rows: syrk(-1.0, rows, 1.0, block, overwrite_c=True))[0]
    return seconds


def measure_seeds(counts: tuple[int, ...] = (1, 25, 100, 1000)) -> dict[str, Any]:
    """Warm seconds of the cell for other numbers of runs, and the memory of it all.

    On a CPU all compile once.
    """
    seconds = {}
    for count in counts:
        if not seconds or jax.default_backend() != "cpu":
            monte_carlo(paper(), num_seeds=count, key=jax.random.key(0))
        seconds[str(count)] = timed(lambda count=count: monte_carlo(paper(), num_seeds=count, key=jax.random.key(0)))[0]
    return {"seconds_by_seeds": seconds, "seeds_peak_memory_mib": peak_memory_mib()}


def measure_gradients(repeats: int = 5) -> dict[str, Any]:
    """Value and gradient of one run's mean position error by Th₁, Th₂, A and f, over time and memory of a plain run.

    Forward mode (`jacfwd`, four tangents at once) and reverse mode, each against the plain run of one seed, all on one
    core and compiled; the runs take turns, so that what disturbs one disturbs all. The derivative by the thresholds is
    zero, since decisions are hard, and costs as much as any. Memory is what the compiled program
    allocates for its own use.
    """

    def loss(config: FilterConfig, values: dict[str, Any]) -> Any:
        experiment = replace_at(Experiment(paper(), config), values)
        return jnp.mean(run_one(experiment, jax.random.key(0))["position_error_m"])

    hard, reverse = FilterConfig(), FilterConfig(reverse_mode=True)
    values = {path: jnp.asarray(value) for path, value in PARAMETERS.items()}
    functions: dict[str, Callable[..., Any]] = {
        "plain": lambda values: loss(hard, values),
        "forward": jax.jacfwd(lambda values: (loss(hard, values),) * 2, has_aux=True),
        "reverse": jax.value_and_grad(lambda values: loss(reverse, values)),
    }
    options = ONE_THREAD_PER_LANE if jax.default_backend() == "cpu" else None
    compiled = {
        name: jax.jit(function, compiler_options=options).lower(values).compile()
        for name, function in functions.items()
    }
    seconds = {name: [] for name in compiled}
    for repeat in range(repeats + 1):
        for name, call in compiled.items():
            taken, _ = timed(lambda call=call: jax.block_until_ready(call(values)))
            if repeat > 0:  # the first is to warm up
                seconds[name].append(taken)
    run_s = statistics.median(seconds["plain"])
    # Not every platform tells of its memory.
    memory = {name: getattr(call.memory_analysis(), "temp_size_in_bytes", np.nan) for name, call in compiled.items()}
    result = {"run_s": run_s, "run_memory_mib": memory["plain"] / 2**20}
    for name in ("forward", "reverse"):
        result[f"gradient_{name}_ratio"] = statistics.median(seconds[name]) / run_s
        result[f"gradient_{name}_memory_ratio"] = memory[name] / memory["plain"]
    return result


def measure_reproduce() -> dict[str, Any]:
    """`vcjax reproduce`, whole, as a process of its own: start, compilation, 36 cells, tables and figures."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "vcjax", "reproduce", "--out", folder]
        if jax.default_backend() == "cpu":
            command += ["--devices", str(jax.local_device_count())]
        call = functools.partial(subprocess.run, command, env=environment, capture_output=True, text=True, check=False)
        seconds, done = timed(call)
    if done.returncode:
        raise ValueError(f"`vcjax reproduce` failed: {done.stderr.strip().splitlines()[-1:]}")
    return {"reproduce_s": seconds}


def measure_numpy(tests: Path, num_runs: int = 2) -> dict[str, Any]:
    """The same cell by the plain NumPy EKF-SLAM of the tests, from `num_runs` runs scaled up to 25.

    It is written to be read, with dense textbook updates and derivatives by complex steps: a peer to check numbers
    with, not a fast one. None where its folder is not there, as outside a checkout.
    """
    if not (tests / "reference" / "ekf_slam.py").is_file():
        return {"numpy_cell_s": None}
    with _importable(tests):
        reference = importlib.import_module("reference.ekf_slam")
    scenario: Scenario = paper()
    seconds = 0.0
    for seed in range(num_runs):
        r = jax.device_get(simulate(scenario, jax.random.fold_in(jax.random.key(0), seed))[0])
        seen = r.is_valid
        frames = [
            reference.Frame(
                r.odometry[t], r.odometry_cov[t], r.sensor_shift_m[t], r.track_id[t, seen[t]], r.uv_px[t, seen[t]]
            )
            for t in range(scenario.num_frames)
        ]
        start = (r.camera.intrinsics_px, r.robot_start, r.sensor_start, r.start_cov)
        seconds += timed(lambda start=start, frames=frames: reference.run(reference.Options(), *start, frames))[0]
    return {"numpy_cell_s": seconds * NUM_SEEDS / num_runs, "numpy_runs": num_runs}


@contextlib.contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """A folder whose packages can be imported in the block."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


def where() -> dict[str, Any]:
    """What was measured on."""
    devices = jax.local_devices()
    return {
        "device": devices[0].device_kind,
        "num_devices": len(devices),
        "cpu_count": os.cpu_count(),
        "machine": platform.machine(),
        "dtype": str(jax.dtypes.canonicalize_dtype(np.float64)),
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def peak_memory_mib() -> float | None:
    """Largest resident memory of this process so far, MiB; None where the system cannot tell."""
    try:
        import resource
    except ModuleNotFoundError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


PARTS: dict[str, Callable[[], dict[str, Any]]] = {
    "cell": measure_cell,
    "seeds": measure_seeds,
    "gradients": measure_gradients,
    "numpy": lambda: measure_numpy(Path("tests")),
    "reproduce": measure_reproduce,
}
"""What can be measured, by name, in the order in which it is."""


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds that some work takes, and what it returns."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def read_ratios(baseline: Path) -> dict[str, float]:
    """The `RATIOS` in a JSON file of an earlier session, accepted.

    Raises:
        ValueError: if the file is no result of `vcjax bench`, or has none of them.
        OSError: if it cannot be read.
    """
    try:
        found = json.loads(baseline.read_text("utf-8"))
        accepted = {name: found[name] for name in RATIOS if found.get(name) is not None}
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{baseline}: no numbers of `vcjax bench --json` ({error!r}).") from None
    for name, value in accepted.items():
        if type(value) not in (int, float) or not 0 < value < np.inf:
            raise ValueError(f"{baseline}: no numbers of `vcjax bench --json` ({name} is {value!r}).")
    if not accepted:
        raise ValueError(f"{baseline}: none of the ratios {', '.join(RATIOS)} in it; give a file of `vcjax bench`.")
    return accepted


def compare(measured: dict[str, Any], accepted: dict[str, float]) -> list[str]:
    """The ratios that have become worse than accepted ones by more than the factor `TOLERANCE`, as sentences.

    Raises:
        ValueError: if there is none to compare.
    """
    shared = [name for name in accepted if measured.get(name) is not None]
    if not shared:
        raise ValueError(f"nothing to compare: measured was none of {', '.join(accepted)}; measure more parts.")
    return [
        f"{name} is {measured[name]:.2f}, more than {TOLERANCE:g} times the accepted {accepted[name]:.2f}"
        for name in shared
        if not measured[name] <= TOLERANCE * accepted[name]  # also where it is NaN
    ]
