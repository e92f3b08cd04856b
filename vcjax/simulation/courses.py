"""Courses of movers that do not keep one velocity: they start late, stop, go on, turn.

A course is a row of legs, each with a constant velocity. With v_l that of leg l, and s_l and e_l its beginning and end
(s_0 = 0, the last never ends), a mover has gone by time t

    Σ_l v_l min(max(t - s_l, 0), e_l - s_l).
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import is_concrete, require, vector

CourseName = Literal["late", "stops", "stops_and_starts", "turns"]
COURSES: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "late": ((0.25,), (0.0, 1.0), (0.0, 0.0)),
    "stops": ((0.5,), (1.0, 0.0), (0.0, 0.0)),
    "stops_and_starts": ((0.25, 0.5), (1.0, 0.0, 1.0), (0.0, 0.0, 0.0)),
    "turns": ((0.25, 0.5), (1.0, 1.0, 1.0), (0.0, 90.0, 0.0)),
}
"""Named courses: where in the run the motion changes (0 to 1), pace and heading (deg) of each leg."""
PACES = (0.5, 1.5)
"""Between which paces are drawn."""


class Course(eqx.Module):
    """Legs of constant velocity, for all movers together or for each its own."""

    change_s: tuple[float, ...] = eqx.field(converter=vector, default=())
    """When each leg but the last ends, s; positive and rising. (L - 1,)"""
    pace: tuple[float, ...] | Float[Array | np.ndarray, "*D L"] = eqx.field(converter=vector, default=(1.0,))
    """Speed in each leg as a factor of `Movers.speed_m_s`, at least 0; 0: stands still. (L,), or (D, L) for each."""
    heading_deg: tuple[float, ...] | Float[Array | np.ndarray, "*D L"] = eqx.field(converter=vector, default=(0.0,))
    """How far the direction is turned to the left about the vertical in each leg, deg. (L,), or (D, L) for each."""

    def __check_init__(self):
        require(self, "change_s", np.isfinite, "give finite times.", length=None)
        rises = "times at which the motion changes are positive and rise."
        require(self, "change_s", lambda t: np.diff(t, axis=-1, prepend=0.0) > 0, rises, length=None)
        require(self, "pace", lambda p: np.isfinite(p) & (p >= 0), "a pace is at least 0.", length=None)
        require(self, "heading_deg", np.isfinite, "give finite angles.", length=None)
        num_legs = np.shape(self.change_s)[-1] + 1
        for name in ("pace", "heading_deg"):
            shape = np.shape(getattr(self, name))
            if not shape or shape[-1] != num_legs:
                raise ValueError(
                    f"Course({name}) has shape {shape}, but {num_legs} legs need as many numbers: motion changes "
                    f"{num_legs - 1} times (change_s)."
                )


def named_course(name: str, duration_s: float | Float[Array, ""]) -> Course:
    """One of `COURSES` for a run of some length, s.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in COURSES:
        raise ValueError(f"dynamic_course={name!r}: choose one of {tuple(COURSES)}.")
    parts, pace, heading = COURSES[name]
    return Course(tuple(part * duration_s for part in parts), pace, heading)


def drawn_course(num: int, seed: int, course: Course | None = None) -> Course:
    """A course for each of some movers, with its own heading, uniform over the circle, and pace, uniform in `PACES`.

    More movers only add to fewer. Drawn from a seed of its own: which features move is drawn independently.

    Args:
        num: how many movers.
        seed: of the draw, from 0 to 2³² - 1.
        course: of all legs, which heading and pace drawn come on top of; one leg if None.
    """
    course = Course() if course is None else course
    heading, pace = np.random.RandomState([seed, 1]).random_sample((num, 2)).T[:, :, None]
    low, high = PACES
    return Course(course.change_s, (low + (high - low) * pace) * course.pace, 360.0 * heading + course.heading_deg)


def leg_velocities(course: Course, velocity: Float[Array, "3"], num: int) -> Float[Array, "D L 3"]:
    """Velocity of each of `num` movers in each leg, m/s (`velocity`: at pace 1, heading 0). Derivative exact."""
    shape = (num, np.shape(course.change_s)[-1] + 1)
    pace = jnp.broadcast_to(jnp.asarray(course.pace), shape)
    angle = jnp.deg2rad(jnp.broadcast_to(jnp.asarray(course.heading_deg), shape))
    x, y, z = velocity
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    turned = [cosine * x - sine * y, sine * x + cosine * y, jnp.broadcast_to(z, shape)]
    return pace[..., None] * jnp.stack(turned, axis=-1)


def displacements(
    course: Course, velocity: Float[Array, "3"], num: int, time_s: Float[Array, " T"]
) -> Float[Array, "T D 3"]:
    """How far each mover has gone by each time, m. Derivative exact but at the moments of change."""
    begin, end = _ends(course)
    spent = jnp.clip(time_s[:, None] - begin, 0.0, end - begin)
    return jnp.einsum("tl,dlk->tdk", spent, leg_velocities(course, velocity, num))


def _ends(course: Course) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """Beginning and end of each leg, s."""
    change = jnp.asarray(course.change_s)
    begin = jnp.concatenate([jnp.zeros(1, change.dtype), change])
    return begin, jnp.concatenate([change, jnp.full(1, jnp.inf, change.dtype)])


def has_moved(course: Course, velocity: Float[Array, "3"], num: int, until_s: Float[Array, ""]):
    """Whether each mover moves at any time before another, (D,)."""
    begin, _ = _ends(course)
    return jnp.any(jnp.any(leg_velocities(course, velocity, num) != 0, axis=-1) & (begin < until_s), axis=-1)


def require_course(course: Course, num: int) -> None:
    """Refuse a course with legs for another number of movers.

    Raises:
        ValueError: naming both numbers.
    """
    for name in ("pace", "heading_deg"):
        value = getattr(course, name)
        shape = np.shape(value)
        if is_concrete(value) and isinstance(value, np.ndarray) and (len(shape) > 2 or shape[:-1] not in ((), (num,))):
            raise ValueError(
                f"Movers(course.{name}) has shape {shape}, but there are {num} movers; give the legs of all in "
                "one row, or one row for each mover."
            )
