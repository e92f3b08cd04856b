"""White innovations against two Kalman filters: one that leaves measurements out, and one that takes them all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gates.evidence import evidence

from vcjax.gates.left_out import LeftOut, nothing_left_out, whiten_innovations

NUM, FRAMES = 6, 30
R = np.array([[1.5, 0.3], [0.3, 0.8]])
whiten_once = jax.jit(whiten_innovations)


def kalman(x, P, y, H, is_used):
    """Innovations z, S and P Hᵀ of all tracks, and the state after correcting those that are used."""
    z, PH = y - np.einsum("rai,ri->ra", H, x), P @ H.mT
    S = H @ PH + R
    K = PH @ np.linalg.inv(S)
    used = is_used[:, None, None]
    corrected = np.where(is_used[:, None], x + np.einsum("ria,ra->ri", K, z), x)
    return (z, S, PH, K), corrected, np.where(used, P - K @ S @ K.mT, P)


def fresh(num):
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), nothing_left_out())


@pytest.mark.parametrize("share_used", [1.0, 0.6, 0.0])
def test_they_are_those_of_a_filter_that_takes_everything(share_used):
    rng = np.random.default_rng(1)
    P = np.tile(np.diag([0.1, 0.2, 0.1, 0.02, 0.02, 0.02, 0.3]), (NUM, 1, 1))
    x, true = np.zeros((NUM, 7)), np.einsum("rij,rj->ri", np.linalg.cholesky(P), rng.standard_normal((NUM, 7)))
    whole_x, whole_P, state = x, P, fresh(NUM)
    for _ in range(FRAMES):
        H = rng.normal(size=(NUM, 2, 7)) * np.array([3, 3, 3, 5, 5, 5, 2])
        y = np.einsum("rai,ri->ra", H, true) + rng.multivariate_normal(np.zeros(2), R, NUM)
        is_used, is_measured = rng.random(NUM) < share_used, rng.random(NUM) < 0.8
        (z, S, PH, _), x, P = kalman(x, P, y, H, is_used & is_measured)
        (expected_z, expected_S, _, expected_K), whole_x, whole_P = kalman(whole_x, whole_P, y, H, is_measured)
        frame = evidence(
            np.arange(NUM),
            NUM,
            is_measured=is_measured,
            is_corrected=is_used & is_measured,
            innovation=z,
            innovation_cov=S,
            H=H,
            PH=PH,
            pixel_cov=R,
        )
        state, white = whiten_once(state, frame)
        for found, expected in zip(white, (expected_z, expected_S, expected_K), strict=True):
            np.testing.assert_allclose(found[is_measured], expected[is_measured], rtol=1e-8, atol=1e-10)
        assert not np.asarray(white.z)[~is_measured].any() and not np.asarray(white.gain)[~is_measured].any()
        np.testing.assert_allclose(state.offset, whole_x - x, rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(state.cov, P - whole_P, rtol=1e-7, atol=1e-10)
    if share_used == 1.0:
        np.testing.assert_allclose(state.cov, 0.0, atol=1e-12)
    else:
        assert np.abs(state.offset).max() > 0.01


def test_where_the_estimates_have_drifted_apart_they_begin_anew():
    """More is left out than the filter is unsure of: H D Hᵀ beyond S."""
    state = LeftOut(jnp.ones((1, 7)), 10.0 * jnp.eye(7)[None])
    H, PH = np.ones((1, 2, 7)) * np.array([[1.0], [0.5]]), np.full((1, 7, 2), 0.1)
    frame = evidence([0], 1, innovation=np.array([[2.0, 1.0]]), innovation_cov=3 * np.eye(2)[None], H=H, PH=PH)
    found, expected = whiten_once(state, frame), whiten_once(fresh(1), frame)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)
