"""χ² with three degrees of freedom against SciPy, its inverses, and derivatives against densities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from vcjax.detectability.chi_squared import SMALL, noncentrality, quantile, survival

Q = np.array([1e-3, 0.5, 7.8, 16.3, 30.0, 80.0])
DELTA = np.array([1e-9, 1e-3, SMALL * 0.999, SMALL * 1.001, 0.3, 4.0, 30.0, 200.0, 2000.0])


def test_power_is_scipy_s():
    q, delta = np.meshgrid(Q, DELTA)
    np.testing.assert_allclose(survival(q, delta), stats.ncx2.sf(q, 3, delta), rtol=1e-8, atol=1e-13)
    np.testing.assert_allclose(survival(Q), stats.chi2.sf(Q, 3), rtol=1e-12)
    np.testing.assert_array_equal(survival(Q, -1e-9), survival(Q))  # rounding


def test_derivatives_are_densities():
    """∂P/∂δ is the density of χ²₅(δ) at q, ∂P/∂q minus that of χ²₃(δ)."""
    q, delta = (a.ravel() for a in np.meshgrid(Q, DELTA))
    by_q, by_delta = jax.vmap(jax.grad(survival, argnums=(0, 1)))(jnp.asarray(q), jnp.asarray(delta))
    np.testing.assert_allclose(by_delta, stats.ncx2.pdf(q, 5, delta), rtol=1e-7, atol=2e-11)
    np.testing.assert_allclose(by_q, -stats.ncx2.pdf(q, 3, delta), rtol=1e-7, atol=1e-12)


def test_threshold_of_a_false_alarm_rate():
    rate = np.array([1e-9, 1e-3, 0.05, 0.5, 0.99])
    np.testing.assert_allclose(quantile(rate), stats.chi2.isf(rate, 3), rtol=1e-12)
    slope = jax.vmap(jax.grad(quantile))(jnp.asarray(rate))
    np.testing.assert_allclose(slope, -1 / stats.chi2.pdf(stats.chi2.isf(rate, 3), 3), rtol=1e-9)


@pytest.mark.parametrize("power", [0.01, 0.5, 0.9, 0.999])
def test_noncentrality_gives_the_power(power):
    np.testing.assert_allclose(stats.ncx2.sf(16.3, 3, float(noncentrality(power, 16.3))), power, rtol=1e-10)
    assert noncentrality(1e-4, 16.3) == 0.0  # less than the false-alarm rate
