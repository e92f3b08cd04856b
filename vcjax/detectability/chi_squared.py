"""The χ² distribution with three degrees of freedom, central and non-central, differentiable in all its arguments.

For three (any odd number of) degrees of freedom the non-central distribution has a closed form. With a = √δ, b = √q and
Q the upper tail of the normal distribution,

    P(χ²₃(δ) > q) = Q(b - a) + Q(b + a) + (e^(-(b - a)²/2) - e^(-(b + a)²/2)) / (a √(2π)).

Near δ = 0, where this is 0/0, the first terms of the Poisson mixture Σ_j e^(-δ/2) (δ/2)^j / j! P(χ²_(3+2j) > q) serve.

References:
    Johnson, Kotz, Balakrishnan 1995, "Continuous univariate distributions", volume 2, chapter 29.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Number = float | Float[Array | np.ndarray, "..."]
"""One number or an array of them; several arguments are broadcast."""
SMALL = 1e-2
"""δ below which the mixture is used: five terms of it are exact to 3e-14, their derivative to 2e-11."""
_TERMS = 5
_HALVINGS = 60
_FAR = 40.0
"""Standard deviations beyond which a normal tail is 0 in double precision."""


def survival(q: Number, noncentrality: Number = 0.0) -> Float[Array, "..."]:
    """P(χ²₃(δ) > q), the power of a test. Derivative exact.

    Args:
        q: threshold, positive.
        noncentrality: δ, at least 0; below 0, as rounding makes it, it counts as 0.
    """
    q, delta = jnp.broadcast_arrays(jnp.asarray(q, float), jnp.asarray(noncentrality, float))
    delta = jnp.maximum(delta, 0.0)
    is_small, b = delta < SMALL, jnp.sqrt(q)
    a = jnp.sqrt(jnp.where(is_small, 1.0, delta))
    gap = -jnp.exp(-0.5 * (b - a) ** 2) * jnp.expm1(-2.0 * a * b)
    closed = _tail(b - a) + _tail(b + a) + gap / (a * jnp.sqrt(2.0 * jnp.pi))
    return jnp.where(is_small, _mixture(q, jnp.where(is_small, delta, 0.0)), closed)


def density(q: Number) -> Float[Array, "..."]:
    """The density of χ²₃ at q. Derivative exact."""
    q = jnp.asarray(q, float)
    return jnp.sqrt(q / (2.0 * jnp.pi)) * jnp.exp(-0.5 * q)


def quantile(false_alarm_rate: Number) -> Float[Array, "..."]:
    """The threshold q that χ²₃ exceeds with a probability in (0, 1). Derivative exact."""
    rate = jnp.asarray(false_alarm_rate, float)
    q = jax.lax.stop_gradient(_bisect(lambda b: survival(b * b) > rate, jnp.zeros_like(rate), _FAR) ** 2)
    q = jnp.maximum(q, jnp.finfo(q.dtype).tiny)
    return q + (survival(q) - rate) / jax.lax.stop_gradient(density(q))  # one step of Newton's carries the derivative


def noncentrality(power: Number, q: Number) -> Float[Array, "..."]:
    """The δ with which χ²₃(δ) exceeds q with probability `power`; 0 where δ = 0 suffices. Derivative zero."""
    power, q = jnp.broadcast_arrays(jnp.asarray(power, float), jnp.asarray(q, float))
    low = _bisect(lambda a: survival(q, a * a) < power, jnp.zeros_like(q), jnp.sqrt(q) + _FAR)
    return jnp.where(survival(q) >= power, 0.0, jax.lax.stop_gradient(low**2))


def _tail(x: Float[Array, "..."]) -> Float[Array, "..."]:
    return 0.5 * jax.scipy.special.erfc(x / jnp.sqrt(2.0))


def _mixture(q: Float[Array, "..."], delta: Float[Array, "..."]) -> Float[Array, "..."]:
    """P(χ²₃(δ) > q) for small δ; P(χ²_(k+2) > q) is P(χ²_k > q) plus twice the density of χ²_(k+2)."""
    tail, density_k = 2.0 * _tail(jnp.sqrt(q)) + 2.0 * density(q), density(q)
    weight, total = jnp.exp(-0.5 * delta), jnp.zeros_like(q)
    for j in range(_TERMS):
        total = total + weight * tail
        density_k = density_k * q / (3 + 2 * j)
        tail = tail + 2.0 * density_k
        weight = weight * 0.5 * delta / (j + 1)
    return total


def _bisect(is_below, low: Float[Array, "..."], high) -> Float[Array, "..."]:
    """Where a condition that holds from `low` on stops to hold, by halving."""

    def halve(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        below = is_below(middle)
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (low, jnp.broadcast_to(high, low.shape).astype(low.dtype)))
    return 0.5 * (low + high)
