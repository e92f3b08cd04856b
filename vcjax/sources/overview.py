"""What is in a recording: a summary in words, and a picture."""

from typing import Any

import numpy as np

from vcjax.recording import Recording, moves_in_frame
from vcjax.sources.odometry import dead_reckoning
from vcjax.sources.recording_file import RecordingFile, TrackLabel
from vcjax.sources.repeats import repeated_frames
from vcjax.sources.tracks import tracks_of
from vcjax.sources.warnings import warnings


def summary(content: Recording | RecordingFile) -> str:
    """A recording in words: frames, tracks and their lengths, calibration, odometry, truth; and what to be warned of.

    Args:
        content: a recording, alone or with what is known beside it.
    """
    recording, truth, labels, image_paths, calibration = _content(content)
    time_s = np.asarray(recording.time_s)
    tracks, visible = tracks_of(recording), np.sum(np.asarray(recording.is_valid), axis=1)
    length = np.unique(tracks.track_id, return_counts=True)[1]
    u0, v0, au, av = np.asarray(recording.camera.intrinsics_px)
    width, height = np.asarray(recording.camera.image_size_px)
    lens = np.ravel(recording.camera.distortion)
    rows = [("frames", f"{len(time_s)}" + (f" in {_num(np.ptp(time_s))} s" if len(time_s) > 1 else ""))]
    if len(time_s) > 1:
        step = np.diff(time_s)
        longest = int(np.argmax(step))
        rows.append(
            ("rate", f"{_num(1 / np.median(step))} Hz; longest gap {_num(step[longest])} s, before frame {longest + 1}")
        )
    rows.append(("tracks", f"{len(length)}, {len(tracks.frame)} sightings"))
    if len(length):
        quartiles = " / ".join(_num(q) for q in np.quantile(length, [0, 0.25, 0.5, 0.75, 1]))
        rows.append(("track length", f"{quartiles} frames (least, quartiles, most)"))
    quartiles = " / ".join(_num(q) for q in np.quantile(visible, [0, 0.25, 0.5, 0.75, 1]))
    empty = f"; {np.sum(visible == 0)} frames without any" if np.any(visible == 0) else ""
    rows.append(("seen per frame", f"{quartiles} (least, quartiles, most){empty}"))
    rows.append(("camera", f"{_num(width)} × {_num(height)} px, focal lengths {_num(au)}, {_num(av)} px, "
                 f"centre {_num(u0)}, {_num(v0)} px"))  # fmt: skip
    if len(lens):
        rows.append(("distortion", f"radial {', '.join(map(_num, lens))}"))
    if calibration is not None:
        model = calibration.distortion_model.replace("_", "-")
        rows.append(("images", f"{calibration.width} × {calibration.height} px, distortion {model}"))
    rows += [("odometry", _odometry(recording)), ("camera motion", _shift(recording))]
    if truth is None:
        rows.append(("truth", "none"))
    else:
        known = int(np.sum(np.all(np.isfinite(np.asarray(truth.robot)), axis=1)))
        num, moving = np.shape(truth.is_moving)[0], int(np.sum(truth.is_moving))
        when = f" (in {int(np.any(moves_in_frame(truth), axis=1).sum())} frames)" if moving else ""
        rows.append(("truth", f"poses of {known} frames" + (f", {num} features, {moving} move{when}" if num else "")))
    if labels is not None:
        counts = [f"{np.sum(labels.label == label)} {label.name.lower()}" for label in TrackLabel]
        rows.append(("labels", ", ".join(counts)))
    if image_paths is not None:
        rows.append(("image files", f"{_shown(image_paths[0])} … {_shown(image_paths[-1])}"))
    rows += [("warning", text) for text in warnings(recording)]
    return "\n".join(f"{name:15s} {text}" for name, text in rows)


def draw_overview(content: Recording | RecordingFile) -> Any:
    """A recording in a picture: features per frame, lengths of tracks, where in the image they are, and the path.

    Places in the image are those of the image as it was taken, where its calibration is known. The path, from above, is
    that of the odometry alone, if there is any, beside the true one where it is known.

    Returns:
        A figure of matplotlib, to be shown or saved.

    Raises:
        ModuleNotFoundError: if matplotlib is not installed, with the remedy.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("Pictures need matplotlib: pip install 'vcjax[study]'.") from error

    recording, truth, labels, _, calibration = _content(content)
    tracks = tracks_of(recording, calibration)
    ids, first, length = np.unique(tracks.track_id, return_index=True, return_counts=True)
    time_s = np.asarray(recording.time_s) - float(recording.time_s[0])
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    (seen, lengths), (image, path) = figure.subplots(2, 2)

    seen.plot(time_s, np.sum(np.asarray(recording.is_valid), axis=1), color=_BLUE)
    if len(repeated := repeated_frames(tracks_of(recording))):
        seen.plot(time_s[repeated], np.zeros(len(repeated)), "|", color=_RED, markersize=12)
    marked = f"; {len(repeated)} repeat (marked)" if len(repeated) else ""
    seen.set(xlabel="time (s)", ylabel="features seen", title=f"Features in each frame{marked}")
    seen.set_ylim(0, 1.1 * max(1, int(np.sum(np.asarray(recording.is_valid), axis=1).max())))
    if len(length):
        begin = np.unique(np.rint(np.geomspace(1, length.max() + 1, 30)))  # the first whole number in each bar
        lengths.hist(length, np.sqrt(begin * (begin - 1 + (begin == 1) / 2)), color=_BLUE)
        lengths.set_xscale("log")
    lengths.set(xlabel="length (frames)", ylabel="tracks", title=f"{len(ids)} tracks")

    size = np.asarray(recording.camera.image_size_px)
    width, height = size if calibration is None else (calibration.width, calibration.height)
    moving = np.zeros(0, int) if labels is None else labels.track_id[labels.label == TrackLabel.MOVING]
    is_moving = np.isin(ids, moving)
    for chosen, colour, name in ((~is_moving, _GREY, "tracks"), (is_moving, _RED, "labelled moving")):
        if np.any(chosen):
            image.scatter(*tracks.uv_px[first[chosen]].T, s=4, color=colour, label=name)
    image.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    image.set_title("Where tracks begin")
    if np.any(is_moving):
        # Below: wherever it is put inside, it hides tracks.
        image.legend(loc="upper left", bbox_to_anchor=(0.0, 0.0), borderaxespad=4.5, ncols=2, fontsize=8, frameon=False)

    has_odometry = bool(np.any(np.asarray(recording.odometry)))
    if has_odometry:
        path.plot(*dead_reckoning(recording)[:, :2].T, color=_GREY, label="odometry alone")
    if truth is not None:
        path.plot(*np.asarray(truth.robot)[:, :2].T, color=_BLUE, linestyle="--", label="truth")
    path.set(xlabel="x (m)", ylabel="y (m)", title="Path from above")
    path.axis("equal")
    if has_odometry or truth is not None:
        path.legend(loc="best", fontsize=8)
    else:
        path.set_axis_off()
        path.text(0.5, 0.5, "neither odometry nor truth", transform=path.transAxes, ha="center", color=_GREY)
    return figure


_BLUE, _RED, _GREY = "#0072b2", "#d55e00", "#7f7f7f"


def _content(content: Recording | RecordingFile) -> RecordingFile:
    return RecordingFile(content) if isinstance(content, Recording) else content


def _num(value: float) -> str:
    """A number with as many digits as a person wants."""
    return f"{float(value):.4g}"


def _shown(path: str) -> str:
    """A name from the file, with what a terminal would obey or cannot print written out."""
    return path if path.isprintable() else repr(path)


def _odometry(recording: Recording) -> str:
    """How far and how sure the odometry is."""
    increment = np.asarray(recording.odometry)
    std = np.sqrt(np.median(np.asarray(recording.odometry_cov)[:, range(6), range(6)], axis=0))
    sure = f"standard deviations {_num(std[:3].max())} m, {_num(np.rad2deg(std[3:].max()))}° per frame"
    if not np.any(increment):
        return f"none ({sure})"
    way, turn = np.linalg.norm(increment[:, :3], axis=1), np.linalg.norm(increment[:, 3:], axis=1)
    return f"{_num(way.sum())} m, {_num(np.rad2deg(turn.sum()))}° in all; {sure}"


def _shift(recording: Recording) -> str:
    """How the camera is moved on the robot."""
    place = np.cumsum(np.asarray(recording.sensor_shift_m), axis=0)
    span = np.ptp(np.vstack([np.zeros(3), place]), axis=0)
    return f"commanded, over {', '.join(map(_num, span))} m" if np.any(span) else "fixed on the robot"
