"""Movers that start, stop and start again: flagged, followed, handed back, flagged again; nothing else changes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filter_runs import frame_of, head, quick_jit, start

import vcjax as vc
from vcjax.filter.follower import Following
from vcjax.filter.following import follow
from vcjax.filter.run import run
from vcjax.simulation.scenarios import harder
from vcjax.simulation.simulate import simulate

STOPS, STARTS = 40, 80
"""Frames in which the movers stop and start again."""
CONFIG = vc.FilterConfig(
    gate=vc.ReprojectionError(th1=12.0),
    detector=vc.VelocityGLR(threshold=20.0),
    blacklist_capacity=64,
    see_beyond_infinity=True,
    following=Following(max_followed=16),
)


@quick_jit
def simulated_and_run(config, scenario, keys):
    """Recordings, truths, last states and infos."""

    def one(key):
        recording, truth = simulate(scenario, key)
        return recording, truth, *run(config, recording)

    return jax.lax.map(one, keys)


@pytest.fixture(scope="module")
def runs():
    scenario = harder("stops_and_starts", oscillation_amplitude_m=0.1)
    return jax.device_get(simulated_and_run(CONFIG, scenario, jax.random.split(jax.random.key(0), 2)))


def frames_with(ids, feature):
    """Frames in which a feature is among some ids (T, n)."""
    return np.flatnonzero((np.asarray(ids) == feature).any(axis=1))


def events(runs):
    """Of every mover flagged before the stop: seed, feature, frames in which it was flagged and handed back."""
    _, truth, _, info = runs
    for seed, is_moving in enumerate(truth.is_moving):
        for feature in np.flatnonzero(is_moving):
            flagged = frames_with(info.inconsistent_id[seed], feature)
            if len(flagged) and flagged[0] < STOPS:
                yield seed, feature, flagged, frames_with(info.handed_back_id[seed], feature)


def test_a_mover_that_stops_is_handed_back_and_flagged_again_when_it_starts(runs):
    found = list(events(runs))
    back = [any(STOPS < t <= STARTS for t in handed_back) for *_, handed_back in found]
    assert len(found) >= 5 and sum(back) >= 0.8 * len(found)
    again = [
        any(STARTS < t < STARTS + 20 for t in flagged)
        for (*_, flagged, _), is_back in zip(found, back, strict=True)
        if is_back
    ]
    assert sum(again) >= 0.8 * len(again)
    for seed, feature, _, handed_back in found:  # and between the two it is in the map
        for t in handed_back[handed_back <= STARTS]:
            assert (runs[3].track_id[seed, t : t + 3] == feature).any()


def test_velocity_is_near_the_truth(runs):
    _, truth, _, info = runs
    velocity = np.gradient(truth.landmarks_m, 0.1, axis=1)
    seed, t, k = np.nonzero(
        (info.followers.track_id >= 0) & (np.diagonal(info.followers.cov, axis1=-2, axis2=-1)[..., 4] < 0.1)
    )
    is_late = (t > STARTS + 20) & truth.is_moving[seed, info.followers.track_id[seed, t, k]]
    seed, t, k = seed[is_late], t[is_late], k[is_late]
    true = velocity[seed, t, info.followers.track_id[seed, t, k]]
    error = info.followers.velocity_m_s[seed, t, k] - true
    np.testing.assert_allclose(true, [[0.0, 0.5, 0.0]] * len(true), atol=1e-9)
    assert len(error) > 200 and np.sqrt(np.mean(error[:, 1] ** 2)) < 0.2
    cov = info.followers.cov[seed, t, k][:, 3:, 3:]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    assert 0.05 * 3 < nees.mean() < 1.5 * 3  # below 3: a constant velocity is steadier than the model allows


def test_what_is_followed_is_out_of_the_map_and_on_the_blacklist_until_it_is_handed_back(runs):
    _, _, state, info = runs
    for seed in range(2):
        for t in range(1, info.track_id.shape[1]):
            followed = info.followers.track_id[seed, t]
            followed = followed[followed >= 0]
            assert len(set(followed)) == len(followed)
            assert not np.isin(followed, info.track_id[seed, t]).any()
            assert not np.isin(info.handed_back_id[seed, t], followed).any()
        assert np.isin(followed, state.blacklist[seed]).all()


def test_the_filter_does_not_know_that_it_is_followed(runs):
    """Until a feature is handed back, all is as without."""
    recording, _, _, info = runs
    first_back = np.flatnonzero((info.handed_back_id[0] >= 0).any(axis=1))[0]
    only = jax.tree.map(lambda leaf: leaf[0], recording)
    _, without = quick_jit(run)(dataclasses.replace(CONFIG, following=Following()), only)
    assert first_back > 30 and without.followers is None and without.handed_back_id is None
    np.testing.assert_array_equal(without.track_id[:first_back], info.track_id[0, :first_back])
    np.testing.assert_allclose(without.vehicle[:first_back], info.vehicle[0, :first_back], rtol=0, atol=1e-9)


def test_the_newest_take_the_places_of_the_oldest(runs):
    recording = jax.tree.map(lambda leaf: leaf[0], runs[0])
    config = dataclasses.replace(CONFIG, following=Following(max_followed=3))
    state = start(config, head(recording, 1))[0]
    mapped = np.flatnonzero(state.is_mapped)
    ids = np.asarray(state.track_id)
    # Nothing is known of their depth at birth: as if it were.
    state = dataclasses.replace(state, is_euclidean=jnp.ones_like(state.is_euclidean))
    frame = frame_of(recording, 1)
    for deleted in (mapped[:2], mapped[2:4], []):
        is_deleted = jnp.zeros(len(ids), bool).at[jnp.array(deleted, int)].set(True)
        left = dataclasses.replace(state, track_id=jnp.full(len(ids), -1, jnp.int32))
        after, _ = quick_jit(follow)(config, state, left, is_deleted, frame)
        state = dataclasses.replace(state, followers=after.followers)
    assert state.followers.track_id.tolist() == [ids[mapped[2]], ids[mapped[3]], ids[mapped[0]]]
