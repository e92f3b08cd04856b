"""Derivatives checked three ways: forward mode, reverse mode and central differences.

Along one random direction v, weighted by one random w: an error in any entry of a Jacobian J shows in J v and wᵀ J.
Nothing is compiled as a whole: one call of each does not pay for it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

# The error of a central difference is about step² of curvature plus rounding/step: 1e-10 of the value's size at best.
STEP = 1e-6
TOLERANCE = 1e-7


def assert_exact_derivative(function, *arguments):
    """The derivative of `function` by all its arguments is the same forward, in reverse, and by central differences."""
    flat, x, v = _flatten(function, arguments)
    value, forward, w, reverse = _both_ways(flat, x, v)
    difference = (flat(x + STEP * v) - flat(x - STEP * v)) / (2 * STEP)
    size = max(1.0, np.abs(value).max(), np.abs(forward).max())
    np.testing.assert_allclose(forward, difference, rtol=0, atol=TOLERANCE * size)
    np.testing.assert_allclose(w @ forward, reverse @ v, rtol=0, atol=1e-11 * size)


def assert_finite(function, *arguments):
    """Value and derivative of `function` hold no NaN and no infinity, forward and in reverse."""
    for numbers in _both_ways(*_flatten(function, arguments)):
        assert np.all(np.isfinite(numbers))


def _flatten(function, arguments):
    """The function of one vector to one vector, that vector, and a random direction."""
    x, unravel = ravel_pytree(arguments)
    v = np.random.default_rng(0).normal(size=x.size)
    return lambda x: ravel_pytree(function(*unravel(x)))[0], x, jnp.array(v)


def _both_ways(flat, x, v):
    """Value, J v, a random w, and wᵀ J."""
    value, forward = jax.jvp(flat, (x,), (v,))
    w = jnp.array(np.random.default_rng(1).normal(size=value.size))
    return value, forward, w, jax.vjp(flat, x)[1](w)[0]
