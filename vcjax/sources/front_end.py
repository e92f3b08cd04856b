"""From images to feature tracks: corners spread over the image, followed by optical flow. All of it is OpenCV's.

Corners are those of Shi and Tomasi (CVPR 1994), refined below a pixel; the best of each cell of a grid are taken, so
that no rich corner of the scene takes all places. They are followed from image to image by the pyramidal method of
Lucas and Kanade (Bouguet 2001), forward and back again: a track that does not come back to where it was ends. Where
tracks have ended or left the image, new corners begin; a number is never used again.

No test of a common motion (such as RANSAC on the epipolar constraint) removes tracks here: it would remove what moves,
which is what the gates are to find.
"""

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from vcjax import extras
from vcjax.sources.tracks import Tracks

Image = UInt8[np.ndarray, "height width"]


@dataclasses.dataclass(frozen=True)
class FrontEnd:
    """How corners are found and followed."""

    max_features: int = 200
    """Most features in an image."""
    grid: tuple[int, int] = (8, 6)
    """Columns and rows of the cells that corners are spread over; each takes its share of `max_features`."""
    min_distance_px: float = 10.0
    """Least distance of a new corner from every other feature, px."""
    quality: float = 0.01
    """Least strength of a corner (smaller eigenvalue of its gradients' moments) as a part of the best one's."""
    window_px: int = 15
    """Side of the square that is followed, px; odd."""
    num_levels: int = 3
    """How often the image is halved for large motions: they may be about window_px · 2**num_levels / 2."""
    max_return_px: float = 0.5
    """Farthest that a feature followed forth and back may end from where it was, px."""

    def __post_init__(self):
        for name, least, most in (("max_features", 1, 2**20), ("window_px", 3, 255), ("num_levels", 0, 10)):
            value = getattr(self, name)
            is_good = isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
            _require(self, name, is_good, f"give a whole number from {least} to {most}.")
        _require(self, "window_px", self.window_px % 2 == 1, "give an odd number, so that it has a middle.")
        is_grid = isinstance(self.grid, tuple) and len(self.grid) == 2
        is_grid = is_grid and all(isinstance(n, int) and 1 <= n <= 1000 for n in self.grid)
        _require(self, "grid", is_grid, "give columns and rows, whole numbers of at least 1.")
        for name, most in (("min_distance_px", np.inf), ("quality", 1.0), ("max_return_px", np.inf)):
            value = getattr(self, name)
            is_good = isinstance(value, int | float) and bool(0 < value <= most and np.isfinite(value))
            _require(self, name, is_good, "give a positive number" + (f", at most {most:g}." if most < 1e9 else "."))


def track_images(
    images: Iterable[Image], options: FrontEnd | None = None, progress: Callable[[int], None] | None = None
) -> Tracks:
    """Tracks of corners through a sequence of images. The same images give the same tracks.

    Args:
        images: grey images of one size, one for each frame; they are taken one by one, and two are held.
        options: how corners are found and followed; the defaults of `FrontEnd`.
        progress: called with the number of frames done after each.

    Returns:
        Sightings, frame by frame; ids count from 0 in the order of detection. Pixels are those of the images, with
        whole numbers at the centres of pixels.

    Raises:
        ModuleNotFoundError: if OpenCV is not installed, with the remedy.
        ValueError: for what is no grey image of 8 bits, or of another size than the first, by its frame.
    """
    options = options or FrontEnd()
    before: Image | None = None
    points, ids, next_id = np.zeros((0, 2), np.float32), np.zeros(0, np.int64), 0
    sightings: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for frame, image in enumerate(images):
        _refuse_image(image, frame, before)
        if before is not None and len(points):
            moved, is_followed = _follow(before, image, points, options)
            points, ids = moved[is_followed], ids[is_followed]
            is_apart = _apart(points, options.min_distance_px / 2)
            points, ids = points[is_apart], ids[is_apart]
        new = _corners(image, points, options)
        points = np.concatenate([points, new])
        ids = np.concatenate([ids, np.arange(next_id, next_id + len(new))])
        next_id += len(new)
        sightings.append((np.full(len(ids), frame), ids, points.astype(np.float64)))
        before = image
        if progress is not None:
            progress(frame + 1)
    if not sightings:
        raise ValueError("track_images(images): no image; give at least one.")
    frames, track_ids, uv_px = (np.concatenate(parts) for parts in zip(*sightings, strict=True))
    return Tracks(frames, track_ids, uv_px)


def _follow(
    before: Image, image: Image, points: Float[np.ndarray, "n 2"], options: FrontEnd
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Where points have moved, and which of them came back, stayed inside the image and have a texture still."""
    cv2 = extras.load("cv2", "Images", "images")
    settings = {
        "winSize": (options.window_px, options.window_px),
        "maxLevel": options.num_levels,
        "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.003),
    }
    moved, is_found, _ = cv2.calcOpticalFlowPyrLK(before, image, points, None, **settings)
    back, is_back, _ = cv2.calcOpticalFlowPyrLK(image, before, moved, None, **settings)
    height, width = image.shape
    is_inside = np.all((moved >= 0) & (moved <= [width - 1, height - 1]), axis=1)
    is_near = np.linalg.norm(back - points, axis=1) <= options.max_return_px
    return moved, (is_found[:, 0] == 1) & (is_back[:, 0] == 1) & is_inside & is_near


def _apart(points: Float[np.ndarray, "n 2"], distance_px: float) -> Bool[np.ndarray, " n"]:
    """Which points have no earlier one nearby: of two tracks that have run together the older stays."""
    is_near = np.linalg.norm(points[:, None] - points, axis=-1) < distance_px
    return ~np.any(np.tril(is_near, k=-1), axis=1)


def _corners(image: Image, points: Float[np.ndarray, "n 2"], options: FrontEnd) -> Float[np.ndarray, "m 2"]:
    """New corners: the best of each cell that has places left, apart from the points that there are."""
    cv2 = extras.load("cv2", "Images", "images")
    num_free = options.max_features - len(points)
    if num_free <= 0:
        return np.zeros((0, 2), np.float32)
    mask = np.full(image.shape, 255, np.uint8)
    for u, v in np.rint(points).astype(int):
        cv2.circle(mask, (int(u), int(v)), round(options.min_distance_px), 0, -1)
    found = cv2.goodFeaturesToTrack(image, 0, options.quality, options.min_distance_px, mask=mask)
    if found is None:
        return np.zeros((0, 2), np.float32)
    found = found[:, 0]  # the best first
    share = -(-options.max_features // (options.grid[0] * options.grid[1]))
    taken = np.bincount(_cell(points, image, options), minlength=options.grid[0] * options.grid[1])
    cell = _cell(found, image, options)
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], cell[order])
    rank = np.empty(len(cell), np.int64)
    rank[order] = np.arange(len(cell)) - first
    chosen = found[taken[cell] + rank < share][:num_free]
    if not len(chosen):
        return chosen
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
    refined = cv2.cornerSubPix(image, chosen[:, None].copy(), (3, 3), (-1, -1), criteria)[:, 0]
    # One that has slid away was no corner of the kind that the refinement looks for.
    is_same = np.linalg.norm(refined - chosen, axis=1, keepdims=True) <= 2.0
    return np.where(is_same, refined, chosen)


def _cell(points: Float[np.ndarray, "n 2"], image: Image, options: FrontEnd) -> Int[np.ndarray, " n"]:
    """Number of the cell of the grid that a point lies in."""
    columns, rows = options.grid
    height, width = image.shape
    column = np.clip(points[:, 0] * columns / width, 0, columns - 1).astype(np.int64)
    return column + columns * np.clip(points[:, 1] * rows / height, 0, rows - 1).astype(np.int64)


def _refuse_image(image: Image, frame: int, before: Image | None) -> None:
    """Refuse what is no grey image, or of another size than the one before."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 2 or image.size == 0:
        found = f"{image.dtype}{list(image.shape)}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"track_images(images): frame {frame} is {found}; give grey images, (height, width) of uint8.")
    if before is not None and image.shape != before.shape:
        raise ValueError(
            f"track_images(images): frame {frame} has {image.shape[1]} × {image.shape[0]} pixels, but those before "
            f"have {before.shape[1]} × {before.shape[0]}; give images of one size."
        )


def _require(owner: FrontEnd, name: str, condition: bool, remedy: str) -> None:
    if not condition:
        raise ValueError(f"FrontEnd({name}={getattr(owner, name)!r}): {remedy}")
