"""The oscillation with the largest power for its motion: found by gradient, in seconds, with nothing run.

Made small over A and f, both within intervals, is

    mean over scenes and movers of (1 - power) + price · (2πfA)²/2,

the share of movers missed, as predicted by `detectability`, and the price of moving the camera. It has no noise, so
that its gradient is enough for a quasi-Newton method (L-BFGS-B). It has many valleys (f and half the frame rate mirror
each other, and a run holds a whole number of swings at certain f only), hence several starts.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize
from scipy.stats import qmc

from vcjax.detectability.velocity_test import VelocityTest, mover_power, require_test
from vcjax.simulation.scenarios import Scenario
from vcjax.study.sweep import replace_at
from vcjax.tuning.evaluate import stacked
from vcjax.tuning.intervals import OSCILLATION, Interval
from vcjax.tuning.losses import camera_motion_m2_s2

_AT_THE_END = 1e-3
"""Part of an interval that is its end."""
_PATHS = tuple(path.removeprefix("scenario.") for path in OSCILLATION)


class Oscillating(NamedTuple):
    """An oscillation, and what it is worth."""

    amplitude_m: float
    frequency_hz: float
    missed: float
    """Mean over scenes and movers of 1 - power."""
    camera_motion_m2_s2: float
    """Mean square speed of the camera, (2πfA)²/2."""
    cost: float
    """What is made small."""
    at_the_end: tuple[str, ...]
    """Which of A and f lie at an end of their interval, beyond which nothing was tried."""


def best_oscillation(
    scenarios: Mapping[str, Scenario],
    test: VelocityTest,
    *,
    price: float = 0.02,
    intervals: Mapping[str, Interval] = OSCILLATION,
    num_starts: int = 8,
) -> Oscillating:
    """The best A and f for the movers of some scenes.

    Args:
        scenarios: scenes by name, which differ in numbers only; their own A and f do not matter.
        test: which frames count, and the false-alarm rate. Frames enough to find every mover anyway tell nothing of A
            and f: choose as few as one is willing to wait.
        price: what a mean square speed of the camera of 1 m²/s² costs in movers missed, at least 0.
        intervals: where A and f may go, by their paths as in `intervals.OSCILLATION`.
        num_starts: descents, from points spread over the intervals; at least 1.

    Raises:
        ValueError: for arguments that make no sense.
    """
    require_price(price)
    if not isinstance(num_starts, int | np.integer) or num_starts < 1:
        raise ValueError(f"best_oscillation(num_starts={num_starts!r}): give a whole number of at least 1.")
    if set(intervals) != set(OSCILLATION):
        raise ValueError(f"best_oscillation(intervals): give one for each of {tuple(OSCILLATION)}.")
    for scenario in scenarios.values():
        require_test("best_oscillation", scenario, test)
    scenes = stacked(scenarios)
    ends = tuple(intervals[path] for path in OSCILLATION)

    def objective(part: np.ndarray) -> tuple[float, np.ndarray]:
        (value, _), gradient = cost_and_gradient(scenes, test, price, ends, jnp.asarray(part))
        return float(value), np.asarray(gradient, float)

    starts = qmc.Halton(len(ends), scramble=False).random(num_starts + 1)[1:]  # its first point is a corner
    found = [minimize(objective, start, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * 2) for start in starts]
    best = min(found, key=lambda result: result.fun)
    (value, (missed, motion)), _ = cost_and_gradient(scenes, test, price, ends, jnp.asarray(best.x))
    A, f = (float(interval.at(p)) for interval, p in zip(ends, best.x, strict=True))
    at_the_end = tuple(name for name, part in zip("Af", best.x, strict=True) if min(part, 1 - part) < _AT_THE_END)
    return Oscillating(A, f, float(missed), float(motion), float(value), at_the_end)


@jax.jit
def cost_and_gradient(
    scenes: Scenario,
    test: VelocityTest,
    price: float | Float[Array, ""],
    ends: tuple[Interval, Interval],
    part: Float[Array, "2"],
):
    """The cost at a part of each interval, from 0 to 1, with its parts, and its gradient by these.

    Returns: ((cost, (missed, camera motion)), gradient).
    """

    def cost(part):
        total, missed, motion = oscillation_cost(
            scenes, test, price, *(i.at(p) for i, p in zip(ends, part, strict=True))
        )
        return total, (missed, motion)

    return jax.value_and_grad(cost, has_aux=True)(part)


def require_price(price: float) -> None:
    """Refuse what is no price.

    Raises:
        ValueError: for a negative number, or none.
    """
    if not np.isfinite(price) or price < 0:
        raise ValueError(f"best_oscillation(price={price}): a price is at least 0.")


def oscillation_cost(
    scenes: Scenario,
    test: VelocityTest,
    price: float | Float[Array, ""],
    amplitude_m: float | Float[Array, ""],
    frequency_hz: float | Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The module's cost of an oscillation in stacked scenes, and its parts: movers missed, and camera motion.

    Pure; derivative exact but for which frames are in view, which have none.
    """

    def one(scene: Scenario):
        scene = replace_at(scene, dict(zip(_PATHS, (amplitude_m, frequency_hz), strict=True)))
        return jnp.mean(1.0 - mover_power(scene, test)), camera_motion_m2_s2(scene)

    missed, motion = jax.tree.map(jnp.mean, jax.vmap(one)(jax.tree.map(jnp.asarray, scenes)))
    return missed + price * motion, missed, motion
