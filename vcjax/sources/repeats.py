"""Tracks that stand still to the last bit: a front end that did not follow, or an image that came twice.

A tracker that measures a feature in a new image does not find it at the pixel of the frame before to the last bit.
Where one says so, it did not look: it carried the place over. Either the image was a copy of the one before, or, as
front ends do that follow and look for new corners in turns, the next frame is followed from the old place in the new
image, and the track goes on with another point of the world. Nothing in such a sighting tells of the camera's motion,
and all of them together say that it stood still, which no gate can tell from the truth where odometry is poor.

Standing cameras and pixels that were rounded (to whole ones, or to few digits) repeat in earnest: so nothing here is
done unasked.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Int

from vcjax.recording import Recording, last_sightings
from vcjax.sources.tracks import Tracks


class CutRecording(NamedTuple):
    """A recording whose tracks are cut where they repeat."""

    recording: Recording
    last_id: int
    """The largest identity before; pieces cut off are numbered from there on."""
    origin: Int[np.ndarray, " C"]
    """Track that each piece was cut off."""

    def track_of(self, piece: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """Which track each piece belongs to; -1, nobody, stays."""
        piece = np.asarray(piece)
        if not len(self.origin):
            return piece
        cut = self.origin[(piece - self.last_id - 1).clip(0, len(self.origin) - 1)]
        return np.where(piece > self.last_id, cut, piece).astype(piece.dtype)


class _Sorted(NamedTuple):
    """Sightings in order of track, then frame."""

    order: Int[np.ndarray, " N"]
    is_next: Bool[np.ndarray, " N"]
    """Whether a sighting follows one of the same track in the frame before."""
    is_repeat: Bool[np.ndarray, " N"]
    """Whether it does, at the same pixel."""


def repeated_frames(tracks: Tracks) -> Int[np.ndarray, " R"]:
    """Frames in which more than half of the tracks that go on from the frame before have not moved by one bit."""
    order, is_next, is_repeat = _sorted(tracks)
    num_frames = int(tracks.frame.max()) + 1 if len(tracks.frame) else 0
    frame = np.asarray(tracks.frame)[order]
    going_on = np.bincount(frame[is_next], minlength=num_frames)
    repeating = np.bincount(frame[is_repeat], minlength=num_frames)
    return np.flatnonzero(2 * repeating > going_on)


def cut_repeats(tracks: Tracks) -> Tracks:
    """Tracks cut where they repeat a pixel to the last bit: what follows goes on as a track of its own.

    Args:
        tracks: sightings, at most one of a track in a frame.

    Returns: the same sightings in the same order. The first piece of a track keeps its id; the others get new ones from
    the largest on. So `zip(cut.track_id, tracks.track_id)` says whose piece each is.
    """
    order, _, is_repeat = _sorted(tracks)
    track_id, frame = np.asarray(tracks.track_id), np.asarray(tracks.frame)
    if not len(track_id):
        return tracks
    piece = np.cumsum(is_repeat)  # of all tracks together: 0 before the first cut
    is_first = np.diff(track_id[order], prepend=-1) != 0
    piece_of_start = np.maximum.accumulate(np.where(is_first, piece, 0))
    cuts = np.flatnonzero(is_repeat)
    # New ids in order of time, so that births by id keep their order.
    rank = np.empty(len(cuts), np.int64)
    rank[np.lexsort((track_id[order][cuts], frame[order][cuts]))] = np.arange(len(cuts))
    ids = np.concatenate([[0], int(track_id.max()) + 1 + rank])
    cut = track_id.astype(np.int64)
    cut[order] = np.where(piece > piece_of_start, ids[piece], track_id[order])
    return tracks._replace(track_id=cut)


def cut_recording(recording: Recording) -> CutRecording:
    """A recording with its tracks cut by `cut_repeats`, and which piece is whose. Pixels stay where they are."""
    is_valid, track_id = np.asarray(recording.is_valid), np.array(recording.track_id, np.int64)
    last_id = int(track_id[is_valid].max(initial=-1))
    frame, column = np.nonzero(is_valid)
    uv_px = np.asarray(recording.uv_px, np.float64)[frame, column]
    cut = cut_repeats(Tracks(frame, track_id[frame, column], uv_px)).track_id
    pieces, first = np.unique(cut, return_index=True)
    origin = track_id[frame, column][first[pieces > last_id]]
    track_id[frame, column] = cut
    if cut.max(initial=0) > np.iinfo(np.int32).max:
        raise ValueError(
            f"cut_recording: pieces are numbered from {last_id + 1} on, which passes 2³¹; number tracks from 0."
        )
    track_id = track_id.astype(np.asarray(recording.track_id).dtype)
    changed = track_id, last_sightings(track_id, is_valid)
    return CutRecording(eqx.tree_at(lambda r: (r.track_id, r.is_last), recording, changed), last_id, origin)


def _sorted(tracks: Tracks) -> _Sorted:
    frame, track_id, uv_px = (np.asarray(part) for part in tracks)
    order = np.lexsort((frame, track_id))
    track_id, frame, uv_px = track_id[order], frame[order], uv_px[order]
    is_next = np.append(False, (np.diff(track_id) == 0) & (np.diff(frame) == 1))[: len(order)]
    is_same = np.append(False, np.all(uv_px[1:] == uv_px[:-1], axis=-1))[: len(order)]
    return _Sorted(order, is_next, is_next & is_same)
