"""Images with the features of a recording in the colours of their verdicts, and an animation of them.

Pictures have a palette: greys, and a colour for each verdict. So what is drawn keeps its colour exactly, and an
animated GIF of many frames stays small. The work is Pillow's.
"""

import io
import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from vcjax import extras
from vcjax.recorded.verdicts import DELETED, DYNAMIC, Verdicts
from vcjax.sources.image_sequence import read_image
from vcjax.sources.map_file import CLASS_COLOURS
from vcjax.sources.recording_file import RecordingFile
from vcjax.sources.tracks import tracks_of
from vcjax.storage import write_file

STATUSES = ("accepted", "recovered", "dynamic", "rejected", "suspect", "not used")
"""What is told of a feature in a frame, the first five as in `verdicts.VERDICTS`; "not used": seen, and no more."""
NOT_USED = len(STATUSES) - 1
_NUM_GREYS = 250
_COLOURS = [
    *(CLASS_COLOURS[name] for name in ("accepted", "recovered", "dynamic")),
    *((86, 180, 233), (204, 121, 167), (240, 228, 66)),
]
_BLACK, _WHITE = 0, _NUM_GREYS - 1
_LEGEND_PX = 26
_MOST_PX = 8192
_GIF_WIDTH_PX, _GIF_GREYS = 640, 24


class Seen(NamedTuple):
    """The features in an image."""

    uv_px: Float[np.ndarray, "n 2"]
    status: Int[np.ndarray, " n"]
    """Index into `STATUSES`."""
    was_dynamic: Bool[np.ndarray, " n"]
    """Called dynamic or deleted in an earlier frame."""


class FeaturePictures:
    """Pictures of the frames of a recording with the verdicts of a run.

    A frame whose image cannot be read is drawn on plain axes, and `unread` tells why.
    """

    def __init__(self, content: RecordingFile, passed: Verdicts, folder: Path, width_px: int = 720):
        """A picture of each frame can be asked for.

        Args:
            content: the recording.
            passed: verdicts of a run over it.
            folder: where relative paths of its images begin.
            width_px: least width of a picture; smaller images are enlarged by a whole number, those with a side of
                more than 8192 px shrunk.
        """
        self.content, self.folder = content, folder
        calibration = content.calibration
        if calibration is None or content.image_paths is None:
            size = np.ceil(np.asarray(content.recording.camera.image_size_px)).astype(int)
            self.size, self.has_images = (int(size[0]), int(size[1])), False
            tracks = tracks_of(content.recording)
        else:
            self.size, self.has_images = (calibration.width, calibration.height), True
            tracks = tracks_of(content.recording, calibration)
        self.scale = min(float(max(1, -(-width_px // self.size[0]))), _MOST_PX / max(self.size))
        self.unread: dict[int, str] = {}
        """What was wrong with the images that could not be read, by frame, of those that were drawn."""
        self._tracks, self._passed = tracks, passed
        is_end = (passed.verdict == DYNAMIC) | (passed.verdict == DELETED)
        # First frame in which each track was called dynamic or deleted.
        self._ended = dict(zip(passed.track_id[is_end][::-1], passed.frame[is_end][::-1], strict=True))

    def seen(self, t: int) -> Seen:
        """The features in frame t."""
        rows = slice(*np.searchsorted(self._tracks.frame, [t, t + 1]))
        ids, uv_px = self._tracks.track_id[rows], self._tracks.uv_px[rows]
        here = slice(*np.searchsorted(self._passed.frame, [t, t + 1]))
        told = dict(zip(self._passed.track_id[here].tolist(), self._passed.verdict[here].tolist(), strict=True))
        status = np.array([told.get(i, NOT_USED) for i in ids.tolist()], int).clip(max=NOT_USED)
        was_dynamic = np.array([self._ended.get(i, t) < t for i in ids.tolist()], bool)
        return Seen(uv_px, status, was_dynamic)

    def picture(self, t: int, scale: float | None = None, num_greys: int = _NUM_GREYS) -> Any:
        """Frame t as an image of Pillow with a palette.

        Args:
            t: number of the frame.
            scale: pixels of the picture for each of the image; so many that it is wide enough if None.
            num_greys: how many greys the image has.
        """
        pillow = extras.load("PIL.Image", "Pictures", "images")
        from PIL import ImageDraw

        scale = self.scale if scale is None else scale
        size = max(1, round(self.size[0] * scale)), max(1, round(self.size[1] * scale))
        canvas = pillow.new("L", (size[0], size[1] + _LEGEND_PX), _WHITE)
        draw = ImageDraw.Draw(canvas)
        grey = self._grey(t)
        if grey is not None:
            image = pillow.fromarray(grey).resize(size, pillow.Resampling.BILINEAR)
            image = image.point(lambda grey: round(grey * (num_greys - 1) / _WHITE) * _WHITE // (num_greys - 1))
            canvas.paste(image, (0, _LEGEND_PX))
        else:
            _plain_axes(draw, self.size, scale)
        seen = self.seen(t)
        # What was used lies above what was not.
        for i in np.argsort(-seen.status, kind="stable"):
            place = (seen.uv_px[i] + 0.5) * scale + [0, _LEGEND_PX]
            _mark(draw, place, int(seen.status[i]), bool(seen.was_dynamic[i]))
        time_s = float(self.content.recording.time_s[t] - self.content.recording.time_s[0])
        _legend(draw, size[0], f"{t}: {time_s:.2f} s")
        greys = np.repeat(np.linspace(0, 255, _NUM_GREYS).round().astype(np.uint8), 3).tolist()
        picture = pillow.new("P", canvas.size)
        picture.putdata(canvas.tobytes())
        picture.putpalette([*greys, *(part for colour in _COLOURS for part in colour)])
        return picture

    def write_picture(self, t: int, path: Path) -> Path:
        """Write the picture of frame t as PNG, complete or not at all."""
        stream = io.BytesIO()
        self.picture(t).save(stream, format="PNG", optimize=True)
        return write_file(path, stream.getvalue())

    def write_animation(
        self, frames: Sequence[int], path: Path, progress: Callable[[int, int], None] | None = None
    ) -> Path:
        """Write frames as an animated GIF or a video (MPEG-4), as the ending says, complete or not at all.

        It runs as fast as the recording where every frame is drawn, at up to 25 pictures per second. The GIF is at
        most 640 px wide and has few greys, since it stores every noisy pixel.

        Args:
            frames: their numbers, growing.
            path: `.gif` or `.mp4`.
            progress: called with (pictures done, in all).

        Raises:
            ValueError: for another ending.
        """
        if path.suffix not in (".gif", ".mp4"):
            raise ValueError(f"{path}: unknown ending {path.suffix!r}; give .gif or .mp4.")
        is_gif = path.suffix == ".gif"
        scale = min(self.scale, _GIF_WIDTH_PX / self.size[0]) if is_gif else self.scale
        time_s = np.asarray(self.content.recording.time_s, np.float64)
        step_s = max(0.04, float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0)

        def pictures():
            for done, t in enumerate(frames, 1):
                yield self.picture(t, scale, _GIF_GREYS if is_gif else _NUM_GREYS)
                if progress is not None:
                    progress(done, len(frames))

        with tempfile.TemporaryDirectory() as folder:
            temporary = Path(folder) / path.name
            (_save_gif if is_gif else _save_video)(pictures(), temporary, step_s)
            return write_file(path, temporary.read_bytes())

    def _grey(self, t: int) -> UInt8[np.ndarray, "height width"] | None:
        """The image of frame t in the greys of the palette; None if there is none, or it cannot be read."""
        if not self.has_images or self.content.image_paths is None:
            return None
        try:
            image = read_image(self.folder / self.content.image_paths[t], *self.size)
        except (OSError, ValueError) as error:
            self.unread[t] = str(error)
            return None
        return (image.astype(np.uint16) * (_NUM_GREYS - 1) // 255).astype(np.uint8)


def _save_gif(pictures: Iterator[Any], path: Path, step_s: float) -> None:
    next(pictures).save(path, save_all=True, append_images=pictures, duration=round(1000 * step_s), loop=0)


def _save_video(pictures: Iterator[Any], path: Path, step_s: float) -> None:
    cv2 = extras.load("cv2", "Videos", "images")
    first = next(pictures)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 1.0 / step_s, first.size)
    for picture in itertools.chain([first], pictures):
        video.write(np.asarray(picture.convert("RGB"))[:, :, ::-1])
    video.release()


def _mark(draw: Any, place: np.ndarray, status: int, was_dynamic: bool) -> None:
    """A feature: a ring, a disc where dynamic, a cross where rejected or suspect, a dot where not used."""
    x, y = (float(p) for p in place)
    colour = _NUM_GREYS + status
    if STATUSES[status] == "not used":
        draw.ellipse((x - 2, y - 2, x + 2, y + 2), fill=colour, outline=_BLACK)
    elif STATUSES[status] == "dynamic":
        draw.ellipse((x - 7, y - 7, x + 7, y + 7), fill=colour, outline=_BLACK)
    elif STATUSES[status] in ("rejected", "suspect"):
        for width, ink in ((4, _BLACK), (2, colour)):
            draw.line((x - 5, y - 5, x + 5, y + 5), fill=ink, width=width)
            draw.line((x - 5, y + 5, x + 5, y - 5), fill=ink, width=width)
    else:
        draw.ellipse((x - 7, y - 7, x + 7, y + 7), outline=_BLACK, width=4)
        draw.ellipse((x - 6, y - 6, x + 6, y + 6), outline=colour, width=2)
    if was_dynamic:
        _square(draw, x, y, 8.0)


def _square(draw: Any, x: float, y: float, half: float) -> None:
    """Around what was called dynamic before."""
    draw.rectangle((x - half, y - half, x + half, y + half), outline=_NUM_GREYS + STATUSES.index("dynamic"), width=1)


def _legend(draw: Any, width: int, told: str) -> None:
    """What the marks mean, and which frame it is, in a line above."""
    from PIL import ImageFont

    font = ImageFont.load_default(size=12)
    x, middle = 12.0, _LEGEND_PX / 2
    for status, name in enumerate(STATUSES):
        _mark(draw, np.array([x, middle]), status, False)
        draw.text((x + 11, middle), name, fill=_BLACK, font=font, anchor="lm")
        x += 11 + draw.textlength(name, font=font) + 18
    _square(draw, x, middle, 6.0)
    draw.text((x + 11, middle), "dynamic before", fill=_BLACK, font=font, anchor="lm")
    draw.text((width - 8, middle), told, fill=_BLACK, font=font, anchor="rm")


def _plain_axes(draw: Any, size: tuple[int, int], scale: float) -> None:
    """Lines every so many pixels, with their numbers, instead of an image."""
    from PIL import ImageFont

    font, light, grey = ImageFont.load_default(size=10), int(0.93 * _WHITE), int(0.5 * _WHITE)
    step = 10 ** np.floor(np.log10(max(size) / 2)) if max(size) >= 20 else 1
    width, height = (max(1.0, side * scale) for side in size)
    draw.rectangle((0, _LEGEND_PX, width - 1, _LEGEND_PX + height - 1), outline=grey)
    for u in np.arange(step, size[0], step):
        draw.line((u * scale, _LEGEND_PX + 1, u * scale, _LEGEND_PX + height - 2), fill=light)
        draw.text((u * scale, _LEGEND_PX + height - 3), f"{u:g}", fill=grey, font=font, anchor="ms")
    for v in np.arange(step, size[1], step):
        draw.line((1, v * scale + _LEGEND_PX, width - 2, v * scale + _LEGEND_PX), fill=light)
        draw.text((4, v * scale + _LEGEND_PX), f"{v:g}", fill=grey, font=font, anchor="lm")
