"""The landmark map: birth, deletion, retirement. Slots change hands; P is touched only where a landmark is born."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from vcjax.filter.config import FilterConfig
from vcjax.filter.map_covariance import SLOT
from vcjax.filter.state import FREE, VEHICLE, FilterState
from vcjax.models.camera import is_inside
from vcjax.models.landmarks import INVERSE_DEPTH, back_project_landmark
from vcjax.recording import Frame


def delete(state: FilterState, is_deleted: Bool[Array, " L"]) -> FilterState:
    """Free the slots of landmarks. What is left in their rows of P is inert, and overwritten at the next birth.

    Removing rows and columns of a Gaussian is marginalisation: exact for everything that stays.
    """
    track_id = jnp.where(is_deleted, FREE, state.track_id)
    return eqx.tree_at(lambda s: s.track_id, state, track_id)


def retire(config: FilterConfig, state: FilterState, is_near: Bool[Array, " L"]) -> FilterState:
    """Free the slots of landmarks whose features are never measured again, and which nothing depends on any more.

    Among the predicted, a landmark that is not measured can be chosen for update as long as it is predicted visible
    (see `FilterConfig.retire`), so it stays while it is near the image.
    """
    is_retired = state.has_ended & ~is_near if config.choose_among == "predicted" else state.has_ended
    return delete(state, is_retired)


def ban(config: FilterConfig, state: FilterState, is_banned: Bool[Array, " L"]) -> FilterState:
    """Put the features of some slots on the blacklist, newest first, once in every frame.

    Those whose time is over fall off, and the oldest when it is full.
    """
    capacity = state.blacklist.shape[0]
    if capacity == 0:
        return state
    frames = jnp.asarray(config.blacklist_frames, state.blacklist_left.dtype)
    left = jnp.concatenate([jnp.broadcast_to(frames, is_banned.shape), state.blacklist_left - 1])
    everyone = jnp.concatenate([jnp.where(is_banned, state.track_id, FREE), state.blacklist])
    everyone = jnp.where(left > 0, everyone, FREE)
    newest_first = jnp.argsort(everyone == FREE, stable=True)[:capacity]
    return eqx.tree_at(lambda s: (s.blacklist, s.blacklist_left), state, (everyone[newest_first], left[newest_first]))


def give_birth(
    config: FilterConfig, state: FilterState, frame: Frame, is_mapped: Bool[Array, " V"], num_births: int
) -> tuple[FilterState, Int[Array, " births"], Int[Array, ""]]:
    """Initialise up to `num_births` new landmarks from features that are not in the map. Paper's Table 1.

    Eligible are measured features at least `birth_margin_px` inside the image and not on the blacklist; lowest id
    first, or in random order.

    Args:
        config: priors, margin and order.
        state: the state after the frame's corrections.
        frame: measured features.
        is_mapped: which of them the map holds already.
        num_births: static number of attempts.

    Returns: the state, the ids of those born (-1 for an attempt without a birth), and how many features have to
    wait because the map is full.
    """
    is_eligible = frame.is_valid & ~is_mapped & is_inside(frame.camera, frame.uv_px, config.birth_margin_px)
    is_eligible &= ~jnp.any(frame.track_id[:, None] == state.blacklist, axis=1)
    rank = frame.track_id if state.key is None else _random_rank(state.key, frame.track_id)
    last = jnp.iinfo(rank.dtype).max

    def attempt(carry, _):
        state, is_eligible = carry
        column = jnp.argmin(jnp.where(is_eligible, rank, last))
        first_free = jnp.argmin(state.is_mapped)
        is_born = is_eligible[column] & (first_free < config.max_landmarks)
        # Where nothing is born, the last slot, which is always free, takes the write.
        slot = jnp.where(is_born, first_free, state.track_id.shape[0] - 1)
        born_id = jnp.where(is_born, frame.track_id[column], FREE)
        state = _initialise(config, state, frame, column, slot, born_id)
        return (state, is_eligible.at[column].set(is_eligible[column] & ~is_born)), born_id

    (state, is_waiting), born = jax.lax.scan(attempt, (state, is_eligible), None, length=num_births)
    is_full = jnp.all(state.is_mapped[: config.max_landmarks])
    return state, born, jnp.where(is_full, jnp.sum(is_waiting), 0)


def _initialise(
    config: FilterConfig,
    state: FilterState,
    frame: Frame,
    column: Int[Array, ""],
    slot: Int[Array, ""],
    born_id: Int[Array, ""],
) -> FilterState:
    """Write a new AHP landmark l(vehicle, pixel, ρ) into a slot.

    P_lX = L_m P_mX and P_ll = L_m P_mm L_mᵀ + L_y R L_yᵀ + σ_ρ² L_ρ L_ρᵀ with m the vehicle (robot and sensor).
    """
    uv_px = jnp.where(born_id != FREE, frame.uv_px[column], 0.0)

    def back_project(vehicle, pixel):
        return back_project_landmark(
            frame.camera, vehicle[:7], vehicle[7:VEHICLE], pixel, config.inverse_depth_mean, config.toolbox_parity
        )

    landmark = back_project(state.vehicle, uv_px)
    L_m, L_y = jax.jacfwd(back_project, argnums=(0, 1))(state.vehicle, uv_px)
    own = L_m @ state.P_vv @ L_m.T + config.pixel_std_px**2 * (L_y @ L_y.T)
    own = own.at[INVERSE_DEPTH, INVERSE_DEPTH].add(config.inverse_depth_std**2)

    first = SLOT * slot
    rows = jax.lax.dynamic_update_slice_in_dim(L_m @ state.P_vm, own, first, axis=1)
    P_vm = jax.lax.dynamic_update_slice_in_dim(state.P_vm, state.P_vv @ L_m.T, first, axis=1)
    P_mm = jax.lax.dynamic_update_slice_in_dim(state.P_mm, rows, first, axis=0)
    P_mm = jax.lax.dynamic_update_slice_in_dim(P_mm, rows.T, first, axis=1)
    return eqx.tree_at(
        lambda s: (s.landmarks, s.to_coordinates, s.P_vm, s.P_mm, s.track_id, s.is_euclidean, s.has_ended, s.detector),
        state,
        (
            state.landmarks.at[slot].set(landmark),
            state.to_coordinates.at[slot].set(jnp.eye(SLOT, dtype=P_mm.dtype)),
            P_vm,
            P_mm,
            state.track_id.at[slot].set(born_id.astype(state.track_id.dtype)),
            state.is_euclidean.at[slot].set(False),
            state.has_ended.at[slot].set(frame.is_last[column]),
            jax.tree.map(lambda field, value: field.at[slot].set(value), state.detector, config.detector.born()),
        ),
    )


def _random_rank(key: PRNGKeyArray, track_id: Int[Array, " V"]) -> Int[Array, " V"]:
    """A random number for each id, the same in every frame."""

    def rank(i):
        return jax.random.randint(jax.random.fold_in(key, i), (), 0, jnp.iinfo(jnp.int32).max)

    return jax.vmap(rank)(track_id)
