"""What the parts of one frame cost: each in a compiled loop of its own, on a state from the middle of a run.

python scripts/time_kernels.py --frames 80

What is apart here is fused in a whole `step`, so the parts do not quite add up to it.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import tyro

import vcjax as vc
from vcjax.filter.features import choose, match, predict_features
from vcjax.filter.frame_corrections import correct_frame
from vcjax.filter.landmark_map import give_birth
from vcjax.filter.slam import predict
from vcjax.filter.submap import gather, scatter
from vcjax.study.monte_carlo import ONE_THREAD_PER_LANE


@dataclasses.dataclass(frozen=True)
class Study:
    """Time the parts of one frame of the paper's forward scenario with the VC gate."""

    frames: int = 80
    """Frame whose state is taken."""
    repeats: int = 200
    """Calls of each part in a loop."""
    seed: int = 0
    """Number of the run."""


def microseconds(part: Callable[[Any, Any], tuple[Any, Any]], argument: Any, repeats: int) -> float:
    """Median over five loops of the time of one call, µs.

    A part gets its argument and the number of the call, and gives the argument of the next call and what is made of it;
    each result counts, so that none is left out, and depends on the call, so that none is done once for all.
    """

    def again(i, carry):
        argument, total = carry
        argument, result = part(argument, i)
        some = (jnp.ravel(leaf)[i % leaf.size].astype(total.dtype) for leaf in jax.tree.leaves(result) if leaf.size)
        return argument, total + sum(some)

    options = ONE_THREAD_PER_LANE if jax.default_backend() == "cpu" else None
    loop = jax.jit(lambda x: jax.lax.fori_loop(0, repeats, again, (x, jnp.zeros(()))), compiler_options=options)
    compiled, taken = loop.lower(argument).compile(), []
    for _ in range(6):
        start = time.perf_counter()
        jax.block_until_ready(compiled(argument))
        taken.append(time.perf_counter() - start)
    return 1e6 * statistics.median(taken[1:]) / repeats


def main(study: Study) -> None:
    config = vc.FilterConfig()
    recording, _ = vc.simulate(vc.scenarios.paper(num_frames=study.frames + 1), jax.random.key(study.seed))
    head = jax.tree.map(
        lambda leaf: leaf[: study.frames] if jnp.shape(leaf)[:1] == (study.frames + 1,) else leaf, recording
    )
    state, _ = vc.run(config, head)
    frame = recording.frame(study.frames)

    state = predict(config, state, frame)
    prediction, column = predict_features(config, state, frame.camera), match(state, frame)
    slot, is_searched = choose(config, prediction, column >= 0)
    is_measured, uv_px = is_searched & (column[slot] >= 0), frame.uv_px[column[slot]]
    _, submap, rows = gather(config, state, slot)
    corrected, _ = correct_frame(config, frame.camera, submap, uv_px, is_measured)
    is_mapped = jnp.zeros_like(frame.is_valid)
    num_slots = len(state.is_mapped)

    def at(state: vc.FilterState, i: Any) -> vc.FilterState:
        """The state a little elsewhere in each call."""
        return dataclasses.replace(state, vehicle=state.vehicle + 1e-9 * i)

    parts: dict[str, tuple[Callable[[Any, Any], tuple[Any, Any]], Any]] = {
        "step": (lambda s, i: vc.step(config, s, frame), state),
        "predict": (lambda s, i: (predict(config, s, frame), ()), state),
        "predict_features": (lambda s, i: (s, predict_features(config, at(s, i), frame.camera)), state),
        "match": (lambda s, i: (s, match(dataclasses.replace(s, track_id=s.track_id + i), frame)), state),
        "gather": (lambda s, i: (s, gather(config, s, (slot + i) % num_slots)[1:]), state),
        "correct_frame": (
            lambda s, i: (s, correct_frame(config, frame.camera, s, uv_px + 1e-9 * i, is_measured)),
            submap,
        ),
        "scatter": (lambda s, i: (scatter(config, s, corrected, slot, rows), ()), state),
        "give_birth": (lambda s, i: give_birth(config, s, frame, is_mapped, 1)[:2], state),
    }
    print(f"frame {study.frames}: {int(state.is_mapped.sum())} landmarks in {len(state.is_mapped)} slots")
    for name, (part, argument) in parts.items():
        print(f"{name:18s} {microseconds(part, argument, study.repeats):8.1f} µs")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(tyro.cli(Study))
