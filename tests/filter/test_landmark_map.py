"""The map: births, the full map, deletion, blacklist, retirement."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filter_runs import CAPACITY, filtered, frame_of, head, ids, joint, recorded, start, step

from vcjax.filter import landmark_map
from vcjax.filter.config import FilterConfig
from vcjax.filter.features import Block, observe
from vcjax.gates.virtual_correction import VirtualCorrection
from vcjax.models.camera import Camera

VC = FilterConfig(max_landmarks=CAPACITY, retire=False)
# Many features are called dynamic without being so.
STRICT = VirtualCorrection(th1=4.0, th2=2.0)
# Twelve slots, a blacklist, births in random order, stacked updates: one compilation for the tests of all of them.
SMALL = FilterConfig(
    gate=STRICT,
    max_landmarks=12,
    blacklist_capacity=200,
    birth_order="random",
    update="stacked",
    choose_among="measured",
)
KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def recording():
    return recorded(seed=10, dynamic="lateral", oscillation_amplitude_m=0.05)


@pytest.fixture(scope="module")
def small_run(recording):
    """State and info of 80 frames with the small map."""
    return list(filtered(SMALL, head(recording, 80), KEY))


def deleted_ids(info):
    """What gate and detector deleted in a frame."""
    return ids(info.candidate_id[info.is_dynamic]) + ids(info.inconsistent_id)


def ended_ids(recording, t):
    """What was seen for the last time in frame t."""
    return set(recording.track_id[t, recording.is_last[t]].tolist())


def tenants_of(infos):
    """All ids that each slot ever held."""
    tenants = {}
    for info in infos:
        for slot in np.flatnonzero(info.track_id >= 0):
            tenants.setdefault(int(slot), set()).add(int(info.track_id[slot]))
    return tenants


def eligible_ids(config, recording, t):
    """Features that may be born in a frame by where they are."""
    uv, margin = recording.uv_px[t], config.birth_margin_px
    is_inside = np.all((uv >= margin) & (uv <= np.array([640.0, 480.0]) - margin), axis=1)
    return set(recording.track_id[t, recording.is_valid[t] & is_inside].tolist())


def test_a_full_map_is_reported_and_no_birth_is_lost_silently(small_run, recording):
    previous, ended, banned, num_full = set(), set(), set(), 0
    for t, (state, info) in enumerate(small_run):
        mapped = set(ids(info.track_id))
        assert len(mapped) == len(ids(info.track_id)) <= 12
        deleted, born = set(deleted_ids(info)), ids(info.born_id)
        assert len(set(born)) == len(born)
        assert mapped == (previous - deleted - ended) | set(born)
        banned |= deleted
        waiting = eligible_ids(SMALL, recording, t) - mapped - banned
        attempts = SMALL.births_per_frame if t else SMALL.births_first_frame
        assert bool(info.map_is_full) == (len(mapped) == 12 and bool(waiting))
        assert len(born) == attempts or info.map_is_full or not waiting
        num_full += bool(info.map_is_full)
        previous = mapped
        ended |= ended_ids(recording, t)
        assert set(ids(state.track_id)) == mapped
        assert info.is_finite
    assert 0 < num_full < 80


def test_slots_are_used_again(small_run):
    tenants = tenants_of([info for _, info in small_run])
    assert len(tenants) <= 12
    assert sum(len(t) > 1 for t in tenants.values()) > 3


def test_features_on_the_blacklist_are_never_born_again(small_run):
    banned = set()
    for _, info in small_run:
        banned |= set(deleted_ids(info))
        assert not banned & set(ids(info.born_id))
    assert len(banned) > 3


def test_without_a_blacklist_a_deleted_feature_may_come_back(recording):
    config = eqx.tree_at(lambda c: c.gate, VC, STRICT)
    deleted, returned = set(), set()
    for _, info in filtered(config, head(recording, 40)):
        deleted |= set(deleted_ids(info))
        returned |= deleted & set(ids(info.born_id))
    assert returned


def test_the_blacklist_keeps_the_newest(recording):
    state, _ = start(SMALL, head(recording, 1), KEY)
    state = eqx.tree_at(lambda s: (s.blacklist, s.blacklist_left), state, (jnp.full(3, -1), jnp.zeros(3)))
    held = ids(state.track_id)
    slots = jnp.arange(len(state.track_id))
    for slot in (4, 1, 7, 2):
        is_banned = slots == slot
        state = landmark_map.delete(landmark_map.ban(SMALL, state, is_banned), is_banned)
    assert state.blacklist.tolist() == [held[2], held[7], held[1]]
    nobody = landmark_map.ban(SMALL, state, slots < 0)
    assert nobody.blacklist.tolist() == state.blacklist.tolist()


def test_the_blacklist_keeps_a_feature_for_a_time(recording):
    config = dataclasses.replace(SMALL, blacklist_frames=2)
    state, _ = start(SMALL, head(recording, 1), KEY)
    state = eqx.tree_at(lambda s: (s.blacklist, s.blacklist_left), state, (jnp.full(3, -1), jnp.zeros(3)))
    held, slots, banned = ids(state.track_id), jnp.arange(len(state.track_id)), []
    for slot in (4, 1, -1, -1, -1):
        state = landmark_map.ban(config, state, slots == slot)
        banned.append(ids(state.blacklist))
    assert banned == [[held[4]], [held[1], held[4]], [held[1]], [], []]


@pytest.mark.parametrize(("rho", "is_ahead"), [(0.1, True), (-0.001, True), (-0.001, False)])
def test_a_negative_inverse_depth_is_behind_the_camera_or_beyond_infinity(rho, is_ahead):
    pose, mount = np.array([0.0, 0, 0, 1, 0, 0, 0]), np.array([0.0, 0, 0.6, 0.5, -0.5, 0.5, -0.5])
    landmark = np.array([0.1, 0.2, 0.6, 1.0 if is_ahead else -1.0, 0.1, 0.0, rho])
    block = Block(jnp.concatenate([pose, mount]), jnp.asarray(landmark), jnp.eye(7))
    for config, is_seen in ((VC, is_ahead == (rho > 0)), (FilterConfig(see_beyond_infinity=True), is_ahead)):
        observation = observe(config, Camera(), block)
        assert bool(observation.is_visible) == bool(observation.is_near) == is_seen


def test_births_go_by_the_lowest_id(recording):
    _, info = start(VC, head(recording, 1))
    assert ids(info.born_id) == sorted(eligible_ids(VC, recording, 0))[:10]


def test_a_random_order_of_births_is_a_permutation_by_its_key(recording):
    first = head(recording, 1)
    births = [ids(start(SMALL, first, jax.random.key(k))[1].born_id) for k in (0, 0, 1, 2)]
    assert births[0] == births[1]
    assert len({tuple(b) for b in births}) == 3
    for born in births:
        assert len(set(born)) == 10
        assert set(born) <= eligible_ids(SMALL, recording, 0)
        assert born != sorted(born)


def test_every_eligible_feature_is_as_likely_to_be_first(recording):
    """Over 300 keys, the mean rank among the eligible is in the middle, within four standard errors."""
    first, eligible = head(recording, 1), sorted(eligible_ids(SMALL, recording, 0))
    places = [eligible.index(ids(start(SMALL, first, jax.random.key(k))[1].born_id)[0]) for k in range(300)]
    n = len(eligible)
    assert np.mean(places) == pytest.approx((n - 1) / 2, abs=4 * n / np.sqrt(12 * 300))


@pytest.mark.parametrize(("config", "key"), [(SMALL, None), (VC, KEY)])
def test_a_key_is_for_a_random_order_and_only_then(config, key, recording):
    with pytest.raises(ValueError, match=r"key.*birth_order"):
        start(config, head(recording, 1), key)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (dict(max_landmarks=0), "max_landmarks=0"),
        (dict(max_updates=0), "max_updates=0"),
        (dict(max_updates=30, max_landmarks=29), r"max_updates=30.*max_landmarks=29"),
        (dict(births_first_frame=-1), "births_first_frame=-1"),
        (dict(births_per_frame=-2), "births_per_frame=-2"),
        (dict(blacklist_capacity=-1), "blacklist_capacity=-1"),
    ],
)
def test_a_capacity_too_small_is_refused(numbers, message):
    with pytest.raises(ValueError, match=message):
        FilterConfig(**numbers)


def test_deletion_is_marginalisation(recording):
    """The others' joint Gaussian stays, and the next frame is that of a state that never had the deleted numbers."""
    *_, (state, _) = filtered(VC, head(recording, 30))
    mapped = ids(state.track_id)
    is_deleted = jnp.isin(state.track_id, jnp.array(mapped[::3]))
    kept = [i for i in mapped if i not in mapped[::3]]
    deleted = landmark_map.delete(state, is_deleted)
    assert sorted(ids(deleted.track_id)) == sorted(kept)
    for ours, theirs in zip(joint(deleted, kept), joint(state, kept), strict=True):
        np.testing.assert_array_equal(ours, theirs)

    rows = np.repeat(is_deleted, 7)
    wiped = eqx.tree_at(
        lambda s: (s.P_vm, s.P_mm),
        deleted,
        (np.where(rows, 0.0, deleted.P_vm), np.where(rows | rows[:, None], 0.0, deleted.P_mm)),
    )
    (after, info), (after_wiped, info_wiped) = (step(VC, s, frame_of(recording, 30)) for s in (deleted, wiped))
    jax.tree.map(np.testing.assert_array_equal, info, info_wiped)
    still = ids(after.track_id)
    for ours, theirs in zip(joint(after, still), joint(after_wiped, still), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("choose_among", ["measured", "predicted"])
def test_retirement_is_exact(recording, choose_among):
    """A run that retires is the run that does not; only slots differ, and their number."""
    config = FilterConfig(max_landmarks=CAPACITY, choose_among=choose_among)
    endless = dataclasses.replace(recording, is_last=np.zeros_like(recording.is_last))
    infos, ended, num_mapped, num_mapped_endless = [], set(), 0, 0
    runs = zip(filtered(config, head(recording, 110)), filtered(config, head(endless, 110)), strict=True)
    for t, ((_, info), (_, info_endless)) in enumerate(runs):
        np.testing.assert_allclose(info.vehicle, info_endless.vehicle, rtol=0, atol=1e-9)
        np.testing.assert_allclose(info.vehicle_cov, info_endless.vehicle_cov, rtol=0, atol=1e-9)
        for name in ("candidate_id", "is_measured", "is_dynamic", "is_recovered", "born_id"):
            np.testing.assert_array_equal(getattr(info, name), getattr(info_endless, name))
        if choose_among == "measured":
            assert not ended & set(ids(info.track_id))
        ended |= ended_ids(recording, t)
        infos.append(info)
        num_mapped += len(ids(info.track_id))
        num_mapped_endless += len(ids(info_endless.track_id))
    assert num_mapped < 0.9 * num_mapped_endless
    assert any(len(t) > 1 for t in tenants_of(infos).values())  # a retired landmark's slot has a new tenant
