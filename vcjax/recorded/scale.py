"""Where the lengths of a run come from, and what to do where nothing gives them.

A camera alone sees directions: without odometry, known landmarks or a known motion of the camera on the robot, path and
map are as good at any scale, and what a run shows is the scale of its priors. Then one known length settles it: all
lengths are multiplied by known / found. That is exact, since all scales fit the pixels alike, where a correction of the
filter with the length would be linearised about a scale that may be wrong by any factor. It does not mend a scale that
drifts on the way.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from vcjax.filter.known_landmarks import KnownLandmarks
from vcjax.filter.motion_model import AbstractMotion
from vcjax.recorded.filtered import Filtered, LastPlaces
from vcjax.recording import Recording
from vcjax.sources.image_sequence import camera_of_robot


class KnownDistance(NamedTuple):
    """A length in the world that somebody has measured."""

    track_id: tuple[int, int]
    """The two features that it lies between."""
    distance_m: float
    """m; positive."""


def scale_source(motion: AbstractMotion, recording: Recording, known: KnownLandmarks | None = None) -> str | None:
    """What gives a run its lengths, in words; None where nothing does, and the scale is free."""
    if motion.gives_scale and np.any(np.asarray(recording.odometry)):
        return "odometry"
    if known is not None and (num := len(known.track_id)):  # one will do: the start's place is known as well
        return f"{num} known landmark{'s' if num > 1 else ''}"
    if np.any(np.asarray(recording.sensor_shift_m)):
        return "the commanded motion of the camera"
    return None


def check_known_distance(known: KnownDistance, recording: Recording, source: str | None) -> None:
    """Refuse a known distance that settles nothing.

    Raises:
        ValueError: for a length that is not positive, the same track twice, one that the recording has not, or a run
            whose scale is known already.
    """
    first, second = known.track_id
    if not (np.isfinite(known.distance_m) and known.distance_m > 0):
        raise ValueError(f"known distance {known.distance_m}: give a positive number of metres.")
    if first == second:
        raise ValueError(f"known distance between track {first} and itself: give two tracks.")
    there = np.asarray(recording.track_id)[np.asarray(recording.is_valid)]
    for track in known.track_id:
        if track not in there:
            raise ValueError(f"known distance from track {track}: the recording has no such track.")
    if source is not None:
        raise ValueError(f"known distance: the scale of this run is known from {source}; leave one of the two out.")


def found_distance(known: KnownDistance, landmarks: LastPlaces) -> float:
    """The same length in the map, between the last places of both, m.

    Raises:
        ValueError: if one of the two was never in the map.
    """
    places = []
    for track in known.track_id:
        if not len(row := np.flatnonzero(landmarks.track_id == track)):
            raise ValueError(
                f"known distance from track {track}: it was never in the map; take tracks that are seen for longer, or "
                "raise births_per_frame."
            )
        places.append(landmarks.place_m[row[0]])
    return float(np.linalg.norm(places[1] - places[0]))


def scaled(filtered: Filtered, factor: float) -> Filtered:
    """A run with the path of its camera, its landmarks and followers multiplied, as seen from the camera's first place.

    The camera's place on the robot is known and stays: the robot goes where its camera does. What the motion model
    carries is left as the filter had it.
    """
    vehicle = np.array(filtered.info.vehicle, np.float64)
    place = camera_of_robot(*np.split(vehicle, 2, axis=1))[:, :3]
    moved = (factor - 1.0) * (place - place[0])
    vehicle[:, :3] += moved
    cov = np.array(filtered.info.vehicle_cov, np.float64)
    cov[:, :3] *= factor
    cov[:, :, :3] *= factor
    landmarks = filtered.landmarks
    places = place[0] + factor * (landmarks.place_m - place[0])
    info = eqx.tree_at(lambda i: (i.vehicle, i.vehicle_cov), filtered.info, (vehicle, cov))
    if (followers := info.followers) is not None:
        scaled_followers = followers._replace(
            place_m=place[0] + factor * (followers.place_m - place[0]),
            velocity_m_s=factor * followers.velocity_m_s,
            cov=factor**2 * followers.cov,
            rest_place_m=place[0] + factor * (followers.rest_place_m - place[0]),
            rest_cov=factor**2 * followers.rest_cov,
        )
        info = eqx.tree_at(lambda i: i.followers, info, scaled_followers)
    return filtered._replace(
        info=info, landmarks=LastPlaces(landmarks.track_id, places, factor**2 * np.asarray(landmarks.cov))
    )
