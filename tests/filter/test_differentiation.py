"""The hard filter's derivatives through 25 frames: forward mode, reverse mode and finite differences agree.

Choices and verdicts have no derivative; a finite difference is one only where no decision flips within its step, which
is checked.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filter_runs import CAPACITY, derivative, filtered, frame_of, head, quick_jit, start_jvp, step_jvp

from vcjax.filter.config import FilterConfig
from vcjax.filter.run import run
from vcjax.simulation.scenarios import paper
from vcjax.simulation.simulate import simulate

NUM_FRAMES = 25
SCENARIO = paper(dynamic="lateral", num_frames=NUM_FRAMES)
CONFIG = FilterConfig(max_landmarks=CAPACITY, retire=False)
NAMES = ("pixel_std_px", "oscillation_amplitude_m", "odometry")
AT = np.array([0.9, 0.05, 0.0])
RNG = np.random.default_rng(5)
ODOMETRY_DIRECTION = RNG.standard_normal((NUM_FRAMES, 6))
# A random functional of what the last frame knows: state and covariance in comparable units.
WEIGHTS = RNG.standard_normal(14), 1e3 * RNG.standard_normal((14, 14))


def inputs(parameters, sees):
    """Configuration and recording by assumed pixel noise (px), amplitude (m), odometry error; all features or none."""
    pixel_std_px, amplitude_m, odometry_error = parameters
    scenario = eqx.tree_at(lambda s: s.oscillation.amplitude_m, SCENARIO, amplitude_m)
    recording, _ = simulate(scenario, jax.random.key(11))
    recording = dataclasses.replace(
        recording,
        odometry=recording.odometry + odometry_error * ODOMETRY_DIRECTION,
        is_valid=recording.is_valid & sees,
    )
    return eqx.tree_at(lambda c: c.pixel_std_px, CONFIG, pixel_std_px), recording


inputs_once = quick_jit(inputs)


@quick_jit
def inputs_jvp(parameters, direction, sees):
    return derivative(lambda p: inputs(p, sees), (parameters,), (direction,))


def summary(vehicle, vehicle_cov):
    """One number of the last frame's state and covariance."""
    return jnp.sum(WEIGHTS[0] * vehicle) + jnp.sum(WEIGHTS[1] * vehicle_cov)


def forward(direction, sees=True):
    """State, info and their derivatives of the last frame, by forward mode through every frame."""
    (config, recording), (d_config, d_recording) = inputs_jvp(AT, direction, sees)
    first, d_first = derivative(lambda r: head(r, 1), (recording,), (d_recording,))
    (state, info), (d_state, d_info) = start_jvp((config, first), (d_config, d_first))
    for t in range(1, NUM_FRAMES):
        frame, d_frame = derivative(lambda r, t=t: frame_of(r, t), (recording,), (d_recording,))
        (state, info), (d_state, d_info) = step_jvp((config, state, frame), (d_config, d_state, d_frame))
    return state, info, d_state, d_info


def forward_gradient(sees=True):
    """Derivative of the summary in the three directions."""
    tangents = [forward(direction, sees)[3] for direction in np.eye(3)]
    return np.array([summary(d.vehicle, d.vehicle_cov) for d in tangents])


def run_filter(parameters):
    """Last state and all infos."""
    frames = list(filtered(*inputs_once(parameters, True)))
    return frames[-1][0], [info for _, info in frames]


def decisions(infos):
    """All choices and verdicts of a run."""
    names = ("candidate_id", "is_measured", "is_accepted", "is_recovered", "is_dynamic", "inconsistent_id", "born_id")
    return [getattr(info, name).tolist() for info in infos for name in names]


@pytest.mark.parametrize("k", range(3), ids=NAMES)
def test_forward_mode_is_the_central_difference(k):
    """Truncation (step² times a third derivative) and cancellation (rounding over step) stay below 1e-7 of the largest
    derivative; 1e-6 leaves a margin. Every decision is the same on both sides, and there were some.
    """
    step_size = (1e-5, 1e-6, 1e-6)[k]
    low, high = AT - step_size * np.eye(3)[k], AT + step_size * np.eye(3)[k]
    (low, low_infos), (high, high_infos), (_, infos) = (run_filter(p) for p in (low, high, AT))
    assert decisions(low_infos) == decisions(high_infos) == decisions(infos)
    assert any(info.is_recovered.any() for info in infos)
    assert any(info.is_dynamic.any() for info in infos)

    state, info, d_state, d_info = forward(np.eye(3)[k])
    np.testing.assert_allclose(info.vehicle, infos[-1].vehicle, rtol=0, atol=1e-13)
    mapped = np.flatnonzero(state.track_id >= 0)
    for ours, below, above in (
        (d_info.vehicle, low_infos[-1].vehicle, high_infos[-1].vehicle),
        (d_info.vehicle_cov, low_infos[-1].vehicle_cov, high_infos[-1].vehicle_cov),
        (d_state.landmarks[mapped], low.landmarks[mapped], high.landmarks[mapped]),
    ):
        difference = (np.asarray(above) - np.asarray(below)) / (2 * step_size)
        largest = np.abs(difference).max()
        assert largest > 0
        np.testing.assert_allclose(ours, difference, rtol=0, atol=1e-6 * largest)


@pytest.fixture(scope="module")
def reverse():
    """Value and gradient of the summary by reverse mode through `run`, of parameters and `sees`."""

    def last_frame(parameters, sees):
        config, recording = inputs(parameters, sees)
        config = dataclasses.replace(config, reverse_mode=True, max_landmarks=40)  # 34 births: enough
        _, info = run(config, recording)
        return summary(info.vehicle[-1], info.vehicle_cov[-1])

    return quick_jit(jax.value_and_grad(last_frame))


def test_reverse_mode_is_forward_mode(reverse):
    value, gradient = reverse(AT, True)
    state, info, *_ = forward(np.zeros(3))
    np.testing.assert_allclose(value, summary(info.vehicle, info.vehicle_cov), rtol=0, atol=1e-11)
    expected = forward_gradient()
    np.testing.assert_allclose(gradient, expected, rtol=1e-9, atol=0)
    assert np.all(np.abs(expected) > 1e-6)
    assert state.is_mapped.sum() <= 40


def test_derivatives_are_finite_where_nothing_is_seen(reverse):
    """With an empty map the pixel noise does nothing, and the odometry all."""
    value, gradient = reverse(AT, False)
    assert np.isfinite(value)
    np.testing.assert_allclose(gradient, forward_gradient(sees=False), rtol=1e-9, atol=1e-15)
    assert gradient[0] == 0.0
    assert abs(gradient[2]) > 0.1


def test_all_derivatives_of_the_state_are_finite():
    for sees in (True, False):
        *_, d_state, d_info = forward(np.ones(3), sees)
        for leaf in [*jax.tree.leaves(d_state), d_info.vehicle, d_info.vehicle_cov, d_info.innovation]:
            assert np.isfinite(leaf).all()
