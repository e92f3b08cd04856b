"""Iterated corrections: an innovation linearised where its correction leads to, against a least-squares solver."""

import jax.numpy as jnp
import numpy as np
from filter_runs import filtered, head, recorded
from scipy.optimize import least_squares

from vcjax.filter.config import FilterConfig
from vcjax.filter.correction import innovate
from vcjax.filter.features import move, observe
from vcjax.filter.submap import block, gather


def test_re1_is_the_least_that_state_and_pixel_have_to_come_up_for():
    """With P = L Lᵀ and the block moved by s = L a, RE₁ is the minimum of |a|² + |y - h(x + L a)|²/σ²."""
    recording = head(recorded(0, robot="curved"), 4)
    config = FilterConfig(max_landmarks=11, max_updates=4)
    *_, (state, _) = filtered(config, recording)
    _, submap, _ = gather(config, state, jnp.arange(4))
    n = 21
    P = np.asarray(submap.P)[:n, :n]
    values, vectors = np.linalg.eigh(P)
    L = vectors * np.sqrt(np.maximum(values, 0))
    at = block(submap, 0)
    uv_px = observe(config, recording.camera, at).pixel + jnp.array([12.0, -9.0])  # far off, where h is curved

    def residuals(a):
        pixel = observe(config, recording.camera, move(at, jnp.asarray(L @ a))).pixel
        return np.concatenate([a, np.asarray(uv_px - pixel)])

    least = 2 * least_squares(residuals, np.zeros(n), xtol=1e-12, ftol=1e-12, gtol=1e-12).cost
    re1 = {}
    for iterations in (1, 12):
        config = FilterConfig(max_landmarks=11, max_updates=4, iterations=iterations)
        re1[iterations] = float(innovate(config, recording.camera, submap, 0, uv_px)[0].re1)
    np.testing.assert_allclose(re1[12], least, rtol=1e-5)
    assert abs(re1[1] / least - 1) > 1e-3, (re1, least)
