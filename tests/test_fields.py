"""Configuration fields: numbers stay traced, bad values are refused by class, field and value."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vcjax.fields import number, require, require_count, vector


class Box(eqx.Module):
    """A configuration with one field of each kind."""

    width: float = eqx.field(converter=number, default=1.0)
    corner: tuple[float, float] = eqx.field(converter=vector, default=(0.0, 0.0))
    count: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        require(self, "width", lambda w: ~(w <= 0), "give a positive width.")  # a condition that NaN would pass
        require(self, "corner", np.isfinite, "give a place.", length=2)
        require_count(self, "count", 1)


@pytest.mark.parametrize("width", [2, 2.0, "2", np.float32(2), np.array(2.0), jnp.array(2.0)])
def test_a_number_is_a_traced_leaf(width):
    leaves = jax.tree.leaves(Box(width))
    assert leaves[0] == 2.0
    assert all(isinstance(leaf, np.ndarray | np.number | jax.Array) for leaf in leaves)


def test_arrays_pass_through_untouched():
    for array in (jnp.array([1.0, 2.0]), np.array([1.0, 2.0])):
        assert Box(array).width is array
        assert Box(corner=array).corner is array


def test_another_value_compiles_nothing_new():
    num_traces = 0

    @eqx.filter_jit
    def area(box):
        nonlocal num_traces
        num_traces += 1
        return box.width * box.corner[0]

    assert (area(Box(2.0, (3.0, 0.0))), area(Box(5, [1, 0]))) == (6.0, 5.0)
    assert num_traces == 1


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(width=-1), r"Box\(width=-1.0\): give a positive width."),
        (dict(width=np.nan), r"Box\(width=nan\)"),
        (dict(width=None), r"Box\(width=None\)|Box\(width=nan\)"),
        (dict(width="wide"), r"Box\(width='wide'\) is no number"),
        (dict(width=jnp.array([1.0, -2.0])), r"Box\(width=\[1.0, -2.0\]\)"),
        (dict(corner=(1.0, np.inf)), r"Box\(corner=\[1.0, inf\]\): give a place."),
        (dict(corner=(1.0, 2.0, 3.0)), r"Box\(corner\) has shape \(3,\), but 2 numbers"),
        (dict(corner=jnp.zeros((2, 3))), r"Box\(corner\) has shape \(2, 3\)"),
        (dict(corner=((1.0, 2.0), (3.0,))), r"Box\(corner=.*is no number"),
        (dict(count=0), r"Box\(count=0\): give a whole number of at least 1"),
        (dict(count=1.5), r"Box\(count=1.5\)"),
    ],
)
def test_a_bad_value_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Box(**fields)


def test_traced_values_are_checked_for_their_length_only():
    jax.jit(lambda w: Box(w).width)(-1.0)
    with pytest.raises(ValueError, match=r"Box\(corner\) has shape \(3,\)"):
        jax.jit(lambda corner: Box(corner=corner).corner)(jnp.zeros(3))


def test_swept_values_have_a_leading_axis():
    assert Box(corner=np.zeros((5, 2))).corner.shape == (5, 2)
