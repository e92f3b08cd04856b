"""VC where measurement is linear: the closed form, its limits, its relation to RE, and what is masked."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gates.linear_blocks import MODEL, errors_before_correction, linear_candidates
from hypothesis import given
from hypothesis import strategies as st

from vcjax.gates.gate import Candidates
from vcjax.gates.reprojection import ReprojectionError
from vcjax.gates.virtual_correction import VirtualCorrection

R_FULL = np.array([[1.3, 0.4], [0.4, 0.7]])
judge = jax.jit(lambda gate, candidates: gate.judge(candidates, MODEL))
thresholds = st.floats(0.01, 50)


def innovations(candidates):
    """z, Z and E = H P Hᵀ of linear candidates, in NumPy."""
    x, H = map(np.asarray, candidates.mean)
    E = H @ np.asarray(candidates.P) @ H.mT
    return np.asarray(candidates.uv_px) - np.einsum("kin,kn->ki", H, x), E + np.asarray(candidates.R), E


@pytest.mark.parametrize("R", [np.eye(2), R_FULL], ids=["identity", "full"])
def test_errors_are_the_closed_form(R):
    candidates = linear_candidates(1, num=40, R=R)
    verdict = judge(VirtualCorrection(), candidates)
    z, Z, E = innovations(candidates)
    W = Z + 2 * Z @ np.linalg.solve(R, E)
    re2 = np.einsum("ki,ki->k", z, np.linalg.solve(W, z[..., None])[..., 0])
    np.testing.assert_allclose(verdict.re1, errors_before_correction(candidates), rtol=1e-10)
    np.testing.assert_allclose(verdict.re2, re2, rtol=1e-9)
    np.testing.assert_array_equal(verdict.is_dynamic, verdict.re1 - verdict.re2 > 9.0)
    np.testing.assert_array_equal(verdict.is_recovered, ~verdict.is_dynamic)
    assert 5 < np.sum(verdict.is_dynamic) < 35


@pytest.mark.parametrize("r", [1.0, 2.25])
def test_fall_of_the_error_is_the_sum_over_eigenvalues(r):
    candidates = linear_candidates(2, num=40, R=r * np.eye(2))
    verdict = judge(VirtualCorrection(), candidates)
    z, Z, _ = innovations(candidates)
    s, u = np.linalg.eigh(Z)
    lam = s / r
    fall = np.sum(np.einsum("kji,kj->ki", u, z) ** 2 / s * (2 * lam - 2) / (2 * lam - 1), axis=1)
    np.testing.assert_allclose(verdict.re1 - verdict.re2, fall, rtol=1e-10, atol=1e-10)


@given(st.integers(0, 2**32 - 1), thresholds, thresholds)
def test_vc_deletes_a_subset_of_what_re_rejects(seed, th1, th2):
    candidates = linear_candidates(seed)
    re1 = errors_before_correction(candidates)
    vc = VirtualCorrection(th1, th2)
    isolated = eqx.tree_at(lambda c: c.is_isolated, candidates, ~vc.accepts(jnp.array(re1)))
    verdict = judge(vc, isolated)
    is_rejected = ~np.asarray(ReprojectionError(th1).accepts(jnp.array(re1)))
    np.testing.assert_array_equal(verdict.is_dynamic | verdict.is_recovered, is_rejected)
    assert not np.any(verdict.is_dynamic & verdict.is_recovered)
    assert np.all(re1[verdict.is_dynamic] > max(th1, th2))


@given(st.integers(0, 2**32 - 1), st.floats(1, 1e4))
def test_a_well_mapped_feature_is_always_recovered(seed, error):
    candidates = linear_candidates(seed)
    well_mapped = Candidates(candidates.mean, 1e-18 * candidates.P, 0 * candidates.uv_px + error, *_rest(candidates))
    verdict = judge(VirtualCorrection(th2=1e-4), well_mapped)
    assert np.all(verdict.is_recovered)


def test_an_uncertain_feature_meets_the_larger_threshold():
    candidates = linear_candidates(4, num=40)
    uncertain = eqx.tree_at(lambda c: c.P, candidates, 1e9 * candidates.P)
    x, H = map(np.asarray, uncertain.mean)
    L = np.linalg.cholesky(H @ np.asarray(uncertain.P) @ H.mT + np.eye(2))
    re1 = np.linspace(9.001, 25, 40)
    z = L[:, :, 0] * np.sqrt(re1)[:, None]
    uncertain = eqx.tree_at(lambda c: c.uv_px, uncertain, jnp.array(np.einsum("kin,kn->ki", H, x) + z))
    for th2 in (4.0, 9.0, 16.0):
        verdict = judge(VirtualCorrection(9.0, th2), uncertain)
        np.testing.assert_array_equal(verdict.is_dynamic, re1 > max(9.0, th2))


MASK = jnp.arange(8) % 3 != 0


@jax.jit
@functools.partial(jax.value_and_grad, has_aux=True)
def total_error(leaves, mask):
    """The sum over all judged candidates of a smooth function of their errors, and the verdict."""
    verdict = VirtualCorrection().judge(Candidates(*leaves, mask), MODEL)
    return jnp.sum(jnp.where(mask, verdict.re1 + jnp.sin(verdict.re2), 0.0)), verdict


@pytest.mark.parametrize("rubbish", [np.nan, np.inf, -1e200])
@pytest.mark.parametrize("mask", [MASK, ~MASK & MASK], ids=["some", "all"])
def test_masked_candidates_are_inert_in_value_and_gradient(rubbish, mask):
    clean = linear_candidates(5, is_isolated=mask)

    def replace(leaf):
        return jnp.where(jnp.reshape(mask, (-1, *(1,) * (leaf.ndim - 1))), leaf, rubbish)

    dirty = Candidates(jax.tree.map(replace, clean.mean), replace(clean.P), replace(clean.uv_px), *_rest(clean))

    (_, verdict), gradient = total_error((clean.mean, clean.P, clean.uv_px, clean.R), mask)
    (_, dirty_verdict), dirty_gradient = total_error((dirty.mean, dirty.P, dirty.uv_px, dirty.R), mask)
    jax.tree.map(np.testing.assert_array_equal, dirty_verdict, verdict)
    jax.tree.map(np.testing.assert_array_equal, dirty_gradient, gradient)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(dirty_gradient))
    np.testing.assert_array_equal(np.isnan(verdict.re1), ~mask)
    np.testing.assert_array_equal(np.isnan(verdict.re2), ~mask)
    assert not np.any((verdict.is_recovered | verdict.is_dynamic) & ~mask)
    assert np.any(gradient[1][0] != 0) == np.any(mask[0])


@pytest.mark.parametrize("place", ["mean", "P", "uv_px"])
def test_a_candidate_of_which_nothing_can_be_said_is_neither_recovered_nor_dynamic(place):
    candidates = linear_candidates(7)
    bad = eqx.tree_at(
        lambda c: getattr(c, place),
        candidates,
        jax.tree.map(lambda leaf: leaf.at[2].set(jnp.nan), getattr(candidates, place)),
    )
    verdict, expected = judge(VirtualCorrection(), bad), judge(VirtualCorrection(), candidates)
    assert np.isnan(verdict.re1[2]) and not verdict.is_recovered[2] and not verdict.is_dynamic[2]
    others = np.arange(8) != 2
    np.testing.assert_array_equal(verdict.is_recovered, expected.is_recovered & others)
    np.testing.assert_array_equal(verdict.is_dynamic, expected.is_dynamic & others)


def test_another_threshold_compiles_nothing_new():
    once = jax.jit(eqx.debug.assert_max_traces(lambda gate, c: gate.judge(c, MODEL).is_dynamic, max_traces=1))
    candidates = linear_candidates(6)
    found = [int(np.sum(once(VirtualCorrection(9.0, th2), candidates))) for th2 in (0.0, 9, 1e3)]
    assert found[0] > found[1] > found[2] == 0


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(th1=0), r"VirtualCorrection\(th1=0.0\): .*positive"),
        (dict(th2=-1.0), r"VirtualCorrection\(th2=-1.0\): .*at least 0"),
        (dict(th2=np.nan), r"VirtualCorrection\(th2=nan\)"),
        (dict(prior="after"), r"VirtualCorrection\(prior='after'\): choose one of \('corrected', 'predicted'\)"),
    ],
)
def test_bad_input_is_refused_by_name_and_value(fields, message):
    with pytest.raises(ValueError, match=message):
        VirtualCorrection(**fields)


def _rest(candidates):
    """The fields of candidates after mean, P and pixel."""
    return candidates.R, candidates.is_isolated
