"""What the commands for recordings refuse: hostile files, bad options, and places where somebody's files lie."""

import json
import shutil
import zipfile

import numpy as np
import pytest
import recorded
from rendered import tracked
from told import assert_one_line, said

from vcjax.cli import main
from vcjax.sources.recording_file import save_recording
from vcjax.sources.table_file import write_table
from vcjax.sources.tracks import read_tracks, write_tracks

pytestmark = pytest.mark.usefixtures("unchecked")  # as people have it


def changed(path, out, name, array):
    """A recording file with one array replaced, as somebody else's program may write it."""
    with zipfile.ZipFile(path) as archive:
        arrays = {n.removesuffix(".npy"): np.load(archive.open(n)) for n in archive.namelist()}
    np.savez_compressed(out, **arrays | {name: array(arrays[name].copy())})
    return out


def nan_pixel(uv_px):
    uv_px[4, 2] = np.nan
    return uv_px


def negative_id(track_id):
    track_id[5, 1] = -3
    return track_id


HOSTILE = {
    "NaN": (("uv_px", nan_pixel), ["Recording(uv_px[4, 2, 0] = nan)", "clear is_valid there"]),
    "negative id": (("track_id", negative_id), ["Recording(track_id[5, 1] = -3)", "ids start at 0"]),
    "whole pixels": (("uv_px", lambda a: a.astype(int)), ["uv_px is int64; floating-point numbers are needed"]),
    "endless covariance": (("odometry_cov", lambda a: a + np.inf), ["odometry_cov[0, 0, 0]", "must be finite"]),
    "times that stand": (("time_s", lambda a: a * 0 + 1), ["time_s[1] = 1.0", "times must grow"]),
    "label of nobody's": (("label", lambda a: a + 7), ["label[0] = ", "give one of -1 UNKNOWN"]),
    "calibration of words": (("calibration", lambda _: np.asarray("{}")), ["calibration: lacks width"]),
}


@pytest.mark.parametrize("command", ["inspect", "run", "evaluate"])
@pytest.mark.parametrize(("change", "words"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_recording_is_refused_in_one_line(change, words, command, results, tmp_path, capsys):
    path = changed(recorded.recording_path(), tmp_path / "bad.npz", *change)
    out = tmp_path / "out"
    shutil.copytree(results, out)
    before = recorded.contents(tmp_path)
    arguments = {
        "inspect": [str(path)],
        "run": [str(path), "--out", str(out)],
        "evaluate": [str(out), "--truth", str(path), "--out", str(tmp_path / "report.txt")],
    }
    assert main([command, *arguments[command]]) == 1
    printed, told = said(capsys)
    assert printed == ""
    assert_one_line(told, "bad.npz", *words)
    assert recorded.contents(tmp_path) == before


@pytest.mark.parametrize("command", ["inspect", "run"])
def test_truncated_recording(command, tmp_path, capsys):
    whole = recorded.recording_path().read_bytes()
    (tmp_path / "bad.npz").write_bytes(whole[: len(whole) // 2])
    assert main([command, str(tmp_path / "bad.npz")]) == 1
    assert_one_line(said(capsys)[1], "bad.npz: not a sound .npz file")
    assert [p.name for p in tmp_path.iterdir()] == ["bad.npz"]


def test_images_of_changing_size(folder, tmp_path, capsys):
    import cv2

    copy = tmp_path / "sequence"
    shutil.copytree(folder, copy)
    cv2.imwrite(str(copy / "images" / "00017.png"), np.zeros((240, 321), np.uint8))
    out = tmp_path / "a.npz"
    out.write_bytes(b"what was there")
    assert main(["track", str(copy), "--out", str(out)]) == 1
    assert_one_line(said(capsys)[1].splitlines()[-1], "00017.png: 321 × 240 pixels", "320 × 240")
    (copy / "images" / "00017.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0" * 40)
    assert main(["track", str(copy), "--out", str(out)]) == 1
    assert_one_line(said(capsys)[1].splitlines()[-1], "00017.png: no image that can be read")
    assert out.read_bytes() == b"what was there"


@pytest.mark.parametrize(("ending", "place"), [("csv", "line 765434"), ("parquet", "row 765433")])
def test_million_rows_with_one_bad_cell(tmp_path, ending, place):
    """Said by its place, in the time that reading takes."""
    num = 1_000_000
    columns = {"frame": np.arange(num) // 50, "track_id": np.arange(num) % 50, "u": np.zeros(num), "v": np.zeros(num)}
    columns["u"][765432] = np.nan
    path = write_table(tmp_path / f"tracks.{ending}", columns)
    with pytest.raises(ValueError, match=rf"tracks\.{ending}, {place}, column u: nan is not finite"):
        read_tracks(path)
    columns["u"][765432], columns["track_id"][765432] = 0.0, -1
    with pytest.raises(ValueError, match=rf"{place}, column track_id: -1 is below 0"):
        read_tracks(write_table(path, columns))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("run", ["PATH"]),
        ("run nowhere.npz", ["nowhere.npz: no such file"]),
        ("run {recording} --gate XX", ["'XX'", "'RE', 'VC'"]),
        ("run {recording} --gate RE --th2 3", ["--th2"]),
        ("run {recording} --motion walk", ["'walk'", "'odometry', 'biased_odometry', 'constant_velocity'"]),
        ("run {recording} --acceleration 1", ["--acceleration"]),
        ("run {recording} --motion constant_velocity --acceleration -1", ["ConstantVelocity(acceleration=-1.0)"]),
        ("run {recording} --known nowhere.csv", ["nowhere.csv: no such file"]),
        ("run {recording} --known-std-m 0", ["--known-std-m 0.0: give a positive number"]),
        ("run {recording} --known-distance 0 1 2", ["the scale of this run is known from odometry"]),
        ("track folder --start-std-m -1", ["--start-std-m -1.0: a standard deviation is at least 0"]),
        ("run {recording} --max-landmarks 1000000000000", ["FilterConfig(max_landmarks=1000000000000): give at most"]),
        ("run {recording} --th1 -1", ["VirtualCorrection(th1=-1.0)"]),
        ("run {recording} --out file", ["file is a file"]),
        ("run {recording} --pictures -1", ["--pictures -1: give a whole number of at least 0"]),
        ("run {recording} --animation-frames 0", ["--animation-frames 0: give at least 1, or --animation none"]),
        ("run {recording} --animation avi", ["'avi'"]),
        ("run {recording} --birth-order random", ["birth_order='random'"]),
        ("run file", ["file: not a sound .npz file"]),
        ("inspect nowhere.npz", ["nowhere.npz: no such file"]),
        ("inspect .", [".: no such file"]),
        ("inspect {recording} --picture folder", ["folder is a directory"]),
        ("track nowhere", ["nowhere: no such folder"]),
        ("track folder", ["folder: no image in it"]),
        ("track folder --first -1", ["--first -1"]),
        ("track folder --step 0", ["--step 0"]),
        ("track folder --first 3 --last 3", ["--last 3: give a number above --first 3"]),
        ("track folder --window-px 4", ["FrontEnd(window_px=4)", "odd"]),
        ("track folder --layout tumb", ["'tumb'"]),
        ("evaluate folder", ["no complete run here", "run `vcjax run` first"]),
        ("evaluate file", ["file: names no recording; give --truth"]),
        ("evaluate file --truth {recording}", ["3 words in its first line"]),
        ("evaluate nowhere --truth {recording}", ["nowhere: no such file"]),
        ("simulate --recording folder", ["folder is a directory; give the name of a file"]),
    ],
)
def test_what_is_refused_is_said_clearly(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "folder").mkdir()
    try:
        status = main(arguments.format(recording=recorded.recording_path()).split())
    except SystemExit as stop:
        status = int(stop.code)
    printed, told = said(capsys)
    assert status in (1, 2) and printed == "" and "Traceback" not in told
    if status == 1:
        assert_one_line(told, *words)
    else:
        assert all(word in told for word in words), told
    assert {path.name for path in tmp_path.iterdir()} == {"file", "folder"}


def test_no_command_replaces_what_is_not_its_own(results, folder, tmp_path, capsys):
    """Neither what it reads, nor, of a run, files of its names that no run has written."""
    mine, sequence, run = tmp_path / "mine", tmp_path / "sequence", tmp_path / "run"
    shutil.copytree(folder, sequence)
    shutil.copytree(results, run)
    (mine / "unfinished").mkdir(parents=True)
    (mine / "unfinished" / "notes.txt").write_text("mine")
    tracks = write_tracks(mine / "tracks.csv", tracked())
    recording, calibration = mine / "a.npz", sequence / "calibration.json"
    shutil.copy(recorded.recording_path(), recording)
    before, is_read = recorded.contents(tmp_path), "is one of the files that are read"
    commands = {
        f"run {recording} --out {mine}": "tracks.csv is in the way of the run's",
        f"run {recording} --known {run / 'landmarks.csv'} --out {run}": f"landmarks.csv {is_read}",
        f"inspect {recording} --picture {recording}": f"a.npz {is_read}",
        f"record {tracks} --calibration {calibration} --rate-hz 10 --out {tracks}": f"tracks.csv {is_read}",
        f"record {tracks} --calibration {calibration} --rate-hz 10 --out {calibration}": f"calibration.json {is_read}",
        f"track {sequence} --out {sequence / 'images' / '00003.png'}": f"00003.png {is_read}",
        f"evaluate {run} --out {run / 'robot_tum.txt'}": f"robot_tum.txt {is_read}",
        f"evaluate {run / 'robot_tum.txt'} --truth {recording} --out {recording}": f"a.npz {is_read}",
    }
    for command, words in commands.items():
        assert main(command.split()) == 1, command
        printed, told = said(capsys)
        assert printed == ""
        assert_one_line(told, words)
        assert recorded.contents(tmp_path) == before, command
    tracks.unlink()
    options = ["--pictures", "0", "--animation", "none", "--out", str(mine)]
    for _ in range(2):  # and again
        assert main(["run", str(recording), *recorded.OPTIONS, *options]) == 0
    assert (mine / "unfinished" / "notes.txt").read_text() == "mine" and (mine / "tracks.csv").exists()


def test_evaluate_without_anything_to_compare_with(results, tmp_path, capsys):
    bare = save_recording(tmp_path / "bare.npz", recorded.content().recording)
    assert main(["evaluate", str(results), "--truth", str(bare)]) == 1
    assert_one_line(said(capsys)[1], "bare.npz: holds neither true poses nor labels")
    copy = tmp_path / "run"
    shutil.copytree(results, copy)
    summary = json.loads((copy / "summary.json").read_text())
    (copy / "summary.json").write_text(json.dumps(summary | {"recording": str(tmp_path / "gone.npz")}))
    assert main(["evaluate", str(copy)]) == 1
    assert_one_line(said(capsys)[1], "gone.npz, which was run: no such file; give --truth")
