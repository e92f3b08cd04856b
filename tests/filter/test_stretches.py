"""Long recordings in stretches: the same numbers as a run in one piece, taken up again anywhere, with the whole map."""

import jax
import numpy as np
import pytest
from filter_runs import head, recorded
from tiny_runs import compilations

from vcjax.filter import stretches as module
from vcjax.filter.config import FilterConfig
from vcjax.filter.landmark_points import landmark_points
from vcjax.filter.run import run
from vcjax.filter.stretches import run_in_stretches

# As they are, also where other tests have them compiled quickly, which changes last bits.
PLAIN = {name: jax.jit(getattr(module, name).__wrapped__) for name in ("_first", "_advance")}
CONFIG = FilterConfig(max_landmarks=23, births_per_frame=2)


@pytest.fixture(autouse=True)
def plainly_compiled(monkeypatch):
    for name, function in PLAIN.items():
        monkeypatch.setattr(module, name, function)


def short() -> tuple:
    recording = head(recorded(0, robot="curved"), 40)
    return recording, jax.device_get(run(CONFIG, recording))


def equal(one, other) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_stretches_are_a_run_to_the_bit():
    recording, (state, info) = short()
    stretches = list(run_in_stretches(CONFIG, recording, length=16))
    assert [s.first_frame for s in stretches] == [0, 16, 32] and stretches[-1].next_frame == 40
    assert np.any(info.departed.track_id >= 0)  # else a part of the infos is not compared
    equal(stretches[-1].state, state)
    equal(jax.tree.map(lambda *leaves: np.concatenate(leaves), *(s.info for s in stretches)), info)

    # Taken up again after the second, as if from disk.
    (last,) = run_in_stretches(CONFIG, recording, length=16, state=stretches[1].state, next_frame=32)
    equal(last, stretches[2])


def test_other_lengths_and_numbers_do_not_compile_anew():
    recording, _ = short()
    list(run_in_stretches(CONFIG, recording, length=16))
    with compilations() as counted:
        other = FilterConfig(max_landmarks=23, births_per_frame=2, pixel_std_px=0.7)
        assert sum(len(s.info.is_finite) for s in run_in_stretches(other, head(recording, 21), length=16)) == 21
    assert counted.num == 0


def test_the_departed_and_those_left_are_all_that_were_born():
    _, (state, info) = short()
    gone, left = info.departed, landmark_points(state)
    ids = np.concatenate([gone.track_id[gone.track_id >= 0], np.asarray(left.track_id)[np.asarray(left.track_id) >= 0]])
    born = info.born_id[info.born_id >= 0]
    assert sorted(ids) == sorted(born)  # one born twice left twice, or is there again
    # A landmark that left is where its slot had it in the frame before, moved by no more than that frame's corrections.
    cov = gone.cov[gone.track_id >= 0]
    assert np.all(np.isfinite(cov)) and np.all(np.linalg.eigvalsh(cov)[:, 0] > -1e-9 * np.abs(cov).max((1, 2)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"length": 0}, "length=0"),
        ({"next_frame": 3}, "next_frame=3"),
        ({"state": 1.0, "next_frame": 3}, "state=1.0"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_makes_no_sense_is_refused_at_once(arguments, message):
    with pytest.raises(ValueError, match=message):
        run_in_stretches(CONFIG, recorded(0, robot="curved"), **arguments)
