"""One filtered recording in numbers: speed, updates, verdicts, consistency, failures."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from vcjax.filter.config import FilterConfig
from vcjax.filter.info import FrameInfo
from vcjax.gates.gate import AbstractJointGate
from vcjax.recorded.filtered import Filtered
from vcjax.recorded.verdicts import ACCEPTED, DELETED, DYNAMIC, RECOVERED, REJECTED, SUSPECT, TrackVerdicts
from vcjax.recording import Recording


def first_failure(info: FrameInfo) -> int | None:
    """The first frame whose vehicle is not finite; None where all are."""
    failed = np.flatnonzero(~np.asarray(info.is_finite))
    return int(failed[0]) if len(failed) else None


def run_summary(
    config: FilterConfig, recording: Recording, filtered: Filtered, tracks: TrackVerdicts
) -> dict[str, Any]:
    """Numbers of a run, by name; times in s. NaN where there is nothing to say.

    `nis` is the mean normalised innovation squared of the accepted updates, z ᵀ Z⁻¹ z with 2 degrees of freedom. The
    gate cuts off what is not below t, its threshold, so in a consistent filter it has the mean and the variance of χ²₂
    below t; `nis_low` and `nis_high` hold 95 % of the means of as many independent ones. `beyond_gate` is the share of
    measurements at or above the threshold, suspect or not, exp(-t/2) in a consistent filter of a static scene. A gate
    that accepts by all innovations together cuts off otherwise: nothing is expected of it.

    Source: Bar-Shalom, Li, Kirubarajan 2001, section 5.4, for the test.
    """
    info = filtered.info
    accepted, measured = np.asarray(info.is_accepted), np.asarray(info.is_measured)
    num_measured, num_accepted = int(measured.sum()), int(accepted.sum())
    is_within = accepted | (np.asarray(info.is_suspect) & np.asarray(config.gate.accepts(jnp.asarray(info.re1))))
    limit = float(config.gate.margin(jnp.zeros(())))
    mean, variance = nis_moments(limit)
    if isinstance(config.gate, AbstractJointGate):
        limit = mean = math.nan
    half = 1.96 * math.sqrt(variance / num_accepted) if num_accepted else math.nan
    time_s = np.asarray(recording.time_s, np.float64)
    failure = first_failure(info)
    counts = tracks.counts.sum(axis=0)
    duration_s = float(np.ptp(time_s))
    return {
        "frames": recording.num_frames,
        "duration_s": duration_s,
        "compile_s": filtered.compile_s,
        "run_s": filtered.run_s,
        "times_real_time": duration_s / filtered.run_s if duration_s else math.nan,
        "measured": num_measured,
        "accepted": int(counts[ACCEPTED]),
        "recovered": int(counts[RECOVERED]),
        "dynamic": int(counts[DYNAMIC]),
        "rejected": int(counts[REJECTED]),
        "suspect": int(counts[SUSPECT]),
        "deleted": int(counts[DELETED]),
        "tracks_dynamic": int(np.sum(tracks.is_called)),
        "landmarks": len(filtered.landmarks.track_id),
        "nis": float(np.mean(np.asarray(info.re1)[accepted])) if num_accepted else math.nan,
        "nis_low": mean - half,
        "nis_high": mean + half,
        "beyond_gate": float(np.mean(~is_within[measured])) if num_measured else math.nan,
        "beyond_gate_expected": math.exp(-limit / 2.0),
        "first_failure": failure,
        "failures": int(np.sum(~np.asarray(info.is_finite))),
        "frames_map_full": int(np.sum(info.map_is_full)),
        "frames_blind": int(np.sum(np.asarray(info.is_blind)[1:])),
        "end_std_m": float(np.sqrt(np.trace(np.asarray(info.vehicle_cov, np.float64)[-1, :3, :3]))),
    }


def nis_moments(limit: float) -> tuple[float, float]:
    """Mean and variance of χ²₂ below a limit t > 0, which is exponential with mean 2 and cut off.

    With τ = t/2 and q = τ e^{-τ}/(1 - e^{-τ}): mean 2 (1 - q), variance 4 (1 - q (q + τ)).
    """
    tau = limit / 2.0
    if not math.isfinite(tau):
        return 2.0, 4.0
    q = tau / math.expm1(tau) if tau < 700 else 0.0
    return 2.0 * (1.0 - q), 4.0 * (1.0 - q * (q + tau))


def run_summary_text(found: dict[str, Any]) -> str:
    """The numbers in words, a line for each thing to know."""
    within = found["nis_low"] <= found["nis"] <= found["nis_high"]
    is_expected = not math.isnan(found["nis_low"])
    unit = "of the priors' lengths" if found.get("scale") == "free" else "m"
    failed = "none" if found["first_failure"] is None else f"not finite from frame {found['first_failure']} on"
    rows = [
        (
            "frames",
            f"{found['frames']} of {found['duration_s']:.4g} s; {found['frames_blind']} after the first are blind, "
            "corrected by nothing",
        ),
        (
            "speed",
            f"{found['run_s']:.3g} s, {found['times_real_time']:.3g} times real time; "
            f"compilation {found['compile_s']:.3g} s",
        ),
        ("updates", f"{found['accepted']} accepted, {found['recovered']} recovered of {found['measured']} measured"),
        (
            "dynamic",
            f"{found['dynamic']} verdicts of the gate, {found['deleted']} deletions by the detector, "
            f"of {found['tracks_dynamic']} tracks",
        ),
        ("left out", f"{found['rejected']} rejected without a verdict, {found['suspect']} suspect to the detector"),
        ("landmarks", f"{found['landmarks']} mapped; the map was full in {found['frames_map_full']} frames"),
        (
            "mean NIS",
            f"{found['nis']:.3f} of the accepted"
            + (f"; consistent: {found['nis_low']:.3f} to {found['nis_high']:.3f} (95 %)" if is_expected else "")
            + ("" if within or not is_expected else ", which it is not"),
        ),
        (
            "beyond the gate",
            f"{100 * found['beyond_gate']:.2f} % of the measured"
            + (
                f"; consistent and static: {100 * found['beyond_gate_expected']:.2f} %"
                if math.isfinite(found["beyond_gate_expected"])
                else ""
            ),
        ),
        ("place at the end", f"known to {found['end_std_m']:.3g} {unit}, by the filter's own covariance"),
        ("failures", failed),
    ]
    if found.get("scale") is not None:
        by = f"; lengths are multiplied by {found['scale_factor']:.4g}" if found["scale_factor"] != 1.0 else ""
        free = ": lengths are those of the priors, and mean nothing" if found["scale"] == "free" else by
        rows.insert(1, ("scale", f"{found['scale']}{free}"))
    if found.get("tracks_cut") is not None:
        rows.insert(1, ("tracks", f"cut at {found['tracks_cut']} sightings that repeat the one before"))
    return "\n".join(f"{name:16s} {text}" for name, text in rows)
