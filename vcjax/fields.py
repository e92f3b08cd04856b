"""Converters for configuration fields: numbers stay traced, bad values are refused before anything compiles.

A Python float is static under `equinox.filter_jit`, so that every new threshold would compile anew. These converters
store NumPy numbers, which are traced; they start no JAX device, so configurations can be built at import. Values that
are already JAX arrays (a tracer, a swept batch) pass through unchecked. So does what is no number: a converter knows
no name, and `require` refuses it by field and value.
"""

from collections.abc import Callable
from numbers import Integral
from typing import Any

import jax.core
import numpy as np


def number(value: Any) -> Any:
    """A traced number: `numpy.float64` of a Python number; arrays pass through."""
    if isinstance(value, (jax.Array, np.ndarray)):
        return value
    try:
        return np.float64(value)
    except (TypeError, ValueError):
        return value


def vector(value: Any) -> Any:
    """A traced vector: float64 NumPy array of Python numbers; JAX arrays pass through."""
    if isinstance(value, jax.Array):
        return value
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return value


def is_concrete(value: Any) -> bool:
    """Whether a value can be looked at now, i.e. is not being traced."""
    return not isinstance(value, jax.core.Tracer)


def require(
    owner: object, name: str, condition: Callable[[np.ndarray], Any], remedy: str, length: int | None = None
) -> None:
    """Refuse a field whose value breaks a condition, naming class, field, value and remedy.

    Args:
        owner: the configuration object.
        name: its field.
        condition: from the value as a NumPy array to true where it is acceptable; NaN is never acceptable.
        remedy: what to give instead.
        length: how many numbers a vector must have (its last axis); None: any.

    Raises:
        ValueError: if it has another length, any element is no number, NaN or breaks the condition. Of traced values
            only the length is checked.
    """
    value, owner_name = getattr(owner, name), type(owner).__name__
    try:
        array = np.asarray(value, np.float64) if is_concrete(value) else value
    except (TypeError, ValueError):
        raise ValueError(f"{owner_name}({name}={value!r}) is no number: {remedy}") from None
    if length is not None and array.shape[-1:] != (length,):
        raise ValueError(f"{owner_name}({name}) has shape {array.shape}, but {length} numbers are needed: {remedy}")
    if is_concrete(value) and (np.any(np.isnan(array)) or not np.all(condition(array))):
        raise ValueError(f"{owner_name}({name}={np.asarray(value).tolist()}): {remedy}")


def require_count(owner: object, name: str, minimum: int) -> None:
    """Refuse a static field that is no whole number, or below a minimum.

    Raises:
        ValueError: naming class, field, value and remedy.
    """
    value = getattr(owner, name)
    if not isinstance(value, Integral) or value < minimum:
        raise ValueError(f"{type(owner).__name__}({name}={value!r}): give a whole number of at least {minimum}.")
