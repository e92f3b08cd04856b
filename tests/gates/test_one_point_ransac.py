"""1-point RANSAC: sets by plainly corrected states, a case by hand, the rescue, masks, derivatives, refusals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gates.linear_blocks import MODEL, errors_before_correction, linear_candidates
from hypothesis import given
from hypothesis import strategies as st

from vcjax.gates.gate import Candidates, Joint
from vcjax.gates.one_point_ransac import OnePointRansac

R = np.array([[1.3, 0.4], [0.4, 0.7]])
K = 7
margins = jax.jit(lambda gate, joint: gate.margins(joint))


def problem(seed, num=K):
    """A state's covariance, the candidates' derivatives by it, and innovations, a third of them far off."""
    rng = np.random.default_rng(seed)
    size = 9
    A, H = rng.normal(size=(size, size)), rng.normal(size=(num, 2, size))
    P = 10 ** rng.uniform(-1, 2) * A @ A.T / size
    z = H @ (np.linalg.cholesky(P) @ rng.normal(size=size)) + rng.normal(size=(num, 2)) @ np.linalg.cholesky(R).T
    z += np.where(rng.random((num, 1)) < 0.3, 20 * rng.normal(size=(num, 2)), 0.0)
    return P, H, z, rng.random(num) < 0.8


def joint_of(P, H, z, is_measured):
    """What the gate is shown."""
    S = np.einsum("ian,nm,jbm->ijab", H, P, H)
    S[~(is_measured[:, None] & is_measured)] = 0.0
    S[np.arange(len(z)), np.arange(len(z))] += R
    return Joint(*map(jnp.array, (np.where(is_measured[:, None], z, 0.0), S, R, is_measured)))


def plainly(gate, P, H, z, is_measured):
    """Margins of the best hypothesis, each by a state corrected with that one measurement."""
    best, best_margins = (-1, 0.0), np.full(len(z), -np.inf)
    re1 = [z[j] @ np.linalg.inv(H[j] @ P @ H[j].T + R) @ z[j] for j in range(len(z))]
    for i in range(len(z)):
        if not is_measured[i] or re1[i] >= gate.th1:
            continue
        shift = P @ H[i].T @ np.linalg.inv(H[i] @ P @ H[i].T + R) @ z[i]
        found = np.full(len(z), -np.inf)
        squares = []
        for j in np.flatnonzero(is_measured):
            left = z[j] - H[j] @ shift
            square = left @ np.linalg.inv(R) @ left
            found[j] = min(gate.th_consensus - square, gate.th1 - re1[j])
            if found[j] > 0:
                squares.append(square)
        if (len(squares), -sum(squares)) > best:
            best, best_margins = (len(squares), -sum(squares)), found
    return best_margins


@given(st.integers(0, 2**32 - 1), st.floats(2.0, 30.0), st.floats(1.0, 20.0))
def test_margins_are_those_of_the_best_plain_hypothesis(seed, th1, th_consensus):
    gate, given = OnePointRansac(th1, th_consensus), problem(seed)
    is_measured, expected = given[-1], plainly(gate, *given)
    found = np.asarray(margins(gate, joint_of(*given)))
    if np.isneginf(expected).all():
        assert not np.any(found[is_measured] > 0)
    else:
        np.testing.assert_allclose(found[is_measured], expected[is_measured], rtol=1e-8, atol=1e-8)


def test_four_that_shift_together_outvote_two_that_fit_by_themselves():
    """The camera may have shifted sideways by 10 px or so. All but the last lie in their search region."""
    z = np.array([[-8.0, 0.0], [10.0, 0.0], [10.0, 0.0], [10.0, 1.0], [10.0, 0.0], [10.0, 9.0]])
    S = np.broadcast_to(np.diag([100.0, 0.0]), (6, 6, 2, 2)) + np.eye(6)[:, :, None, None] * np.eye(2)
    joint = Joint(jnp.array(z), jnp.array(S), jnp.eye(2), jnp.ones(6, bool))
    found = margins(OnePointRansac(), joint)
    left = 10 - 10 * 100 / 101
    expected = [
        5.99 - (-8 - 1000 / 101) ** 2,
        *2 * [5.99 - left**2],
        5.99 - left**2 - 1,
        5.99 - left**2,
        5.99 - left**2 - 81,
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_array_equal(OnePointRansac().accepts(jnp.array([64 / 101, 100 / 101 + 81])), [True, False])
    # Without three of the four, the two sets are equal, and the better fit wins, whoever comes first.
    for order in ([0, 3], [3, 0]):
        pair = Joint(jnp.array(z[order]), jnp.array(S[:2, :2]), jnp.eye(2), jnp.ones(2, bool))
        np.testing.assert_array_equal(np.asarray(margins(OnePointRansac(), pair)) > 0, np.array(order) == 0)


def test_rescue_is_by_the_error_at_the_corrected_state():
    candidates = linear_candidates(1, num=40, is_isolated=np.arange(40) % 4 != 0)
    verdict = jax.jit(lambda gate, c: gate.judge(c, MODEL))(OnePointRansac(), candidates)
    expected = np.where(candidates.is_isolated, errors_before_correction(candidates), np.nan)
    np.testing.assert_allclose(verdict.re1, expected, rtol=1e-10)
    np.testing.assert_array_equal(verdict.is_recovered, expected <= 5.99)
    assert np.isnan(verdict.re2).all() and 3 < np.sum(verdict.is_recovered) < 30


@pytest.mark.parametrize("rubbish", [np.nan, np.inf, -1e200])
def test_what_is_not_judged_is_inert_in_value_and_gradient(rubbish):
    mask = jnp.arange(8) % 3 != 0
    clean = linear_candidates(5, is_isolated=mask)

    def replace(leaf):
        return jnp.where(jnp.reshape(mask, (-1, *(1,) * (leaf.ndim - 1))), leaf, rubbish)

    @jax.jit
    @jax.value_and_grad
    def total(leaves):
        margin = OnePointRansac().judge(Candidates(*leaves, clean.R, mask), MODEL).margin
        return jnp.sum(jnp.where(jnp.isnan(margin), 0.0, jnp.sin(margin)))

    dirty = jax.tree.map(replace, clean.mean), replace(clean.P), replace(clean.uv_px)
    jax.tree.map(np.testing.assert_array_equal, total(dirty), total((clean.mean, clean.P, clean.uv_px)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(total(dirty)))


def test_margins_have_exact_derivatives():
    joint = joint_of(*problem(3)[:3], np.arange(K) != 2)

    def total(z, S, th1, th_consensus):
        margin = OnePointRansac(th1, th_consensus).margins(joint._replace(z=z, S=S))
        return jnp.sum(jnp.where(joint.is_measured, jnp.tanh(margin / 30), 0.0))

    at = joint.z, joint.S, 4.0, 30.0
    gradient = jax.grad(total, argnums=(0, 1, 2, 3))(*at)
    assert (gradient[0][2] == 0).all() and all(np.any(g != 0) for g in gradient)
    rng = np.random.default_rng(0)
    for k, g in enumerate(gradient):
        direction = rng.normal(size=np.shape(g))
        step = 1e-6 * direction
        if k == 1:
            step = (step + step.transpose(1, 0, 3, 2)) / 2
        low, high = (total(*(a + s * step if i == k else a for i, a in enumerate(at))) for s in (-1, 1))
        np.testing.assert_allclose(high - low, 2 * np.sum(g * step), rtol=1e-5, atol=1e-12)


def test_another_threshold_compiles_nothing_new():
    once = jax.jit(eqx.debug.assert_max_traces(lambda gate, joint: gate.margins(joint), max_traces=1))
    joint = joint_of(*problem(0))
    numbers = [np.sum(once(OnePointRansac(25.0, th), joint) > 0) for th in (1, 5.99, 1e3)]
    assert numbers[0] < numbers[-1]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", ["th1", "th_consensus", "th_rescue"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_bad_thresholds_are_refused_by_name_and_value(name, value):
    with pytest.raises(ValueError, match=rf"OnePointRansac\({name}={value}\): .*positive"):
        OnePointRansac(**{name: value})
