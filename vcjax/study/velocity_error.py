"""How far a detector's velocity of a feature is from the truth, when it flags it. Computed inside the batch."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from vcjax.filter.info import FrameInfo
from vcjax.gates.gate import AbstractDetector
from vcjax.recording import Truth
from vcjax.study.detection import first_frame


def velocity_errors(
    detector: AbstractDetector, info: FrameInfo, truth: Truth, frame_rate_hz: float | Float[Array, ""]
) -> dict[str, Float[Array, " F"]]:
    """Error of v̂ of each feature at its first deletion by the detector, and its normalised square.

    The truth is the mean velocity from its last birth before that to then, which is the velocity of a feature that
    keeps it, and zero of a static one. `velocity_error_m_s` is |v̂ - v|, `velocity_nees` eᵀ Cov⁻¹ e with three degrees
    of freedom. NaN of features that the detector never deleted, and of detectors that estimate no velocity.
    """
    num_features = truth.is_moving.shape[0]
    estimate = detector.velocity(info.detector)
    if estimate is None:
        nothing = jnp.full(num_features, jnp.nan)
        return {"velocity_error_m_s": nothing, "velocity_nees": nothing}
    deleted = first_frame(info.inconsistent_id, num_features)
    frame = jnp.arange(1, info.inconsistent_id.shape[0] + 1)[:, None]

    # The slot and frame of each first deletion, which no other entry shares.
    ids = info.inconsistent_id
    place = jnp.where((ids >= 0) & (deleted[ids] == frame), ids, num_features)
    v, cov = (
        jnp.full((num_features, *value.shape[2:]), jnp.nan, value.dtype).at[place].set(value, mode="drop")
        for value in estimate
    )
    ids = info.born_id
    is_before = (ids >= 0) & (frame < deleted[ids])
    born = jnp.zeros(num_features, frame.dtype).at[jnp.where(is_before, ids, num_features)].max(frame, mode="drop")

    def where(frames):
        return jnp.take_along_axis(jnp.asarray(truth.landmarks_m), jnp.maximum(frames - 1, 0)[None, :, None], axis=0)[0]

    moved = (where(deleted) - where(born)) * frame_rate_hz
    error = v - moved / jnp.maximum(deleted - born, 1)[:, None]
    nees = jnp.sum(error * jnp.linalg.solve(cov, error[..., None])[..., 0], axis=-1)
    is_there = (deleted > 0) & (born > 0)
    return {
        "velocity_error_m_s": jnp.where(is_there, jnp.linalg.norm(error, axis=-1), jnp.nan),
        "velocity_nees": jnp.where(is_there, nees, jnp.nan),
    }
