"""What a frame shows a detector, made by hand or at random; and detectors run over a whole record of it."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from vcjax.gates.gate import Evidence


def evidence(slot, num_slots, **fields) -> Evidence:
    """Evidence of candidates that were all searched, found and corrected with, unless a field says otherwise."""
    everyone = np.ones(len(slot), bool)
    default = dict(
        slot=np.array(slot),
        is_searched=everyone,
        is_measured=everyone,
        is_corrected=everyone,
        is_suspect=~everyone,
        innovation=np.zeros((len(slot), 2)),
        innovation_cov=np.tile(np.eye(2), (len(slot), 1, 1)),
        H=np.zeros((len(slot), 2, 7)),
        PH=np.zeros((len(slot), 7, 2)),
        pixel_cov=np.eye(2),
        re1=np.zeros(len(slot)),
        dynamic_margin=np.full(len(slot), -9.0),
        is_visible=np.ones(num_slots, bool),
        time_step_s=np.array(0.1),
    )
    fields = default | fields
    weight = np.asarray(fields["is_corrected"], float)
    return Evidence(**jax.tree.map(jnp.asarray, {"weight": weight} | fields))


def born(detector, num_slots):
    """The states of so many slots at birth."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_slots, *leaf.shape)), detector.born())


@jax.jit
def observe_all(detector, state, record):
    """States and margins after each frame of a record (leading axis T). Nothing is deleted by what is flagged."""

    def observe(state, frame):
        state, margin = detector.observe(state, Evidence(**frame))
        return state, (state, margin)

    return jax.lax.scan(observe, state, record)[1]


def random_record(seed, num_frames=40, num_slots=5, num_candidates=3) -> dict:
    """A record of random numbers (fields of evidence, leading axis T), with rubbish where a number means nothing."""
    rng = np.random.default_rng(seed)
    shape = num_frames, num_candidates
    slot = np.stack([rng.permutation(num_slots)[:num_candidates] for _ in range(num_frames)])
    is_searched = rng.random(shape) < 0.9
    is_measured = rng.random(shape) < 0.8
    is_corrected = is_searched & is_measured & (rng.random(shape) < 0.7)
    A = rng.normal(size=(*shape, 2, 2))
    S = A @ A.mT + np.eye(2)
    z = 2 * rng.normal(size=(*shape, 2))
    re1 = np.einsum("tka,tkab,tkb->tk", z, np.linalg.inv(S), z)
    numbers = dict(
        innovation=z,
        innovation_cov=S,
        H=5 * rng.normal(size=(*shape, 2, 7)),
        PH=0.05 * rng.normal(size=(*shape, 7, 2)),
        re1=re1,
        dynamic_margin=re1 - 9,
    )
    is_found = is_searched & is_measured
    numbers = {k: np.where(is_found.reshape(*shape, *(1,) * (v.ndim - 2)), v, np.nan) for k, v in numbers.items()}
    fields = dict(
        slot=slot,
        is_searched=is_searched,
        is_measured=is_measured,
        is_corrected=np.where(is_searched, is_corrected, rng.random(shape) < 0.5),
        is_suspect=np.zeros(shape, bool),
        weight=is_corrected.astype(float),
        pixel_cov=np.tile(0.5 * np.eye(2), (num_frames, 1, 1)),
        is_visible=rng.random((num_frames, num_slots)) < 0.8,
        time_step_s=rng.uniform(0.05, 0.2, num_frames),
    )
    return jax.tree.map(jnp.asarray, fields | numbers)


def frames(record):
    """The frames of a record in NumPy, their fields as attributes."""
    record = jax.device_get(record)
    for t in range(len(record["slot"])):
        yield SimpleNamespace(**{name: values[t] for name, values in record.items()})
