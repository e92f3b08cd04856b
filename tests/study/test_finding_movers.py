"""The velocity GLR as `vcjax detect` has it, in the paper's scenes: it finds the movers and leaves the others alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import vcjax as vc
from vcjax.study.detection_methods import METHODS
from vcjax.study.detection_scores import is_flagged, scores

CONFIG = METHODS["RE+velocity_glr"].config
KEY = jax.random.key(0)


def runs_of(dynamic, amplitude_m, num_seeds=6):
    scenario = vc.scenarios.paper(dynamic=dynamic, dynamic_speed_m_s=0.5, oscillation_amplitude_m=amplitude_m)
    return vc.monte_carlo(scenario, CONFIG, num_seeds=num_seeds, key=KEY)


@pytest.mark.slow
@pytest.mark.parametrize("dynamic", ["lateral", "inverse_forward"])
def test_an_oscillating_camera_finds_movers(dynamic):
    runs, static = runs_of(dynamic, 0.10), runs_of(None, 0.10)
    found, alone = scores(runs, static), scores(static, static)
    assert found["found_of_mapped_fraction"]["mean"] > 0.9
    assert found["static_flagged_fraction"]["mean"] < 0.025 and alone["static_flagged_fraction"]["mean"] < 0.025
    assert found["position_ratio"]["mean"] < 1.1


SPEEDS_M_S = (1.0, 0.5, 0.25)


def mimicked(speed_m_s: float) -> tuple[vc.Scenario, vc.Scenario, np.ndarray]:
    """Movers that come towards a steady camera, the same scene with what they look like, and who they are.

    In the place of each stands a point in the same direction from where the camera starts, at 1/(1 + β) of the
    distance, β being the mover's speed by the camera's, 0.5 m/s: at 1 m/s 4 m ahead of it instead of 12.
    """
    moving, still = vc.scenarios.paper(dynamic="inverse_forward", dynamic_speed_m_s=speed_m_s), vc.scenarios.paper()
    ids, places = np.asarray(moving.movers.ids), np.array(still.landmarks_m)
    camera = np.add(moving.mount[:3], [*moving.start[:2], 0.0])
    places[ids] = camera + (places[ids] - camera) / (1 + speed_m_s / 0.5)
    return moving, dataclasses.replace(still, landmarks_m=places), ids


@pytest.mark.parametrize("speed_m_s", SPEEDS_M_S)
def test_movers_towards_a_steady_camera_are_seen_where_static_points_closer_by_are(speed_m_s):
    moving, still, ids = mimicked(speed_m_s)
    one, other = (jax.device_get(vc.simulate(scenario, KEY)[0]) for scenario in (moving, still))
    np.testing.assert_array_equal(one.track_id, other.track_id)  # a column for each feature
    np.testing.assert_array_equal(one.is_valid, other.is_valid)
    seen = one.is_valid[:, ids]
    assert seen.sum() > 6 * 40
    np.testing.assert_allclose(one.uv_px[:, ids][seen], other.uv_px[:, ids][seen], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("speed_m_s", SPEEDS_M_S)
def test_a_steady_camera_cannot_tell_what_comes_towards_it_from_what_is_closer(speed_m_s):
    """A fact of geometry, not of the test: as often as static ones in the places that they mimic, which is seldom."""
    moving, still, ids = mimicked(speed_m_s)
    runs = [vc.monte_carlo(scenario, CONFIG, num_seeds=12, key=KEY) for scenario in (moving, still)]
    flagged, mimics_flagged = (is_flagged(each)[:, ids].sum() for each in runs)
    mapped = (runs[0].frames_mapped.values[:, ids] > 0).sum()
    assert abs(flagged - mimics_flagged) <= 1 and mapped == 12 * 6  # a rounding may tip a decision
    assert 0 < flagged < 0.2 * mapped


@pytest.mark.slow
def test_the_statistic_of_a_static_scene_is_chi_squared_with_the_whole_filter():
    """With nothing left out or deleted, all landmarks corrected in each frame, of tracks seen twenty times at least.

    The tracks of a run depend on each other, so the spread of a share is that of the runs' shares. Along what is hardly
    observed yet the prior fades the statistic out, so that it may be somewhat smaller than χ²₃, and is not larger.
    """
    num_runs, scenario = 20, vc.scenarios.paper(oscillation_amplitude_m=0.1, num_frames=100)
    config = vc.FilterConfig(gate=vc.ReprojectionError(th1=1e9), detector=vc.VelocityGLR(threshold=1e9), max_updates=60)

    def last_of_each_track(key):
        info = vc.run(config, vc.simulate(scenario, key)[0])[1]
        nobody, ids = len(scenario.landmarks_m), info.watched_id
        place = jnp.where((ids >= 0) & ~jnp.isnan(info.detector_margin), ids, nobody)
        frame = jnp.broadcast_to(jnp.arange(len(ids))[:, None], ids.shape)
        times, last = (jnp.zeros(nobody + 1, int).at[place] for _ in range(2))
        times, last = times.add(1), last.max(frame)
        place = jnp.where(frame == last[place], place, nobody)
        margin = jnp.zeros(nobody + 1).at[place].set(info.detector_margin)
        return jnp.where(times >= 20, margin + 1e9, jnp.nan)[:-1]

    keys = jax.vmap(lambda seed: jax.random.fold_in(KEY, seed))(jnp.arange(num_runs))
    statistic = np.asarray(jax.jit(lambda keys: jax.lax.map(last_of_each_track, keys))(keys))
    num_tracks = (~np.isnan(statistic)).sum(axis=1)
    assert num_tracks.min() > 60
    for level in (0.5, 0.9, 0.95, 0.99):
        share = (statistic < stats.chi2(3).ppf(level)).sum(axis=1) / num_tracks
        error = share.std(ddof=1) / np.sqrt(num_runs)
        assert -3 * error < share.mean() - level < 0.02 + 3 * error, (level, share.mean(), error)
