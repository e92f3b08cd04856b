"""Overviews: what they say is counted from the recording."""

import dataclasses

import numpy as np
import recorded
from rendered import rendered, tracked
from test_recording import good_recording
from test_recording_file import full

from vcjax.sources.odometry import Odometry
from vcjax.sources.overview import draw_overview, summary
from vcjax.sources.recording_file import RecordingFile
from vcjax.sources.tracks import recording_from_tracks


def said(content) -> dict[str, str]:
    return {line[:15].strip(): line[16:] for line in summary(content).splitlines()}


def test_summary_by_hand():
    """Five frames at 10 Hz, four features of which one is missing in each of the first four."""
    recording = dataclasses.replace(good_recording(), time_s=np.array([0.1, 0.2, 0.3, 0.6, 0.7]))
    found = said(recording)
    assert found["frames"] == "5 in 0.6 s"
    assert found["rate"] == "10 Hz; longest gap 0.3 s, before frame 3"
    assert found["tracks"] == "4, 16 sightings"
    assert found["track length"].startswith("4 / 4 / 4 / 4 / 4 frames")
    assert found["seen per frame"].startswith("3 / 3 / 3 / 3 / 4 ")
    assert found["camera"] == "640 × 480 px, focal lengths 320, 320 px, centre 320, 240 px"
    assert found["odometry"].endswith("standard deviations 0.001 m, 0.0573° per frame")
    assert found["camera motion"] == "fixed on the robot" and found["truth"] == "none" and "labels" not in found


def test_summary_of_all_that_is_known():
    found = said(full())
    assert found["truth"] == "poses of 3 frames"
    assert found["labels"] == "1 unknown, 0 static, 1 moving, 1 bad"
    assert found["images"] == "640 × 480 px, distortion none" and found["image files"].startswith("images/0 ä.png …")


def test_names_of_images_obey_nobody():
    """Neither what clears a terminal nor half a letter, which none can print."""
    found = said(full()._replace(image_paths=("\x1b[2J.png", *("a.png",) * 3, "\udc80.png")))
    assert found["image files"] == r"'\x1b[2J.png' … '\udc80.png'"


def test_recordings_without_anything():
    recording = good_recording()
    empty = dataclasses.replace(
        recording, is_valid=np.zeros((5, 4), bool), is_last=np.zeros((5, 4), bool), odometry=np.zeros((5, 6))
    )
    found = said(empty)
    assert found["tracks"] == "0, 0 sightings" and "5 frames without any" in found["seen per frame"]
    assert found["odometry"].startswith("none (standard deviations")
    path = draw_overview(empty).axes[3]
    assert not path.lines and path.get_legend() is None and path.texts[0].get_text() == "neither odometry nor truth"
    assert not path.axison


def test_picture_has_the_pixels_of_the_images():
    """Tracks begin where they do in the image, and not where the straightened image has them."""
    tracks = tracked()
    lens = dataclasses.replace(rendered().sequence.calibration, distortion_model="wide_angle", distortion=(4e-6,))
    odometry = Odometry(*(np.asarray(x) for x in (rendered().simulated.odometry, rendered().simulated.odometry_cov)))
    recording = recording_from_tracks(tracks, lens, time_s=rendered().sequence.time_s, odometry=odometry)
    image = draw_overview(RecordingFile(recording, calibration=lens)).axes[2]
    first = np.unique(tracks.track_id, return_index=True)[1]
    drawn = np.asarray(image.collections[0].get_offsets())
    np.testing.assert_allclose(np.sort(drawn, axis=0), np.sort(tracks.uv_px[first], axis=0), atol=0.01)
    assert image.get_xlim() == (0, 320) and image.get_ylim() == (240, 0)


def test_bars_of_track_lengths_reach_halfway_to_their_neighbours():
    """On an axis of powers, where the bar at 1 reaches from 1/√2 to √2."""
    lengths = draw_overview(recorded.content()).axes[1]
    edges = np.array([(bar.get_x(), bar.get_x() + bar.get_width()) for bar in lengths.patches])
    assert np.all(edges[:, 1] / edges[:, 0] < 2.001) and sum(bar.get_height() for bar in lengths.patches) == len(
        np.unique(tracked().track_id)
    )


def test_picture_shows_what_there_is(tmp_path):
    world, tracks = rendered(), tracked()
    sequence = world.sequence
    recording = recording_from_tracks(tracks, sequence.calibration, time_s=sequence.time_s, odometry=sequence.odometry)
    content = RecordingFile(recording, world.truth, world.followed(tracks).labels)
    assert "over 0, 0.09511, 0 m" in said(content)["camera motion"]
    figure = draw_overview(content)
    seen, lengths, image, path = figure.axes
    assert len(seen.lines[0].get_ydata()) == 30 and sum(bar.get_height() for bar in lengths.patches) > 100
    assert [text.get_text() for text in image.get_legend().get_texts()] == ["tracks", "labelled moving"]
    assert [line.get_label() for line in path.lines] == ["odometry alone", "truth"]
    figure.savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000
