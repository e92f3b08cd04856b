"""What the gate said of each measured feature in each frame, and what became of each track over the recording."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from vcjax.filter.info import FrameInfo
from vcjax.sources.map_file import CLASSES

VERDICTS = ("accepted", "recovered", "dynamic", "rejected", "suspect", "deleted")
"""Accepted: corrected with. Recovered: isolated, then corrected with. Dynamic: isolated, called dynamic by the gate and
deleted. Rejected: isolated and left out. Suspect: left out unjudged, since the detector suspects it. Deleted: by the
detector, for what the frames before had shown."""
ACCEPTED, RECOVERED, DYNAMIC, REJECTED, SUSPECT, DELETED = range(6)


class Verdicts(NamedTuple):
    """One row for each verdict, by frame."""

    frame: Int[np.ndarray, " N"]
    """Number of the frame, from 0."""
    track_id: Int[np.ndarray, " N"]
    """Identity of the feature."""
    re1: Float[np.ndarray, " N"]
    """RE₁ at the state where it was gated; NaN for "deleted"."""
    re2: Float[np.ndarray, " N"]
    """RE₂ after the virtual correction; NaN where there was none."""
    margin: Float[np.ndarray, " N"]
    """How dynamic it looked, in χ² units (see `FrameInfo.dynamic_margin`); NaN for "suspect" and "deleted"."""
    verdict: Int[np.ndarray, " N"]
    """Index into `VERDICTS`."""


class TrackVerdicts(NamedTuple):
    """What became of the tracks that the gate or the detector had anything to say of."""

    track_id: Int[np.ndarray, " L"]
    """Identities, growing."""
    counts: Int[np.ndarray, "L 6"]
    """How often each of `VERDICTS` was passed."""
    margin: Float[np.ndarray, " L"]
    """The largest of all frames: a score by which tracks can be ranked; NaN where never judged."""
    detector_margin: Float[np.ndarray, " L"]
    """The same of the detector's; NaN where it never had anything to say."""

    @property
    def is_called(self) -> Bool[np.ndarray, " L"]:
        """Called dynamic by the gate, or deleted by the detector, at least once."""
        return (self.counts[:, DYNAMIC] + self.counts[:, DELETED]) > 0


def verdicts(info: FrameInfo) -> Verdicts:
    """The verdicts of a run.

    Args:
        info: of every frame, leading axis T.
    """
    is_measured = np.asarray(info.is_measured)
    told = {
        ACCEPTED: info.is_accepted,
        RECOVERED: info.is_recovered,
        DYNAMIC: info.is_dynamic,
        SUSPECT: info.is_suspect,
    }
    in_frame = np.select([np.asarray(flag)[is_measured] for flag in told.values()], list(told), REJECTED)
    numbers = [np.asarray(x, np.float64)[is_measured] for x in (info.re1, info.re2, info.dynamic_margin)]
    deleted = np.asarray(info.inconsistent_id)
    frame, slot = np.nonzero(deleted >= 0)
    nothing = np.full(len(frame), np.nan)
    frames = np.concatenate([np.nonzero(is_measured)[0], frame])
    order = np.argsort(frames, kind="stable")
    columns = (
        frames,
        np.concatenate([np.asarray(info.candidate_id)[is_measured], deleted[frame, slot]]).astype(np.int64),
        *(np.concatenate([column, nothing]) for column in numbers),
        np.concatenate([in_frame, np.full(len(frame), DELETED)]),
    )
    return Verdicts(*(column[order] for column in columns))


def track_verdicts(passed: Verdicts, info: FrameInfo) -> TrackVerdicts:
    """The verdicts of each track.

    Args:
        passed: all verdicts.
        info: of every frame, leading axis T.
    """
    ids, track = np.unique(passed.track_id, return_inverse=True)
    counts = np.zeros((len(ids), len(VERDICTS)), np.int64)
    np.add.at(counts, (track, passed.verdict), 1)
    margin, by_detector = np.full((2, len(ids)), -np.inf)
    np.fmax.at(margin, track, passed.margin)
    watched, said = np.asarray(info.watched_id), np.asarray(info.detector_margin, np.float64)
    is_said = np.isfinite(said) & np.isin(watched, ids)
    np.fmax.at(by_detector, np.searchsorted(ids, watched[is_said]), said[is_said])
    margin, by_detector = (np.where(np.isneginf(x), np.nan, x) for x in (margin, by_detector))
    return TrackVerdicts(ids, counts, margin, by_detector)


def classes(track_id: Int[np.ndarray, " M"], tracks: TrackVerdicts) -> tuple[str, ...]:
    """What became of landmarks, of `map_file.CLASSES`.

    Dynamic if it was ever called so or deleted; recovered if it ever was; accepted if it ever corrected the state;
    unused otherwise.
    """
    unused = len(CLASSES) - 1
    kind = np.full(len(tracks.track_id), unused)
    for verdict, name in ((ACCEPTED, "accepted"), (RECOVERED, "recovered"), (DYNAMIC, "dynamic"), (DELETED, "dynamic")):
        kind[tracks.counts[:, verdict] > 0] = CLASSES.index(name)
    if not len(kind):
        return (CLASSES[unused],) * len(track_id)
    place = np.searchsorted(tracks.track_id, track_id).clip(max=len(kind) - 1)
    found = np.where(tracks.track_id[place] == track_id, kind[place], unused)
    return tuple(CLASSES[i] for i in found)
