"""Monte Carlo in one call: equal to single runs, whatever their grouping; paired seeds; compiled once; failed seeds."""

import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_runs
from jax.sharding import Mesh
from jax.tree_util import Partial
from tiny_runs import (
    MEASURES,
    NUM_FEATURES,
    NUM_FRAMES,
    NUM_SEEDS,
    STRICT,
    assert_same_runs,
    compilations,
    run_once,
    run_strict,
    simulate_once,
)

import vcjax as vc
from vcjax.study import monte_carlo as module
from vcjax.study.monte_carlo import metrics_of, monte_carlo, run_one
from vcjax.study.results import PER_FEATURE, PER_FRAME, PER_RUN, attributes
from vcjax.study.summary import summarise
from vcjax.study.sweep import Experiment

KEY = jax.random.key(7)
ROUNDING = {"rtol": 1e-9, "atol": 1e-10}  # another compilation rounds differently, and NEES amplifies it


@cache
def strict_runs():
    return run_strict()


def test_equals_single_runs_one_after_another():
    scenario, config = tiny_runs.scenario(), tiny_runs.config(STRICT)
    runs = strict_runs()
    for seed in range(NUM_SEEDS):
        recording, truth = simulate_once(scenario, jax.random.fold_in(KEY, seed))
        state, info = run_once(config, recording)
        single = metrics_of(Experiment(scenario, config), state, info, truth)
        assert set(single) == set(MEASURES)
        found = runs.isel(seed=seed)
        assert_same_runs(found, single, **ROUNDING)
    assert runs.num_recovered.sum() > 0 and runs.num_dynamic.sum() > 0  # there was something to agree on
    assert not np.array_equal(runs.robot[0], runs.robot[1])


def test_results_are_labelled():
    runs = strict_runs()
    assert dict(runs.sizes) == {"seed": NUM_SEEDS, "frame": NUM_FRAMES, "feature": NUM_FEATURES, "pose": 7, "axis": 3}
    assert runs.seed.values.tolist() == list(range(NUM_SEEDS))
    assert runs.frame.values.tolist() == list(range(1, NUM_FRAMES + 1))
    assert runs.feature.values.tolist() == list(range(NUM_FEATURES))
    assert all(runs[name].dims == ("seed", "frame") for name in PER_FRAME)
    assert all(runs[name].dims == ("seed", "feature") for name in PER_FEATURE)
    assert all(runs[name].dims == ("seed",) for name in PER_RUN)
    assert all(runs[name].attrs["long_name"] for name in runs)
    _, truth = simulate_once(tiny_runs.scenario(), KEY)
    np.testing.assert_allclose(runs.robot_true, truth.robot, atol=1e-12)
    np.testing.assert_allclose(runs.sensor_true, truth.sensor, atol=1e-12)
    np.testing.assert_allclose(runs.landmark_true, truth.landmarks_m, atol=1e-12)
    assert runs.is_moving.sum() == 6
    settings = json.loads(runs.attrs["config"])
    assert settings["gate"] == {"class": "VirtualCorrection", "th1": 1.0, "th2": 0.7, "prior": "corrected"}
    assert json.loads(runs.attrs["scenario"])["num_frames"] == NUM_FRAMES


def test_seed_depends_on_its_number_only(monkeypatch):
    """Not on the calls it is divided into, nor on the first seed; and progress tells of each call."""
    monkeypatch.setattr(module, "LANES_PER_CALL", NUM_SEEDS)
    run_strict()
    told = []
    with compilations() as compiled:
        five = run_strict(num_seeds=5, progress=lambda *done: told.append(done))
        later = run_strict(first_seed=3)
    assert compiled.num == 0
    assert told == [(3, 5), (5, 5)]
    assert five.seed.values.tolist() == [0, 1, 2, 3, 4] and later.seed.values.tolist() == [3, 4, 5]
    assert_same_runs(five.sel(seed=[0, 1, 2]), strict_runs())
    assert_same_runs(five.sel(seed=[3, 4]), later.sel(seed=[3, 4]))


def test_other_numbers_compile_nothing():
    monte_carlo(tiny_runs.scenario(), tiny_runs.config(), num_seeds=NUM_SEEDS, key=KEY)
    calls = module._run_lanes._cache_size()
    with compilations() as compiled:
        for scenario, config in (
            (tiny_runs.scenario(), tiny_runs.config(vc.VirtualCorrection(4.0, 5.0))),
            (tiny_runs.scenario(dynamic=None), tiny_runs.config()),
            (tiny_runs.scenario(dynamic="inverse_forward", dynamic_speed_m_s=0.25), tiny_runs.config()),
            (tiny_runs.scenario(dynamic_set="near_path", robot="curved"), tiny_runs.config(pixel_std_px=2.0)),
            (
                tiny_runs.scenario(oscillation_amplitude_m=0.05, oscillation_frequency_hz=2.0, noise="six_axis"),
                tiny_runs.config(vc.VirtualCorrection(np.float64(3.0)), oscillation_std_m=0.002),
            ),
            (tiny_runs.scenario(pixel_error_std_px=0.5, step_m=0.1, frame_rate_hz=20.0), tiny_runs.config()),
        ):
            runs = monte_carlo(scenario, config, num_seeds=NUM_SEEDS, key=jax.random.key(1))
            assert runs.is_finite.all()
    assert compiled.num == 0 and module._run_lanes._cache_size() == calls


def test_seeds_are_paired_across_gates_scenes_and_cameras():
    """Common random numbers: the first frame holds the odometry's draw only; where gates agree, all frames are one."""

    def runs(gate, **options):
        return monte_carlo(tiny_runs.scenario(**options), tiny_runs.config(gate), num_seeds=NUM_SEEDS, key=KEY)

    steady = runs(vc.VirtualCorrection(th1=1e9))
    assert steady.num_recovered.sum() == 0
    reprojection = runs(vc.ReprojectionError(th1=1e9))
    for name in ("robot", "nis_sum", "num_updates", "nees_pose", "frames_mapped"):
        np.testing.assert_allclose(steady[name], reprojection[name], rtol=1e-9, atol=1e-12, err_msg=name)
    others = (
        strict_runs(),
        runs(vc.VirtualCorrection(), oscillation_amplitude_m=0.05),
        runs(vc.VirtualCorrection(), dynamic=None),
    )
    for other in others:
        np.testing.assert_array_equal(other.robot[:, 0], steady.robot[:, 0])
        assert np.abs(other.robot[:, -1] - steady.robot[:, -1]).max() > 1e-4


def test_births_in_random_order_do_not_reuse_the_keys_of_the_noise(monkeypatch):
    seen = []

    def run(config, recording, key):
        seen.append(key)
        return vc.run(config, recording, key)

    monkeypatch.setattr(module, "run", run)
    run_one(Experiment(tiny_runs.scenario(), tiny_runs.config(birth_order="random")), KEY)
    run_one(Experiment(tiny_runs.scenario(), tiny_runs.config()), KEY)
    birth_key, nothing = seen
    assert nothing is None
    of_the_noise = [KEY, *jax.random.split(KEY)]  # as `simulate` splits it
    assert all((jax.random.key_data(birth_key) != jax.random.key_data(key)).any() for key in of_the_noise)


def test_failed_seed_is_flagged_counted_and_spoils_no_other(monkeypatch):
    """In the batch of an accelerator, where all lanes go through each operation together."""
    bad_seed, bad_key = 1, jax.random.fold_in(KEY, 1)

    def simulate(scenario, key):
        recording, truth = vc.simulate(scenario, key)
        is_bad = jnp.all(jax.random.key_data(key) == jax.random.key_data(bad_key))
        odometry = recording.odometry.at[5, 0].set(jnp.where(is_bad, jnp.nan, recording.odometry[5, 0]))
        return vc.Recording(**{**vars(recording), "odometry": odometry}), truth

    monkeypatch.setattr(module, "simulate", simulate)
    experiment = Experiment(tiny_runs.scenario(), tiny_runs.config(STRICT))
    mesh = Mesh(np.array(jax.local_devices()[:1]), ("lane",))
    seeds, everyone = jnp.arange(NUM_SEEDS, dtype=jnp.uint32), jnp.ones(NUM_SEEDS, bool)
    lanes = module._run_lanes(Partial(module._run_point, experiment), {}, seeds, everyone, KEY, mesh, NUM_SEEDS)
    assert lanes["is_finite"].tolist() == [seed != bad_seed for seed in range(NUM_SEEDS)]

    runs, good = strict_runs(), [0, 2]
    lanes = {name: np.asarray(value[0] if name == "is_moving" else value) for name, value in lanes.items()}
    failed = runs.assign({name: (runs[name].dims, lanes[name]) for name in MEASURES})
    assert_same_runs(failed.isel(seed=good), runs.isel(seed=good), **ROUNDING)
    summary, expected = summarise(failed), summarise(runs.isel(seed=good))
    assert summary.runs_failed == 1 and summary.num_runs == NUM_SEEDS
    np.testing.assert_allclose(summary.position_rmse_cm, expected.position_rmse_cm, rtol=1e-9)


def test_number_of_devices_makes_no_difference(tmp_path):
    """Two devices, in a process of their own, against the one of this process: the second has a place left empty."""
    script = f"""
        import sys
        sys.path.insert(0, {str(Path(tiny_runs.__file__).parent)!r})
        import jax
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_num_cpu_devices", 2)
        import numpy as np
        from tiny_runs import MEASURES, run_strict
        assert jax.local_device_count() == 2
        runs = run_strict()
        np.savez({str(tmp_path / "two.npz")!r}, seed=runs.seed, **{{name: runs[name] for name in MEASURES}})
    """
    lines = "\n".join(line.strip() for line in script.splitlines())
    subprocess.run([sys.executable, "-c", lines], check=True)
    with np.load(tmp_path / "two.npz") as two:
        np.testing.assert_array_equal(two["seed"], strict_runs().seed)
        assert_same_runs(two, strict_runs(), **ROUNDING)


def test_old_style_key_is_as_good():
    experiment = Experiment(tiny_runs.scenario(), tiny_runs.config())
    assert attributes(experiment, jax.random.PRNGKey(3)) == attributes(experiment, jax.random.key(3))


def test_missing_xarray_is_told_before_the_work(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    monkeypatch.setattr(module, "run_lanes", lambda *_: pytest.fail("worked"))
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vcjax\[study\]'"):
        run_strict()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_seeds": 0}, r"num_seeds=0\): give at least one seed"),
        ({"num_seeds": -3}, r"num_seeds=-3\)"),
        ({"num_seeds": 2.5}, r"num_seeds=2.5\).*whole number"),
        ({"first_seed": -1}, r"first_seed=-1\).*from 0"),
        ({"first_seed": 2**32}, r"first_seed=4294967296\).*2\*\*32 - 1"),
        ({"devices": []}, r"devices=\[\]\): give at least one"),
        ({"key": 0}, r"key=0\).*jax.random.key\(0\)"),
        ({"key": jax.random.split(KEY, 3)}, r"key=key<fry>\[3\]\): give one random key"),
    ],
)
def test_bad_arguments_are_refused_before_anything_compiles(arguments, message, unchecked):
    with compilations() as compiled, pytest.raises(ValueError, match=message):
        run_strict(**arguments)
    assert compiled.num == 0
