"""The deletion rule: its counts and flags against a plain Python simulation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcjax.gates.gate import Evidence
from vcjax.gates.inlier_ratio import Counts, InlierRatio

NUM_SLOTS, NUM_CANDIDATES, NUM_FRAMES = 5, 3, 40


def random_evidence(seed):
    """A run's evidence (leading axis T): some landmarks are hard to find, some fit badly, some are out of view."""
    rng = np.random.default_rng(seed)
    shape = NUM_FRAMES, NUM_CANDIDATES
    slot = np.stack([rng.permutation(NUM_SLOTS)[:NUM_CANDIDATES] for _ in range(NUM_FRAMES)])
    is_searched = rng.random(shape) < 0.9
    is_measured = rng.random(shape) < rng.choice([0.08, 0.5, 1.0], NUM_SLOTS)[slot]
    fits = rng.random(shape) < rng.choice([0.3, 0.5, 0.9], NUM_SLOTS)[slot]
    # Where not searched the rest means nothing: there anything is set.
    is_corrected = np.where(is_searched, is_measured & fits, fits)
    is_visible = rng.random((NUM_FRAMES, NUM_SLOTS)) < 0.8
    re1 = np.full(shape, np.nan)
    return tuple(map(jnp.array, (slot, is_searched, is_measured, is_corrected, re1, is_visible)))


@jax.jit
def observe_all(detector, evidence):
    """States and flags after each frame. Nothing is deleted, so that the counts of flagged slots go on."""
    state = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (NUM_SLOTS,)), detector.born())

    def observe(state, evidence):
        state, is_flagged = detector.observe(state, Evidence(*evidence))
        return state, (state, is_flagged)

    return jax.lax.scan(observe, state, evidence)[1]


def count_plainly(detector, evidence):
    """The same by Python integers, one candidate after another."""
    counts = [[1, 1, 1] for _ in range(NUM_SLOTS)]
    for slots, is_searched, is_measured, is_corrected, _, is_visible in zip(*map(np.asarray, evidence), strict=True):
        for k in range(NUM_CANDIDATES):
            if is_searched[k]:
                count = counts[slots[k]]
                count[0] += 1
                count[1] += int(is_measured[k])
                count[2] += int(is_corrected[k])
        flags = [
            bool(is_visible[i])
            and searched >= detector.min_searches
            and (found / searched < detector.min_measured_ratio or fitted / found < detector.min_corrected_ratio)
            for i, (searched, found, fitted) in enumerate(counts)
        ]
        yield [list(count) for count in counts], flags


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(5, 0.25, 0.5), (10, 0.1, 0.5), (20, 0.1, 0.7)]))
def test_counts_and_flags_are_the_plain_ones(seed, numbers):
    detector = InlierRatio(*numbers)
    evidence = random_evidence(seed)
    states, flags = observe_all(detector, evidence)
    counts, expected = zip(*count_plainly(detector, evidence), strict=True)
    np.testing.assert_array_equal(np.stack(states, axis=-1), counts)
    np.testing.assert_array_equal(flags, expected)


def test_both_ratios_and_only_they_flag():
    def is_anything_flagged(*ratios):
        return bool(np.any(observe_all(InlierRatio(5, *ratios), random_evidence(3))[1]))

    assert is_anything_flagged(1, 0)
    assert is_anything_flagged(0, 1)
    assert not is_anything_flagged(0, 0)


@pytest.mark.parametrize("found", [7, 14, 28, 57])
def test_a_ratio_exactly_at_its_bound_is_not_flagged(found):
    nothing_happens = Evidence(*map(jnp.array, ([0], [False], [False], [False], [np.nan], [True])))
    detector = InlierRatio(min_measured_ratio=found / 100)
    for num_found, is_bad in ((found, False), (found - 1, True)):
        state = Counts(*(jnp.array([float(n)]) for n in (100, num_found, num_found)))
        assert bool(detector.observe(state, nothing_happens)[1][0]) == is_bad


def test_infinitely_many_searches_switch_the_rule_off():
    assert observe_all(InlierRatio(5), random_evidence(1))[1].any()
    assert not observe_all(InlierRatio(np.inf), random_evidence(1))[1].any()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(min_searches=-1), r"InlierRatio\(min_searches=-1.0\)"),
        (dict(min_measured_ratio=1.1), r"InlierRatio\(min_measured_ratio=1.1\): .*\[0, 1\]"),
        (dict(min_corrected_ratio=-0.1), r"InlierRatio\(min_corrected_ratio=-0.1\)"),
    ],
)
def test_bad_input_is_refused_by_name_and_value(fields, message):
    with pytest.raises(ValueError, match=message):
        InlierRatio(**fields)
