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
    """Its tracks are the pieces, numbered by the frame in which they begin, and of those that begin together the one
    of the oldest track first: births by id take what has been followed for long before what is new."""
    origin: Int[np.ndarray, " C"]
    """Track that each piece is of."""
    num_cuts: int

    def track_of(self, piece: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """Which track each piece belongs to; -1, nobody, stays.

        Raises:
            ValueError: for a piece that there is not.
        """
        piece = np.asarray(piece)
        if not len(self.origin):
            return piece
        if np.any(is_none := piece >= len(self.origin)):
            raise ValueError(f"track_of(piece={piece[is_none].flat[0]}): there are {len(self.origin)} pieces, from 0.")
        return np.where(piece >= 0, self.origin[piece], -1).astype(piece.dtype)

    def first_piece_of(self, track_id: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """The piece of each track that begins first.

        Raises:
            ValueError: for a track that there is not.
        """
        track_id = np.asarray(track_id)
        tracks, first = np.unique(self.origin, return_index=True)  # pieces are numbered in order of time
        if np.any(is_none := ~np.isin(track_id, tracks)):
            raise ValueError(f"first_piece_of(track_id={track_id[is_none].flat[0]}): the recording has no such track.")
        return first[np.searchsorted(tracks, track_id)].astype(track_id.dtype)


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
    is_valid, track_id = np.asarray(recording.is_valid), np.asarray(recording.track_id)
    frame, column = np.nonzero(is_valid)
    ids, uv_px = track_id[is_valid].astype(np.int64), np.asarray(recording.uv_px, np.float64)[is_valid]
    cut = cut_repeats(Tracks(frame, ids, uv_px)).track_id
    pieces, first, piece = np.unique(cut, return_index=True, return_inverse=True)
    order = np.lexsort((ids[first], frame[first]))
    rank = np.empty(len(order), track_id.dtype)
    rank[order] = np.arange(len(order))
    renamed = np.zeros_like(track_id)
    renamed[frame, column] = rank[piece]
    changed = renamed, last_sightings(renamed, is_valid)
    whole = eqx.tree_at(lambda r: (r.track_id, r.is_last), recording, changed)
    return CutRecording(whole, ids[first][order], len(pieces) - len(np.unique(ids)))


def _sorted(tracks: Tracks) -> _Sorted:
    frame, track_id, uv_px = (np.asarray(part) for part in tracks)
    order = np.lexsort((frame, track_id))
    track_id, frame, uv_px = track_id[order], frame[order], uv_px[order]
    is_next = np.append(False, (np.diff(track_id) == 0) & (np.diff(frame) == 1))[: len(order)]
    is_same = np.append(False, np.all(uv_px[1:] == uv_px[:-1], axis=-1))[: len(order)]
    return _Sorted(order, is_next, is_next & is_same)
