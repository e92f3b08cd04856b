"""A survey of detectability over a scene: the power of the test and the smallest speed it finds, place by place."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.detectability.chi_squared import noncentrality, quantile, survival
from vcjax.detectability.velocity_test import VelocityTest, information, mover_power, require_test
from vcjax.simulation.scenarios import Scenario
from vcjax.study.sweep import replace_at

SEARCHED_M_S = 0.01 * 2.0 ** (np.arange(19) / 2)
"""Speeds among which the smallest is looked for, m/s: 0.01 to 5.12 by factors of √2."""
_PLACES_PER_BATCH = 16
AMPLITUDE = "oscillation.amplitude_m"


class Survey(NamedTuple):
    """What can be told at each of N places, for A amplitudes of the camera, H directions and S speeds."""

    power: Float[np.ndarray, "A N H S"]
    """Power of the test."""
    smallest_m_s: Float[np.ndarray, "A N H"]
    """Smallest speed found with the power wanted, m/s, interpolated in `SEARCHED_M_S`; infinite where none of these is
    found, NaN where a feature that stands there is never in view."""


def heading(angle_deg: float | Float[Array | np.ndarray, "*n"]) -> Float[Array, "*n 3"]:
    """The horizontal unit vector at an angle from x (forward) to y (left), deg. Derivative exact."""
    angle = jnp.deg2rad(jnp.asarray(angle_deg, float))
    return jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)], axis=-1)


def survey(
    scenario: Scenario,
    test: VelocityTest,
    places_m: Float[np.ndarray, "N 3"],
    *,
    amplitudes_m: Sequence[float],
    headings_deg: Sequence[float],
    speeds_m_s: Sequence[float],
    power: float = 0.9,
) -> Survey:
    """Predict the test at some places, with nothing run.

    Args:
        scenario: path, camera and noise.
        test: which frames count, and the false-alarm rate.
        places_m: where a feature is at time 0.
        amplitudes_m: of the camera's oscillation.
        headings_deg: directions of motion, 0 along x, 90 along y.
        speeds_m_s: speeds for which the power is wanted.
        power: at which a speed counts as found; above the false-alarm rate and below 1.

    Raises:
        ValueError: for a number out of its range.
    """
    require_test("survey", scenario, test)
    require_power(test, power)
    for name, values in (("amplitudes_m", amplitudes_m), ("headings_deg", headings_deg), ("speeds_m_s", speeds_m_s)):
        if not len(values) or not np.all(np.isfinite(values)) or (name != "headings_deg" and np.min(values) < 0):
            remedy = "finite" if name == "headings_deg" else "finite and none negative"
            raise ValueError(f"survey({name}={tuple(values)}): give at least one number, {remedy}.")
    places, directions = jnp.asarray(places_m, float), heading(np.asarray(headings_deg))
    speeds = jnp.asarray(speeds_m_s, float)
    found = [
        _survey(replace_at(scenario, {AMPLITUDE: np.float64(a)}), test, places, directions, speeds, power)
        for a in amplitudes_m
    ]
    return Survey(*(np.stack([np.asarray(one) for one in part]) for part in zip(*found, strict=True)))


@jax.jit
def _survey(scenario: Scenario, test: VelocityTest, places, directions, speeds, wanted):
    q = quantile(test.false_alarm_rate)
    needed, searched = noncentrality(wanted, q), jnp.asarray(SEARCHED_M_S)

    # All speeds in one, at rest too: so the kernel is compiled once.
    every = jnp.concatenate([jnp.zeros(1), searched, speeds])

    def of_mover(place, direction, speed):
        C = information(scenario, test, place, speed * direction)
        return speed**2 * (direction @ C @ direction), jnp.trace(C) > 0

    def at_place(place):
        deltas, has_some = jax.vmap(lambda u: jax.vmap(lambda s: of_mover(place, u, s))(every))(directions)
        smallest = jax.vmap(lambda d: _crossing(searched, d, needed))(deltas[:, 1 : 1 + len(searched)])
        return survival(q, deltas[:, 1 + len(searched) :]), jnp.where(has_some[:, 0], smallest, jnp.nan)

    return jax.lax.map(at_place, places, batch_size=_PLACES_PER_BATCH)


def _crossing(speed: Float[Array, " S"], delta: Float[Array, " S"], needed: Float[Array, ""]) -> Float[Array, ""]:
    """The smallest speed with δ as large as needed, between those searched by a power law; infinite if there is none.

    Below the smallest speed searched δ grows with its square. A fast mover leaves the image earlier, so that δ may
    fall again: the first crossing counts.
    """
    reached = delta >= needed
    i = jnp.argmax(reached)
    log_speed, log_delta = jnp.log(speed), jnp.log(jnp.maximum(delta, 1e-12))
    before = jnp.maximum(i - 1, 0)
    slope = (log_delta[i] - log_delta[before]) / jnp.where(i > 0, log_speed[i] - log_speed[before], 1.0)
    slope = jnp.where(i > 0, slope, 2.0)
    crossing = jnp.exp(log_speed[i] + (jnp.log(needed) - log_delta[i]) / slope)
    return jnp.where(jnp.any(reached), crossing, jnp.inf)


class Prediction(NamedTuple):
    """What the test does against the movers of one scene (D of them)."""

    power: Float[np.ndarray, " D"]
    """Within the frames of the test."""
    power_of_all_frames: Float[np.ndarray, " D"]
    """In all frames in view."""
    frames_needed: Float[np.ndarray, " D"]
    """From the first sight on until the power wanted is reached; infinite where it never is."""


def predict_movers(scenarios: Mapping[str, Scenario], test: VelocityTest, power: float = 0.9) -> dict[str, Prediction]:
    """The power against each mover of some scenes, and after how many frames it is as large as wanted.

    Raises:
        ValueError: as `survey`.
    """
    require_power(test, power)
    predictions = {}
    for name, scenario in scenarios.items():
        require_test("predict_movers", scenario, test)
        by_frames = np.asarray(_power_by_frames(scenario, test))
        reached = by_frames >= power
        needed = np.where(reached.any(axis=0), reached.argmax(axis=0) + 1.0, np.inf)
        last = min(int(min(test.within_frames, scenario.num_frames)), len(by_frames))
        predictions[name] = Prediction(by_frames[last - 1], by_frames[-1], needed)
    return predictions


@jax.jit
def _power_by_frames(scenario: Scenario, test: VelocityTest) -> Float[Array, "T D"]:
    """The power against each mover with 1, 2, … frames."""

    def one(within):
        return mover_power(scenario, replace_at(test, {"within_frames": within}))

    return jax.lax.map(one, jnp.arange(1.0, scenario.num_frames + 1), batch_size=_PLACES_PER_BATCH)


def require_power(test: VelocityTest, power: float) -> None:
    """Refuse a power that is none, or that a test without any information has.

    Raises:
        ValueError: naming it and the false-alarm rate.
    """
    if not test.false_alarm_rate < power < 1:
        raise ValueError(
            f"power={power}: give a number above the false-alarm rate {test.false_alarm_rate} and below 1."
        )
