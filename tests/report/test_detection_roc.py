"""Operating curves as tables and figures: every method at every amplitude, whatever is unknown."""

import numpy as np

from vcjax.report.detection_roc import curves_markdown, curves_table, precision_figure, roc_figure
from vcjax.study.detection_scores import Counts

SEEDS = 8


def made(found: int, flagged: int) -> Counts:
    """The same counts in each seed, of six movers and fifty static features."""
    return Counts(*(np.full(SEEDS, each) for each in (found, 6, flagged, 50)))


CURVES = {
    ("RE", 0.0): {4.0: made(3, 5), 9.0: made(0, 0)},
    ("RE+velocity_glr", 0.0): {8.0: made(6, 1), 17.0: made(5, 0)},
    ("RE", 0.1): {4.0: made(6, 5), 9.0: made(3, 1)},
}


def test_points_are_told_with_intervals_and_a_dash_where_nothing_was_flagged():
    table = curves_table(CURVES)
    assert [(line["detector"], line["amplitude_m"], len(line["points"])) for line in table] == [
        ("RE", 0.0, 2),
        ("RE+velocity_glr", 0.0, 2),
        ("RE", 0.1, 2),
    ]
    text = curves_markdown(table)
    assert "| steady | RE | 4 | 10.00 [10.00, 10.00] | 50.0 [50.0, 50.0] | 37.5 [37.5, 37.5] |" in text
    assert "| steady | RE | **9** | 0.00 [0.00, 0.00] | 0.0 [0.0, 0.0] | – |" in text
    assert text.index("| A = 0.1 m | RE | **9** |") > text.index("| steady | RE+velocity_glr | 17 |")


def test_a_panel_for_each_amplitude_has_the_points_of_its_methods():
    roc, precision = (draw(curves_table(CURVES)) for draw in (roc_figure, precision_figure))
    steady, swinging = (
        {container.get_label(): container.lines[0].get_xydata() for container in axes.containers} for axes in roc.axes
    )
    assert set(steady) == {"RE", "RE+velocity_glr"} and set(swinging) == {"RE"}
    np.testing.assert_allclose(steady["RE"], [[0.1, 0.5], [0, 0]])
    np.testing.assert_allclose(swinging["RE"], [[0.1, 1.0], [0.02, 0.5]])
    rings = [[line.get_xydata() for line in axes.lines if line.get_markersize() == 10] for axes in roc.axes]
    assert [len(each) for each in rings] == [2, 1]
    np.testing.assert_allclose(rings[0][0], [[0, 0]])
    np.testing.assert_allclose(rings[1][0], [[0.02, 0.5]])
    assert rings[0][1].size == 0  # 24 was not run
    (points, _) = (container.lines[0].get_xydata() for container in precision.axes[0].containers)
    np.testing.assert_allclose(points, [[0.5, 3 / 8], [0, np.nan]])
