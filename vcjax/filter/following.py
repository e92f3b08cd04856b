"""After a detection: flagged features are followed outside the map, and handed back when they have stood still.

A follower reads the filter's vehicle and this frame's pixels, and nothing of the filter reads a follower but the
blacklist: one that has stood still long enough leaves it, and may be born again. Should it move after all, the detector
finds it again. Derivatives are zero.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vcjax.filter.config import FilterConfig
from vcjax.filter.correction import pixel_cov
from vcjax.filter.features import Block, observe
from vcjax.filter.follower import Followers, Sight, advance, begin, watch
from vcjax.filter.landmark_points import landmark_points
from vcjax.filter.map_covariance import SLOT
from vcjax.filter.state import FREE, VEHICLE, FilterState
from vcjax.models.landmarks import INVERSE_DEPTH, camera_centre, euclidean
from vcjax.recording import Frame


def follow(
    config: FilterConfig, before: FilterState, state: FilterState, is_deleted: Bool[Array, " L"], frame: Frame
) -> tuple[FilterState, Int[Array, " F"] | None]:
    """Watch the followers, hand back those that stand still, and take up what was deleted in this frame.

    Args:
        config: settings.
        before: the state after the frame's corrections, its landmarks still in place.
        state: the state after deletions, with the blacklist.
        is_deleted: which of its landmarks gate or detector deleted.
        frame: measured features.

    Returns: the state, and the features that were handed back (-1 elsewhere); None if nothing is followed.
    """
    followers = before.followers
    if followers is None:
        return state, None
    before, followers, frame = jax.lax.stop_gradient((before, followers, frame))
    followers = advance(config.following, followers, frame.time_step_s)
    is_match = (followers.track_id[:, None] == frame.track_id) & frame.is_valid & (followers.track_id >= 0)[:, None]
    sight = Sight(jnp.any(is_match, axis=1), frame.uv_px[jnp.argmax(is_match, axis=1)])
    followers, is_lost = watch(config.following, followers, sight, _measure(config, before, frame))
    is_back = (followers.track_id >= 0) & (followers.at_rest >= config.following.rest_frames) & ~is_lost
    back_id = jnp.where(is_back, followers.track_id, FREE)
    is_done = is_back | is_lost | jnp.any(followers.track_id[:, None] == state.track_id, axis=1)
    followers = followers._replace(track_id=jnp.where(is_done, FREE, followers.track_id))

    everyone = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), _taken_up(config, before, is_deleted), followers)
    newest_first = jnp.argsort(everyone.track_id == FREE, stable=True)[: config.following.max_followed]
    followers = jax.tree.map(lambda leaf: leaf[newest_first], everyone)
    is_free = jnp.any(state.blacklist[:, None] == back_id, axis=1)
    blacklist = jnp.where(is_free, FREE, state.blacklist)
    return eqx.tree_at(lambda s: (s.followers, s.blacklist), state, (followers, blacklist)), back_id


def _measure(config: FilterConfig, state: FilterState, frame: Frame):
    """Predicted pixel of a place, its derivative, and its noise with the vehicle's uncertainty."""
    v, R = len(state.vehicle), pixel_cov(config, state.vehicle.dtype)
    to_coordinates = jnp.zeros((SLOT, SLOT), R.dtype).at[:3, :3].set(jnp.eye(3, dtype=R.dtype))

    def measure(place):
        observation = observe(config, frame.camera, Block(state.vehicle, euclidean(place), to_coordinates))
        H_v, H_p = observation.H[:, :v], observation.H[:, v : v + 3]
        return observation.pixel, H_p, H_v @ state.P_vv @ H_v.T + R

    return measure


def _taken_up(config: FilterConfig, state: FilterState, is_deleted: Bool[Array, " L"]) -> Followers:
    """Followers for the landmarks deleted, where the map knew their depth at all: ρ above its standard deviation."""
    last = SLOT * jnp.arange(len(is_deleted)) + INVERSE_DEPTH
    rho = state.landmarks[:, INVERSE_DEPTH]
    is_known = state.is_euclidean | ((rho > 0) & (jnp.diagonal(state.P_mm)[last] < rho**2))
    points = landmark_points(state, is_deleted & is_known)
    centre = camera_centre(state.vehicle[:7], state.vehicle[7:VEHICLE])
    distance = jnp.linalg.norm(points.place_m - centre, axis=-1)
    return begin(config.following, points.track_id, points.place_m, points.cov, distance)
