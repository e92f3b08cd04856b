"""RE: accept by the threshold, recover and condemn nobody."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gates.linear_blocks import MODEL, linear_candidates

from vcjax.gates.reprojection import ReprojectionError


def test_accepts_below_the_threshold_only():
    re1 = jnp.array([0.0, 8.999, 9.0, 9.001, 1e9, np.nan])
    np.testing.assert_array_equal(ReprojectionError().accepts(re1), [1, 1, 0, 0, 0, 0])
    np.testing.assert_array_equal(ReprojectionError(th1=9.0005).accepts(re1), [1, 1, 1, 0, 0, 0])


def test_recovers_and_condemns_nobody():
    candidates = linear_candidates(0)
    verdict = ReprojectionError().judge(candidates, MODEL)
    assert not np.any(verdict.is_recovered | verdict.is_dynamic)
    assert np.all(np.isnan(verdict.re1) & np.isnan(verdict.re2))
    assert verdict.re1.shape == candidates.is_isolated.shape


def test_another_threshold_compiles_nothing_new():
    accepts = eqx.debug.assert_max_traces(lambda gate, re1: gate.accepts(re1), max_traces=1)
    accepts = jax.jit(accepts)
    assert not accepts(ReprojectionError(th1=9), jnp.array(10.0))
    assert accepts(ReprojectionError(th1=11.0), jnp.array(10.0))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(th1=0.0), r"ReprojectionError\(th1=0.0\): .*positive"),
        (dict(th1=-9), r"ReprojectionError\(th1=-9.0\)"),
        (dict(th1=np.nan), r"ReprojectionError\(th1=nan\)"),
        (dict(prior="after"), r"ReprojectionError\(prior='after'\): choose one of \('corrected', 'predicted'\)"),
    ],
)
def test_bad_input_is_refused_by_name_and_value(fields, message):
    with pytest.raises(ValueError, match=message):
        ReprojectionError(**fields)
