"""Derivatives checked three ways: forward mode, reverse mode and central differences."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

# The error of a central difference is about step² of curvature plus rounding/step: 1e-10 of the value's size at best.
STEP = 1e-6
TOLERANCE = 1e-7


def assert_exact_derivative(function, *arguments):
    """The derivative of `function` by all its arguments is the same forward, in reverse, and by central differences."""
    x, unravel = ravel_pytree(arguments)

    def flat(x):
        return ravel_pytree(function(*unravel(x)))[0]

    forward, reverse = jax.jit(jax.jacfwd(flat))(x), jax.jit(jax.jacrev(flat))(x)
    steps = STEP * jnp.eye(len(x))
    ahead, behind = jax.jit(jax.vmap(flat))(x + steps), jax.jit(jax.vmap(flat))(x - steps)
    size = max(1.0, np.abs(forward).max(), np.abs(flat(x)).max())
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(forward, (ahead - behind).T / (2 * STEP), rtol=0, atol=TOLERANCE * size)


def assert_finite(function, *arguments):
    """Value and derivative of `function` hold no NaN and no infinity, forward and in reverse."""
    x, unravel = ravel_pytree(arguments)

    def flat(x):
        return ravel_pytree(function(*unravel(x)))[0]

    for f in (flat, jax.jacfwd(flat), jax.jacrev(flat)):
        assert np.all(np.isfinite(jax.jit(f)(x)))
