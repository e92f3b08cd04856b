"""Parameters that stay valid whatever an optimiser does: an interval, and the free number that moves within it.

θ = l + (u - l) σ(x), or on a logarithmic scale θ = l (u/l)^σ(x), with x any number and σ the logistic function.
"""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from vcjax.fields import number, require


class Interval(eqx.Module):
    """Where a parameter may go: between two numbers, on a linear or a logarithmic scale."""

    low: float = eqx.field(converter=number)
    high: float = eqx.field(converter=number)
    is_log: bool = eqx.field(static=True, default=False)
    spread: float = eqx.field(converter=number, default=0.05)
    """σ of the neighbourhood in x over which a descent averages (see `descent`): small where runs change smoothly with
    the parameter, large where they ripple; positive."""

    def __check_init__(self):
        require(self, "low", np.isfinite, "give a finite number.")
        require(self, "high", lambda h: np.isfinite(h) & (h > self.low), f"give a number above low={self.low}.")
        require(self, "spread", lambda s: np.isfinite(s) & (s > 0), "give a positive number.")
        if self.is_log:
            require(self, "low", lambda low: low > 0, "a logarithmic scale needs a positive number.")

    def to_parameter(self, free: Float[Array, ""]) -> Float[Array, ""]:
        """θ(x). Derivative exact."""
        return self.at(jax.nn.sigmoid(free))

    def at(self, part: Any) -> Any:
        """The parameter at a part of the interval, from 0 (low) to 1 (high), on its scale. Derivative exact."""
        if self.is_log:
            return self.low * (self.high / self.low) ** part
        return self.low + (self.high - self.low) * part

    def to_free(self, parameter: float) -> float:
        """x(θ).

        Raises:
            ValueError: unless θ lies inside.
        """
        if not self.low < parameter < self.high:
            raise ValueError(f"Interval({self.low:g}, {self.high:g}): {parameter:g} is not inside; widen the interval.")
        if self.is_log:
            part = np.log(parameter / self.low) / np.log(self.high / self.low)
        else:
            part = (parameter - self.low) / (self.high - self.low)
        return float(np.log(part / (1.0 - part)))


THRESHOLDS = {
    "config.gate.th1": Interval(1.0, 100.0, is_log=True),
    "config.gate.th2": Interval(0.1, 100.0, is_log=True),
}
"""Th₁ and Th₂, in χ² units."""
OSCILLATION = {
    "scenario.oscillation.amplitude_m": Interval(0.0, 0.15),
    "scenario.oscillation.frequency_hz": Interval(0.5, 4.5, spread=0.4),
}
"""A, m, and f, Hz: below half of the 10 frames per second of the paper's scenarios. The phase at the end of a run turns
by 16 cycles for every hertz, so that runs ripple with f; the neighbourhood is about ± 0.4 Hz wide."""
