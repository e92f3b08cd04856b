"""Followers against plain NumPy, their statistics where measurement is linear, masks, and refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from vcjax.filter.config import FilterConfig
from vcjax.filter.follower import Following, Sight, advance, begin, watch

STEP_S = jnp.array(0.1)
H = np.array([[40.0, 3.0, -5.0], [2.0, 45.0, 8.0]])
N = np.array([[1.5, 0.3], [0.3, 1.2]])


def bent(place):
    """A camera of sorts: a pixel that is not linear in the place."""
    x, y, z = place
    return jnp.stack([300 * x / z + 0.1 * y**2, 300 * y / z])


def measure_bent(place):
    return bent(place), jax.jacfwd(bent)(place), jnp.asarray(N)


def measure_in_turn(place, turn):
    """Two directions of three in each frame, another pair in each."""
    matrix = jnp.roll(jnp.asarray(H), turn, axis=1)
    return matrix @ place, matrix, jnp.asarray(N)


def plainly(following, place, cov, distance, pixels):
    """Both models of one follower, frame by frame; None where a pixel is missing."""
    x = np.concatenate([place, np.zeros(3)])
    P = np.zeros((6, 6))
    P[:3, :3] = cov + (following.relative_place_std * distance) ** 2 * np.eye(3)
    P[3:, 3:] = following.follower_velocity_std_m_s**2 * np.eye(3)
    q, Q, misfit, at_rest = place.copy(), P[:3, :3].copy(), 0.0, 0
    keep = np.exp(-STEP_S / following.velocity_memory_s)
    F = np.block([[np.eye(3), STEP_S * np.eye(3)], [np.zeros((3, 3)), keep * np.eye(3)]])
    noise = np.diag([0.0] * 3 + [following.follower_velocity_std_m_s**2 * (1 - keep**2)] * 3)

    def corrected(x, P, J, z):
        S = J @ P @ J.T + N
        K = P @ J.T @ np.linalg.inv(S)
        badness = z @ np.linalg.inv(S) @ z + np.log(np.linalg.det(S))
        return x + K @ z, (np.eye(len(x)) - K @ J) @ P, badness

    for y in pixels:
        x, P = F @ x, F @ P @ F.T + noise
        if y is not None:
            J = np.asarray(jax.jacfwd(bent)(jnp.asarray(x[:3])))
            x, P, of_mover = corrected(x, P, np.hstack([J, np.zeros((2, 3))]), y - np.asarray(bent(x[:3])))
            q, Q, of_stander = corrected(q, Q, np.asarray(jax.jacfwd(bent)(jnp.asarray(q))), y - np.asarray(bent(q)))
            misfit, at_rest = max(0.0, misfit + of_stander - of_mover), at_rest + 1
            if misfit >= following.rest_limit:
                q, Q, misfit, at_rest = x[:3].copy(), P[:3, :3].copy(), 0.0, 0
        yield x, P, q, Q, misfit, at_rest


@jax.jit
def step_bent(following, followers, sight):
    return watch(following, advance(following, followers, STEP_S), sight, measure_bent)


def test_both_models_are_the_plain_ones():
    """One follower moves, stands, moves; another place is free, a third one's pixels are missing now and then."""
    rng, following = np.random.default_rng(0), Following(max_followed=3, rest_limit=12.0)
    places, distances = np.array([[1.0, -0.5, 6.0], [0.0, 0.0, 1.0], [-2.0, 1.0, 9.0]]), np.array([6.0, 1.0, 9.0])
    covs = 0.01 * np.stack([np.eye(3)] * 3)
    followers = begin(following, *map(jnp.array, (np.array([7, -1, 4], np.int32), places, covs, distances)))
    pace = np.repeat([0.5, 0.0, 0.5], 20)
    path = places[:, None] + np.array([0.0, 1.0, 0.2]) * STEP_S * np.cumsum(pace)[:, None]
    pixels = np.asarray(jax.vmap(jax.vmap(bent))(jnp.array(path))) + rng.normal(size=(3, 60, 2))
    is_measured = np.array([np.ones(60, bool), np.zeros(60, bool), rng.random(60) < 0.6])
    given = [
        [y if seen else None for y, seen in zip(*both, strict=True)] for both in zip(pixels, is_measured, strict=True)
    ]
    plain = [plainly(following, places[i], covs[i], distances[i], given[i]) for i in (0, 2)]
    longest, began = 0.0, followers
    for t in range(60):
        dirty = np.where(is_measured[:, t, None], pixels[:, t], np.nan)
        followers, is_lost = step_bent(following, followers, Sight(jnp.array(is_measured[:, t]), jnp.array(dirty)))
        assert not is_lost.any()
        for i, expected in zip((0, 2), map(next, plain), strict=True):
            x, P, q, Q, misfit, at_rest = expected
            np.testing.assert_allclose(np.concatenate([followers.place_m[i], followers.velocity_m_s[i]]), x, atol=1e-9)
            np.testing.assert_allclose(followers.cov[i], P, atol=1e-9)
            np.testing.assert_allclose(followers.rest_place_m[i], q, atol=1e-9)
            np.testing.assert_allclose(followers.rest_cov[i], Q, atol=1e-9)
            assert followers.misfit[i] == pytest.approx(misfit, abs=1e-8) and followers.at_rest[i] == at_rest
        longest = max(longest, followers.at_rest[0])
    assert longest > 15 > followers.at_rest[0]
    np.testing.assert_array_equal(followers.place_m[1], began.place_m[1])


@jax.jit
def followed(following, start, velocity, key):
    """Linear tracks of given velocities (T, 3): errors, covariances, and for how long each stood still."""
    noise = jax.random.normal(key, (len(velocity), 2)) @ jnp.linalg.cholesky(jnp.asarray(N)).T
    place = start + STEP_S * jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(velocity, axis=0)[:-1]])
    followers = begin(following, jnp.zeros(1, jnp.int32), jnp.zeros((1, 3)), jnp.zeros((1, 3, 3)), jnp.ones(1))

    def frame(followers, given):
        t, place, velocity, noise = given
        measure = lambda p: measure_in_turn(p, t)  # noqa: E731
        sight = Sight(jnp.ones(1, bool), (measure(place)[0] + noise)[None])
        followers, _ = watch(following, advance(following, followers, STEP_S), sight, measure)
        error = jnp.concatenate([followers.place_m[0] - place, followers.velocity_m_s[0] - velocity])
        return followers, (error, followers.cov[0], followers.at_rest[0])

    return jax.lax.scan(frame, followers, (jnp.arange(len(velocity)), place, velocity, noise))[1]


def test_velocity_is_consistent_where_measurement_is_linear():
    """Velocities drawn as the model says: the NEES of place and velocity at the end is χ² with 6 degrees of freedom."""
    following, rng, num = (
        Following(follower_velocity_std_m_s=0.4, velocity_memory_s=2.0),
        np.random.default_rng(1),
        400,
    )
    keep = np.exp(-STEP_S / following.velocity_memory_s)
    velocity = np.zeros((num, 40, 3))
    velocity[:, 0] = 0.4 * rng.normal(size=(num, 3))
    for t in range(1, 40):
        velocity[:, t] = keep * velocity[:, t - 1] + 0.4 * np.sqrt(1 - keep**2) * rng.normal(size=(num, 3))
    # The first frame is moved to by the velocity before it.
    start = following.relative_place_std * rng.normal(size=(num, 3))
    keys = jax.random.split(jax.random.key(0), num)
    error, cov, _ = jax.vmap(followed, in_axes=(None, 0, 0, 0))(following, jnp.array(start), jnp.array(velocity), keys)
    last_error, last_cov = np.asarray(error)[:, -1], np.asarray(cov)[:, -1]
    nees = np.einsum("ki,kij,kj->k", last_error, np.linalg.inv(last_cov), last_error)
    low, high = stats.chi2.ppf([0.001, 0.999], 6 * num) / num
    assert low < nees.mean() < high
    assert stats.kstest(nees, stats.chi2(6).cdf).pvalue > 1e-3


def test_what_stands_is_seldom_taken_to_move_and_what_moves_never_to_stand():
    """Page's sum of 20 log ratios exceeds 12 with a probability of at most 20 exp(-12/2) = 5 %."""
    following, num = Following(), 400
    start = jnp.array(following.relative_place_std * np.random.default_rng(2).normal(size=(num, 3)))
    keys = jax.random.split(jax.random.key(1), num)
    each = jax.vmap(followed, in_axes=(None, 0, None, 0))
    _, _, at_rest = each(following, start, jnp.zeros((20, 3)), keys)
    num_stopped = np.sum(np.asarray(at_rest)[:, -1] < 20)
    assert num_stopped < stats.binom(num, 0.05).ppf(0.999)
    _, _, at_rest = each(following, start, jnp.zeros((40, 3)) + jnp.array([0.0, 0.5, 0.0]), keys)
    assert np.asarray(at_rest).max() < following.rest_frames


def test_a_pixel_from_elsewhere_loses_the_feature():
    following = Following(max_followed=1)
    followers = begin(following, jnp.zeros(1, jnp.int32), jnp.array([[0.0, 0, 5]]), jnp.zeros((1, 3, 3)), jnp.ones(1))
    _, is_lost = step_bent(following, followers, Sight(jnp.ones(1, bool), jnp.array([[9e3, 0.0]])))
    assert is_lost.all()
    _, is_lost = step_bent(following, followers, Sight(jnp.zeros(1, bool), jnp.array([[9e3, 0.0]])))
    assert not is_lost.any()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Following(max_followed=-1), r"Following\(max_followed=-1\)"),
        (lambda: Following(rest_frames=0), r"Following\(rest_frames=0\)"),
        (lambda: Following(rest_limit=-1.0), r"Following\(rest_limit=-1.0\): .*positive"),
        (lambda: Following(follower_velocity_std_m_s=np.inf), r"Following\(follower_velocity_std_m_s=inf\)"),
        (
            lambda: FilterConfig(following=Following(max_followed=4)),
            r"max_followed=4.*must stay out of the map; set blacklist_capacity",
        ),
        (
            lambda: FilterConfig(following=Following(max_followed=9), blacklist_capacity=8),
            r"max_followed=9.*blacklist_capacity=8.*at least as large",
        ),
        (
            lambda: FilterConfig(following=Following(max_followed=4), blacklist_capacity=8, blacklist_frames=30),
            r"blacklist_frames=30.0, following=.*max_followed=4.*born again.*infinite",
        ),
        (lambda: FilterConfig(blacklist_frames=30), r"blacklist_frames=30.0, blacklist_capacity=0.*set blacklist"),
        (lambda: FilterConfig(following=True, blacklist_capacity=9), r"following=True.*give a Following"),
    ],
)
def test_bad_settings_are_refused_by_name_and_value(build, message):
    with pytest.raises(ValueError, match=message):
        build()
