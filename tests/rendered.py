"""A small rendered sequence that several tests share: ten patches in a room, two of which move, and a moving camera."""

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import jax
import numpy as np

import vcjax as vc
from vcjax.simulation.world import Movers
from vcjax.sources.front_end import track_images
from vcjax.sources.rendered_sequence import RenderedSequence, render_sequence
from vcjax.sources.tracks import Tracks

MOVERS = (2, 7)


def scenario(num_frames=30, amplitude_m=0.05) -> vc.Scenario:
    """Straight on at 0.3 m/s towards patches at 3 to 5 m, with the camera oscillating."""
    layers = [(y, z) for z in (0.1, 1.1) for y in (-2.2, -1.1, 0.0, 1.1, 2.2)]
    return vc.Scenario(
        landmarks_m=np.array([(3.0 + i % 3, y, z) for i, (y, z) in enumerate(layers)]),
        movers=Movers(list(MOVERS), (0.0, 1.0, 0.0), 0.4),
        oscillation=vc.Oscillation(amplitude_m, 3.0),
        camera=vc.Camera((159.5, 119.5, 200.0, 200.0), (320.0, 240.0)),
        start=(0.0, 0.0, 0.0),
        increment=(0.03, 0.0, 0.0),
        pixel_std_px=0.0,
        num_frames=num_frames,
    )


@cache
def rendered() -> RenderedSequence:
    """The sequence, rendered once."""
    return render_sequence(Path(mkdtemp()) / "sequence", scenario(), jax.random.key(0), patch_m=0.5)


@cache
def tracked() -> Tracks:
    """Its tracks."""
    return track_images(rendered().sequence.images())
