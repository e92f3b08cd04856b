"""`vcjax inspect`: what is in a recording."""

import dataclasses
from pathlib import Path

import tyro
from rich.console import Console

from vcjax.commands.console import say
from vcjax.report.style import write_picture
from vcjax.sources.overview import draw_overview, summary
from vcjax.sources.recording_file import load_recording
from vcjax.storage import check_writable


@dataclasses.dataclass(frozen=True)
class Inspect:
    """Say what is in a recording: frames, rate, tracks, calibration, odometry, truth; and draw it."""

    recording: tyro.conf.Positional[Path]
    """Recording file (.npz)."""
    picture: Path | None = None
    """File of the picture (PNG); beside the recording, NAME_overview.png, if not given."""

    def __call__(self, console: Console) -> None:
        """Read, print, draw."""
        content = load_recording(self.recording)
        picture = self.picture or self.recording.with_name(f"{self.recording.stem}_overview.png")
        images = [self.recording.parent / path for path in content.image_paths or ()]
        check_writable(picture, [self.recording, *images])
        print(summary(content))
        say(console, f"wrote {write_picture(draw_overview(content), picture)}")
