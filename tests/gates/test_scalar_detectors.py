"""The detectors that keep a number or a few for each landmark, against plain NumPy: likelihood ratio, NIS, CUSUM."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gates.evidence import born, evidence, frames, observe_all, random_record
from scipy import stats

from vcjax.gates.cusum import Cusum
from vcjax.gates.either import Either
from vcjax.gates.immediate import Immediate
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.velocity_glr import VelocityGLR
from vcjax.gates.velocity_likelihood_ratio import VelocityLikelihoodRatio
from vcjax.gates.windowed_nis import WindowedNIS

NUM_SLOTS = 5


def found(frame):
    """Slot and number of each candidate that was found."""
    return [(frame.slot[k], k) for k in np.flatnonzero(frame.is_searched & frame.is_measured)]


def likelihood_ratio_plainly(detector, record):
    total = np.zeros(NUM_SLOTS)
    for frame in frames(record):
        for i, k in found(frame):
            S, H = frame.innovation_cov[k], frame.H[k][:, :3]
            moved = S + (detector.velocity_std_m_s * frame.time_step_s) ** 2 * H @ H.T
            densities = [stats.multivariate_normal(np.zeros(2), cov).logpdf(frame.innovation[k]) for cov in (moved, S)]
            total[i] += 2 * (densities[0] - densities[1])
        yield total - 2 * np.log(1 / detector.false_alarm_rate)


def windowed_nis_plainly(detector, record):
    last = [[] for _ in range(NUM_SLOTS)]
    for frame in frames(record):
        for i, k in found(frame):
            last[i].append(frame.re1[k])
        W = detector.window
        yield np.array([sum(re1[-W:]) - detector.limit if len(re1) >= W else np.nan for re1 in last])


def cusum_plainly(detector, record):
    total = np.zeros(NUM_SLOTS)
    for frame in frames(record):
        for i, k in found(frame):
            total[i] = max(0.0, total[i] + frame.re1[k] - detector.drift)
        yield total - detector.limit


def immediate_plainly(detector, record):
    for frame in frames(record):
        margin = np.full(NUM_SLOTS, np.nan)
        for i, k in found(frame):
            margin[i] = frame.dynamic_margin[k]
        yield margin


PLAINLY = {
    VelocityLikelihoodRatio: likelihood_ratio_plainly,
    WindowedNIS: windowed_nis_plainly,
    Cusum: cusum_plainly,
    Immediate: immediate_plainly,
}
DETECTORS = [VelocityLikelihoodRatio(0.3, 1.0), WindowedNIS(4, 10.0), Cusum(3.0, 5.0), Immediate()]


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("seed", range(3))
def test_margins_are_the_plain_ones(detector, seed):
    record = random_record(seed)
    _, margins = observe_all(detector, born(detector, NUM_SLOTS), record)
    expected = np.stack([margin.copy() for margin in PLAINLY[type(detector)](detector, record)])
    np.testing.assert_allclose(margins, expected, rtol=1e-9, atol=1e-9)
    assert (expected > 0).any() and (expected < 0).any()


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("rubbish", [np.nan, np.inf, 1e200])
def test_what_is_not_found_is_inert_in_value_and_gradient(detector, rubbish):
    rng = np.random.default_rng(1)
    masks = dict(is_measured=np.array([True, False, True]), is_searched=np.array([True, True, False]))
    A = rng.normal(size=(3, 2, 2))
    fields = dict(
        innovation=rng.normal(size=(3, 2)),
        innovation_cov=A @ A.mT + np.eye(2),
        H=rng.normal(size=(3, 2, 7)),
        re1=rng.uniform(5, 9, 3),
        dynamic_margin=rng.normal(size=3),
    )
    dirty = {name: value.copy() for name, value in fields.items()}
    for value in dirty.values():
        value[1:] = rubbish

    def total(fields):
        state, sums = born(detector, 4), 0.0
        for _ in range(4):
            state, margin = detector.observe(state, evidence([1, 3, 0], 4, **fields, **masks))
            sums += jnp.sum(jnp.where(jnp.isnan(margin), 0.0, jnp.sin(margin)))
        return sums

    (value, gradient), (dirty_value, dirty_gradient) = map(jax.value_and_grad(total), (fields, dirty))
    assert value == dirty_value and value != 0
    for name in fields:
        np.testing.assert_array_equal(gradient[name], dirty_gradient[name])
        assert np.isfinite(gradient[name]).all() and (gradient[name][1:] == 0).all()
    assert any((np.asarray(g)[0] != 0).any() for g in gradient.values())


def static_record(num_tracks, num_frames, seed=0):
    """Static tracks, each in a slot of its own, with white innovations and their own covariances."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(num_frames, num_tracks, 2, 2))
    S = A @ A.mT + np.eye(2)
    z = np.einsum("tkab,tkb->tka", np.linalg.cholesky(S), rng.standard_normal((num_frames, num_tracks, 2)))
    re1 = np.einsum("tka,tkab,tkb->tk", z, np.linalg.inv(S), z)
    H = 10 * rng.normal(size=(num_frames, num_tracks, 2, 7))
    numbers = dict(innovation=z, innovation_cov=S, re1=re1, H=H)
    fixed = jax.device_get(vars(evidence(np.arange(num_tracks), num_tracks)))
    return {name: np.broadcast_to(value, (num_frames, *value.shape)) for name, value in fixed.items()} | numbers


def share_ever_flagged(detector, num_tracks=4000, num_frames=50):
    _, margins = observe_all(detector, born(detector, num_tracks), static_record(num_tracks, num_frames))
    return np.mean((np.asarray(margins) > 0).any(axis=0))


@pytest.mark.parametrize("rate", [0.3, 0.05])
def test_the_likelihood_ratio_flags_no_more_static_tracks_than_asked_for(rate):
    flagged = share_ever_flagged(VelocityLikelihoodRatio(rate))
    assert rate / 5 < flagged < rate + 3 * np.sqrt(rate / 4000)


def test_cusum_flags_no_more_static_tracks_than_its_bound():
    """n exp(-θ h) with the θ of the docstring."""
    theta, num_frames = 0.3984, 50
    assert np.exp(-4.0 * theta) == pytest.approx(1 - 2 * theta, rel=1e-3)
    for limit in (12.0, 15.0):
        bound = num_frames * np.exp(-theta * limit)
        assert bound / 20 < share_ever_flagged(Cusum(limit=limit)) < bound


def test_windowed_nis_is_chi_squared():
    _, margins = observe_all(WindowedNIS(), born(WindowedNIS(), 400), static_record(400, 10))
    assert np.isnan(margins[8]).all()
    assert stats.kstest(margins[9] + 52.4, stats.chi2(20).cdf).pvalue > 0.01
    assert stats.chi2(20).sf(52.4) == pytest.approx(1e-4, rel=0.02)


def test_either_flags_what_one_of_them_flags():
    first, second = Cusum(3.0, 5.0), InlierRatio(5, 0.1, 0.7)
    both = Either(first, Either(second, Immediate()))
    record = random_record(2)
    states, margins = observe_all(both, born(both, NUM_SLOTS), record)
    alone = [observe_all(d, born(d, NUM_SLOTS), record) for d in (first, second, Immediate())]
    expected = np.fmax.reduce([np.asarray(margin) for _, margin in alone])
    np.testing.assert_array_equal(margins, expected)
    jax.tree.map(np.testing.assert_array_equal, states, (alone[0][0], (alone[1][0], ())))
    flags = np.stack([np.asarray(margin) > 0 for _, margin in alone])
    np.testing.assert_array_equal(np.asarray(margins) > 0, flags.any(axis=0))
    assert all((alone != flags.any(axis=0)).any() for alone in flags)


def test_either_suspects_whom_one_of_them_suspects():
    low, high, nobody = VelocityGLR(suspect=2.0), VelocityGLR(suspect=5.0), InlierRatio()
    state = low.born()
    assert Either(nobody, Cusum()).suspicion((nobody.born(), Cusum().born())) is None
    for first, second in ((low, nobody), (nobody, low), (high, low), (low, high)):
        states = tuple(state if isinstance(each, VelocityGLR) else each.born() for each in (first, second))
        assert Either(first, second).suspicion(states) == -2.0


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("kind", "fields", "message"),
    [
        (VelocityLikelihoodRatio, dict(false_alarm_rate=1.0), r"false_alarm_rate=1.0\): .*\(0, 1\)"),
        (VelocityLikelihoodRatio, dict(velocity_std_m_s=-1), r"velocity_std_m_s=-1.0\)"),
        (WindowedNIS, dict(window=0), r"WindowedNIS\(window=0\): give a whole number of at least 1"),
        (WindowedNIS, dict(limit=0), r"WindowedNIS\(limit=0.0\): .*positive"),
        (Cusum, dict(drift=2.0), r"Cusum\(drift=2.0\): .*mean 2"),
        (Cusum, dict(limit=np.nan), r"Cusum\(limit=nan\)"),
        (Either, dict(first=Cusum(), second=9.0), r"Either\(second=9.0\): give a detector"),
    ],
)
def test_bad_input_is_refused_by_name_and_value(kind, fields, message):
    with pytest.raises(ValueError, match=message):
        kind(**fields)
