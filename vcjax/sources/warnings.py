"""What whoever runs a filter over a recording should know of it first: repeats, jumps, blind frames, wrong lenses.

None of it breaks a run. It tells where the estimate is weak, or where the front end rather than the filter is at fault.
"""

import numpy as np
from jaxtyping import Int

from vcjax.recording import Recording
from vcjax.sources.repeats import repeated_frames
from vcjax.sources.tracks import tracks_of

JUMP = 1.5
"""A time step this many times the median, or more, is a jump: at least one frame in between was dropped."""
NO_ODOMETRY = "no odometry: run with --motion constant_velocity; the scale is free unless a length is known"
_MOST_NAMED = 5


def time_jumps(recording: Recording) -> Int[np.ndarray, " J"]:
    """Frames before which time jumps."""
    step = np.diff(np.asarray(recording.time_s, np.float64))
    return np.flatnonzero(step >= JUMP * np.median(step)) + 1 if len(step) else np.zeros(0, int)


def empty_frames(recording: Recording) -> Int[np.ndarray, " E"]:
    """Frames without any feature."""
    return np.flatnonzero(~np.any(np.asarray(recording.is_valid), axis=1))


def unfollowed_frames(recording: Recording) -> Int[np.ndarray, " U"]:
    """Frames with features, after frames with features, in which no track goes on: nothing links the two images."""
    is_valid, track_id = np.asarray(recording.is_valid), np.asarray(recording.track_id)
    found = [
        t
        for t in range(1, len(is_valid))
        if is_valid[t].any()
        and is_valid[t - 1].any()
        and not np.isin(track_id[t][is_valid[t]], track_id[t - 1][is_valid[t - 1]]).any()
    ]
    return np.array(found, int)


def outside_image(recording: Recording) -> int:
    """How many sightings are more than a pixel outside the image."""
    uv_px = np.asarray(recording.uv_px)[np.asarray(recording.is_valid)]
    return int(np.sum(np.any((uv_px < -1.0) | (uv_px > np.asarray(recording.camera.image_size_px) + 1.0), axis=1)))


def without_ray(recording: Recording) -> int:
    """How many sightings are not valid because the lens has no inverse there (see `recording_from_tracks`)."""
    is_nowhere = np.isnan(np.asarray(recording.uv_px)).any(axis=-1)
    return int(np.sum(is_nowhere & ~np.asarray(recording.is_valid)))


def warnings(recording: Recording) -> list[str]:
    """A line for each thing to be warned of."""
    found = []
    repeated = repeated_frames(tracks_of(recording))
    if len(repeated):
        found.append(
            f"{_frames(repeated)}: most tracks repeat the frame before to the last bit. If the camera did not stand "
            "still there, run with --cut-repeats"
        )
    jumps = time_jumps(recording)
    if len(jumps):
        found.append(f"time jumps before {_frames(jumps)}, by {JUMP} times the usual step or more")
    if len(empty := empty_frames(recording)):
        found.append(f"{_frames(empty)}: no feature is seen")
    if len(unfollowed := unfollowed_frames(recording)):
        found.append(f"{_frames(unfollowed)}: no track goes on from the frame before")
    if num := outside_image(recording):
        width, height = np.asarray(recording.camera.image_size_px)
        found.append(
            f"{num} sightings of {np.sum(recording.is_valid)} lie outside the image ({width:g} × {height:g} px): is "
            "this the calibration of these images?"
        )
    if num := without_ray(recording):
        found.append(f"{num} sightings are left out, as the lens of the calibration has no place for their pixels")
    if not np.any(np.asarray(recording.odometry)):
        found.append(NO_ODOMETRY)
    return found


def _frames(numbers: Int[np.ndarray, " N"]) -> str:
    """Some frames by number, and how many there are."""
    if len(numbers) == 1:
        return f"frame {numbers[0]}"
    more = ", …" if len(numbers) > _MOST_NAMED else ""
    return f"{len(numbers)} frames ({', '.join(map(str, numbers[:_MOST_NAMED]))}{more})"
