"""Two detectors as one: a landmark is deleted when either flags it."""

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from vcjax.fields import require_kind
from vcjax.gates.gate import AbstractDetector, Evidence


class Either(AbstractDetector):
    """Flag what either of two detectors flags, each with a state of its own; they nest, for three and more.

    Its margin is the larger of the two that say something.
    """

    first: AbstractDetector
    """One detector."""
    second: AbstractDetector
    """The other."""

    def __check_init__(self):
        remedy = "give a detector, e.g. Either(VelocityGLR(), InlierRatio())."
        for name in ("first", "second"):
            require_kind("Either", name, getattr(self, name), AbstractDetector, remedy)

    def born(self) -> tuple[PyTree, PyTree]:
        """Both states."""
        return self.first.born(), self.second.born()

    def observe(self, state: PyTree, evidence: Evidence) -> tuple[PyTree, Float[Array, " L"]]:
        """Both detectors' new states and the larger margin."""
        first, first_margin = self.first.observe(state[0], evidence)
        second, second_margin = self.second.observe(state[1], evidence)
        return (first, second), jnp.fmax(first_margin, second_margin)

    def suspicion(self, state: PyTree) -> Float[Array, "*L"] | None:
        """The larger, of those that suspect anybody."""
        first, second = self.first.suspicion(state[0]), self.second.suspicion(state[1])
        if first is None or second is None:
            return second if first is None else first
        return jnp.fmax(first, second)

    def velocity(self, state: PyTree) -> tuple[Float[Array, "*L 3"], Float[Array, "*L 3 3"]] | None:
        """That of the first that estimates one."""
        first = self.first.velocity(state[0])
        return self.second.velocity(state[1]) if first is None else first
