"""EKF-SLAM: `start` for the first frame, `step` for every other (`run` takes a whole recording).

One frame, in order: prediction (6) (7); every landmark's pixel predicted; the K most uncertain visible ones chosen;
formal corrections (8)–(12) with those that the detector does not suspect, the gate's verdict on the others (13) (14),
corrections with the recovered; deletion of what gate or detector flagged, which is then followed outside the map if
wanted; retirement of what cannot matter any more; births.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray, PyTree

from vcjax.fields import require_kind
from vcjax.filter import landmark_map
from vcjax.filter.config import FilterConfig, check_arguments
from vcjax.filter.correction import pixel_cov
from vcjax.filter.evidence import evidence_of
from vcjax.filter.features import choose, match, predict_features
from vcjax.filter.following import follow
from vcjax.filter.frame_corrections import correct_frame
from vcjax.filter.info import FrameInfo
from vcjax.filter.known_landmarks import KnownLandmarks, check_known, place_known
from vcjax.filter.landmark_points import landmark_points
from vcjax.filter.map_covariance import SLOT
from vcjax.filter.state import FREE, VEHICLE, FilterState, initial_state, slot_count
from vcjax.filter.submap import gather, normalise, scatter
from vcjax.gates.surrogates import decide
from vcjax.recording import Frame, Recording, validate


def predict(config: FilterConfig, state: FilterState, frame: Frame) -> FilterState:
    """Prediction: the robot moves as its model says, the camera by its commanded displacement. Equations (6) and (7).

    Only the rows of P of the robot, and of what the model carries, change: P_r,all ← F P_r,all, P_rr += F_n N F_nᵀ.
    """
    moving = _moving(state)

    def move(moving: Array, given: Array) -> Array:
        robot, carried = config.motion.move(moving[:7], moving[7:], given, frame.time_step_s)
        return jnp.concatenate([robot, carried]) if len(carried) else robot

    given, given_cov = config.motion.input(frame)
    F, F_n = jax.jacfwd(move, argnums=(0, 1))(moving, given)
    moved, sensor = move(moving, given), state.sensor.at[:3].add(frame.sensor_shift_m)
    if len(moving) > 7:
        rows = np.r_[0:7, VEHICLE : len(state.vehicle)]
        square = np.ix_(rows, rows)
    else:
        rows, square = slice(7), (slice(7), slice(7))
    F_v = jnp.eye(len(state.vehicle), dtype=F.dtype).at[square].set(F)
    P_vv = F_v @ state.P_vv @ F_v.T
    P_vv = P_vv.at[square].add(F_n @ given_cov @ F_n.T)
    P_vv = P_vv.at[8, 8].add(config.oscillation_std_m**2)  # the lateral axis, y, of the sensor's position
    P_vm = state.P_vm.at[rows].set(F @ state.P_vm[rows])
    vehicle = jnp.concatenate([moved[:7], sensor, moved[7:]] if len(moving) > 7 else [moved, sensor])
    return eqx.tree_at(lambda s: (s.vehicle, s.P_vv, s.P_vm), state, (vehicle, P_vv, P_vm))


def _moving(state: FilterState) -> Array:
    """Robot pose and what the motion model carries."""
    carried = state.vehicle[VEHICLE:]
    return jnp.concatenate([state.robot, carried]) if len(carried) else state.robot


def step(config: FilterConfig, state: FilterState, frame: Frame) -> tuple[FilterState, FrameInfo]:
    """One frame of EKF-SLAM.

    Pure; works under `jit`, `vmap`, `scan` and differentiation (exact derivatives of all that is continuous; choices
    and verdicts have zero derivative). What happens in a run raises nothing: look at `is_finite` and `map_is_full`.

    Args:
        config: filter configuration.
        state: state after the frame before, from `start` or `step`.
        frame: odometry and features.

    Returns: the state after this frame, and its info.

    Raises:
        ValueError: for what is no configuration, state or frame, or a state of another configuration's size, before
            anything compiles.
    """
    _check_step(config, state, frame)
    state = predict(config, state, frame)
    prediction = predict_features(config, state, frame.camera)
    column = match(state, frame)
    slot, is_searched = choose(config, prediction, column >= 0)
    is_measured = is_searched & (column[slot] >= 0)
    uv_px = frame.uv_px[column[slot]]

    detector = _of_mapped(config, state)
    suspicion = config.detector.suspicion(detector)
    state, submap, rows = gather(config, state, slot)
    is_suspect = jnp.zeros_like(is_searched) if suspicion is None else is_searched & (suspicion[slot] > 0)
    submap, outcome = correct_frame(config, frame.camera, submap, uv_px, is_measured, is_suspect)
    state = scatter(config, state, submap, slot, rows)
    innovation, verdict = outcome.innovation, outcome.verdict

    is_dynamic = jnp.zeros_like(prediction.is_visible).at[slot].set(outcome.is_dynamic)
    is_visible = prediction.is_visible.at[slot].set(
        jnp.where(is_measured, innovation.is_visible, prediction.is_visible[slot])
    )
    is_watched = state.is_mapped & ~is_dynamic
    R = pixel_cov(config, innovation.S.dtype)
    is_visible &= ~is_dynamic
    evidence = evidence_of(outcome, slot, is_searched, is_measured, is_suspect, is_visible, R, frame.time_step_s)
    detector, margin = config.detector.observe(detector, evidence)
    margin = jnp.where(is_watched, margin, jnp.nan).astype(state.P_vv.dtype)
    is_flagged = margin > 0
    state = eqx.tree_at(lambda s: s.detector, state, detector)

    info_of_candidates: dict[str, Any] = dict(
        candidate_id=jnp.where(is_searched, state.track_id[slot], FREE),
        is_measured=is_measured,
        pixel=innovation.pixel,
        innovation=innovation.z,
        innovation_cov=innovation.S,
        re1=innovation.re1,
        re1_prior=verdict.re1,
        re2=verdict.re2,
        is_accepted=outcome.is_accepted,
        is_recovered=outcome.is_recovered,
        is_dynamic=outcome.is_dynamic,
        is_suspect=outcome.is_suspect,
        dynamic_margin=outcome.dynamic_margin,
        p_dynamic=outcome.p_dynamic,
        watched_id=jnp.where(is_watched, state.track_id, FREE),
        detector=detector,
        detector_margin=margin,
        p_detector=decide(config.smoothing, margin, config.temperature),
        inconsistent_id=jnp.where(is_flagged, state.track_id, FREE),
    )
    is_deleted = is_dynamic | is_flagged
    before = state
    state = landmark_map.delete(landmark_map.ban(config, state, is_deleted), is_deleted)
    state, info_of_candidates["handed_back_id"] = follow(config, before, state, is_deleted, frame)
    if config.retire:
        state = landmark_map.retire(config, state, prediction.is_near)
    info_of_candidates["departed"] = landmark_points(before, ~state.is_mapped)
    has_ended = state.has_ended | (frame.is_last[column] & (column >= 0))
    state = eqx.tree_at(lambda s: s.has_ended, state, has_ended)
    num_features = frame.is_valid.shape[0]
    place = jnp.where(state.is_mapped & (column >= 0), column, num_features)
    is_mapped = jnp.zeros(num_features, bool).at[place].set(True, mode="drop")
    return _finish(config, state, frame, is_mapped, config.births_per_frame, info_of_candidates)


def _of_mapped(config: FilterConfig, state: FilterState) -> PyTree:
    """The detector's states, of free slots as at birth: what is left of the landmark before must have no effect."""

    def born_if_free(born, leaf):
        return jnp.where(state.is_mapped.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, born)

    return jax.tree.map(born_if_free, config.detector.born(), state.detector)


def _check_step(config: FilterConfig, state: FilterState, frame: Frame) -> None:
    """Refuse what `step` cannot work with, as far as kinds and shapes tell."""
    check_arguments("step", config, None)
    require_kind("step", "state", state, FilterState, "give a state as vcjax.start or vcjax.step returns it.")
    require_kind("step", "frame", frame, Frame, "give a frame, e.g. recording.frame(t).")
    num_slots, needed = state.track_id.shape[-1], slot_count(config)
    if num_slots != needed:
        raise ValueError(
            f"step(state) has {num_slots} slots, but config (max_landmarks={config.max_landmarks}) needs {needed}: "
            "go on with the configuration that `start` was given."
        )
    num_features = frame.track_id.shape
    for name, shape in (("uv_px", (*num_features, 2)), ("is_valid", num_features), ("is_last", num_features)):
        if getattr(frame, name).shape != shape:
            found = getattr(frame, name).shape
            raise ValueError(f"step(frame.{name}) has shape {found}, but {shape} is needed: one row for each track_id.")


def start(
    config: FilterConfig,
    recording: Recording,
    key: PRNGKeyArray | None = None,
    known: KnownLandmarks | None = None,
) -> tuple[FilterState, FrameInfo]:
    """The first frame of a recording: its odometry, and the first births into the empty map.

    Args:
        config: filter configuration.
        recording: what the run reads.
        key: for a random order of births, and only then.
        known: landmarks that are in the map from the start.

    Returns: the state after the first frame, and its info.

    Raises:
        ValueError: for a recording that no filter can run on (see `recording.validate`), or known landmarks that make
            no map.
    """
    check_arguments("start", config, key)
    validate(recording)
    state = initial_state(config, recording, key)
    if known is not None:
        check_known(config, known)
        state = place_known(state, known)
    frame = recording.frame(0)
    state = predict(config, state, frame)
    # The start's covariance may hold variance along a quaternion, which births must not see.
    vehicle, N = normalise(config, state.vehicle)
    state = eqx.tree_at(lambda s: (s.vehicle, s.P_vv), state, (vehicle, N @ state.P_vv @ N.T))
    K, L, dtype = config.max_updates, slot_count(config), state.P_vv.dtype
    nobody, nothing = jnp.zeros(K, bool), jnp.full(K, jnp.nan, dtype)
    info_of_candidates: dict[str, Any] = dict(
        candidate_id=jnp.full(K, FREE, jnp.int32),
        is_measured=nobody,
        pixel=jnp.zeros((K, 2), dtype),
        innovation=jnp.zeros((K, 2), dtype),
        innovation_cov=jnp.zeros((K, 2, 2), dtype),
        re1=nothing,
        re1_prior=nothing,
        re2=nothing,
        is_accepted=nobody,
        is_recovered=nobody,
        is_dynamic=nobody,
        is_suspect=nobody,
        dynamic_margin=nothing,
        p_dynamic=jnp.zeros(K, dtype),
        watched_id=jnp.full(L, FREE, jnp.int32),
        detector=state.detector,
        detector_margin=jnp.full(L, jnp.nan, dtype),
        p_detector=jnp.zeros(L, dtype),
        inconsistent_id=jnp.full(L, FREE, jnp.int32),
        handed_back_id=jnp.full(config.following.max_followed, FREE, jnp.int32)
        if config.following.max_followed
        else None,
    )
    info_of_candidates["departed"] = landmark_points(state, jnp.zeros_like(state.is_mapped))
    is_mapped = jnp.zeros_like(frame.is_valid) if known is None else jnp.isin(frame.track_id, known.track_id)
    return _finish(config, state, frame, is_mapped, config.births_first_frame, info_of_candidates)


def _finish(
    config: FilterConfig,
    state: FilterState,
    frame: Frame,
    is_mapped: Bool[Array, " V"],
    num_births: int,
    info_of_candidates: dict[str, Any],
) -> tuple[FilterState, FrameInfo]:
    """Births, and the frame's info."""
    state, born, num_waiting = landmark_map.give_birth(config, state, frame, is_mapped, num_births)
    attempts = max(config.births_first_frame, config.births_per_frame)
    info = FrameInfo(
        vehicle=state.vehicle[:VEHICLE],
        vehicle_cov=state.P_vv[:VEHICLE, :VEHICLE],
        carried=state.vehicle[VEHICLE:],
        carried_std=jnp.sqrt(jnp.diagonal(state.P_vv)[VEHICLE:]),
        born_id=jnp.full(attempts, FREE, born.dtype).at[:num_births].set(born),
        followers=state.followers,
        track_id=state.track_id,
        num_coordinates=len(state.vehicle)
        + jnp.sum(jnp.where(state.is_mapped, jnp.where(state.is_euclidean, 3, SLOT), 0)),
        map_is_full=num_waiting > 0,
        num_waiting=num_waiting,
        is_finite=jnp.all(jnp.isfinite(state.vehicle)) & jnp.all(jnp.isfinite(state.P_vv)),
        **info_of_candidates,
    )
    return state, info
