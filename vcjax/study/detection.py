"""What one run found out about each feature, whether it moves. Computed inside the batch."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.filter.info import FrameInfo
from vcjax.recording import Truth


def detections(info: FrameInfo, truth: Truth) -> dict[str, Array]:
    """How often and when each feature (F,) was mapped and deleted, how dynamic it ever looked, and the run's AUC.

    `dynamic_margin` is the largest of all frames (see `FrameInfo`), NaN of a feature that was never a measured
    candidate: a score by which features can be ranked, and above 0 where the gate has called it dynamic.
    `detector_margin` is the same of the detector's, NaN where it never had anything to say, and above 0 where it has
    deleted the feature: if for good, the score ends there (see `roc`). Frames count from 1; `first_mapped` and
    `first_deleted` are 0 where that never happened.
    """
    num_features, is_moving = truth.is_moving.shape[0], jnp.asarray(truth.is_moving)
    dynamic_id = jnp.where(info.is_dynamic, info.candidate_id, -1)
    deleted_id = jnp.concatenate([dynamic_id, info.inconsistent_id], axis=1)
    margin = largest_by_feature(info.candidate_id, info.dynamic_margin, num_features)
    detector_margin = largest_by_feature(info.watched_id, info.detector_margin, num_features)
    return {
        "dynamic_deletions": _count_by_feature(dynamic_id, num_features),
        "inconsistent_deletions": _count_by_feature(info.inconsistent_id, num_features),
        "frames_mapped": _count_by_feature(info.track_id, num_features),
        "first_mapped": first_frame(info.track_id, num_features),
        "first_deleted": first_frame(deleted_id, num_features),
        "dynamic_margin": margin,
        "detector_margin": detector_margin,
        "detection_auc": area_under_roc(margin, is_moving),
        "detector_auc": area_under_roc(detector_margin, is_moving),
        "is_moving": is_moving,
    }


def area_under_roc(score: Float[Array, " F"], is_mover: Bool[Array, " F"]) -> Float[Array, ""]:
    """Share of the pairs of a mover and another in which the mover has the higher score, ties counted half.

    Args:
        score: NaN of those that do not count.
        is_mover: labels.

    Returns: the area under the receiver operating characteristic, in [0, 1]; NaN where there are no pairs.
    """
    counts = ~jnp.isnan(score)
    is_pair = (is_mover & counts)[:, None] & (~is_mover & counts)
    above, tie = score[:, None] > score, score[:, None] == score
    num = jnp.sum(is_pair)
    right = jnp.sum(jnp.where(is_pair, above + 0.5 * tie, 0.0))
    return jnp.where(num > 0, right / jnp.where(num > 0, num, 1), jnp.nan)


def happened(ids: Int[Array, "T n"], num_features: int) -> Bool[Array, " F"]:
    """Which features are among the ids; -1 is none."""
    return jnp.zeros(num_features, bool).at[_places(ids, num_features)].set(True, mode="drop")


def _count_by_feature(ids: Int[Array, "T n"], num_features: int) -> Int[Array, " F"]:
    """How often each feature is among the ids."""
    return jnp.zeros(num_features, jnp.int32).at[_places(ids, num_features)].add(1, mode="drop")


def first_frame(ids: Int[Array, "T n"], num_features: int) -> Int[Array, " F"]:
    """First frame, from 1, in which each feature is among the ids; 0 where in none."""
    num_frames = ids.shape[0]
    frame = jnp.broadcast_to(jnp.arange(1, num_frames + 1, dtype=jnp.int32)[:, None], ids.shape).ravel()
    never = num_frames + 1
    first = jnp.full(num_features, never, jnp.int32).at[_places(ids, num_features)].min(frame, mode="drop")
    return jnp.where(first == never, 0, first)


def largest_by_feature(ids: Int[Array, "T n"], value: Float[Array, "T n"], num_features: int) -> Float[Array, " F"]:
    """Largest value of each feature over all frames, of those that are numbers; NaN where there is none."""
    places = jnp.where(jnp.isnan(value).ravel(), num_features, _places(ids, num_features))
    none = jnp.full(num_features, -jnp.inf, value.dtype)
    largest = none.at[places].max(jnp.nan_to_num(value.ravel()), mode="drop")
    return jnp.where(jnp.isneginf(largest), jnp.nan, largest)


def _places(ids: Int[Array, "T n"], num_features: int) -> Int[Array, " m"]:
    """The ids in a row, those of none beyond the end, where they are dropped."""
    return jnp.where(ids >= 0, ids, num_features).ravel()
