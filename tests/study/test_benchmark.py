"""The benchmark: what it measures beside the clock, and how it compares."""

import json
from pathlib import Path

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


def test_a_ratio_is_worse_only_beyond_the_tolerance(tmp_path):
    baseline = tmp_path / "baseline.json"
    baseline.write_text(json.dumps({"ratio_to_floor": 5.0, "gradient_forward_ratio": 7.0, "cell_warm_s": 0.1}))
    accepted = benchmark.read_ratios(baseline)
    assert (
        benchmark.compare({"ratio_to_floor": 7.4, "cell_warm_s": 9.0, "gradient_reverse_ratio": 99.0}, accepted) == []
    )
    (worse,) = benchmark.compare({"ratio_to_floor": 7.6}, accepted)
    assert worse == "ratio_to_floor is 7.60, more than 1.5 times the accepted 5.00"
    assert len(benchmark.compare({"ratio_to_floor": float("nan")}, accepted)) == 1
    with pytest.raises(ValueError, match="nothing to compare"):
        benchmark.compare({"cell_warm_s": 1.0}, accepted)


NO_NUMBERS = ["{}", "[]", "no json", '{"cell_warm_s": 1.0}']
NO_RATIOS = [f'{{"ratio_to_floor": {value}}}' for value in ('"fast"', '"4.5"', "true", "NaN", "0", "-1")]


@pytest.mark.parametrize("content", NO_NUMBERS + NO_RATIOS)
def test_what_is_no_baseline_is_refused(tmp_path, content):
    baseline = tmp_path / "baseline.json"
    baseline.write_text(content)
    with pytest.raises(ValueError, match=r"baseline.json: no"):
        benchmark.read_ratios(baseline)


def test_the_accepted_numbers_are_those_of_a_whole_session():
    """What docs hold can be compared with, and says what it ran on."""
    accepted = Path(__file__).parents[2] / "docs" / "benchmark.json"
    numbers = json.loads(accepted.read_text())
    assert set(benchmark.read_ratios(accepted)) == set(benchmark.RATIOS)
    assert benchmark.compare(numbers, benchmark.read_ratios(accepted)) == []
    assert {"cell_compile_s", "cell_warm_s", "floor_s", "numpy_cell_s", "reproduce_s"} <= set(numbers)
    assert set(benchmark.where()) | {"peak_memory_mib", "seeds_peak_memory_mib"} <= set(numbers)
    assert set(numbers["seconds_by_seeds"]) == {"1", "25", "100", "1000"}


def test_memory_is_that_of_this_process():
    used = benchmark.peak_memory_mib()
    assert used is None or 50 < used < 100_000


def test_the_numpy_peer_is_told_as_missing_outside_a_checkout(tmp_path):
    assert benchmark.measure_numpy(tmp_path) == {"numpy_cell_s": None}
