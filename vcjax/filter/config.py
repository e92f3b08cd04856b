"""Filter configuration: static capacities and choices, traced thresholds and noises.

What is static (capacities, choices) compiles anew when changed. What is a number is traced: another value costs
nothing, and any of them can be swept or differentiated.
"""

from typing import Literal

import equinox as eqx
import numpy as np

from vcjax.fields import (
    is_concrete,
    number,
    require,
    require_choice,
    require_count,
    require_key,
    require_kind,
    require_single,
)
from vcjax.filter.follower import Following
from vcjax.filter.motion_model import AbstractMotion, Odometry
from vcjax.gates.gate import AbstractDetector, AbstractGate
from vcjax.gates.inlier_ratio import InlierRatio
from vcjax.gates.surrogates import SMOOTHINGS, Smoothing
from vcjax.gates.virtual_correction import VirtualCorrection

MAX_LANDMARKS = 2**13
"""Most landmark slots: their covariance, of seven numbers each, takes 26 GB in float64."""
MAX_BLACKLIST = 2**20
"""Most features that are remembered."""


class FilterConfig(eqx.Module):
    """All that shapes a filter run beside its recording. The defaults are the paper's scenario."""

    gate: AbstractGate = eqx.field(default_factory=VirtualCorrection)
    """Which measurements correct the state."""
    detector: AbstractDetector = eqx.field(default_factory=InlierRatio)
    """Which landmarks are deleted over time."""

    motion: AbstractMotion = eqx.field(default_factory=Odometry)
    """What leads the robot from frame to frame."""

    max_landmarks: int = eqx.field(static=True, default=107)
    """Landmark slots. A full map is reported, and no feature is born until a slot is free. The paper's scenarios need
    94; with a spare one, 108 are 9 tiles of 12 (see `map_covariance`)."""
    max_updates: int = eqx.field(static=True, default=10)
    """Landmarks corrected per frame (Table 1: 10)."""
    births_first_frame: int = eqx.field(static=True, default=10)
    """Features initialised in the first frame (Table 1: 10)."""
    births_per_frame: int = eqx.field(static=True, default=1)
    """Features initialised in every other frame (Table 1: 1)."""
    update: Literal["sequential", "stacked"] = eqx.field(static=True, default="sequential")
    """Correct one landmark after another, each re-linearised at the state left by the one before; or all at once."""
    errors: Literal["additive", "invariant"] = eqx.field(static=True, default="additive")
    """What the covariance is of: differences, as in the paper; or errors that turn robot and map together, for long
    paths without a known heading (see `invariant`)."""
    choose_among: Literal["predicted", "measured"] = eqx.field(static=True, default="predicted")
    """Choose the most uncertain among those predicted visible (one then not measured has used up its place), or among
    those that also were measured."""
    birth_order: Literal["lowest_id", "random"] = eqx.field(static=True, default="lowest_id")
    """Which feature is initialised first: the lowest id, or a random order from the run's own key."""
    retire: bool = eqx.field(static=True, default=True)
    """Free the slot of a landmark whose track has ended in the recording, as soon as nothing depends on it any more:
    at once if landmarks are chosen among the measured; among the predicted, where it may still use up a place for
    update or be deleted by the detector, once it is predicted far outside the image (`features.NEAR_PX`). Exact for
    everything that stays, unless a landmark would come back from there, as badly mapped ones rarely do."""
    see_beyond_infinity: bool = eqx.field(static=True, default=False)
    """Whether a landmark whose inverse depth has become negative by corrections of others is still looked for: it lies
    in the direction it was seen in, farther off than can be told, and its next correction may bring it back. If not, as
    in the paper's toolbox, it lies behind the camera, and stays in the map unseen: many movers that were badly mapped
    in their first frames end so, and are never found."""
    blacklist_capacity: int = eqx.field(static=True, default=0)
    """How many deleted features are remembered and kept from being born again; 0: a deleted feature may come back."""
    following: Following = eqx.field(default_factory=Following)
    """How deleted features are followed outside the map, and handed back when they stand still (see `follower`); needs
    a blacklist, from which these then come off. None are unless `max_followed` is above 0."""
    skip_free_slots: bool | None = eqx.field(static=True, default=None)
    """Pass over the part of P in use only, by a loop whose length depends on the map: best where runs go one by one, as
    on a CPU. False passes over all of P at once: for runs side by side, as on an accelerator. None: by the default
    device. The numbers are the same."""
    reverse_mode: bool = eqx.field(static=True, default=False)
    """Make the run differentiable in reverse mode, and in that only: loops of fixed length or with a derivative of
    their own, and √T checkpoints, between which the way back passes through the frames once more."""
    smoothing: Smoothing = eqx.field(static=True, default="hard")
    """How decisions are made differentiable (see `gates.surrogates`): "hard" not at all; "straight_through" by declared
    derivatives, with the hard filter's numbers; "soft" by weights in [0, 1] that enter the corrections. What is chosen,
    born, deleted or turned Euclidean stays a hard decision in all three."""
    toolbox_parity: bool = eqx.field(static=True, default=False)
    """Use the scalar shortcut for derivatives of unit vectors, as the paper's toolbox does (see `frames.unit`)."""

    temperature: float = eqx.field(converter=number, default=1.0)
    """τ of the smoothing, in χ² units; positive."""
    pixel_std_px: float = eqx.field(converter=number, default=1.0)
    """Standard deviation of a measured pixel, px (Table 1: 1.0); positive."""
    oscillation_std_m: float = eqx.field(converter=number, default=0.0)
    """Standard deviation of the commanded sideways displacement in each frame, m; 0: known exactly."""
    inverse_depth_mean: float = eqx.field(converter=number, default=0.01)
    """Inverse depth of a new landmark, 1/m; positive."""
    inverse_depth_std: float = eqx.field(converter=number, default=0.5)
    """Its standard deviation, 1/m; positive."""
    inverse_depth_min: float = eqx.field(converter=number, default=0.001)
    """What an inverse depth becomes that a correction made negative, 1/m; positive."""
    linearity_max: float = eqx.field(converter=number, default=0.1)
    """Linearity index below which an AHP landmark becomes Euclidean; at least 0 (0: never)."""
    blacklist_frames: float = eqx.field(converter=number, default=np.inf)
    """For how many frames a deleted feature is kept from being born again; at least 0, infinity: for good. Finite only
    with a blacklist, and if nothing is followed."""
    birth_margin_px: float = eqx.field(converter=number, default=25.6)
    """Distance from every image border a new feature must keep, px; at least 0."""

    def __check_init__(self):
        gates = "give a gate, e.g. VirtualCorrection() or ReprojectionError()."
        require_kind("FilterConfig", "gate", self.gate, AbstractGate, gates)
        detectors = "give a detector, e.g. InlierRatio(), or InlierRatio(min_searches=inf) to delete nothing."
        require_kind("FilterConfig", "detector", self.detector, AbstractDetector, detectors)
        motions = "give a motion model, e.g. Odometry() or ConstantVelocity()."
        require_kind("FilterConfig", "motion", self.motion, AbstractMotion, motions)
        for name in ("temperature", "pixel_std_px", "inverse_depth_mean", "inverse_depth_std", "inverse_depth_min"):
            require(self, name, lambda v: np.isfinite(v) & (v > 0), "give a positive number.")
        for name in ("oscillation_std_m", "linearity_max", "birth_margin_px"):
            require(self, name, lambda v: np.isfinite(v) & (v >= 0), "give a number of at least 0.")
        frames = "give a number of frames of at least 0, or infinity: for good."
        require(self, "blacklist_frames", lambda n: n >= 0, frames)
        for name in ("max_landmarks", "max_updates"):
            require_count(self, name, 1, MAX_LANDMARKS)
        for name in ("births_first_frame", "births_per_frame"):
            require_count(self, name, 0, MAX_LANDMARKS)
        require_count(self, "blacklist_capacity", 0, MAX_BLACKLIST)
        for name, choices in (
            ("update", ("sequential", "stacked")),
            ("smoothing", SMOOTHINGS),
            ("errors", ("additive", "invariant")),
            ("choose_among", ("predicted", "measured")),
            ("birth_order", ("lowest_id", "random")),
            ("skip_free_slots", (None, True, False)),
            *((name, (True, False)) for name in ("see_beyond_infinity", "retire", "reverse_mode", "toolbox_parity")),
        ):
            require_choice(self, name, choices)
        if self.update == "stacked" and self.smoothing != "hard":
            raise ValueError(
                f"FilterConfig(update='stacked', smoothing={self.smoothing!r}): stacked corrections have no smooth "
                "form; take update='sequential'."
            )
        followings = "give a Following, e.g. vcjax.Following(max_followed=16)."
        require_kind("FilterConfig", "following", self.following, Following, followings)
        num_followed, capacity = self.following.max_followed, self.blacklist_capacity
        if num_followed > capacity:
            raise ValueError(
                f"FilterConfig(following=Following(max_followed={num_followed}), blacklist_capacity={capacity}): "
                "what is followed must stay out of the map; set blacklist_capacity at least as large, e.g. 64."
            )
        if is_concrete(self.blacklist_frames) and np.any(np.isfinite(self.blacklist_frames)):
            given = f"FilterConfig(blacklist_frames={np.asarray(self.blacklist_frames).tolist()}"
            if capacity == 0:
                raise ValueError(f"{given}, blacklist_capacity=0) keeps nobody out; set blacklist_capacity, e.g. 64.")
            if num_followed > 0:
                raise ValueError(
                    f"{given}, following=Following(max_followed={num_followed})): a feature would be born again while "
                    "it is followed; leave blacklist_frames infinite, or follow none."
                )
        if self.max_updates > self.max_landmarks:
            raise ValueError(
                f"FilterConfig(max_updates={self.max_updates}) exceeds max_landmarks={self.max_landmarks}: "
                "no more landmarks can be corrected than the map holds; raise max_landmarks."
            )


def check_arguments(function: str, config: object, key: object) -> None:
    """Refuse what is no configuration of one run, or no random key, before a function starts to work with it.

    Raises:
        ValueError: naming function, argument, what was given and remedy.
    """
    require_kind(function, "config", config, FilterConfig, "give a FilterConfig, e.g. vcjax.FilterConfig().")
    require_single(function, config)
    if key is not None:
        require_key(function, key)
