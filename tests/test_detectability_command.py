"""`vcjax detectability`, in this process and tiny: what it writes, says and refuses."""

import json

import numpy as np
import pytest
from told import assert_one_line, said

from vcjax.cli import main
from vcjax.commands import detectability as module
from vcjax.report.detectability import around_figure, markdown

pytestmark = pytest.mark.usefixtures("unchecked")  # as people have it
TINY = ["--num-frames", "30", "--spacing-m", "4", "--speeds-m-s", "1", "--within-frames", "20"]
TINY += ["--amplitudes-m", "0", "0.1"]


def test_maps_tables_and_the_best_oscillation(tmp_path, capsys):
    assert main(["detectability", *TINY, "--false-alarm-rate", "0.01", "--out", str(tmp_path)]) == 0
    printed, told = said(capsys)
    content = json.loads((tmp_path / "detectability.json").read_text())
    assert (content["false_alarm_rate"], content["within_frames"], content["power"]) == (0.01, 20.0, 0.9)
    assert printed.strip() == (tmp_path / "detectability.md").read_text().strip()
    assert "smallest speed found" in printed.lower() and "inverse forward, 1 m/s" in printed
    assert np.shape(content["map"]["power"]) == (2, 5, 5, 2, 1)
    assert np.shape(content["map"]["smallest_speed_m_s"]) == (2, 5, 5, 2)
    towards = [scene for scene in content["scenes"] if scene["scene"] == "inverse forward, 1 m/s"]
    steady, swinging = sorted(towards, key=lambda scene: scene["amplitude_m"])
    np.testing.assert_allclose(steady["power"], [0.01] * 6, atol=1e-3)
    assert steady["frames_needed"] == [None] * 6 and np.all(np.array(swinging["power"]) > 0.3)
    rows = [row for row in content["smallest_speed"] if row["heading_deg"] == 180.0]
    assert [row["places_found"] > 0 for row in rows] == [False, True]
    assert 0 < content["best_oscillation"]["amplitude_m"] <= 0.15
    for name in ("smallest_speed", "power_1_m_s", "all_directions"):
        assert f"wrote {tmp_path / 'figures' / name}.png" in told and (tmp_path / "figures" / f"{name}.svg").is_file()


def test_ends_of_the_search_and_heights_of_places_are_told(tmp_path, capsys, monkeypatch):
    seen = []
    monkeypatch.setattr(module, "write_detectability", lambda found, _: seen.append(found) or [])
    (tmp_path / "detectability.md").write_text("")
    assert main(["detectability", *TINY, "--out", str(tmp_path)]) == 0
    (found,) = seen
    inside, at_the_end = (found._replace(best=found.best._replace(at_the_end=ends)) for ends in ((), ("A", "f")))
    assert "A and f lie at an end of what was searched, 0 to 0.15 m and 0.5 to 4.5 Hz" in markdown(at_the_end)
    assert "at an end" not in markdown(inside)
    titles = [axes.get_title() for axes in around_figure(found).axes]
    assert titles == ["from (4, -2, 0) m", "from (4, 0, 0) m", "from (4, 2, 0) m"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--false-alarm-rate", "0"], ["VelocityTest(false_alarm_rate=0.0)", "between 0 and 1"]),
        (["--false-alarm-rate", "1"], ["VelocityTest(false_alarm_rate=1.0)"]),
        (["--false-alarm-rate", "nan"], ["VelocityTest(false_alarm_rate=nan)"]),
        (["--within-frames", "0"], ["within_frames=0.0", "at least one frame"]),
        (["--power", "1"], ["power=1.0", "below 1"]),
        (["--power", "0.0005"], ["power=0.0005", "above the false-alarm rate 0.001"]),
        (["--spacing-m", "0"], ["--spacing-m 0", "from 0.05 to 8 m"]),
        (["--frequency-hz", "5"], ["frequency_hz=5.0", "below half the frame rate"]),
        (["--amplitudes-m", "-0.1"], ["amplitude_m=-0.1"]),
        (["--amplitudes-m"], ["--amplitudes-m", "at least one"]),
        (["--speeds-m-s"], ["speeds_m_s=()", "at least one"]),
        (["--headings-deg"], ["headings_deg=()", "at least one number, finite."]),
        (["--headings-deg", "nan"], ["headings_deg=(nan,)", "at least one number, finite."]),
        (["--price", "-1"], ["price=-1", "at least 0"]),
        (["--num-frames", "0"], ["num_frames=0"]),
        (["--pose-noise", "-1"], ["pose_noise=-1.0"]),
    ],
)
def test_bad_input_gets_one_line_before_any_work(arguments, words, tmp_path, capsys, monkeypatch):
    for name in ("predict_movers", "write_detectability"):
        monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("worked"))
    assert main(["detectability", *TINY, *arguments, "--out", str(tmp_path)]) == 1
    assert_one_line(said(capsys)[1], *words)
    assert not any(path.is_file() for path in tmp_path.rglob("*"))
