"""Bad input at the public entries: refused before anything compiles, by argument, value and remedy."""

import dataclasses

import jax
import numpy as np
import pytest
import tiny_runs
from tiny_runs import compilations

import vcjax as vc
from vcjax.study.reproduce import reproduce

pytestmark = pytest.mark.usefixtures("unchecked")  # as people have it


@pytest.fixture(scope="module")
def recording():
    recording, _ = tiny_runs.simulate_once(tiny_runs.scenario(), jax.random.key(0))
    return jax.device_get(recording)


def test_compilations_are_counted():
    """All that follows relies on it."""
    with compilations() as compiled:
        jax.jit(lambda x: x + 1)(0.0)
    assert compiled.num == 1


def changed(recording, name: str, place, value):
    """The recording with another number at one place."""
    array = np.array(getattr(recording, name))
    array[place] = value
    return dataclasses.replace(recording, **{name: array})


BAD_RECORDINGS = {
    "empty": (
        lambda r: dataclasses.replace(r, **{f: getattr(r, f)[:0] for f in ("time_s", "odometry", "odometry_cov")}),
        r"Recording\(time_s=\[\]\): the recording is empty; give at least one frame",
    ),
    "of several lengths": (
        lambda r: dataclasses.replace(r, odometry=r.odometry[:-1]),
        r"Recording\(odometry\) has shape \(11, 6\), but \(12, 6\) is needed",
    ),
    "a NaN pixel marked valid": (
        lambda r: changed(changed(r, "uv_px", (3, 40, 1), np.nan), "is_valid", (3, 40), True),
        r"Recording\(uv_px\[3, 40, 1\] = nan\): is marked valid; clear is_valid there",
    ),
    "negative variance": (lambda r: changed(r, "odometry_cov", (2, 1, 1), -1e-6), r"odometry_cov\[2, 1, 1\] = -1e-06"),
    "NaN odometry": (lambda r: changed(r, "odometry", (4, 0), np.nan), r"odometry\[4, 0\] = nan\): must be finite"),
    "negative id": (
        lambda r: changed(changed(r, "track_id", (0, 5), -2), "is_valid", (0, 5), True),
        r"track_id\[0, 5\] = -2\): is marked valid; ids start at 0",
    ),
    "repeated id": (
        lambda r: changed(changed(r, "track_id", (0, [5, 6]), 9), "is_valid", (0, [5, 6]), True),
        r"frame 0 has id 9 twice; keep one",
    ),
}


@pytest.mark.parametrize(("change", "message"), BAD_RECORDINGS.values(), ids=BAD_RECORDINGS)
def test_run_refuses_a_recording(change, message, recording):
    bad = change(recording)
    with compilations() as compiled, pytest.raises(ValueError, match=message):
        vc.run(tiny_runs.config(), bad)
    assert compiled.num == 0


def test_run_takes_a_key_for_births_in_random_order_only(recording):
    key = jax.random.key(0)
    with compilations() as compiled:
        with pytest.raises(ValueError, match=r"key=None\): give a key if and only if births are in random order"):
            vc.run(tiny_runs.config(birth_order="random"), recording)
        with pytest.raises(ValueError, match=r"if and only if births are in random order .*lowest_id"):
            vc.run(tiny_runs.config(), recording, key)
    assert compiled.num == 0


BAD_CONFIGURATIONS = {
    "more slots than memory": (
        dict(max_landmarks=10**12),
        r"FilterConfig\(max_landmarks=1000000000000\): give at most",
    ),
    "endless births": (dict(births_per_frame=10**12), r"births_per_frame=1000000000000\): give at most 8192"),
    "endless blacklist": (dict(blacklist_capacity=10**12), r"blacklist_capacity=1000000000000\): give at most 1048576"),
    "no slot": (dict(max_landmarks=0), r"FilterConfig\(max_landmarks=0.*at least 1"),
    "no update": (dict(max_updates=0), r"FilterConfig\(max_updates=0.*at least 1"),
    "more updates than slots": (
        dict(max_landmarks=8, max_updates=9),
        r"max_updates=9\) exceeds max_landmarks=8.*raise max_landmarks",
    ),
    "negative births": (dict(births_per_frame=-1), r"FilterConfig\(births_per_frame=-1.*at least 0"),
    "negative pixel noise": (dict(pixel_std_px=-1.0), r"FilterConfig\(pixel_std_px=-1.0\): give a positive number"),
    "no pixel noise": (dict(pixel_std_px=0.0), r"FilterConfig\(pixel_std_px=0.0\): give a positive number"),
    "negative sensor noise": (dict(oscillation_std_m=-0.1), r"oscillation_std_m=-0.1\): give a number of at least 0"),
    "no number": (dict(linearity_max=np.nan), r"FilterConfig\(linearity_max=nan\)"),
    "a gate's name": (
        dict(gate="VC"),
        r"FilterConfig\(gate='VC'\): give a gate, e.g. VirtualCorrection\(\) or ReprojectionError\(\)",
    ),
    "a gate's class": (dict(gate=vc.VirtualCorrection), r"FilterConfig\(gate=<.*>\): give a gate, e.g. Virtual"),
    "no detector": (dict(detector=None), r"FilterConfig\(detector=None\): give a detector, e.g. InlierRatio\(\)"),
    **{
        f"{name} a word": (dict([(name, "no")]), rf"FilterConfig\({name}='no'\): choose one of \(True, False\)")
        for name in ("retire", "reverse_mode", "toolbox_parity")
    },
    "skip_free_slots a word": (dict(skip_free_slots="no"), r"choose one of \(None, True, False\)"),
    "many pixel noises": (
        dict(pixel_std_px=np.ones(3)),
        r"FilterConfig\(pixel_std_px\) has shape \(3,\), but one number is needed: .* `sweep` of `monte_carlo`",
    ),
    "unknown update": (
        dict(update="both"),
        r"FilterConfig\(update='both'\): choose one of \('sequential', 'stacked'\)",
    ),
}


@pytest.mark.parametrize(("fields", "message"), BAD_CONFIGURATIONS.values(), ids=BAD_CONFIGURATIONS)
def test_configuration_is_refused(fields, message):
    with compilations() as compiled, pytest.raises(ValueError, match=message):
        vc.FilterConfig(**fields)
    assert compiled.num == 0


@pytest.mark.parametrize("gate", [vc.ReprojectionError, vc.VirtualCorrection])
def test_gates_are_refused(gate):
    with compilations() as compiled:
        for th1 in (0.0, -9.0, np.nan):
            with pytest.raises(ValueError, match=rf"{gate.__name__}\(th1={th1}\): a threshold .* is positive"):
                gate(th1=th1)
        with pytest.raises(ValueError, match=rf"{gate.__name__}\(prior='before'\): choose one of \('corrected', 'pre"):
            gate(prior="before")
        with pytest.raises(ValueError, match=rf"{gate.__name__}\(th1\) has shape \(2,\), but one number is needed"):
            gate(th1=[9, 9])
    assert compiled.num == 0


KEY = jax.random.key(0)
MANY_KEYS = jax.random.PRNGKey(0)[:, None]
CALLS = {
    "run without configuration": (lambda r: vc.run(None, r), r"run\(config=None\): give a FilterConfig"),
    "run with the class": (lambda r: vc.run(vc.FilterConfig, r), r"run\(config=.*\): give a FilterConfig"),
    "run the other way round": (lambda r: vc.run(r, vc.FilterConfig()), r"run\(config=<Recording>\): give a Filter"),
    "run without recording": (lambda r: vc.run(tiny_runs.config(), None), r"run\(recording=None\): give a Recording"),
    "run with a number for a key": (
        lambda r: vc.run(tiny_runs.config(birth_order="random"), r, 5),
        r"run\(key=5\): give one random key, e.g. jax.random.key\(0\)",
    ),
    "start without configuration": (lambda r: vc.start(None, r), r"start\(config=None\): give a FilterConfig"),
    "start without recording": (
        lambda r: vc.start(tiny_runs.config(), "tracks.csv"),
        r"recording='tracks.csv'\): give",
    ),
    "start with many keys": (
        lambda r: vc.start(tiny_runs.config(birth_order="random"), r, MANY_KEYS),
        r"start\(key=uint32\[2, 1\]\): give one random key",
    ),
    "simulate nothing": (lambda r: vc.simulate(None, KEY), r"simulate\(scenario=None\): give a Scenario, e.g. .*paper"),
    "simulate without key": (
        lambda r: vc.simulate(tiny_runs.scenario(), None),
        r"simulate\(key=None\): give one random",
    ),
    "simulate with a seed": (lambda r: vc.simulate(tiny_runs.scenario(), 0), r"simulate\(key=0\): give one random key"),
    "many runs of nothing": (lambda r: vc.monte_carlo(None, key=KEY), r"monte_carlo\(scenario=None\): give a Scenario"),
    "many runs of a recording": (lambda r: vc.monte_carlo(r, key=KEY), r"monte_carlo\(scenario=<Recording>\): give a"),
    "many runs with a gate": (
        lambda r: vc.monte_carlo(tiny_runs.scenario(), vc.VirtualCorrection(), key=KEY),
        r"monte_carlo\(config=.*VirtualCorrection.*\): give a FilterConfig",
    ),
    "run with several values": (
        lambda r: vc.run(vc.FilterConfig(pixel_std_px=jax.device_put(np.array([1.0, 2.0]))), r),
        r"run: FilterConfig\(pixel_std_px\) has shape \(2,\), but one number is needed.*sweep.*vmap",
    ),
    "many runs with several values": (
        lambda r: vc.monte_carlo(
            tiny_runs.scenario(), vc.FilterConfig(vc.VirtualCorrection(jax.device_put(np.ones(3)))), key=KEY
        ),
        r"monte_carlo: VirtualCorrection\(th1\) has shape \(3,\)",
    ),
    "simulate several values": (
        lambda r: vc.simulate(tiny_runs.scenario(pixel_error_std_px=jax.device_put(np.ones(2))), KEY),
        r"simulate: Scenario\(pixel_std_px\) has shape \(2,\)",
    ),
    "sweep without values": (
        lambda r: vc.monte_carlo(tiny_runs.scenario(), key=KEY, sweep=["config.gate.th1"]),
        r"monte_carlo\(sweep=\['config.gate.th1'\]\): give paths with their values",
    ),
    "a number of devices": (
        lambda r: vc.monte_carlo(tiny_runs.scenario(), key=KEY, devices=2),
        r"monte_carlo\(devices=2\): give at least one device in a list",
    ),
    "step without state": (
        lambda r: vc.step(vc.FilterConfig(), None, None),
        r"step\(state=None\): give a state as vcjax.start",
    ),
    "reproduce half a seed": (
        lambda r: reproduce("nowhere", num_seeds=2.5),
        r"reproduce\(num_seeds=2.5\): give at least one seed, a whole number",
    ),
    "reproduce one table": (
        lambda r: reproduce("nowhere", tables=3),
        r"reproduce\(tables=3\): give at least one of .* in a list",
    ),
    "reproduce with a seed": (lambda r: reproduce("nowhere", key=3), r"reproduce\(key=3\): give one random key"),
    "many runs without key": (
        lambda r: vc.monte_carlo(tiny_runs.scenario(), key=None),
        r"monte_carlo\(key=None\): give one random key",
    ),
}


@pytest.mark.parametrize(("call", "message"), CALLS.values(), ids=CALLS)
def test_what_is_of_another_kind_is_refused(call, message, recording):
    with compilations() as compiled, pytest.raises(ValueError, match=message):
        call(recording)
    assert compiled.num == 0


def test_a_step_with_what_does_not_belong_together_is_refused(recording):
    state, _ = tiny_runs.start_once(tiny_runs.config(), recording)
    frame = jax.device_get(recording.frame(1))
    with compilations() as compiled:
        with pytest.raises(ValueError, match=r"step\(state\) has 36 slots, but config \(max_landmarks=107\) needs 108"):
            vc.step(vc.FilterConfig(), state, frame)
        with pytest.raises(ValueError, match=r"step\(frame.uv_px\) has shape \(3, 2\), but .* is needed: one row for"):
            vc.step(tiny_runs.config(), state, dataclasses.replace(frame, uv_px=np.ones((3, 2))))
        with pytest.raises(ValueError, match=r"step\(frame=None\): give a frame"):
            vc.step(tiny_runs.config(), state, None)
    assert compiled.num == 0
