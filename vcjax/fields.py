"""Converters for configuration fields: numbers stay traced, bad values are refused before anything compiles.

A Python float is static under `equinox.filter_jit`, so that every new threshold would compile anew. These converters store
NumPy numbers, which are traced; they start no JAX device, so configurations can be built at import. Values that are already
JAX arrays (a tracer, a swept batch) pass through unchecked.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def number(value: Any) -> Any:
    """A traced number: `numpy.float64` of a Python number; arrays pass through."""
    if isinstance(value, (jax.Array, np.ndarray)):
        return value
    return np.float64(value)


def vector(length: int | None = None) -> Callable[[Any], Any]:
    """A converter to a float vector of `length` (any length if None); JAX arrays pass through."""

    def convert(value: Any) -> Any:
        if isinstance(value, jax.Array):
            return value
        array = np.asarray(value, np.float64)
        if length is not None and array.shape[-1:] != (length,):
            raise ValueError(f"expected {length} numbers, got {value!r} of shape {array.shape}.")
        return array

    return convert


def is_concrete(value: Any) -> bool:
    """Whether a value can be looked at now, i.e. is not being traced."""
    return not isinstance(value, jax.core.Tracer)


def require(owner: object, name: str, condition: Callable[[np.ndarray], Any], remedy: str) -> None:
    """Refuse a field whose value breaks a condition, naming class, field, value and remedy.

    Args:
        owner: the configuration object.
        name: its field.
        condition: from the value as a NumPy array to true where it is acceptable; NaN is never acceptable.
        remedy: what to give instead.

    Raises:
        ValueError: if any element is NaN or breaks the condition. Traced values are not checked.
    """
    value = getattr(owner, name)
    if not is_concrete(value):
        return
    array = np.asarray(value)
    if np.any(np.isnan(array)) or not np.all(condition(array)):
        raise ValueError(f"{type(owner).__name__}({name}={array.tolist()}): {remedy}")
