"""The benchmark: what it measures beside the clock, and how it compares."""

import json

import pytest
from fake_runs import fake_runs

from vcjax.study import benchmark


def test_the_floor_is_one_update_for_every_frame_with_its_own_size_and_rank(monkeypatch):
    """Counted by what BLAS is given: N × N and N × 2k of every frame that corrects with k landmarks."""
    given = []
    monkeypatch.setattr(
        benchmark,
        "get_blas_funcs",
        lambda names, arrays: [lambda alpha, rows, beta, block, overwrite_c: given.append((block.shape, rows.shape))],
    )
    runs = fake_runs(num_seeds=2)
    seconds = benchmark.floor_s(runs)
    corrected = runs.num_updates + runs.num_recovered
    expected = [
        ((n, n), (n, 2 * k))
        for n, k in zip(runs.num_coordinates.values.ravel(), corrected.values.ravel(), strict=True)
        if k > 0
    ]
    assert given == expected and len(given) > 10
    assert 0 < seconds < 10


def test_a_ratio_is_worse_only_beyond_its_tolerance(tmp_path):
    baseline = tmp_path / "baseline.json"
    baseline.write_text(
        json.dumps({"ratios": {"ratio_to_floor": 5.0, "gradient_forward_ratio": 7.0}, "tolerance": 1.5})
    )
    assert benchmark.compare({"ratio_to_floor": 7.4, "gradient_forward_ratio": None}, baseline) == []
    (worse,) = benchmark.compare({"ratio_to_floor": 7.6}, baseline)
    assert worse == "ratio_to_floor is 7.60, more than 1.5 times the accepted 5.00"


@pytest.mark.parametrize("content", ["no json", "{}", '{"ratios": {}, "tolerance": null}', "[]"])
def test_what_is_no_baseline_is_refused(tmp_path, content):
    baseline = tmp_path / "baseline.json"
    baseline.write_text(content)
    with pytest.raises(ValueError, match=r"baseline.json: no baseline of `vcjax bench`"):
        benchmark.compare({}, baseline)


def test_memory_is_that_of_this_process():
    used = benchmark.peak_memory_mib()
    assert used is None or 50 < used < 100_000


def test_the_numpy_peer_is_told_as_missing_outside_a_checkout(tmp_path):
    assert benchmark.measure_numpy(tmp_path) == {"numpy_cell_s": None}
