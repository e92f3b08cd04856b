"""The Kalman algebra of one measurement: the textbook's formulas by another route, and invariants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcjax.ekf import correct, innovation_cov, mahalanobis, whiten, whitener

SIZE = 21
correct_block = jax.jit(lambda P, H, z, R: correct(P, H, z, innovation_cov(H, P, R)))
# From a well-known block to one whose projection is ten thousand times as uncertain as a pixel.
scales = st.sampled_from([1e-3, 1.0, 1e4])


def problem(seed, scale=1.0):
    """A random positive definite P (21, 21), H (2, 21), z (2,) and R (2, 2)."""
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(SIZE, SIZE)), rng.normal(size=(2, 2))
    numbers = scale * (A @ A.T) / SIZE, rng.normal(size=(2, SIZE)), 3 * rng.normal(size=2), B @ B.T + 0.1 * np.eye(2)
    return tuple(jnp.array(n) for n in numbers)


problems = st.builds(problem, st.integers(0, 2**32 - 1), scales)


def assert_close(ours, theirs):
    """Equal to 1e-12 of the largest number."""
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())


@given(problems)
def test_correction_is_the_textbooks(problem):
    P, H, z, R = (np.asarray(n) for n in problem)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    correction = correct_block(*problem)
    assert_close(correction.shift, K @ z)
    assert_close(correction.P, (np.eye(SIZE) - K @ H) @ P)


@given(problems)
def test_corrected_covariance_is_the_joseph_form(problem):
    P, H, _, R = (np.asarray(n) for n in problem)
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    remaining = np.eye(SIZE) - K @ H
    assert_close(correct_block(*problem).P, remaining @ P @ remaining.T + K @ R @ K.T)


@given(problems)
def test_corrected_covariance_is_symmetric_and_lies_between_zero_and_the_prior(problem):
    P, corrected = np.asarray(problem[0]), np.asarray(correct_block(*problem).P)
    rounding = 1e-13 * np.abs(P).max()
    np.testing.assert_allclose(corrected, corrected.T, rtol=0, atol=rounding)
    assert np.linalg.eigvalsh(corrected)[0] > -rounding
    assert np.linalg.eigvalsh(P - corrected)[0] > -rounding


def test_information_of_a_measurement_is_added():
    P, H, z, R = problem(0)
    expected = np.linalg.inv(P) + H.T @ np.linalg.solve(R, H)
    np.testing.assert_allclose(np.linalg.inv(correct_block(P, H, z, R).P), expected, rtol=1e-8, atol=1e-8)


def test_what_is_known_exactly_is_not_corrected():
    P, H, z, R = problem(1)
    known = jnp.arange(SIZE) < 14
    P = jnp.where(known[:, None] | known, 0.0, P)
    correction = correct_block(P, H, z, R)
    np.testing.assert_array_equal(correction.shift[:14], 0)
    np.testing.assert_array_equal(correction.P[:14], 0)
    assert np.all(correction.shift[14:] != 0)


@given(problems)
def test_whitener_whitens(problem):
    P, H, z, R = problem
    S = innovation_cov(H, P, R)
    W = whitener(S)
    np.testing.assert_allclose(W @ S @ W.T, np.eye(2), rtol=0, atol=1e-10)
    np.testing.assert_allclose(W.T @ W, np.linalg.inv(S), rtol=1e-9, atol=1e-9 * np.abs(np.linalg.inv(S)).max())
    assert W[0, 1] == 0
    np.testing.assert_allclose(whiten(W, z), W @ z, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(whiten(W, H), W @ H, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(mahalanobis(z, S), z @ np.linalg.solve(S, z), rtol=1e-9)


@pytest.mark.parametrize("S", [[[1.0, 2.0], [2.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]], ids=["indefinite", "negative"])
def test_an_impossible_covariance_gives_nan(S):
    assert np.isnan(mahalanobis(jnp.ones(2), jnp.array(S)))


def test_derivatives_are_exact_and_finite():
    P, H, z, R = problem(2)
    X = jnp.array(np.random.default_rng(3).normal(size=(SIZE, SIZE)))
    direction = (X @ X.T, H[::-1], z[::-1], R)

    def result(t):
        P_t, H_t, z_t, R_t = (a + t * da for a, da in zip((P, H, z, R), direction, strict=True))
        correction = correct(P_t, H_t, z_t, innovation_cov(H_t, P_t, R_t))
        return jnp.sum(correction.P * X) + jnp.sum(correction.shift) + mahalanobis(z_t, innovation_cov(H_t, P_t, R_t))

    value = jax.jit(result)
    forward, reverse = jax.jit(jax.jacfwd(result))(0.0), jax.jit(jax.grad(result))(0.0)
    difference = (value(1e-6) - value(-1e-6)) / 2e-6
    assert np.isfinite(forward)
    np.testing.assert_allclose([reverse, difference], forward, rtol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-11)
