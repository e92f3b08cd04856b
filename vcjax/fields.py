"""Converters for configuration fields: numbers stay traced, bad values are refused before anything compiles.

A Python float is static under `equinox.filter_jit`, so that every new threshold would compile anew. These converters
store NumPy numbers, which are traced; they start no JAX device, so configurations can be built at import. Values that
are already JAX arrays (a tracer, a batch for `vmap`) pass through. So does what is no number, or not one number: a
converter knows no name, and `require` refuses it by field and value.
"""

import dataclasses
from collections.abc import Callable, Sequence
from numbers import Integral
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np


def number(value: Any) -> Any:
    """A traced number: `numpy.float64` of a Python number or of an array of one; JAX arrays pass through."""
    if value is None or isinstance(value, jax.Array):
        return value
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return value
    return np.float64(array.item()) if array.size == 1 else array


def vector(value: Any) -> Any:
    """A traced vector: float64 NumPy array of Python numbers; JAX arrays pass through, and make one with others."""
    if any(isinstance(part, jax.Array) for part in jax.tree.leaves(value)):
        return jnp.asarray(value)
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return value


def is_concrete(value: Any) -> bool:
    """Whether a value can be looked at now, i.e. is not being traced."""
    return not isinstance(value, jax.core.Tracer)


def require(
    owner: object, name: str, condition: Callable[[np.ndarray], Any], remedy: str, length: int | None = 0
) -> None:
    """Refuse a field whose value breaks a condition, naming class, field, value and remedy.

    Args:
        owner: the configuration object.
        name: its field.
        condition: from the value as a NumPy array to true where it is acceptable; NaN is never acceptable.
        remedy: what to give instead.
        length: 0 for a number; for a vector how many numbers it must have; None: any shape. JAX arrays may have
            leading axes, as batches for `vmap`.

    Raises:
        ValueError: if it has another shape, any element is no number, NaN or breaks the condition. Of traced values
            only the length is checked.
    """
    value, owner_name = getattr(owner, name), type(owner).__name__
    try:
        array = np.asarray(value, np.float64) if is_concrete(value) else value
    except (TypeError, ValueError):
        raise ValueError(f"{owner_name}({name}={value!r}) is no number: {remedy}") from None
    if length and array.shape[-1:] != (length,):
        raise ValueError(f"{owner_name}({name}) has shape {array.shape}, but {length} numbers are needed: {remedy}")
    if length is not None and not isinstance(value, jax.Array) and array.ndim != (length > 0):
        raise ValueError(
            f"{owner_name}({name}) has shape {array.shape}, but {'one vector' if length else 'one number'} is needed: "
            "for several values use `sweep` of `monte_carlo`, or a JAX array and `jax.vmap`."
        )
    if is_concrete(value) and (np.any(np.isnan(array)) or not np.all(condition(array))):
        shown = np.asarray(value).tolist() if array.size <= 16 else f"<{array.shape} numbers, {_range(array)}>"
        raise ValueError(f"{owner_name}({name}={shown}): {remedy}")


def require_count(owner: object, name: str, minimum: int, maximum: int | None = None) -> None:
    """Refuse a static field that is no whole number, below a minimum, or above a maximum.

    Raises:
        ValueError: naming class, field, value and remedy.
    """
    value = getattr(owner, name)
    require_whole(type(owner).__name__, name, value, minimum)
    if maximum is not None and value > maximum:
        raise ValueError(f"{type(owner).__name__}({name}={value}): give at most {maximum}.")


def require_whole(owner: str, name: str, value: object, minimum: int) -> None:
    """Refuse an argument that is no whole number, or below a minimum; truth values are none.

    Raises:
        ValueError: naming owner, name, value and remedy.
    """
    if not isinstance(value, Integral) or isinstance(value, bool) or value < minimum:
        raise ValueError(f"{owner}({name}={_shown(value)}): give a whole number of at least {minimum}.")


def require_choice(owner: object, name: str, choices: Sequence[str | bool | None]) -> None:
    """Refuse a static field that is none of the choices.

    Raises:
        ValueError: naming class, field, value and the choices.
    """
    value = getattr(owner, name)
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        raise ValueError(f"{type(owner).__name__}({name}={value!r}): choose one of {tuple(choices)}.")


def require_kind(owner: str, name: str, value: object, kind: type | tuple[type, ...], remedy: str) -> None:
    """Refuse an argument or field that is of another class than is needed.

    Args:
        owner: the function or class it is given to.
        name: its name there.
        value: what was given.
        kind: the class it must be of, or the classes of which it must be one.
        remedy: what to give instead.

    Raises:
        ValueError: naming owner, name, what was given and remedy.
    """
    if not isinstance(value, kind):
        raise ValueError(f"{owner}({name}={_shown(value)}): {remedy}")


def require_single(function: str, tree: Any) -> None:
    """Refuse a configuration object, or one nested in it, with several values where a number is needed.

    JAX arrays of any shape may be its fields, to be taken apart by `vmap`; what is not taken apart ends here.

    Raises:
        ValueError: naming function, class, field, shape and remedy.
    """
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        if dataclasses.is_dataclass(value):
            require_single(function, value)
        elif field.type is float and np.ndim(value) > 0:
            raise ValueError(
                f"{function}: {type(tree).__name__}({field.name}) has shape {np.shape(value)}, but one number is "
                "needed: for several values use `sweep` of `monte_carlo`, or `jax.vmap`."
            )


def require_key(owner: str, key: object) -> None:
    """Refuse what is not one random key, new style or raw (two unsigned numbers of 32 bits).

    Raises:
        ValueError: naming owner, what was given and remedy.
    """
    if isinstance(key, jax.Array):
        is_typed = jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
        if key.shape == () if is_typed else (key.shape == (2,) and key.dtype == np.uint32):
            return
    found = f"{key.dtype}{list(key.shape)}" if isinstance(key, jax.Array) else _shown(key)
    raise ValueError(f"{owner}(key={found}): give one random key, e.g. jax.random.key(0).")


def _range(array: np.ndarray) -> str:
    """From where to where an array's numbers go, or that some are none."""
    return f"{array.min()} to {array.max()}" if np.all(np.isfinite(array)) else "some not finite"


def _shown(value: object) -> str:
    """A value in a message: as Python shows it, or its class where that is long."""
    text = repr(value)
    return text if len(text) <= 60 and "\n" not in text else f"<{type(value).__name__}>"
