"""Features: predict every slot's pixel, and choose what to correct with."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vcjax.filter.config import FilterConfig
from vcjax.filter.map_covariance import SLOT, slot_blocks
from vcjax.filter.state import VEHICLE, FilterState
from vcjax.gates.gate import MeasurementModel
from vcjax.models.camera import Camera, is_inside
from vcjax.models.frames import unit, unit_jacobian
from vcjax.models.landmarks import INVERSE_DEPTH, project_landmark
from vcjax.recording import Frame


class Block(NamedTuple):
    """Mean of vehicle and landmark: all that a measurement of it depends on."""

    vehicle: Float[Array, "*b v"]
    landmark: Float[Array, "*b 7"]
    to_coordinates: Float[Array, "*b 7 7"]


NEAR_PX = 64.0
"""How far outside the image a landmark may be predicted and still be expected back, px."""


class Observation(NamedTuple):
    """A predicted measurement."""

    pixel: Float[Array, "*b 2"]
    is_visible: Bool[Array, "*b"]
    """Inside the image and in front of the camera."""
    is_near: Bool[Array, "*b"]
    """Visible or almost so: at most `NEAR_PX` outside the image."""
    H: Float[Array, "*b 2 n"]
    """Derivative of the pixel by the errors of vehicle and slot."""


def observe(config: FilterConfig, camera: Camera, block: Block) -> Observation:
    """Predict a landmark's pixel, h(x) with its derivative H. Paper equation (8).

    Within a frame corrections move the quaternions off unit length; measuring through q/|q|, whose derivative enters H,
    makes h blind to their length, and they are normalised once, at the end of the frame.
    """
    robot, robot_H = _unit_pose(config, block.vehicle[:7])
    sensor, sensor_H = _unit_pose(config, block.vehicle[7:VEHICLE])
    pixel, depth, U_r, U_s, U_l = project_landmark(camera, robot, sensor, block.landmark)
    parts = [U_r[:, :3], U_r[:, 3:] @ robot_H, U_s[:, :3], U_s[:, 3:] @ sensor_H, U_l @ block.to_coordinates]
    if num_carried := block.vehicle.shape[0] - VEHICLE:  # what the motion model carries, no pixel shows
        parts.insert(4, jnp.zeros((2, num_carried), U_l.dtype))
    H = jnp.concatenate(parts, axis=1)
    # v_z = depth ρ, of the homogeneous point, says where its direction points, whatever the sign of ρ.
    is_in_front = (depth * block.landmark[INVERSE_DEPTH] if config.see_beyond_infinity else depth) > 0
    return Observation(
        pixel, is_inside(camera, pixel) & is_in_front, is_inside(camera, pixel, -NEAR_PX) & is_in_front, H
    )


def move(block: Block, shift: Float[Array, " n"]) -> Block:
    """A block's coordinates moved by its errors."""
    vehicle_shift, slot_shift = jnp.split(shift, [block.vehicle.shape[0]])
    return Block(
        block.vehicle + vehicle_shift, block.landmark + block.to_coordinates @ slot_shift, block.to_coordinates
    )


def retract(config: FilterConfig, block: Block, shift: Float[Array, " n"]) -> Block:
    """A block moved by a correction, x + K z (11). An inverse depth that is not positive is set to a small one."""
    moved = move(block, shift)
    rho = moved.landmark[INVERSE_DEPTH]
    landmark = moved.landmark.at[INVERSE_DEPTH].set(jnp.where(rho > 0, rho, config.inverse_depth_min))
    return moved._replace(landmark=landmark)


def measurement_model(config: FilterConfig, camera: Camera) -> MeasurementModel:
    """The measurement model that gates use on a candidate's block."""

    def observe_block(block: Block):
        observation = observe(config, camera, block)
        return observation.pixel, observation.H

    return MeasurementModel(observe=observe_block, retract=lambda block, shift: retract(config, block, shift))


def _unit_pose(config: FilterConfig, pose: Float[Array, "7"]) -> tuple[Float[Array, "7"], Float[Array, "4 4"]]:
    """A pose with its quaternion brought to unit length, and the derivative of that."""
    q = pose[3:]
    pose = jnp.concatenate([pose[:3], unit(q, config.toolbox_parity)])
    return pose, unit_jacobian(q, config.toolbox_parity)


class Prediction(NamedTuple):
    """Every slot's predicted measurement at the state after prediction."""

    is_visible: Bool[Array, " L"]
    """Mapped and predicted inside the image."""
    is_near: Bool[Array, " L"]
    """Mapped and predicted inside the image or near it."""
    uncertainty: Float[Array, " L"]
    """det(H P Hᵀ), px⁴."""


def predict_features(config: FilterConfig, state: FilterState, camera: Camera) -> Prediction:
    """Project all slots and their covariance H P Hᵀ (without pixel noise)."""
    num_slots = state.track_id.shape[0]
    is_mapped = state.is_mapped
    # A free slot may hold anything: it is measured as a harmless point, so that no NaN arises where nothing is.
    harmless = jnp.array([0, 0, 0, 1, 0, 0, 1], state.landmarks.dtype)
    landmarks = jnp.where(is_mapped[:, None], state.landmarks, harmless)
    blocks = Block(jnp.broadcast_to(state.vehicle, (num_slots, *state.vehicle.shape)), landmarks, state.to_coordinates)
    observation = jax.vmap(lambda block: observe(config, camera, block))(blocks)

    uncertainty = _uncertainty(observation.H, state)
    return Prediction(is_mapped & observation.is_visible, is_mapped & observation.is_near, uncertainty)


def _uncertainty(H: Float[Array, "L 2 n"], state: FilterState) -> Float[Array, " L"]:
    """det(H P Hᵀ) of every slot.

    With H = [H_v H_l], H P Hᵀ = H_v P_vv H_vᵀ + X H_lᵀ + H_l Xᵀ where X = H_v P_vl + ½ H_l P_ll. The sums over the
    short axes of X are written out: on a CPU that takes a third of the time of a batch of small matrix products.
    """
    num_slots = H.shape[0]
    H_v, H_l = H[..., :VEHICLE], H[..., -SLOT:]
    P_vl, P_ll = state.P_vm[:VEHICLE].reshape(VEHICLE, num_slots, SLOT), 0.5 * slot_blocks(state.P_mm)
    HP_vv = (H_v.reshape(-1, VEHICLE) @ state.P_vv[:VEHICLE, :VEHICLE]).reshape(H_v.shape)
    X = jnp.zeros((num_slots, 2, SLOT), H.dtype)
    for v in range(VEHICLE):
        X += H_v[:, :, v, None] * P_vl[v, :, None]
    for i in range(SLOT):
        X += H_l[:, :, i, None] * P_ll[:, None, i]

    def element(a, b):
        of_vehicle = jnp.sum(HP_vv[:, a] * H_v[:, b], axis=1)
        return of_vehicle + jnp.sum(X[:, a] * H_l[:, b] + X[:, b] * H_l[:, a], axis=1)

    return element(0, 0) * element(1, 1) - element(0, 1) ** 2


def match(state: FilterState, frame: Frame) -> Int[Array, " L"]:
    """Where each slot's feature is among those measured in the frame; -1 where it is not."""
    is_match = state.is_mapped[:, None] & frame.is_valid & (state.track_id[:, None] == frame.track_id)
    return jnp.max(jnp.where(is_match, jnp.arange(frame.is_valid.shape[0]), -1), axis=1, initial=-1)


def choose(
    config: FilterConfig, prediction: Prediction, is_measured: Bool[Array, " L"]
) -> tuple[Int[Array, " K"], Bool[Array, " K"]]:
    """The K visible landmarks with the largest det(H P Hᵀ), most uncertain first, and which of the K there are.

    The order is constant under differentiation. Slots that fill unused places are distinct from all others.
    """
    eligible = prediction.is_visible & (is_measured if config.choose_among == "measured" else True)
    score = jnp.where(eligible, jax.lax.stop_gradient(prediction.uncertainty), -jnp.inf)
    _, slot = jax.lax.top_k(score, config.max_updates)
    return slot, eligible[slot]
