"""The paper's cells, numbers and claims."""

import ast
import inspect
import re

import pytest

from vcjax.study import paper
from vcjax.study.paper import Cell, cells, claims, pairs, paper_figures

# Tables 2 to 5 as printed, row by row.
PRINTED = """
Forward Motion Euclidean Error 5.7318 cm 0 5.6966 cm 17 4.2568 cm 16
Orientation Error 0.1272 deg 0.1208 deg 0.1169 deg
Curved Motion Euclidean Error 4.8793 cm 0 4.8409 cm 16 2.7066 cm 17
Orientation Error 0.1203 deg 0.1159 deg 0.1130 deg
Lateral Motion Euclidean Error 4.3247 cm 0 3.9828 cm 16 3.7290 cm 16
Orientation Error 0.2435 deg 0.2287 deg 0.2144 deg
Lateral Motion Euclidean Error 5.7167 cm 27 5.9133 cm 28 4.5283 cm 29
Orientation Error 0.1393 deg 0.1429 deg 0.1284 deg
Inverse Forward Euclidean Error 5.8394 cm 0 5.7285 cm 0 9.3783 cm 24
Orientation Error 0.1222 deg 0.1236 deg 0.1353 deg
Lateral Motion Euclidean Error 6.1239 cm 3 5.7186 cm 2 4.6172 cm 43
Orientation Error 0.1562 deg 0.1413 deg 0.3739 deg
Inverse Forward Euclidean Error 6.1498 cm 0 5.4650 cm 0 12.5170 cm 18
Orientation Error 0.1170 deg 0.1120 deg 0.1251 deg
Lateral Motion Euclidean Error 5.9099 cm 6 5.8257 cm 11 5.0702 cm 48
Orientation Error 0.1729 deg 0.1582 deg 0.5228 deg
Inverse Forward Euclidean Error 5.6649 cm 0 5.6610 cm 0 15.1492 cm 9
Orientation Error 0.1308 deg 0.1190 deg 0.1195 deg
"""
ALL_CLAIMS = [claim for table in paper.TABLES for claim in claims(table)]


def test_cells_are_the_papers_and_the_one_it_left_out():
    assert len(cells()) == len(set(cells())) == 9 * 4
    assert sum(paper_figures(cell) is None for cell in cells()) == 9
    assert all(paper_figures(c) is None for c in cells() if c.gate == "RE" and c.oscillating)
    assert {c.robot_motion for c in cells([2])} == {"forward", "curved", "lateral"}
    assert {(c.robot_motion, c.dynamic_speed_m_s) for c in cells([4])} == {("forward", 0.5)}
    assert {c.dynamic_motion for c in cells([5])} == {"lateral", "inverse_forward"}
    assert cells([3, 2]) == cells((2, 3))


def test_unknown_table_is_refused():
    with pytest.raises(ValueError, match=r"no table 6; choose among \(2, 3, 4, 5\)"):
        cells([2, 6])


def test_identifiers_are_distinct_file_names():
    names = [cell.identifier for cell in cells()]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[\w.]+", name) for name in names)
    assert Cell(4, "forward", "lateral", 0.5, "VC", True).identifier == "table4_forward_lateral_0.50mps_VC_oscillating"
    assert Cell(2, "curved", None, None, "RE", False).identifier == "table2_curved_static_RE_steady"


def test_numbers_are_those_printed():
    rows = iter(PRINTED.strip().splitlines())
    methods = [("RE", False), ("VC", False), ("VC", True)]
    experiments = dict.fromkeys(cell.experiment for cell in cells())
    for experiment in experiments:
        position_cm_and_count, orientation_deg = (
            [float(number) for number in re.findall(r"(?<!\w)[\d.]+", next(rows))] for _ in range(2)
        )
        counted = "recovered_per_run" if experiment[0] == 2 else "dynamic_events_per_run"
        for i, method in enumerate(methods):
            assert paper_figures(Cell(*experiment, *method)) == {
                "position_rmse_cm": position_cm_and_count[2 * i],
                "orientation_error_deg": orientation_deg[i],
                counted: position_cm_and_count[2 * i + 1],
            }
    assert next(rows, None) is None


def test_pairs_stay_within_an_experiment():
    found = list(pairs(cells()))
    assert len(found) == 9 * 5
    assert all(a.experiment == b.experiment and a != b for _, a, b in found)
    name, a, b = found[-1]
    assert name == "VC oscillating - RE steady"
    assert (a.gate, a.oscillating, b.gate, b.oscillating) == ("VC", True, "RE", False)


def test_pairs_need_both_cells():
    steady = [cell for cell in cells([3]) if not cell.oscillating]
    assert [name for name, _, _ in pairs(steady)] == ["VC - RE (steady)"] * 2
    assert list(pairs(steady[:1])) == []


@pytest.mark.parametrize("claim", ALL_CLAIMS, ids=lambda claim: f"table{claim.minuend.table}-{claim.text}")
def test_the_papers_own_numbers_bear_out_its_claims(claim):
    assert claim.minuend in cells() and (claim.subtrahend is None or claim.subtrahend in cells())
    numbers = paper_figures(claim.minuend) or {}
    if claim.figure not in numbers:
        assert claim.figure == "dynamic_found_per_run"  # the paper counts events, not distinct features
        return
    value = numbers[claim.figure]
    if claim.subtrahend is not None:
        value -= (paper_figures(claim.subtrahend) or {})[claim.figure]
    assert claim.low < value < claim.high


def test_every_experiment_has_claims():
    assert {claim.minuend.experiment for claim in ALL_CLAIMS} == {cell.experiment for cell in cells()}


def test_needs_no_optional_package():
    imports = [node for node in ast.walk(ast.parse(inspect.getsource(paper))) if isinstance(node, ast.Import)]
    names = {alias.name for node in imports for alias in node.names}
    assert names == {"dataclasses", "math"}
