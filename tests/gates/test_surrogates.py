"""Decisions as weights: what is hard, what is soft, and what derivative each declares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special

from vcjax.gates.surrogates import SMOOTHINGS, decide

MARGINS = st.floats(-1e6, 1e6, allow_subnormal=False)
TEMPERATURES = st.floats(1e-3, 1e3)


def weight_and_slopes(smoothing, margin, temperature):
    """The weight and its derivative by the margin, in forward and in reverse mode."""

    def weight(m):
        return decide(smoothing, m, temperature)

    margin = jnp.asarray(margin)
    _, forward = jax.jvp(weight, (margin,), (jnp.ones(()),))
    return float(weight(margin)), float(forward), float(jax.grad(weight)(margin))


@given(MARGINS, TEMPERATURES)
def test_hard_and_straight_through_decide_the_same(margin, temperature):
    hard, *slopes = weight_and_slopes("hard", margin, temperature)
    assert hard == (margin > 0) and slopes == [0.0, 0.0]
    straight, *slopes = weight_and_slopes("straight_through", margin, temperature)
    soft, *true_slopes = weight_and_slopes("soft", margin, temperature)
    assert straight == hard and slopes == pytest.approx(true_slopes, rel=1e-12)
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-12) and 0 <= slopes[0] <= 0.25 / temperature * (1 + 1e-12)
    assert 0 <= soft <= 1 and soft == pytest.approx(special.expit(margin / temperature))


def test_slope_is_the_finite_difference_of_the_soft_weight():
    margin, temperature, h = np.linspace(-4, 6, 11), 1.3, 1e-5
    low, high = (np.asarray(decide("soft", jnp.asarray(margin + s), temperature)) for s in (-h, h))
    slope = jax.vmap(jax.grad(lambda m: decide("straight_through", m, temperature)))(jnp.asarray(margin))
    np.testing.assert_allclose(slope, (high - low) / (2 * h), rtol=1e-8)


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_what_cannot_be_said_has_weight_and_derivative_zero(smoothing):
    assert weight_and_slopes(smoothing, np.nan, 1.0) == (0.0, 0.0, 0.0)
    for margin, weight in ((np.inf, 1.0), (-np.inf, 0.0), (0.0, 0.5 if smoothing == "soft" else 0.0)):
        found, *slopes = weight_and_slopes(smoothing, margin, 1.0)
        assert found == weight and np.isfinite(slopes).all()
