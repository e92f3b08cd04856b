"""The velocity GLR against plain NumPy, and its distributions where measurement is linear and the filter uses all."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gates.evidence import born, evidence, frames, observe_all, random_record
from scipy import stats

from vcjax.gates.velocity_glr import VelocityGLR

NUM_SLOTS = 5
FORGETFUL = VelocityGLR(threshold=3.0, velocity_std_m_s=1.0, forgetting=0.9)


def glr_plainly(detector, record):
    """Every slot's B, d, C, D and margin, frame by frame and candidate by candidate, with NumPy's own solver."""
    f, sigma2 = detector.forgetting, detector.velocity_std_m_s**2
    B, d = np.zeros((NUM_SLOTS, 7, 3)), np.zeros((NUM_SLOTS, 3))
    C, D = np.zeros((NUM_SLOTS, 3, 3)), np.zeros((NUM_SLOTS, 3, 3))
    offset, less = np.zeros((NUM_SLOTS, 7)), np.zeros((NUM_SLOTS, 7, 7))
    for frame in frames(record):
        B, d, C, D = f * B, f * d, f * C, f**2 * D
        B[:, :3] += frame.time_step_s * np.eye(3)
        for k in np.flatnonzero(frame.is_searched & frame.is_measured):
            i, H, z, S, PH = frame.slot[k], frame.H[k], frame.innovation[k], frame.innovation_cov[k], frame.PH[k]
            if np.linalg.eigvalsh(S - H @ less[i] @ H.T - frame.pixel_cov / 2).min() <= 0:
                offset[i], less[i] = 0.0, 0.0
            white_z, white_S = z - H @ offset[i], S - H @ less[i] @ H.T
            inverse = np.linalg.inv(white_S)
            K, own_K = (PH - less[i] @ H.T) @ inverse, PH @ np.linalg.inv(S)
            G = H @ B[i]
            d[i] += G.T @ inverse @ white_z
            C[i] += G.T @ inverse @ G
            D[i] += G.T @ inverse @ G
            B[i] -= K @ G
            offset[i] += K @ white_z - frame.weight[k] * own_K @ z
            less[i] += K @ white_S @ K.T - frame.weight[k] * own_K @ S @ own_K.T
        margin = np.full(NUM_SLOTS, np.nan)
        for i in range(NUM_SLOTS):
            statistic = d[i] @ np.linalg.solve(D[i] + np.eye(3) / sigma2, d[i])
            bound = -2 * np.log(detector.false_alarm_rate or 1) + np.linalg.slogdet(np.eye(3) + sigma2 * D[i])[1]
            if np.trace(C[i]) > 0:
                margin[i] = statistic - (bound if detector.threshold is None else detector.threshold)
        yield B.copy(), d.copy(), C.copy(), D.copy(), offset.copy(), less.copy(), margin


@pytest.mark.parametrize("detector", [VelocityGLR(false_alarm_rate=0.9, velocity_std_m_s=0.1), FORGETFUL])
@pytest.mark.parametrize("seed", range(3))
def test_states_and_margins_are_the_plain_ones(detector, seed):
    record = random_record(seed)
    states, margins = observe_all(detector, born(detector, NUM_SLOTS), record)
    *expected, expected_margins = map(np.stack, zip(*glr_plainly(detector, record), strict=True))
    for ours, theirs in zip(jax.tree.leaves(states), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(margins, expected_margins, rtol=1e-7)
    assert (np.array(expected_margins) > 0).any() and (np.array(expected_margins) < 0).any()


def test_velocity_is_the_regularised_least_squares():
    states, _ = observe_all(FORGETFUL, born(FORGETFUL, NUM_SLOTS), random_record(4))
    v, cov = FORGETFUL.velocity(states)
    d, C, D = map(np.asarray, (states.d[-1], states.C[-1], states.D[-1]))
    for i in range(NUM_SLOTS):
        inverse = np.linalg.inv(C[i] + np.eye(3))
        np.testing.assert_allclose(v[-1, i], inverse @ d[i], rtol=1e-9)
        np.testing.assert_allclose(cov[-1, i], inverse @ (D[i] + np.eye(3)) @ inverse, rtol=1e-8, atol=1e-13)


RUNS, FRAMES, TIME_STEP_S = 400, 60, 0.1
MOVING_M_S = np.array([0.05, -0.03, 0.04])
LINEAR = VelocityGLR(threshold=20.0, velocity_std_m_s=1e4)


@cache
def linear_runs(velocity_m_s=(0.0, 0.0, 0.0), num_runs=RUNS, seed=0, steady=False, gate=np.inf):
    """Each slot a landmark of its own, measured in every frame by a random H, corrected by its own Kalman filter.

    A point that starts where the filter believes, up to its covariance, and then moves as given. With `steady`, what is
    measured does not change along one direction of the velocity. Innovations with RE₁ above `gate` are left out.
    """
    rng = np.random.default_rng(seed)
    P = np.tile(np.diag([0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.3]), (num_runs, 1, 1))
    error = np.einsum("rij,rj->ri", np.linalg.cholesky(P), rng.standard_normal((num_runs, 7)))
    record = {name: [] for name in ("slot", "innovation", "innovation_cov", "H", "PH", "weight", "time_step_s")}
    for _ in range(FRAMES):
        error[:, :3] += TIME_STEP_S * np.asarray(velocity_m_s)
        H = rng.normal(size=(num_runs, 2, 7)) * np.array([3, 3, 3, 5, 5, 5, 2])
        if steady:
            H[..., 0] = 0.0
        z = np.einsum("rai,ri->ra", H, error) + rng.standard_normal((num_runs, 2))
        S = H @ P @ H.mT + np.eye(2)
        PH, inverse = P @ H.mT, np.linalg.inv(S)
        is_used = np.einsum("ra,rab,rb->r", z, inverse, z) < gate
        K = PH @ inverse * is_used[:, None, None]
        error, P = error - np.einsum("ria,ra->ri", K, z), P - K @ S @ K.mT
        for name, value in zip(record, (np.arange(num_runs), z, S, H, PH, 1.0 * is_used, TIME_STEP_S), strict=True):
            record[name].append(value)
    full = jax.device_get(vars(evidence(np.arange(num_runs), num_runs)))
    full = {name: np.broadcast_to(value, (FRAMES, *value.shape)) for name, value in full.items()}
    return full | {name: np.stack(values) for name, values in record.items()}


@cache
def linear_results(velocity_m_s=(0.0, 0.0, 0.0), detector=LINEAR, **options):
    """Final states, and margins of all frames."""
    record = linear_runs(velocity_m_s, **options)
    states, margins = observe_all(detector, born(detector, record["slot"].shape[1]), record)
    return jax.tree.map(lambda leaf: np.asarray(leaf[-1]), states), np.asarray(margins)


def statistic(state):
    return np.einsum("ri,rij,rj->r", state.d, np.linalg.inv(state.C), state.d)


def test_of_static_landmarks_it_is_chi_squared():
    state, margins = linear_results()
    found = statistic(state)
    np.testing.assert_allclose(margins[-1] + LINEAR.threshold, found, rtol=1e-6)
    assert stats.kstest(found, stats.chi2(3).cdf).pvalue > 0.01
    for q in (0.1, 0.5, 0.9, 0.95):  # a share of 400 has this standard error
        assert abs(np.mean(found < stats.chi2(3).ppf(q)) - q) < 3 * np.sqrt(q * (1 - q) / RUNS)


@pytest.mark.parametrize("gate", [9.0, 4.0])
def test_it_is_chi_squared_whatever_the_gate_leaves_out(gate):
    """Of 60 frames Th₁ = 9 leaves out 0.7, Th₁ = 4 eight."""
    record = linear_runs(gate=gate)
    assert 0.3 < np.sum(record["weight"] == 0) / RUNS < 12
    state, _ = linear_results(gate=gate)
    assert stats.kstest(statistic(state), stats.chi2(3).cdf).pvalue > 0.01


def test_of_moving_landmarks_it_is_non_central_by_the_predicted_amount():
    state, _ = linear_results(tuple(MOVING_M_S))
    delta = np.einsum("i,rij,j->r", MOVING_M_S, state.C, MOVING_M_S)
    assert 10 < np.median(delta) < 200
    share = stats.ncx2(3, delta).cdf(statistic(state))  # of every run by its own δ: uniform
    assert stats.kstest(share, "uniform").pvalue > 0.01


def test_velocity_is_unbiased_and_its_covariance_honest():
    num_runs = 2000
    state, _ = linear_results(tuple(MOVING_M_S), num_runs=num_runs)
    v, cov = LINEAR.velocity(jax.tree.map(jnp.asarray, state))
    error = np.asarray(v) - MOVING_M_S
    mean, standard_error = error.mean(0), error.std(0, ddof=1) / np.sqrt(num_runs)
    assert np.all(np.abs(mean) < 3 * standard_error) and np.all(standard_error < 0.01)
    nees = np.einsum("ri,rij,rj->r", error, np.linalg.inv(np.asarray(cov)), error)
    low, high = stats.chi2(3 * num_runs).ppf([0.005, 0.995]) / num_runs
    assert low < nees.mean() < high


def test_along_what_cannot_be_observed_the_prior_stays():
    detector = VelocityGLR(threshold=20.0, velocity_std_m_s=1.0)
    state, margins = linear_results(detector=detector, steady=True)
    np.testing.assert_array_equal(state.C[:, 0], 0.0)
    v, cov = detector.velocity(jax.tree.map(jnp.asarray, state))
    np.testing.assert_array_equal(v[:, 0], 0.0)
    np.testing.assert_allclose(cov[:, 0, 0], 1.0, rtol=1e-9)
    # Two directions are observed well: χ² with two degrees of freedom, all but.
    assert stats.kstest(margins[-1] + 20.0, stats.chi2(2).cdf).pvalue > 0.01


NUM_TRACKS = 4000


@pytest.mark.parametrize("rate", [0.1, 0.02])
def test_no_more_static_tracks_are_ever_flagged_than_asked_for(rate):
    """Of 60 frames a part of it only: the bound holds for any number."""
    _, margins = linear_results(detector=VelocityGLR(false_alarm_rate=rate), num_runs=NUM_TRACKS)
    flagged = np.mean((margins > 0).any(axis=0))
    assert rate / 10 < flagged < rate + 3 * np.sqrt(rate / NUM_TRACKS)


def test_a_fixed_threshold_is_ever_passed_as_often_as_the_docstring_says():
    detector = VelocityGLR(threshold=1.0, velocity_std_m_s=1.0)
    _, margins = linear_results(detector=detector, num_runs=NUM_TRACKS)
    ever = [np.mean((margins > threshold - 1.0).any(axis=0)) for threshold in (12.0, 16.0, 20.0)]
    np.testing.assert_allclose(ever, [0.091, 0.018, 0.0028], rtol=0.05)


def smooth_total(detector, fields, masks):
    """A smooth function of all margins after two frames, as of the candidates' numbers."""
    state = born(detector, 4)
    for _ in range(2):
        state, margin = detector.observe(state, evidence([1, 3, 0], 4, **fields, **masks))
    return jnp.sum(jnp.where(jnp.isnan(margin), 0.0, jnp.sin(margin)))


@pytest.mark.parametrize("detector", [VelocityGLR(), FORGETFUL])
@pytest.mark.parametrize("rubbish", [np.nan, np.inf, 1e200])
def test_what_is_not_found_is_inert_in_value_and_gradient(detector, rubbish):
    frame = next(frames(random_record(6, num_frames=1)))
    rng = np.random.default_rng(1)
    names = ("innovation", "innovation_cov", "H", "PH")
    fields = {name: rng.normal(size=getattr(frame, name).shape) for name in names}
    fields["innovation_cov"] = fields["innovation_cov"] @ fields["innovation_cov"].mT + np.eye(2)
    masks = dict(is_measured=np.array([True, False, True]), is_searched=np.array([True, True, False]))
    dirty = {name: value.copy() for name, value in fields.items()}
    for value in dirty.values():
        value[1:] = rubbish
    value_and_gradient = jax.value_and_grad(smooth_total, argnums=1)
    (value, gradient), (dirty_value, dirty_gradient) = (value_and_gradient(detector, f, masks) for f in (fields, dirty))
    assert value == dirty_value and value != 0
    for name in names:
        np.testing.assert_array_equal(gradient[name], dirty_gradient[name])
        assert np.isfinite(gradient[name]).all() and (gradient[name][1:] == 0).all()
    assert (gradient["innovation"][0] != 0).all()


def test_derivatives_are_finite_differences():
    record = random_record(7)

    def final(rate, std):
        detector = VelocityGLR(false_alarm_rate=rate, velocity_std_m_s=std)
        return observe_all(detector, born(detector, NUM_SLOTS), record)[1][-1]

    at, h = (jnp.array(0.01), jnp.array(0.5)), 1e-6
    for i in range(2):
        _, derivative = jax.jvp(final, at, tuple(jnp.asarray(float(i == j)) for j in range(2)))
        low, high = (final(*(x + s * h * (i == j) for j, x in enumerate(at))) for s in (-1, 1))
        np.testing.assert_allclose(derivative, (high - low) / (2 * h), rtol=1e-5)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(false_alarm_rate=0.0), r"VelocityGLR\(false_alarm_rate=0.0\): .*\(0, 1\)"),
        (dict(false_alarm_rate=1.5), r"VelocityGLR\(false_alarm_rate=1.5\)"),
        (dict(threshold=-1), r"VelocityGLR\(threshold=-1.0\): .*positive χ²"),
        (dict(false_alarm_rate=0.01, threshold=17), r"\(false_alarm_rate=0.01, threshold=17.0\): .*one of them"),
        (dict(suspect=0.0), r"VelocityGLR\(suspect=0.0\): .*positive, finite χ²"),
        (dict(suspect=np.inf), r"VelocityGLR\(suspect=inf\): .*positive, finite χ²"),
        (dict(suspect=17, threshold=17), r"VelocityGLR\(suspect=17.0, threshold=17.0\): .*a smaller value for suspect"),
        (dict(velocity_std_m_s=0), r"VelocityGLR\(velocity_std_m_s=0.0\)"),
        (dict(threshold=20, forgetting=1.1), r"VelocityGLR\(forgetting=1.1\): .*\(0, 1\]"),
        (dict(forgetting=0.9), r"VelocityGLR\(forgetting=0.9\).*give a threshold, or forgetting=1"),
    ],
)
def test_bad_input_is_refused_by_name_and_value(fields, message):
    with pytest.raises(ValueError, match=message):
        VelocityGLR(**fields)


@pytest.mark.parametrize("other", [dict(threshold=17.0), dict(false_alarm_rate=0.9)])
def test_suspect_is_who_passes_a_smaller_value(other):
    detector, record = VelocityGLR(suspect=4.0, velocity_std_m_s=0.1, **other), random_record(0)
    states, _ = observe_all(detector, born(detector, NUM_SLOTS), record)
    suspicion = jax.vmap(detector.suspicion)(states)
    D, d = np.asarray(states.D) + np.eye(3) / 0.1**2, np.asarray(states.d)
    statistic = np.sum(d * np.linalg.solve(D, d[..., None])[..., 0], axis=-1)
    np.testing.assert_allclose(suspicion, statistic - 4.0, rtol=1e-8, atol=1e-10)
    assert (suspicion > 0).any() and (suspicion < 0).any()
    assert VelocityGLR(**other).suspicion(states) is None and detector.suspicion(detector.born()) == -4.0


def test_the_rate_is_one_percent_unless_another_or_a_threshold_is_given():
    state = VelocityGLR().born()
    assert VelocityGLR().margin(state) == VelocityGLR(false_alarm_rate=0.01).margin(state) == 2 * np.log(0.01)
    assert VelocityGLR(threshold=17.0).margin(state) == -17
