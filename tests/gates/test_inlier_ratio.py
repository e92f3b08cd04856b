"""The deletion rule: its counts and flags against a plain Python simulation."""

import jax.numpy as jnp
import numpy as np
import pytest
from gates.evidence import born, evidence, frames, observe_all, random_record
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

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
    is_suspect = rng.random(shape) < 0.2
    is_corrected &= ~(is_searched & is_suspect)
    masks = dict(is_searched=is_searched, is_measured=is_measured, is_corrected=is_corrected, is_visible=is_visible)
    masks["is_suspect"] = is_suspect
    masks = {name: jnp.asarray(value) for name, value in masks.items()}
    return random_record(seed) | {"slot": jnp.asarray(slot)} | masks


def counts_and_flags(detector, record):
    """States and flags after each frame. Nothing is deleted, so that the counts of flagged slots go on."""
    states, margins = observe_all(detector, born(detector, NUM_SLOTS), record)
    return states, np.asarray(margins) > 0


def count_plainly(detector, record):
    """The same by Python integers, one candidate after another."""
    counts = [[1, 1, 1] for _ in range(NUM_SLOTS)]
    for frame in frames(record):
        for k in range(NUM_CANDIDATES):
            if frame.is_searched[k] and not frame.is_suspect[k]:
                count = counts[frame.slot[k]]
                count[0] += 1
                count[1] += int(frame.is_measured[k])
                count[2] += int(frame.is_corrected[k])
        flags = [
            bool(frame.is_visible[i])
            and searched >= detector.min_searches
            and (found / searched < detector.min_measured_ratio or fitted / found < detector.min_corrected_ratio)
            for i, (searched, found, fitted) in enumerate(counts)
        ]
        yield [list(count) for count in counts], flags


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(5, 0.25, 0.5), (10, 0.1, 0.5), (20, 0.1, 0.7)]))
def test_counts_and_flags_are_the_plain_ones(seed, numbers):
    detector = InlierRatio(*numbers)
    record = random_evidence(seed)
    states, flags = counts_and_flags(detector, record)
    counts, expected = zip(*count_plainly(detector, record), strict=True)
    np.testing.assert_array_equal(np.stack(states, axis=-1), counts)
    np.testing.assert_array_equal(flags, expected)


def test_a_suspect_that_is_missed_in_some_frames_is_not_flagged_for_it():
    detector, found = InlierRatio(), np.arange(60) % 6 > 0
    state = born(detector, 1)
    for is_found in found:
        frame = evidence(
            [0], 1, is_measured=np.array([is_found]), is_corrected=np.array([False]), is_suspect=np.array([True])
        )
        state, margin = detector.observe(state, frame)
        assert not margin[0] > 0
    assert state == Counts(1.0, 1.0, 1.0)


def test_both_ratios_and_only_they_flag():
    def is_anything_flagged(*ratios):
        return bool(np.any(counts_and_flags(InlierRatio(5, *ratios), random_evidence(3))[1]))

    assert is_anything_flagged(1, 0)
    assert is_anything_flagged(0, 1)
    assert not is_anything_flagged(0, 0)


@pytest.mark.parametrize("found", [7, 14, 28, 57])
def test_a_ratio_exactly_at_its_bound_is_not_flagged(found):
    nobody = np.array([False])
    nothing_happens = evidence([0], 1, is_searched=nobody, is_measured=nobody, is_corrected=nobody)
    detector = InlierRatio(min_measured_ratio=found / 100)
    for num_found, is_bad in ((found, False), (found - 1, True)):
        state = Counts(*(jnp.array([float(n)]) for n in (100, num_found, num_found)))
        assert bool(detector.observe(state, nothing_happens)[1][0] > 0) == is_bad


def test_the_margin_is_the_deviance_of_a_binomial_share():
    """Twice the log likelihood ratio of the share found and its bound, by scipy, with the verdict's sign."""
    nobody = np.array([False] * 3)
    nothing_happens = evidence([0, 1, 2], 3, is_searched=nobody, is_measured=nobody, is_corrected=nobody)
    found, fitted = np.array([40, 40, 3]), np.array([30, 12, 3])
    counts = Counts(jnp.full(3, 40.0), jnp.array(found, float), jnp.array(fitted, float))
    _, margin = InlierRatio().observe(counts, nothing_happens)

    def deviance(hits, tries, bound):
        size = 2 * (stats.binom.logpmf(hits, tries, hits / tries) - stats.binom.logpmf(hits, tries, bound))
        return np.where(hits / tries < bound, size, -size)

    expected = np.maximum(deviance(found, 40, 0.1), deviance(fitted, found, 0.5))
    np.testing.assert_allclose(margin, expected, rtol=1e-9)
    assert (expected > 0).tolist() == [False, True, True]


def test_infinitely_many_searches_switch_the_rule_off():
    assert counts_and_flags(InlierRatio(5), random_evidence(1))[1].any()
    assert not counts_and_flags(InlierRatio(np.inf), random_evidence(1))[1].any()


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
