"""Worlds of point features: the paper's grid, and which of its points move."""

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vcjax.fields import is_concrete, number, require, require_kind, vector
from vcjax.simulation.courses import Course, displacements, has_moved, require_course

PLACE_TOLERANCE_M = 1e-3
"""How far from a feature a place may lie that means it, m: room for decimals, and far less than features are apart."""


def grid(
    low_m: float = -8.0, high_m: float = 8.0, num_per_side: int = 9, heights_m: Sequence[float] = (0.0, 1.0)
) -> Float[np.ndarray, "F 3"]:
    """Square grid of features in layers, (F, 3) m: the paper's 162 points are 9 × 9 of 2 m pitch at heights 0 and 1 m.

    Feature ids count layer by layer, in a layer by x, and for equal x by y.

    Raises:
        ValueError: for a number of features per side that is no whole number of at least 1, or no layer.
    """
    if not isinstance(num_per_side, Integral) or num_per_side < 1:
        raise ValueError(f"grid(num_per_side={num_per_side!r}): give a whole number of at least 1.")
    if len(heights_m) == 0:
        raise ValueError("grid(heights_m=()): give the height of at least one layer, m.")
    side = np.linspace(low_m, high_m, num_per_side)
    z, x, y = np.meshgrid(heights_m, side, side, indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def _as_ids(value: Any) -> Any:
    """Ids as an array, also where there are none; JAX arrays pass through."""
    if isinstance(value, jax.Array):
        return value
    ids = np.asarray(value)
    return ids.astype(np.int32) if ids.size == 0 or np.issubdtype(ids.dtype, np.integer) else ids


class Movers(eqx.Module):
    """Features that move: with one constant velocity from the first frame on, or on courses of several legs."""

    ids: Int[Array | np.ndarray, " D"] = eqx.field(converter=_as_ids)
    """Which features, each once."""
    direction: tuple[float, float, float] = eqx.field(converter=vector, default=(0.0, 1.0, 0.0))
    """Direction of motion in the world; its length means nothing, but is not 0."""
    speed_m_s: float = eqx.field(converter=number, default=0.0)
    """Speed, m/s; 0: they stand still and count as static."""
    course: Course | None = None
    """When they go, how fast and where to, relative to direction and speed; None: constant velocity."""

    def __check_init__(self):
        _check_ids(self.ids)
        require(self, "direction", np.isfinite, "give finite numbers.", length=3)
        require(self, "direction", lambda d: np.any(d != 0, axis=-1), "give a direction; its length is free.", length=3)
        require(
            self, "speed_m_s", lambda v: np.isfinite(v) & (v >= 0), "a speed is at least 0; turn the direction round."
        )
        if self.course is not None:
            require_kind("Movers", "course", self.course, Course, "give a Course, or None.")
            require_course(self.course, self.ids.shape[0])


def _check_ids(ids: Int[Array | np.ndarray, " D"]) -> None:
    """Refuse ids that are no list of whole numbers, or not each once."""
    if ids.ndim != 1 or not jnp.issubdtype(ids.dtype, jnp.integer):
        shown = ids.tolist() if is_concrete(ids) else f"{ids.dtype}{list(ids.shape)}"
        raise ValueError(f"Movers(ids={shown}): give a list of feature ids, which are whole numbers.")
    if is_concrete(ids):
        found, times = np.unique(ids, return_counts=True)
        if np.any(times > 1):
            raise ValueError(f"Movers(ids={ids.tolist()}): feature {found[times > 1][0]} comes twice; give each once.")


def velocities(movers: Movers, num_features: int) -> Float[Array, "F 3"]:
    """Velocity of every feature at the movers' speed in their direction, m/s. Derivative exact."""
    velocity = _velocity(movers)
    return jnp.zeros((num_features, 3), velocity.dtype).at[jnp.asarray(movers.ids)].set(velocity)


def _velocity(movers: Movers) -> Float[Array, "3"]:
    direction = jnp.asarray(movers.direction)
    return movers.speed_m_s * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)


def moved(
    movers: Movers, landmarks_m: Float[Array, "F 3"], time_s: Float[Array, " T"]
) -> tuple[Float[Array, "T F 3"], Bool[Array, " F"]]:
    """Where every feature is at each time, m, and whether it moves at any time up to the last. Derivative exact."""
    if movers.course is None:
        velocity = velocities(movers, landmarks_m.shape[0])
        return landmarks_m + time_s[:, None, None] * velocity, jnp.any(velocity != 0, axis=-1)
    ids, course = jnp.asarray(movers.ids), (movers.course, _velocity(movers), movers.ids.shape[0])
    places = jnp.broadcast_to(landmarks_m, (len(time_s), *landmarks_m.shape))
    is_moving = jnp.zeros(len(landmarks_m), bool).at[ids].set(has_moved(*course, time_s[-1]))
    return places.at[:, ids].add(displacements(*course, time_s)), is_moving


def is_feature(landmarks_m: Float[np.ndarray, "F 3"], places_m: Any) -> np.ndarray:
    """Whether there is a feature at each of some places, within `PLACE_TOLERANCE_M`."""
    return np.min(_distances(landmarks_m, places_m), axis=1, initial=np.inf) <= PLACE_TOLERANCE_M


def features_at(landmarks_m: Float[np.ndarray, "F 3"], places_m: Any) -> Int[np.ndarray, " D"]:
    """Ids of the features at some places, in the order of the places.

    Args:
        landmarks_m: the features, m.
        places_m: (D, 3), m; each within `PLACE_TOLERANCE_M` of the feature that it means.

    Raises:
        ValueError: naming the place: it is no place, no feature is there, or two places mean one feature.
    """
    distances = _distances(landmarks_m, places_m)
    ids = np.argmin(distances, axis=1)
    for i, place in enumerate(np.asarray(places_m, float)):
        if not distances[i, ids[i]] <= PLACE_TOLERANCE_M:
            raise ValueError(
                f"features_at(places_m[{i}]={place.tolist()}): no feature is there; "
                f"the nearest, {ids[i]}, is at {landmarks_m[ids[i]].tolist()} m."
            )
        if ids[i] in ids[:i]:
            raise ValueError(
                f"features_at(places_m[{i}]={place.tolist()}): feature {ids[i]} comes twice; give each once."
            )
    return ids.astype(np.int32)


def features_near(landmarks_m: Float[np.ndarray, "F 3"], place_m: Sequence[float], num: int) -> Int[np.ndarray, " D"]:
    """Ids of the `num` features nearest to a place, the nearest first, and of equally near ones the lower id.

    Raises:
        ValueError: for a number that is not one from 0 to that of the features.
    """
    if not isinstance(num, Integral) or not 0 <= num <= len(landmarks_m):
        raise ValueError(
            f"features_near(num={num!r}): give a whole number from 0 to {len(landmarks_m)}, all there are."
        )
    distances = np.round(_distances(landmarks_m, [place_m])[0], 6)  # rounding error must not break a tie
    return np.argsort(distances, kind="stable")[:num].astype(np.int32)


def features_drawn(num_features: int, num_drawn: int, seed: int) -> Int[np.ndarray, " D"]:
    """Ids of features drawn at random, each equally likely and none twice; a larger number only adds to a smaller one.

    Args:
        num_features: how many there are.
        num_drawn: how many to draw, from 0 to `num_features`.
        seed: of the draw, from 0 to 2³² - 1; nothing else is drawn from it.

    Raises:
        ValueError: for a number out of its range.
    """
    if not isinstance(num_drawn, Integral) or not 0 <= num_drawn <= num_features:
        raise ValueError(
            f"features_drawn(num_drawn={num_drawn!r}): give a whole number from 0 to {num_features}, all there are."
        )
    if not isinstance(seed, Integral) or not 0 <= seed < 2**32:
        raise ValueError(f"features_drawn(seed={seed!r}): give a whole number from 0 to 2**32 - 1.")
    # Of NumPy's generators the one whose numbers are promised never to change.
    return np.random.RandomState(seed).permutation(num_features)[:num_drawn].astype(np.int32)


def _distances(landmarks_m: Float[np.ndarray, "F 3"], places_m: Any) -> np.ndarray:
    """Distance of every place (rows) to every feature, m; infinite for what is not finite."""
    places = np.asarray(places_m, float)
    if places.ndim != 2 or places.shape[1] != 3:
        raise ValueError(f"features_at(places_m) has shape {places.shape}: give x, y and z for each place, (D, 3) m.")
    distances = np.linalg.norm(landmarks_m - places[:, None], axis=-1)
    return np.where(np.isfinite(distances), distances, np.inf)
