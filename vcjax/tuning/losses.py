"""What a setting of gate and camera costs in one run: small smooth functions of its info and truth, to add as you like.

All are finite with finite derivatives for every run that is, whatever was seen, and follow the smoothing of the run
they are taken of (see `gates.surrogates`): a true gradient of a soft run, a declared one of a straight-through run,
none through the verdicts of a hard run. `p` is the degree p_dynamic to which a candidate of a frame is called dynamic;
of a track, seen in several frames, it is 1 - (1 - p_detector) Π (1 - p): called so at least once, or by the detector.
As a detector's statistic hardly changes from one frame to the next, only its largest p_detector counts. Of a hard or
straight-through run the losses of the tracks are those of the features deleted.

A degree nearer than 1e-9 to 0 or 1 counts as that near where its logarithm is taken. So of a straight-through run,
whose degrees are 0 and 1, `cross_entropy` has no derivative by its mistakes, which are cut off, but one by what is
right, and `ranking_loss` one by ties only: neither says how to do better, as that of F1 does. Of a soft run the same
befalls mistakes of more than about 20 τ.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vcjax.fields import is_concrete, number, require
from vcjax.filter.info import FrameInfo
from vcjax.gates.surrogates import straight_through
from vcjax.recording import Truth
from vcjax.simulation.scenarios import Scenario
from vcjax.study.detection import happened, largest_by_feature
from vcjax.study.metrics import trajectory_errors

_CLOSEST = 1e-9
"""How near a degree may come to 0 or 1 before its logarithm is cut off. Compared with p and 1 - p, and not with p and
1 - 1e-9, which is 1 in single precision."""


class Labelled(NamedTuple):
    """Degrees in [0, 1] beside what they should be."""

    p: Float[Array, "*n"]
    is_mover: Bool[Array, "*n"]
    counts: Bool[Array, "*n"]
    """Which of the entries there are."""


def candidates(info: FrameInfo, truth: Truth) -> Labelled:
    """Every measured candidate of every frame, (T, K)."""
    counts = info.is_measured & (info.candidate_id >= 0)
    is_mover = jnp.asarray(truth.is_moving)[jnp.where(counts, info.candidate_id, 0)] & counts
    return Labelled(jnp.where(counts, info.p_dynamic, 0.0), is_mover, counts)


def tracks(info: FrameInfo, truth: Truth) -> Labelled:
    """Every feature that was a measured candidate at least once, or deleted, (F,)."""
    each, num_features = candidates(info, truth), truth.is_moving.shape[0]
    is_deleted = happened(info.inconsistent_id, num_features)
    by_detector = jnp.nan_to_num(largest_by_feature(info.watched_id, info.p_detector, num_features))
    place = jnp.where(each.counts, info.candidate_id, num_features).ravel()
    p_not = 1.0 - each.p.ravel()
    # The derivative of the product by a factor of zero is the product of the others: it has to pass the cut-off.
    log_not = jnp.log(straight_through(jax.lax.stop_gradient(jnp.maximum(p_not, _CLOSEST)), p_not))
    total = jnp.zeros(num_features, log_not.dtype).at[place].add(log_not, mode="drop")
    counts = is_deleted | happened(jnp.where(each.counts, info.candidate_id, -1), num_features)
    p = jnp.where(counts, 1.0 - (1.0 - by_detector) * jnp.exp(total), 0.0)
    return Labelled(p, jnp.asarray(truth.is_moving) & counts, counts)


def f1_loss(labelled: Labelled) -> Float[Array, ""]:
    """1 - F1 with soft counts: F1 = 2 TP / (2 TP + FP + FN), TP = Σ p of movers, FP = Σ p of the others.

    Between 0 and 1; 1 where there are no movers.
    """
    num_movers = jnp.sum(labelled.is_mover)
    called = jnp.sum(jnp.where(labelled.counts, labelled.p, 0.0))
    hits = jnp.sum(jnp.where(labelled.is_mover, labelled.p, 0.0))
    total = called + num_movers
    return 1.0 - 2.0 * hits / jnp.where(total > 0, total, 1.0)


def cross_entropy(labelled: Labelled, mover_weight: float | Float[Array, ""] = 1.0) -> Float[Array, ""]:
    """Weighted binary cross entropy, -(Σ w ln p of movers + Σ ln(1 - p) of the others) / Σ w; 0 where there is nobody.

    Args:
        labelled: candidates or tracks.
        mover_weight: w of a mover; the others have 1. Positive.
    """
    weight = jnp.where(labelled.is_mover, mover_weight, 1.0) * labelled.counts
    total = jnp.sum(weight)
    log_likelihood = jnp.log(jnp.maximum(jnp.where(labelled.is_mover, labelled.p, 1.0 - labelled.p), _CLOSEST))
    return -jnp.sum(weight * log_likelihood) / jnp.where(total > 0, total, 1.0)


def ranking_loss(labelled: Labelled, temperature: float | Float[Array, ""] = 1.0) -> Float[Array, ""]:
    """1 - soft AUC: mean over pairs of a mover m and another o of σ((s_o - s_m)/τ), with the log-odds s = ln p/(1 - p).

    For τ → 0 the share of pairs in the wrong order. 0.5 where all have the same p; 0 where there are no pairs.

    Args:
        labelled: tracks, or candidates of one frame: all pairs are formed.
        temperature: τ of the order, in log-odds; positive.
    """
    p = labelled.p.ravel()
    odds = jnp.log(jnp.maximum(p, _CLOSEST)) - jnp.log(jnp.maximum(1.0 - p, _CLOSEST))
    is_mover = labelled.is_mover.ravel()
    is_other = labelled.counts.ravel() & ~is_mover
    is_pair = is_mover[:, None] & is_other
    wrong = jax.nn.sigmoid((odds[None, :] - odds[:, None]) / temperature)
    num_pairs = jnp.sum(is_pair)
    return jnp.sum(jnp.where(is_pair, wrong, 0.0)) / jnp.where(num_pairs > 0, num_pairs, 1)


def position_rmse_m(info: FrameInfo, truth: Truth) -> Float[Array, ""]:
    """RMS over the frames of √(ex² + ey²), m; its derivative is zero where there is no error at all."""
    mean_square = jnp.mean(jnp.sum((info.vehicle[:, :2] - truth.robot[:, :2]) ** 2, axis=1))
    is_none = mean_square <= 0
    return jnp.where(is_none, 0.0, jnp.sqrt(jnp.where(is_none, 1.0, mean_square)))


def inconsistency(info: FrameInfo, truth: Truth) -> Float[Array, ""]:
    """(ln ANEES)² of the position (x, y), 0 for a run whose covariance has the size of its error.

    Frames without a defined NEES (see `metrics.trajectory_errors`) are left out; 0 where no frame has one.
    """
    nees = trajectory_errors(info, truth)["nees_position"]
    is_defined = ~jnp.isnan(nees)
    num = jnp.sum(is_defined)
    anees = jnp.sum(jnp.where(is_defined, nees, 0.0)) / (2 * jnp.where(num > 0, num, 1))
    return jnp.where(anees > 0, jnp.log(jnp.where(anees > 0, anees, 1.0)) ** 2, 0.0)


def camera_motion_m2_s2(scenario: Scenario) -> Float[Array, ""]:
    """Price of the oscillation: its mean square speed (2 π f A)² / 2, m²/s². ∝ A² f²."""
    A, f = scenario.oscillation.amplitude_m, scenario.oscillation.frequency_hz
    return 0.5 * (2.0 * jnp.pi * jnp.asarray(f) * A) ** 2


OF_MOVERS = ("track_f1", "candidate_f1", "track_ranking")
"""Losses that are the same where nothing moves, whatever is called dynamic."""
SHAPES = ("mover_weight", "ranking_temperature")
"""Fields of an objective that are no weights of losses."""


class Objective(eqx.Module):
    """What is wanted of a setting: a weighted sum of the losses of this module.

    All weights are at least 0, and one of them is more.
    """

    track_f1: float = eqx.field(converter=number, default=1.0)
    """Weight of 1 - F1 of the tracks (`f1_loss`)."""
    track_cross_entropy: float = eqx.field(converter=number, default=0.0)
    """Weight of the `cross_entropy` of the tracks."""
    track_ranking: float = eqx.field(converter=number, default=0.0)
    """Weight of 1 - AUC of the tracks (`ranking_loss`)."""
    candidate_f1: float = eqx.field(converter=number, default=0.0)
    """Weight of 1 - F1 of the candidates of all frames."""
    candidate_cross_entropy: float = eqx.field(converter=number, default=0.0)
    """Weight of the `cross_entropy` of the candidates."""
    position: float = eqx.field(converter=number, default=0.0)
    """Weight of the position error (`position_rmse_m`), 1/m."""
    consistency: float = eqx.field(converter=number, default=0.0)
    """Weight of (ln ANEES)² of the position (`inconsistency`)."""
    camera_motion: float = eqx.field(converter=number, default=0.0)
    """Weight of the camera's mean square speed, (2πfA)²/2 (`camera_motion_m2_s2`), s²/m²."""
    mover_weight: float = eqx.field(converter=number, default=1.0)
    """What a mover counts in the `cross_entropy` of tracks and candidates, where another counts 1; positive."""
    ranking_temperature: float = eqx.field(converter=number, default=1.0)
    """τ of the order in the `ranking_loss`, in log-odds; positive."""

    def __check_init__(self):
        weights = [name for name in vars(self) if name not in SHAPES]
        for name in weights:
            require(self, name, lambda w: np.isfinite(w) & (w >= 0), "a weight is finite and at least 0.")
        for name in SHAPES:
            require(self, name, lambda v: np.isfinite(v) & (v > 0), "give a positive number.")
        values = [getattr(self, name) for name in weights]
        if all(map(is_concrete, values)) and not np.all(np.sum(np.broadcast_arrays(*values), axis=0) > 0):
            raise ValueError(f"Objective: all weights are 0; give one of {', '.join(weights)} a number above 0.")

    def terms(self, scenario: Scenario, info: FrameInfo, truth: Truth) -> dict[str, Float[Array, ""]]:
        """The losses by the names of their weights, not weighted."""
        of_tracks, of_candidates = tracks(info, truth), candidates(info, truth)
        return {
            "track_f1": f1_loss(of_tracks),
            "track_cross_entropy": cross_entropy(of_tracks, self.mover_weight),
            "track_ranking": ranking_loss(of_tracks, self.ranking_temperature),
            "candidate_f1": f1_loss(of_candidates),
            "candidate_cross_entropy": cross_entropy(of_candidates, self.mover_weight),
            "position": position_rmse_m(info, truth),
            "consistency": inconsistency(info, truth),
            "camera_motion": camera_motion_m2_s2(scenario),
        }

    def __call__(self, scenario: Scenario, info: FrameInfo, truth: Truth) -> Float[Array, ""]:
        """The weighted sum of one run."""
        terms = {name: (getattr(self, name), loss) for name, loss in self.terms(scenario, info, truth).items()}
        wanted = [weight * loss for weight, loss in terms.values() if not is_concrete(weight) or np.any(weight != 0)]
        return sum(wanted, jnp.zeros(()))


WANTED = Objective(track_f1=1.0, position=2.0, camera_motion=0.02)
"""What a setting is wanted to do, unless one says otherwise: 5 cm of position error weigh as much as 0.1 of F1, and the
paper's oscillation as much as 0.009."""
