"""The smoothed filter: straight-through keeps the hard numbers to the bit, soft tends to them, its gradient is true."""

import dataclasses
import itertools
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import QUICK
from tiny_runs import CAPACITIES, MOVERS

from vcjax.filter.config import FilterConfig
from vcjax.filter.info import FrameInfo
from vcjax.filter.run import run
from vcjax.filter.slam import start, step
from vcjax.gates.one_point_ransac import OnePointRansac
from vcjax.gates.reprojection import ReprojectionError
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.simulation.scenarios import paper
from vcjax.simulation.simulate import simulate
from vcjax.study.sweep import Experiment, replace_at
from vcjax.tuning.losses import Objective

PARAMETERS = {
    "config.gate.th1": (9.0, 1e-4),
    "config.gate.th2": (9.0, 1e-4),
    "scenario.oscillation.amplitude_m": (0.05, 1e-7),
    "scenario.oscillation.frequency_hz": (3.0, 1e-6),
}
"""Where the derivatives are taken, and the step of a difference: so small that decisions rarely flip within it."""
AT, STEPS = (np.array(column) for column in zip(*PARAMETERS.values(), strict=True))
# Thresholds so low that a few frames hold recovered and dynamic features.
STRICT = VirtualCorrection(th1=1.0, th2=0.7)
GATES = [
    STRICT,
    dataclasses.replace(STRICT, prior="predicted"),
    ReprojectionError(1.0),
    OnePointRansac(th1=4.0, th_consensus=1.0, th_rescue=1.0),
]
quick_run = jax.jit(run, compiler_options=QUICK)


ALL = Objective(
    **dict.fromkeys(("track_f1", "track_cross_entropy", "track_ranking", "candidate_f1"), 1.0),
    **dict.fromkeys(("candidate_cross_entropy", "position", "consistency", "camera_motion"), 1.0),
)
"""Every loss there is."""


def scene():
    return paper(dynamic="lateral", dynamic_set=MOVERS, num_frames=30, oscillation_amplitude_m=0.05)


@cache
def simulated():
    return jax.jit(simulate, compiler_options=QUICK)(scene(), jax.random.key(3))


def recording():
    return simulated()[0]


def truth():
    return simulated()[1]


def config(gate=STRICT, **options) -> FilterConfig:
    return FilterConfig(gate=gate, **{**CAPACITIES, **options})


def decisions(info: FrameInfo) -> dict[str, np.ndarray]:
    """All that is decided in a run."""
    names = ("candidate_id", "is_measured", "is_accepted", "is_recovered", "is_dynamic", "inconsistent_id", "born_id")
    return {name: np.asarray(getattr(info, name)) for name in names}


def losses(info: FrameInfo) -> dict[str, float]:
    """Of all kinds, of a run of `recording`."""
    return {name: float(loss) for name, loss in ALL.terms(scene(), info, truth()).items()}


@pytest.mark.parametrize("gate", GATES)
def test_straight_through_is_the_hard_filter_to_the_bit(gate):
    # Compiled as users have it: the quick options round as suits the program around.
    hard_state, hard = run(config(gate), recording())
    state, info = run(config(gate, smoothing="straight_through"), recording())
    assert hard.is_accepted.any() and (hard.is_measured & ~hard.is_accepted).any()
    assert isinstance(gate, ReprojectionError) or hard.is_recovered.any()
    assert isinstance(gate, VirtualCorrection) == hard.is_dynamic.any()
    # Here of every measured candidate, there of the isolated.
    judged = ("re1_prior", "re2")
    for name in (field.name for field in dataclasses.fields(FrameInfo) if field.name not in judged):
        np.testing.assert_array_equal(getattr(info, name), getattr(hard, name), err_msg=name)
    mapped = np.asarray(state.is_mapped)
    assert losses(info) == losses(hard)
    np.testing.assert_array_equal(state.vehicle, hard_state.vehicle)
    np.testing.assert_array_equal(state.landmarks[mapped], hard_state.landmarks[mapped])
    np.testing.assert_array_equal(state.P_vv, hard_state.P_vv)
    isolated = ~np.isnan(np.asarray(hard.re1_prior))
    for name in ("re1_prior", "re2"):
        np.testing.assert_array_equal(
            np.asarray(getattr(info, name))[isolated], np.asarray(getattr(hard, name))[isolated]
        )


@pytest.mark.parametrize("gate", GATES)
def test_soft_tends_to_hard_as_the_temperature_falls(gate):
    _, hard = quick_run(config(gate), recording())
    _, soft = quick_run(config(gate, smoothing="soft", temperature=1e-9), recording())
    for name, expected in decisions(hard).items():
        np.testing.assert_array_equal(getattr(soft, name), expected, err_msg=name)
    np.testing.assert_allclose(soft.vehicle, hard.vehicle, rtol=0, atol=1e-10)
    np.testing.assert_allclose(soft.vehicle_cov, hard.vehicle_cov, rtol=0, atol=1e-12)
    for name in ("p_dynamic", "p_detector"):
        np.testing.assert_allclose(getattr(soft, name), getattr(hard, name), atol=1e-9)
    for name, loss in losses(hard).items():
        assert losses(soft)[name] == pytest.approx(loss, abs=1e-6), name
    _, warm = quick_run(config(gate, smoothing="soft", temperature=1.0), recording())
    assert np.abs(np.asarray(warm.vehicle - hard.vehicle)).max() > 1e-4  # it is not the same filter


def loss(filter_config, scenario, parameters, key):
    """All losses of a run together."""
    experiment = replace_at(Experiment(scenario, filter_config), dict(zip(PARAMETERS, parameters, strict=True)))
    recording, truth = simulate(experiment.scenario, key)
    _, info = run(experiment.config, recording)
    return ALL(experiment.scenario, info, truth), info


def check_gradient(scenarios, options, seeds, capacities):
    """Forward mode, reverse mode and central differences agree, where no decision flips within a difference.

    Of two differences the nearer counts: a short one has rounding error, which the logarithm of a small 1 - p makes
    large in a cross entropy, a long one that of the curvature.
    """
    soft = FilterConfig(smoothing="soft", **capacities)
    reverse = dataclasses.replace(soft, reverse_mode=True)
    value = jax.jit(lambda *args: loss(soft, *args), compiler_options=options)
    forward = jax.jit(jax.jacfwd(lambda p, s, key: loss(soft, s, p, key)[0]), compiler_options=options)
    backward = jax.jit(jax.grad(lambda p, s, key: loss(reverse, s, p, key)[0]), compiler_options=options)
    num_checked = np.zeros(4, int)
    for scenario, seed in itertools.product(scenarios, seeds):
        key = jax.random.key(seed)
        gradient = np.asarray(forward(AT, scenario, key))
        np.testing.assert_allclose(backward(AT, scenario, key), gradient, rtol=1e-7)
        assert (np.abs(gradient) > 1e-6).all()
        for k, length in enumerate(STEPS):
            differences = []
            for h in (length, 10 * length):
                (low, info_low), (high, info_high) = (value(scenario, AT + s * h * np.eye(4)[k], key) for s in (-1, 1))
                below, above = decisions(info_low), decisions(info_high)
                if all((below[name] == above[name]).all() for name in below):
                    differences.append((high - low) / (2 * h))
            if differences:
                nearest = min(differences, key=lambda difference: abs(difference - gradient[k]))
                assert nearest == pytest.approx(gradient[k], rel=1e-4, abs=1e-9)
                num_checked[k] += 1
    num_runs = len(scenarios) * len(seeds)
    assert num_checked.sum() >= 0.8 * 4 * num_runs and (num_checked >= 0.5 * num_runs).all(), num_checked


def scenes(num_frames, speeds, **options):
    """The same scene with movers and, as static, with movers that do not move."""
    return [paper(dynamic_speed_m_s=speed, num_frames=num_frames, **options) for speed in speeds]


def test_soft_gradient_is_the_finite_difference():
    scenarios = scenes(20, (0.0, 0.5), dynamic="lateral", dynamic_set=MOVERS)
    check_gradient(scenarios, QUICK, range(2), CAPACITIES)


@pytest.mark.slow
def test_soft_gradient_is_the_finite_difference_through_a_whole_run():
    scenarios = [*scenes(160, (0.0, 0.5), dynamic="lateral"), *scenes(160, (0.5,), dynamic="inverse_forward")]
    check_gradient(scenarios, None, range(4), {})


@pytest.mark.parametrize(
    ("gate", "smoothing", "share"),
    [
        (VirtualCorrection, "soft", 0.2),
        # The lesser of two margins counts, so that of both thresholds only one matters to a candidate.
        pytest.param(OnePointRansac, "soft", 0.1, marks=pytest.mark.slow),
        pytest.param(VirtualCorrection, "straight_through", 0.2, marks=pytest.mark.slow),
    ],
)
def test_gradients_are_finite_whatever_the_map_holds(gate, smoothing, share):
    """Two thousand random states of one frame: empty and full maps, nothing measured, inverse depths at their clamp,
    points behind the camera and at its centre, pixels far off, covariances near zero; and both kinds of landmarks."""
    filter_config = config(gate(), smoothing=smoothing, reverse_mode=True)
    first = start(filter_config, recording())[0]
    middle = jax.jit(run, compiler_options=QUICK)(filter_config, recording())[0]
    frame = recording().frame(recording().num_frames - 1)

    def disturbed(key):
        """A state and a frame between those of the run and nonsense."""
        keys = jax.random.split(key, 8)
        state = jax.tree.map(lambda a, b: jnp.where(jax.random.bernoulli(keys[0], 0.2), a, b), first, middle)
        landmarks = state.landmarks + jax.random.choice(keys[1], jnp.array([0.0, 0.01, 3.0])) * jax.random.normal(
            keys[2], state.landmarks.shape
        )
        clamp = jax.random.bernoulli(keys[3], 0.2, landmarks.shape[:1])
        landmarks = landmarks.at[:, 6].set(jnp.where(clamp, filter_config.inverse_depth_min, landmarks[:, 6]))
        scale = jax.random.choice(keys[4], jnp.array([1e-12, 1.0, 4.0]))
        state = dataclasses.replace(
            state, landmarks=landmarks, P_vv=scale * state.P_vv, P_vm=scale * state.P_vm, P_mm=scale * state.P_mm
        )
        is_valid = frame.is_valid & jax.random.bernoulli(
            keys[5], jax.random.choice(keys[6], jnp.array([0.0, 0.5, 1.0]))
        )
        uv_px = frame.uv_px + 30.0 * jax.random.t(keys[7], 1.0, frame.uv_px.shape)
        return state, dataclasses.replace(frame, is_valid=is_valid, uv_px=uv_px)

    def value(parameters, key):
        th1, th2, pixel_std_px, shift = parameters
        state, frame = disturbed(key)
        frame = dataclasses.replace(frame, sensor_shift_m=frame.sensor_shift_m + shift)
        state, info = step(
            dataclasses.replace(filter_config, gate=gate(th1, th2), pixel_std_px=pixel_std_px), state, frame
        )
        return jnp.sum(info.p_dynamic) + jnp.sum(info.vehicle) + jnp.sum(info.vehicle_cov) * 1e3

    def batch(keys):
        return jax.lax.map(lambda key: jax.grad(value)(jnp.array([9.0, 9.0, 1.0, 0.0]), key), keys)

    gradient = jax.jit(batch, compiler_options=QUICK)(jax.random.split(jax.random.key(0), 2000))
    assert np.isfinite(gradient).all()
    assert (np.abs(gradient) > 0).mean(axis=0).min() > share


def test_smoothing_has_no_stacked_form():
    with pytest.raises(ValueError, match="stacked corrections have no smooth form; take update='sequential'"):
        FilterConfig(update="stacked", smoothing="soft")
    with pytest.raises(ValueError, match=r"temperature=0.0\).*positive"):
        FilterConfig(temperature=0.0)
