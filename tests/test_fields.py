"""Configuration fields: numbers stay traced, bad values are refused by class, field and value."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vcjax.fields import number, require, require_choice, require_count, require_key, require_kind, vector


class Box(eqx.Module):
    """A configuration with one field of each kind."""

    width: float = eqx.field(converter=number, default=1.0)
    corner: tuple[float, float] = eqx.field(converter=vector, default=(0.0, 0.0))
    count: int = eqx.field(static=True, default=1)
    kind: str | bool = eqx.field(static=True, default="plain")

    def __check_init__(self):
        require(self, "width", lambda w: ~(w <= 0), "give a positive width.")  # a condition that NaN would pass
        require(self, "corner", np.isfinite, "give a place.", length=2)
        require_count(self, "count", 1)
        require_choice(self, "kind", ("plain", True))


@pytest.mark.parametrize("width", [2, 2.0, "2", [2], np.float32(2), np.array(2.0), np.array([[2.0]]), jnp.array(2.0)])
def test_a_number_is_a_traced_leaf(width):
    leaves = jax.tree.leaves(Box(width))
    assert leaves[0] == 2.0
    assert all(isinstance(leaf, np.ndarray | np.number | jax.Array) for leaf in leaves)


def test_jax_arrays_pass_through_untouched():
    """They are a batch for `vmap`, or traced."""
    array = jnp.array([1.0, 2.0])
    assert Box(array).width is array
    assert Box(corner=array).corner is array
    widths = jax.vmap(lambda w: 2 * Box(w).width)(array)
    np.testing.assert_array_equal(widths, [2, 4])


def test_a_vector_of_jax_numbers_is_a_jax_array():
    corner = jax.jit(lambda w: Box(corner=(w, 3.0)).corner)(2.0)
    np.testing.assert_array_equal(corner, [2, 3])


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
        (dict(width=None), r"Box\(width=None\): give a positive width"),
        (dict(width=np.ones(3)), r"Box\(width\) has shape \(3,\), but one number is needed: .* `sweep` .* `jax.vmap`"),
        (dict(width=[1, 2]), r"Box\(width\) has shape \(2,\), but one number"),
        (dict(width=[]), r"Box\(width\) has shape \(0,\), but one number"),
        (dict(corner=np.zeros((5, 2))), r"Box\(corner\) has shape \(5, 2\), but one vector is needed: .* `sweep`"),
        (dict(kind="other"), r"Box\(kind='other'\): choose one of \('plain', True\)"),
        (dict(kind=1), r"Box\(kind=1\): choose one of"),
        (dict(count=True), r"Box\(count=True\): give a whole number"),
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
    assert Box(corner=jnp.zeros((5, 2))).corner.shape == (5, 2)


@pytest.mark.parametrize("key", [jax.random.key(3), jax.random.PRNGKey(3)])
def test_a_random_key_is_one_of_either_style(key):
    require_key("draw", key)
    jax.jit(lambda key: require_key("draw", key))(key)
    for bad in (jnp.stack([key, key]), key[:0] if key.ndim else None, 3, "key", jnp.zeros(2)):
        with pytest.raises(ValueError, match=r"draw\(key=.*\): give one random key, e.g. jax.random.key\(0\)"):
            require_key("draw", bad)


def test_what_is_of_another_kind_is_named_shortly():
    require_kind("draw", "box", Box(), Box, "give a Box.")
    with pytest.raises(ValueError, match=r"^draw\(box=None\): give a Box.$"):
        require_kind("draw", "box", None, Box, "give a Box.")
    with pytest.raises(ValueError, match=r"^draw\(box=<ndarray>\): give a Box.$"):
        require_kind("draw", "box", np.arange(100), Box, "give a Box.")
