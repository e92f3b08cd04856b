"""Losses against plain counts, at their edges, and their derivatives by finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcjax.filter.info import FrameInfo
from vcjax.recording import Truth
from vcjax.simulation.scenarios import paper
from vcjax.tuning.losses import (
    Labelled,
    Objective,
    camera_motion_m2_s2,
    candidates,
    cross_entropy,
    f1_loss,
    inconsistency,
    position_rmse_m,
    ranking_loss,
    tracks,
)

IDS = np.array([[0, 1, 2, -1], [1, 0, -1, -1], [1, 3, 2, 0]])
IS_MEASURED = np.array([[1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 0, 1]], bool)
P = np.array([[0.2, 0.9, 0.1, 0.7], [0.5, 0.6, 0.3, 0.3], [0.0, 1.0, 0.4, 0.5]])
IS_MOVING = np.array([True, True, False, False, True])  # the last is never seen
NUM_FRAMES, NUM_CANDIDATES = IDS.shape


NOBODY = ((-1,),) * NUM_FRAMES


def info(
    p=P,
    error_m=0.1,
    variance_m2=0.01,
    inconsistent_id=NOBODY,
    watched_id=NOBODY,
    p_detector=((0.0,),) * NUM_FRAMES,
) -> FrameInfo:
    """A made-up run of three frames; what the losses do not read is empty."""
    vehicle = np.zeros((NUM_FRAMES, 14))
    vehicle[:, 0], vehicle[:, [3, 10]] = error_m, 1.0
    nothing = dict.fromkeys((field.name for field in dataclasses.fields(FrameInfo)), jnp.zeros(NUM_FRAMES))
    return FrameInfo(
        **nothing
        | dict(
            followers=None,
            handed_back_id=None,
            vehicle=jnp.asarray(vehicle),
            vehicle_cov=jnp.broadcast_to(variance_m2 * jnp.eye(14), (NUM_FRAMES, 14, 14)),
            candidate_id=jnp.asarray(IDS),
            is_measured=jnp.asarray(IS_MEASURED),
            p_dynamic=jnp.asarray(p),
            inconsistent_id=jnp.asarray(inconsistent_id),
            watched_id=jnp.asarray(watched_id),
            p_detector=jnp.asarray(p_detector),
        )
    )


def truth() -> Truth:
    pose = jnp.zeros((NUM_FRAMES, 7)).at[:, 3].set(1.0)
    return Truth(pose, pose, jnp.zeros((NUM_FRAMES, 5, 3)), jnp.asarray(IS_MOVING))


def test_candidates_are_those_that_were_measured(unchecked):
    found = candidates(info(), truth())
    counts = IS_MEASURED & (IDS >= 0)
    np.testing.assert_array_equal(found.counts, counts)
    np.testing.assert_array_equal(found.p, np.where(counts, P, 0))
    np.testing.assert_array_equal(found.is_mover, counts & IS_MOVING[IDS])


def test_a_track_is_called_dynamic_at_least_once(unchecked):
    found = tracks(info(), truth())
    np.testing.assert_array_equal(found.counts, [True, True, True, True, False])
    np.testing.assert_array_equal(found.is_mover, [True, True, False, False, False])
    expected = [1 - 0.8 * 0.5, 1 - 0.1 * 0.5 * 1.0, 0.1, 1.0, 0.0]
    np.testing.assert_allclose(found.p, expected, atol=2e-9)


def test_a_track_that_the_detector_deletes_is_called_dynamic(unchecked):
    deleted = dict(inconsistent_id=((-1,), (2,), (4,)), watched_id=((2,), (2,), (4,)))
    found = tracks(info(**deleted, p_detector=((0.0,), (1.0,), (1.0,))), truth())
    np.testing.assert_array_equal(found.counts, [True] * 5)
    np.testing.assert_array_equal(found.is_mover, IS_MOVING)
    np.testing.assert_allclose(found.p[jnp.array([2, 4])], 1.0, rtol=0)


def test_the_largest_degree_of_the_detector_counts_once(unchecked):
    """Features 0 and 3 are watched in two slots, feature 4 never was a candidate; the free slot's degree is nothing."""

    def degrees(p_detector):
        watched = info(watched_id=((0, 3), (3, 0), (4, -1)), p_detector=p_detector)
        return tracks(watched, truth()).p

    by_detector = jnp.array([[0.2, 0.25], [0.5, 0.0], [0.9, 0.9]])
    expected = [1 - 0.8 * 0.8 * 0.5, 1 - 0.1 * 0.5 * 1.0, 0.1, 1.0, 0.0]
    np.testing.assert_allclose(degrees(by_detector), expected, atol=2e-9)
    gradient = jax.grad(lambda p: degrees(p)[0])(by_detector)
    np.testing.assert_allclose(gradient, [[0.8 * 0.5, 0], [0, 0], [0, 0]], atol=2e-9)


LABELLED = st.integers(1, 12).flatmap(
    lambda n: st.tuples(*(st.lists(s, min_size=n, max_size=n) for s in (st.floats(0, 1), st.booleans(), st.booleans())))
)


def labelled(p, is_mover, counts) -> Labelled:
    counts = np.array(counts)
    return Labelled(jnp.array(p), jnp.asarray(np.array(is_mover) & counts), jnp.asarray(counts))


@given(LABELLED)
def test_hard_degrees_give_the_counted_figures(drawn):
    entries = labelled(np.round(drawn[0]), *drawn[1:])
    called, mover, counts = (np.asarray(a, bool) for a in entries)
    hits, wrong, missed = (called & mover).sum(), (called & ~mover & counts).sum(), (~called & mover).sum()
    f1 = 2 * hits / (2 * hits + wrong + missed) if hits + wrong + missed else 0.0
    assert float(f1_loss(entries)) == pytest.approx(1 - f1)
    pairs = [(called[m], called[o]) for m in np.flatnonzero(mover) for o in np.flatnonzero(counts & ~mover)]
    expected = np.mean([(o > m) + 0.5 * (o == m) for m, o in pairs]) if pairs else 0.0
    assert float(ranking_loss(entries, 1e-3)) == pytest.approx(expected)


@given(LABELLED)
def test_losses_and_derivatives_are_finite_whatever_the_degrees(drawn):
    entries = labelled(*drawn)
    for loss in (f1_loss, cross_entropy, ranking_loss):
        value, gradient = jax.value_and_grad(lambda p, loss=loss: loss(entries._replace(p=p)))(entries.p)
        assert np.isfinite(value) and np.isfinite(gradient).all() and value >= 0
    assert float(f1_loss(entries)) <= 1 and float(ranking_loss(entries)) <= 1


def test_cross_entropy_is_the_weighted_mean():
    entries = labelled([0.2, 0.9, 0.4, 0.3], [True, False, False, True], [True, True, True, False])
    expected = -(3 * np.log(0.2) + np.log(0.1) + np.log(0.6)) / 5
    assert float(cross_entropy(entries, 3.0)) == pytest.approx(expected)


@pytest.mark.parametrize("loss", [f1_loss, cross_entropy, ranking_loss])
def test_derivatives_are_finite_differences(loss):
    p, mover, counts = np.array([0.2, 0.9, 0.4, 0.3, 0.6]), np.array([1, 0, 0, 1, 0], bool), np.ones(5, bool)
    gradient, h = jax.grad(lambda p: loss(labelled(p, mover, counts)))(jnp.asarray(p)), 1e-6
    for i in range(5):
        low, high = (float(loss(labelled(p + s * h * np.eye(5)[i], mover, counts))) for s in (-1, 1))
        assert gradient[i] == pytest.approx((high - low) / (2 * h), rel=1e-7)
    assert (np.asarray(gradient)[mover] < 0).all() and (np.asarray(gradient)[~mover] > 0).all()


def test_position_and_consistency(unchecked):
    assert float(position_rmse_m(info(), truth())) == pytest.approx(0.1)
    anees = 0.1**2 / 0.01 / 2
    assert float(inconsistency(info(), truth())) == pytest.approx(np.log(anees) ** 2)
    assert float(inconsistency(info(variance_m2=0.0), truth())) == 0.0  # nowhere defined

    def perfect(x):
        run = info()
        return position_rmse_m(dataclasses.replace(run, vehicle=run.vehicle.at[:, 0].set(x)), truth())

    assert jax.value_and_grad(perfect)(0.0) == (0.0, 0.0)
    assert jax.value_and_grad(perfect)(-0.2) == (pytest.approx(0.2), pytest.approx(-1.0))


def test_camera_motion_is_the_mean_square_speed():
    A, f = 0.07, 2.0
    t = np.linspace(0, 1 / f, 100_001)[:-1]
    speed = A * 2 * np.pi * f * np.cos(2 * np.pi * f * t)
    scenario = paper(oscillation_amplitude_m=A, oscillation_frequency_hz=f)
    assert float(camera_motion_m2_s2(scenario)) == pytest.approx(np.mean(speed**2))


def test_objective_is_the_weighted_sum(unchecked):
    scenario = paper(oscillation_amplitude_m=0.05)
    terms = Objective().terms(scenario, info(), truth())
    weights = dict(zip(terms, (1.0, 0.5, 2.0, 0.0, 3.0, 10.0, 0.1, 4.0), strict=True))
    expected = sum(weights[name] * float(value) for name, value in terms.items())
    assert float(Objective(**weights)(scenario, info(), truth())) == pytest.approx(expected)
    assert float(Objective()(scenario, info(), truth())) == pytest.approx(float(terms["track_f1"]))


def test_what_a_mover_counts_and_the_temperature_of_the_order_are_the_objectives(unchecked):
    scenario = paper(oscillation_amplitude_m=0.05)
    terms = Objective(mover_weight=4.0, ranking_temperature=0.3).terms(scenario, info(), truth())
    assert float(terms["track_cross_entropy"]) == float(cross_entropy(tracks(info(), truth()), 4.0))
    assert float(terms["candidate_cross_entropy"]) == float(cross_entropy(candidates(info(), truth()), 4.0))
    assert float(terms["track_ranking"]) == float(ranking_loss(tracks(info(), truth()), 0.3))
    usual = Objective().terms(scenario, info(), truth())
    assert all(terms[name] != usual[name] for name in ("track_cross_entropy", "track_ranking"))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"position": -1.0}, r"Objective\(position=-1.0\): a weight is finite and at least 0"),
        ({"position": np.inf}, r"Objective\(position=inf\): a weight is finite"),
        ({"track_f1": 0.0}, "all weights are 0; give one of track_f1, .* a number above 0"),
        ({"track_f1": 0.0, "mover_weight": 2.0}, "all weights are 0"),
        ({"mover_weight": 0.0}, r"mover_weight=0.0\): give a positive number"),
        ({"ranking_temperature": np.inf}, r"ranking_temperature=inf\): give a positive number"),
    ],
)
def test_bad_objectives_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Objective(**fields)


def test_a_degree_of_one_pulls_as_the_others_let_it(unchecked):
    """∂/∂p of 1 - Π (1 - p) is the product of the others, at p = 1 as well, where hard decisions are."""
    degrees = np.array([[0.0, 0.3, 1.0, 0.0], [0.2, 0, 0, 0], [0.0, 1.0, 0.5, 1.0]])
    slope = jax.jacrev(lambda p: tracks(info(p), truth()).p.sum())(jnp.asarray(degrees))
    expected = np.zeros_like(degrees)
    counted = IS_MEASURED & (IDS >= 0)
    for t, k in np.argwhere(counted):
        others = counted & (IDS[t, k] == IDS)
        others[t, k] = False
        expected[t, k] = np.prod(1 - degrees[others])
    np.testing.assert_allclose(slope, expected, atol=1e-8)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_losses_are_finite_where_degrees_are_0_and_1(dtype):
    """1 - 1e-9 is 1 in single precision: it must not be what a degree is compared with."""
    labelled = Labelled(jnp.array([0, 1, 1, 0], dtype), jnp.array([True, True, False, False]), jnp.ones(4, bool))
    for loss in (f1_loss, cross_entropy, ranking_loss):
        value, slope = jax.value_and_grad(lambda p, loss=loss: loss(labelled._replace(p=p)))(labelled.p)
        assert slope.dtype == dtype and np.isfinite(value) and np.isfinite(slope).all(), loss
