"""Bad input at the public entries: refused before anything compiles, by argument, value and remedy."""

import dataclasses

import jax
import numpy as np
import pytest
import tiny_runs
from tiny_runs import compilations

import vcjax as vc

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
        with pytest.raises(ValueError, match=rf"{gate.__name__}\(prior='before'\): choose 'corrected' or 'predicted'"):
            gate(prior="before")
    assert compiled.num == 0
