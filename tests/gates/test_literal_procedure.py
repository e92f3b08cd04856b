"""VC on 21 × 21 blocks is the paper's section 3 taken literally: a full copy of the state, fully corrected.

The copy is the reference filter's, in plain NumPy: all of x and P, N = 14 + 7 or 3 for each landmark, with its own
projection and derivatives.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference.ekf_slam import EkfSlam, Landmark, Options

from vcjax.filter.config import FilterConfig
from vcjax.filter.features import Block, measurement_model
from vcjax.gates.gate import Candidates
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.models.camera import Camera
from vcjax.models.landmarks import euclidean, to_point, to_point_jacobian

NUM_AHP, NUM_EUCLIDEAN = 5, 3
NUM = NUM_AHP + NUM_EUCLIDEAN
judge = jax.jit(lambda gate, c: gate.judge(c, measurement_model(FilterConfig(), Camera())))


def random_state(seed):
    """Vehicle (14,), landmarks (NUM, 7), their coordinates' derivatives (NUM, 7, 7) and a dense P over all of them."""
    rng = np.random.default_rng(seed)
    mount = np.array([0.0, 0.0, 0.6, 0.5, -0.5, 0.5, -0.5])
    vehicle = np.concatenate([[0, 0, 0, 1, 0, 0, 0], mount]) + 0.03 * rng.normal(size=14)  # quaternions off unit length
    anchor = rng.normal([0, 0, 0.6], 0.3, size=(NUM, 3))
    direction = np.column_stack([np.ones(NUM), rng.uniform(-0.5, 0.5, (NUM, 2))])
    ahp = np.column_stack([anchor, direction, rng.uniform(0.02, 0.3, NUM)])
    landmarks, T = ahp.copy(), np.stack([np.eye(7)] * NUM)
    for j in range(NUM_AHP, NUM):
        landmarks[j] = euclidean(to_point(jnp.array(ahp[j])))
        T[j] = np.concatenate([to_point_jacobian(jnp.array(ahp[j])), np.zeros((4, 7))])
    N = 14 + 7 * NUM
    A = rng.normal(size=(N, N)) / np.sqrt(N)
    std = np.concatenate([[0.05] * 3 + [0.01] * 4, [0.01] * 3 + [0.002] * 4, *[[0.05] * 3 + [0.02] * 3 + [0.05]] * NUM])
    return vehicle, landmarks, T, std[:, None] * (A @ A.T) * std


def full_copy(vehicle, landmarks, T, P):
    """The reference filter at this state, where a Euclidean landmark has three rows."""
    filter = EkfSlam(Options(), [320.0, 240.0, 320.0, 320.0], vehicle[:7], vehicle[7:], np.zeros((14, 14)))
    sizes = [7] * NUM_AHP + [3] * NUM_EUCLIDEAN
    filter.landmarks = [Landmark(id=j, size=size) for j, size in enumerate(sizes)]
    G = np.zeros((14 + sum(sizes), len(P)))
    G[:14, :14] = np.eye(14)
    for j, row in enumerate(14 + np.cumsum([0, *sizes[:-1]])):
        G[row : row + sizes[j], 14 + 7 * j : 21 + 7 * j] = T[j, : sizes[j]]
    filter.x = np.concatenate([vehicle, *(landmark[:size] for landmark, size in zip(landmarks, sizes, strict=True))])
    filter.P = G @ P @ G.T
    return filter


@pytest.mark.parametrize("seed", range(4))
def test_blocks_give_what_a_full_copy_gives(seed):
    vehicle, landmarks, T, P = random_state(seed)
    filter = full_copy(vehicle, landmarks, T, P)
    rng = np.random.default_rng(100 + seed)
    pixel, errors = np.zeros((NUM, 2)), np.zeros((NUM, 2))
    for j in range(NUM):
        e_hat, _, _, _, Z, _ = filter.innovate(j, np.zeros(2))
        pixel[j] = e_hat + np.linalg.cholesky(Z) @ (4 * rng.normal(size=2))
        errors[j] = filter.virtual_correction(j, pixel[j])

    rows = [np.r_[0:14, 14 + 7 * j : 21 + 7 * j] for j in range(NUM)]
    candidates = Candidates(
        mean=Block(jnp.stack([vehicle] * NUM), jnp.array(landmarks), jnp.array(T)),
        P=jnp.stack([P[np.ix_(r, r)] for r in rows]),
        uv_px=jnp.array(pixel),
        R=jnp.eye(2),
        is_isolated=jnp.ones(NUM, bool),
    )
    th2 = np.median(errors[:, 0] - errors[:, 1])
    verdict = judge(VirtualCorrection(th2=th2), candidates)
    np.testing.assert_allclose(np.stack([verdict.re1, verdict.re2], 1), errors, rtol=1e-10)
    np.testing.assert_array_equal(verdict.is_dynamic, errors[:, 0] - errors[:, 1] > th2)
    assert np.sum(verdict.is_dynamic) == NUM / 2
