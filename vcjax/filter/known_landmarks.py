"""Known landmarks: points of the world whose place is known before the first frame, which give a run its scale.

A camera alone sees directions, and no lengths: without odometry a map is as good at any scale. Some points of known
place (a target of known size in front of the camera, say) settle it. They are in the map from the start, as Euclidean
landmarks with a small covariance, and are from then on like any other. Which feature a point is, its track id says.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vcjax.fields import is_concrete
from vcjax.filter.config import FilterConfig
from vcjax.filter.map_covariance import SLOT
from vcjax.filter.state import FilterState
from vcjax.models.landmarks import euclidean


class KnownLandmarks(NamedTuple):
    """Points of known place."""

    track_id: Int[Array | np.ndarray, " k"]
    """Feature of each."""
    place_m: Float[Array | np.ndarray, "k 3"]
    """Place in the world of the recording's start pose, m."""
    std_m: float | Float[Array | np.ndarray, ""]
    """Standard deviation of each along each axis, m; positive."""


def check_known(config: FilterConfig, known: KnownLandmarks) -> None:
    """Refuse known landmarks that make no map.

    Raises:
        ValueError: for shapes that disagree, more than the map holds, an id twice or below 0, places that are not
            finite or a standard deviation that is not positive. Traced numbers are not checked.
    """
    ids = np.shape(known.track_id)
    if len(ids) != 1 or np.shape(known.place_m) != (*ids, 3):
        raise ValueError(
            f"KnownLandmarks: track_id has shape {ids} and place_m {np.shape(known.place_m)}; give (k,) and (k, 3)."
        )
    if ids[0] > config.max_landmarks:
        raise ValueError(
            f"KnownLandmarks: {ids[0]} points, but the map holds {config.max_landmarks}; raise max_landmarks."
        )
    if not all(is_concrete(leaf) for leaf in known):
        return
    track_id = np.asarray(known.track_id)
    if len(np.unique(track_id)) != len(track_id) or np.any(track_id < 0):
        raise ValueError(f"KnownLandmarks(track_id={track_id.tolist()}): ids are different and at least 0.")
    if not np.all(np.isfinite(known.place_m)):
        raise ValueError("KnownLandmarks(place_m): must be finite.")
    if not (np.ndim(known.std_m) == 0 and np.isfinite(known.std_m) and known.std_m > 0):
        raise ValueError(f"KnownLandmarks(std_m={known.std_m}): give a positive number.")


def place_known(state: FilterState, known: KnownLandmarks) -> FilterState:
    """An empty map with known landmarks in its first slots.

    The first three error coordinates of their slots are the point's; the other four are zero and stay so.
    """
    num, dtype = known.track_id.shape[0], state.P_mm.dtype
    first = SLOT * jnp.arange(num)[:, None] + jnp.arange(3)
    to_coordinates = jnp.zeros((SLOT, SLOT), dtype).at[:3, :3].set(jnp.eye(3, dtype=dtype))
    variance = jnp.asarray(known.std_m, dtype) ** 2
    return eqx.tree_at(
        lambda s: (s.landmarks, s.to_coordinates, s.P_mm, s.track_id, s.is_euclidean),
        state,
        (
            state.landmarks.at[:num].set(jax.vmap(euclidean)(jnp.asarray(known.place_m, dtype))),
            state.to_coordinates.at[:num].set(to_coordinates),
            state.P_mm.at[first, first].set(variance),
            state.track_id.at[:num].set(jnp.asarray(known.track_id, state.track_id.dtype)),
            state.is_euclidean.at[:num].set(True),
        ),
    )
