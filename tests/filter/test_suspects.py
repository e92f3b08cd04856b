"""Landmarks that the detector suspects, in whole runs: measured, tested, and left out until they are harmless."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from filter_runs import CAPACITY, filtered, head, recorded

from vcjax.filter.config import FilterConfig
from vcjax.gates.either import Either
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.velocity_glr import VelocityGLR
from vcjax.gates.virtual_correction import VirtualCorrection

NUM_FRAMES = 60


def states_and_infos(suspect: float | None):
    detector = VelocityGLR(threshold=25.0, suspect=suspect)
    config = FilterConfig(gate=VirtualCorrection(), detector=detector, max_landmarks=CAPACITY, max_updates=20)
    recording = head(recorded(seed=3, dynamic="lateral", dynamic_speed_m_s=0.25), NUM_FRAMES)
    return detector, list(filtered(config, recording))


def test_where_nobody_is_suspect_nothing_changes():
    _, plain = states_and_infos(None)
    _, careful = states_and_infos(24.999)
    first = next(
        t for t, (_, info) in enumerate(careful) if (info.detector_margin > -0.001).any()
    )  # from there on somebody may be suspect
    assert first > 5
    for (state, info), (other, other_info) in zip(plain[:first], careful[:first], strict=True):
        # Two programs, which need not round alike.
        same = functools.partial(np.testing.assert_allclose, rtol=1e-7, atol=1e-10)
        jax.tree.map(same, (state, info), (other, other_info))


def test_who_is_suspect_is_left_out_until_it_calms_down():
    detector, run = states_and_infos(4.0)
    num_left_out = num_back = 0
    suspects_before: set[int] = set()
    ever: set[int] = set()
    for (before, _), (_, info) in itertools.pairwise(run):
        suspicion = np.asarray(detector.suspicion(before.detector))
        suspects = set(np.asarray(before.track_id)[(suspicion > 0) & np.asarray(before.is_mapped)].tolist())
        is_suspect = np.isin(info.candidate_id, list(suspects)) & info.is_measured
        used = info.is_accepted | info.is_recovered
        np.testing.assert_array_equal(info.is_suspect, is_suspect)
        assert not (used | info.is_dynamic)[is_suspect].any()
        # It is looked at as closely as the others: its innovation is there, and finite.
        assert np.isfinite(info.innovation[is_suspect]).all() and np.isfinite(info.re1[is_suspect]).all()
        num_left_out += int(is_suspect.sum())
        ever |= suspects_before
        num_back += int((used & np.isin(info.candidate_id, list(ever - suspects))).sum())
        suspects_before = suspects
    assert num_left_out > 20 and num_back > 5
    flagged = np.concatenate([info.inconsistent_id for _, info in run])
    assert (flagged >= 0).any() and jnp.all(jnp.array([info.is_finite for _, info in run]))


def test_no_other_detector_flags_a_landmark_for_having_been_suspect():
    """Nothing moves; what is left out as suspect has not failed to fit."""
    both = Either(VelocityGLR(threshold=1e9, suspect=1.0), InlierRatio())
    config = FilterConfig(gate=VirtualCorrection(), detector=both, max_landmarks=CAPACITY, max_updates=20)
    infos = [info for _, info in filtered(config, head(recorded(seed=3), NUM_FRAMES))]
    assert np.sum([info.is_suspect for info in infos]) > 100
    assert not (np.concatenate([info.inconsistent_id for info in infos]) >= 0).any()
