"""Invariant errors: what no camera can see, the turn of the whole world, the filter never comes to know."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from filter_runs import filtered, head, recorded
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vcjax.filter.config import FilterConfig
from vcjax.filter.features import Block, observe
from vcjax.filter.invariant import carry, read_turn, turn_of_landmark, turn_of_vehicle
from vcjax.filter.motion_model import ConstantVelocity
from vcjax.filter.state import full_cov
from vcjax.models.camera import Camera
from vcjax.models.landmarks import euclidean

START_STD_RAD = 0.1
numbers = st.floats(-2.0, 2.0)
VEHICLE = np.array([1.0, -2, 0.5, 0.8, 0.6, 0, 0, 0.1, 0.2, 0.6, 0.5, -0.5, 0.5, -0.5, 0.3, 0.1, -0.2, 0, 0, 1])


@given(arrays(float, 20, elements=numbers), arrays(float, 7, elements=numbers), arrays(float, 7, elements=numbers))
def test_carrying_leads_from_turn_to_turn(vehicle_shift, landmark, landmark_shift):
    motion = ConstantVelocity()

    def turn(vehicle, landmark):
        return np.concatenate([turn_of_vehicle(motion, jnp.array(vehicle)), turn_of_landmark(jnp.array(landmark))])

    M = carry(motion, jnp.array(VEHICLE), jnp.array(vehicle_shift), jnp.array(landmark_shift))
    expected = turn(VEHICLE + vehicle_shift, landmark + landmark_shift)
    np.testing.assert_allclose(M @ turn(VEHICLE, landmark), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(read_turn(jnp.array(VEHICLE)) @ turn(VEHICLE, landmark)[:20], np.eye(3), atol=1e-12)


@pytest.mark.parametrize("is_euclidean", [False, True])
def test_no_pixel_shows_a_turn_of_the_world(is_euclidean):
    landmark = jnp.array([1.0, -2, 1.1, 0.36, 0.48, 0.8, 0.25])
    T = np.eye(7)
    if is_euclidean:  # as a landmark born Euclidean: its slot's first three coordinates are the point
        landmark, T = euclidean(jnp.array([5.0, 3.0, 2.0])), np.diag([1.0, 1, 1, 0, 0, 0, 0])
    H = observe(FilterConfig(), Camera(), Block(jnp.array(VEHICLE), landmark, jnp.array(T))).H
    N = np.concatenate([turn_of_vehicle(ConstantVelocity(), jnp.array(VEHICLE)), turn_of_landmark(landmark)])
    assert np.abs(H).max() > 10
    np.testing.assert_allclose(H @ N, 0, atol=1e-9)


def last_turn_std(errors) -> float:
    """Least standard deviation (rad) of any turn of the world after 40 frames that began with START_STD_RAD of each."""
    config = FilterConfig(max_landmarks=23, births_per_frame=2, errors=errors)
    recording = head(recorded(3, robot="curved", dynamic="lateral"), 40)
    N = np.asarray(turn_of_vehicle(config.motion, jnp.array([*recording.robot_start, *recording.sensor_start])))
    recording = dataclasses.replace(recording, start_cov=START_STD_RAD**2 * N @ N.T)
    *_, (state, info) = filtered(config, recording)
    assert info.is_finite
    assert np.linalg.eigvalsh(full_cov(state))[0] > -1e-9
    E = np.asarray(read_turn(state.vehicle))
    return np.sqrt(np.linalg.eigvalsh(E @ np.asarray(state.P_vv) @ E.T)[0])


def test_who_starts_without_a_heading_never_learns_it():
    assert last_turn_std("invariant") > START_STD_RAD * (1 - 1e-9)
    assert last_turn_std("additive") < 0.5 * START_STD_RAD  # plain differences come to know what nobody can


def test_where_all_is_certain_at_the_start_both_are_nearly_the_same():
    recording = head(recorded(0, robot="curved"), 25)
    means = []
    for errors in ("additive", "invariant"):
        config = FilterConfig(max_landmarks=23, births_per_frame=2, errors=errors)
        means.append([info.vehicle for _, info in filtered(config, recording)])
    difference = np.abs(np.subtract(*means)).max()
    assert 0 < difference < 5e-3
