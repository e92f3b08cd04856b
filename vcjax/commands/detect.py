"""`vcjax detect`: what each detector finds of the movers, what it flags wrongly, and what movers cost."""

import dataclasses
from pathlib import Path

from rich.console import Console

from vcjax.commands.console import numbered_key, progress_bar, say
from vcjax.devices import Cores
from vcjax.report.detection_tables import write_detection
from vcjax.simulation.scenarios import DynamicMotion, DynamicSet, HarderName
from vcjax.study.detect import detect
from vcjax.study.detection_methods import METHODS


@dataclasses.dataclass(frozen=True)
class Detect:
    """Run detectors in the scenes with movers and without, steady and oscillating, and score what they find.

    DIR holds every finished block of runs: what was stopped goes on there, and more seeds or methods extend fewer.
    """

    seeds: int = 25
    """Runs of each method in each scene."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Which: the paper's VC and RE, these with a blacklist, and gates with a detector."""
    curves: bool = False
    """Run each method at other thresholds too, for ROC and precision–recall curves: about four times as many runs."""
    amplitudes_m: tuple[float, ...] = (0.0, 0.05, 0.1)
    """Amplitudes of the camera's oscillation, m; 0: steady."""
    motions: tuple[DynamicMotion, ...] = ("lateral", "inverse_forward")
    """How the movers move."""
    speeds_m_s: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Their speeds, m/s."""
    dynamic_sets: tuple[DynamicSet, ...] = ("ahead",)
    """Which features move: the six ahead of the robot, the six near its path, or a bus."""
    harder_scenes: tuple[HarderName, ...] = ()
    """Harder scenes beside them: movers that start late, stop or turn, buses, an oscillation known up to 2 or 5 mm."""
    num_frames: int = 160
    """Frames in a run."""
    key: int = 0
    """Number of the base random key."""
    out: Path = Path("results/detect")
    """Directory of the results."""
    devices: Cores = dataclasses.field(default_factory=Cores)
    """Where the runs are done."""

    def __call__(self, console: Console) -> None:
        """Run, score, report."""
        with progress_bar(console, "compiling, first block") as show:
            found = detect(
                self.out,
                self.methods,
                amplitudes_m=self.amplitudes_m,
                motions=self.motions,
                speeds_m_s=self.speeds_m_s,
                dynamic_sets=self.dynamic_sets,
                harder_scenes=self.harder_scenes,
                num_frames=self.num_frames,
                num_seeds=self.seeds,
                curves=self.curves,
                key=numbered_key(self.key),
                progress=show,
            )
        paths = write_detection(found, self.out)
        print((self.out / "detect.md").read_text("utf-8"))
        for path in paths:
            say(console, f"wrote {path}")
