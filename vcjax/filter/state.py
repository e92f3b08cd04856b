"""FilterState: what the next frame needs, and nothing else.

The map has a fixed number L of slots of seven error coordinates each, whatever it holds. P is kept as the three blocks
of paper equation (3): vehicle (robot and sensor) with itself, vehicle with slots, slots with slots. Prediction, the
normalisation of quaternions and much of a correction touch the first two only, which are small.

A slot keeps the seven AHP error coordinates it was born with for life. When its landmark becomes Euclidean, p =
f(x_AHP), only the mean changes its form; P keeps its seven rows and `to_coordinates` keeps J = ∂f/∂x_AHP, frozen at
that moment. As Kalman updates are linear in the error, using H J with the old rows gives, ever after, exactly the
numbers that P's rows transformed by J would give, and no pass over P is needed.

A free slot's rows hold whatever finite numbers they held before: those of a landmark that is never looked at again.
They are as inert as zeros would be, and cost nothing to leave. L is the capacity rounded up to whole blocks of slots
with at least one to spare: the last slot, always free, takes the writes of births that do not happen, so that no branch
and no copy of P is needed.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from vcjax.filter.config import FilterConfig
from vcjax.filter.follower import Followers, nobody
from vcjax.filter.map_covariance import SLOT, SLOTS_PER_BLOCK, slot_blocks, symmetric
from vcjax.models.frames import unit
from vcjax.recording import Recording, in_working_precision

VEHICLE = 14
"""Error coordinates of robot and sensor; the motion model may add some of its own behind them."""
FREE = -1
"""Track id of a free slot."""


class FilterState(eqx.Module):
    """State mean x, covariance P and the map's book-keeping."""

    vehicle: Float[Array, " v"]
    """Robot pose T_w_r (7), sensor pose T_r_s (7), and what the motion model carries. Quaternions are of unit length
    between frames."""
    landmarks: Float[Array, "L 7"]
    """Landmark means, AHP or Euclidean in the common form (see `models.landmarks`)."""
    to_coordinates: Float[Array, "L 7 7"]
    """Derivative of a landmark's coordinates by its slot's error coordinates: I for AHP, [J; 0] for Euclidean."""
    P_vv: Float[Array, "v v"]
    """Covariance of the vehicle, [P_rr P_rs; P_sr P_ss]."""
    P_vm: Float[Array, "v M"]
    """Covariance of vehicle with slots' error coordinates, M = 7 L; [P_rm; P_sm]."""
    P_mm: Float[Array, "M M"]
    """Covariance of slots' error coordinates, current on and below the diagonal tiles (see `map_covariance`)."""
    track_id: Int[Array, " L"]
    """Which feature a slot holds; -1 where it is free."""
    is_euclidean: Bool[Array, " L"]
    """Whether a landmark has become Euclidean."""
    has_ended: Bool[Array, " L"]
    """Whether a landmark's feature is never measured again in the recording."""
    detector: PyTree
    """The detector's state of every slot."""
    blacklist: Int[Array, " B"]
    """Deleted features that must not be born again, newest first; -1 where empty."""
    blacklist_left: Float[Array, " B"]
    """For how many frames more; meaningless where empty."""
    followers: Followers | None
    """Deleted features that are followed outside the map; None where none are to be."""
    key: PRNGKeyArray | None
    """Key of the random birth order; None where births go by id."""

    @property
    def is_mapped(self) -> Bool[Array, " L"]:
        """Which slots hold a landmark."""
        return jnp.asarray(self.track_id) != FREE

    @property
    def robot(self) -> Float[Array, "7"]:
        """Robot pose T_w_r."""
        return self.vehicle[:7]

    @property
    def sensor(self) -> Float[Array, "7"]:
        """Sensor pose T_r_s."""
        return self.vehicle[7:VEHICLE]


def slot_count(config: FilterConfig) -> int:
    """L, the number of slots: max_landmarks and at least one to spare, in whole blocks."""
    return SLOTS_PER_BLOCK * (config.max_landmarks // SLOTS_PER_BLOCK + 1)


def initial_state(config: FilterConfig, recording: Recording, key: PRNGKeyArray | None = None) -> FilterState:
    """The state before the first frame: start poses with their covariance, and an empty map.

    Raises:
        ValueError: if births are in random order and there is no key.
    """
    if (config.birth_order == "random") != (key is not None):
        raise ValueError(
            f"initial_state(key={key}): give a key if and only if births are in random order "
            f"(FilterConfig(birth_order={config.birth_order!r}))."
        )
    num_slots = slot_count(config)
    poses = (in_working_precision(recording.robot_start), in_working_precision(recording.sensor_start))
    vehicle = jnp.concatenate([part for pose in poses for part in (pose[:3], unit(pose[3:]))])
    dtype = vehicle.dtype
    P_vv = jnp.asarray(recording.start_cov, dtype)
    carried, carried_cov = config.motion.start()
    if len(carried):
        vehicle = jnp.concatenate([vehicle, jnp.asarray(carried, dtype)])
        P_vv = jnp.zeros((len(vehicle), len(vehicle)), dtype).at[:VEHICLE, :VEHICLE].set(P_vv)
        P_vv = P_vv.at[VEHICLE:, VEHICLE:].set(carried_cov)
    size = SLOT * num_slots
    return FilterState(
        vehicle=vehicle,
        landmarks=jnp.broadcast_to(jnp.array([0, 0, 0, 1, 0, 0, 1], dtype), (num_slots, SLOT)),
        to_coordinates=jnp.broadcast_to(jnp.eye(SLOT, dtype=dtype), (num_slots, SLOT, SLOT)),
        P_vv=P_vv,
        P_vm=jnp.zeros((vehicle.shape[0], size), dtype),
        P_mm=jnp.zeros((size, size), dtype),
        track_id=jnp.full(num_slots, FREE, jnp.int32),
        is_euclidean=jnp.zeros(num_slots, bool),
        has_ended=jnp.zeros(num_slots, bool),
        detector=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_slots, *leaf.shape)), config.detector.born()),
        blacklist=jnp.full(config.blacklist_capacity, FREE, jnp.int32),
        blacklist_left=jnp.zeros(config.blacklist_capacity, dtype),
        followers=nobody(config.following, dtype) if config.following.max_followed else None,
        key=key,
    )


def landmark_cov(state: FilterState) -> Float[Array, "L 7 7"]:
    """Covariance of each landmark's coordinates (the last four rows and columns are zero where Euclidean)."""
    T = state.to_coordinates
    return T @ slot_blocks(jnp.asarray(state.P_mm)) @ T.mT


def full_cov(state: FilterState) -> Float[Array, "N N"]:
    """P whole: vehicle, then the coordinates of every slot. Free slots are zero. Paper equation (3)."""
    num_slots = state.track_id.shape[0]
    T = jnp.where(state.is_mapped[:, None, None], state.to_coordinates, 0.0)
    P_vm = jnp.einsum("vlj,lij->vli", state.P_vm.reshape(-1, num_slots, SLOT), T).reshape(len(state.P_vm), -1)
    P_mm = symmetric(state.P_mm).reshape(num_slots, SLOT, num_slots, SLOT)
    P_mm = jnp.einsum("lij,ljmk,mnk->limn", T, P_mm, T)
    size = num_slots * SLOT
    return jnp.block([[state.P_vv, P_vm], [P_vm.T, P_mm.reshape(size, size)]])
