"""`vcjax detectability`, in this process and tiny: what it writes, says and refuses."""

import json

import numpy as np
import pytest
from told import assert_one_line, said

from vcjax.cli import main
from vcjax.commands import detectability as module

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
        (["--headings-deg"], ["headings_deg=()", "at least one"]),
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
