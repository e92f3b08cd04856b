"""What moves outside the map: place and velocity of each feature that is followed, in each frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from vcjax.filter.info import FrameInfo


class Followed(NamedTuple):
    """One row for each followed feature in each frame, by frame."""

    frame: Int[np.ndarray, " N"]
    """Number of the frame, from 0."""
    track_id: Int[np.ndarray, " N"]
    """Identity of the feature."""
    place_m: Float[np.ndarray, "N 3"]
    """Place in the world, m."""
    velocity_m_s: Float[np.ndarray, "N 3"]
    """Velocity in the world, m/s."""
    velocity_cov: Float[np.ndarray, "N 3 3"]
    """Its covariance, (m/s)²."""


def followed(info: FrameInfo) -> Followed | None:
    """The followers of a run (see `vcjax.filter.follower`); None where nothing was to be followed.

    Args:
        info: of every frame, leading axis T.
    """
    followers = info.followers
    if followers is None:
        return None
    frame, slot = np.nonzero(np.asarray(followers.track_id) >= 0)
    leaves = followers.track_id, followers.place_m, followers.velocity_m_s, followers.cov
    track_id, place, velocity, cov = (np.asarray(leaf)[frame, slot] for leaf in leaves)
    return Followed(frame, track_id, place, velocity, cov[:, 3:, 3:])
