"""A choice among settings by invented figures, of which the later settings have the better ones."""

import numpy as np
import xarray as xr

from vcjax.study.results import describe
from vcjax.tuning.choice import COMPARED, Choice, Seeds
from vcjax.tuning.losses import Objective

TH1, TH2 = "config.gate.th1", "config.gate.th2"
SCENES = ["lateral, 1 m/s", "inverse forward, 1 m/s"]
NUM_FEATURES = 12


def invented(settings: list[tuple[float, float]], num_seeds: int) -> xr.Dataset:
    """Runs as `evaluate` gives them: noise shared by the settings, of which the later ones are better."""
    rng = np.random.default_rng(0)
    dims, shape = ("setting", "scene", "seed"), (len(settings), len(SCENES), num_seeds)
    shared, better = rng.normal(size=shape[1:]), np.arange(len(settings))[:, None, None]
    own = 0.1 * rng.normal(size=shape)
    figures = {name: (dims, 5.0 + shared - 0.5 * better + own) for name in COMPARED}
    figures["detection_delay_frames"] = (dims, np.where(own > 0.1, np.nan, 3.0 + own))
    is_moving = np.zeros((len(SCENES), NUM_FEATURES), bool)
    is_moving[:, :4] = True
    margin = rng.normal(size=(*shape, NUM_FEATURES)) + is_moving[:, None] * (1 + better[..., None])
    return xr.Dataset(
        figures
        | {
            "is_finite": (dims, np.ones(shape, bool)),
            "map_full_frames": (dims, np.zeros(shape, int)),
            "track_score": ((*dims, "feature"), margin),
            "is_moving": (("scene", "feature"), is_moving),
        },
        {
            "setting": np.arange(len(settings)),
            "scene": SCENES,
            "seed": np.arange(num_seeds),
            TH1: ("setting", [th1 for th1, _ in settings]),
            TH2: ("setting", [th2 for _, th2 in settings]),
        },
    )


def invented_choice() -> Choice:
    """The last of a grid of nine thresholds was chosen by three seeds, and compared on thirty."""
    points = [(9.0, 9.0), *((a, b) for a in (4.0, 8.0, 16.0) for b in (3.0, 9.0, 27.0))]
    before, after = ({TH1: th1, TH2: th2} for th1, th2 in (points[0], points[-1]))
    origin = {"vcjax": "0", "objective": describe(Objective(position=2.0)), "seeds": describe(Seeds(3, 30))}
    return Choice(before, after, invented(points, 3), invented([points[0], points[-1]], 30), origin)
