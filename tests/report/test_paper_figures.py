"""Figures: what is drawn is what was computed, labels are whole and apart, and files depend on the results alone."""

import ast
import inspect
import itertools

import matplotlib
import numpy as np
import pytest
from fake_runs import fake_results, fake_runs, with_failed_seed
from matplotlib.colors import to_hex
from matplotlib.text import Annotation
from scipy import stats

from vcjax.report import paper_figures as figures
from vcjax.report.paper_figures import error_figure, scene_figure, write_figures
from vcjax.report.style import RC
from vcjax.study.paper import Cell

RE = Cell(2, "forward", None, None, "RE", False)
OSCILLATING = Cell(2, "forward", None, None, "VC", True)


@pytest.fixture(scope="module")
def results():
    return fake_results((2, 3), num_seeds=5, num_frames=40)


def names(paths) -> list[str]:
    return sorted(path.name for path in paths)


def test_writes_all_figures_as_png_and_svg(results, tmp_path):
    paths = write_figures(results, tmp_path)
    assert names(paths) == sorted(f"figure_{n}.{kind}" for n in (3, 4, 5, 6) for kind in ("png", "svg"))
    assert names((tmp_path / "figures").iterdir()) == names(paths)
    assert (tmp_path / "figures" / "figure_3.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_results_give_the_same_bytes(results, tmp_path):
    results = {cell: results[cell] for cell in (RE, Cell(3, "forward", "lateral", 1.0, "RE", False))}
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    first, second = (write_figures(results, tmp_path / name) for name in ("a", "b"))
    for a, b in zip(first, second, strict=True):
        assert a.read_bytes() == b.read_bytes(), a.name


def test_settings_of_matplotlib_are_left_alone(results, tmp_path):
    before = dict(matplotlib.rcParams)
    write_figures({RE: results[RE]}, tmp_path)
    assert before["svg.hashsalt"] != RC["svg.hashsalt"]
    assert dict(matplotlib.rcParams) == before
    imports = ast.walk(ast.parse(inspect.getsource(figures)))
    assert not any("pyplot" in ast.dump(node) for node in imports if isinstance(node, (ast.Import, ast.ImportFrom)))


def test_only_figures_whose_cells_exist(results, tmp_path):
    other_tables = fake_results((4,), num_seeds=2)
    assert write_figures(other_tables, tmp_path) == []
    assert not (tmp_path / "figures").exists()
    assert names(write_figures({RE: results[RE]}, tmp_path)) == ["figure_3.png", "figure_3.svg"]
    lateral = {cell: runs for cell, runs in results.items() if cell.dynamic_motion == "lateral"}
    assert names(write_figures(lateral, tmp_path))[::2] == ["figure_4.png", "figure_6.png"]
    left_out = Cell(2, "forward", None, None, "RE", True)
    assert error_figure(3, {left_out: results[left_out]}) is None


def test_lines_are_means_over_finite_seeds_and_bands_their_intervals():
    runs = with_failed_seed(fake_runs(OSCILLATING, 6, num_frames=12), 4)
    figure = error_figure(3, {OSCILLATING: runs})
    assert figure is not None
    kept = [0, 1, 2, 3, 5]
    errors = [100 * runs.position_error_m.values[kept], runs.orientation_error_deg.values[kept]]
    for axes, error, unit in zip(figure.axes, errors, ("cm", "deg"), strict=True):
        (line,), (band,) = axes.lines, axes.collections
        np.testing.assert_allclose(line.get_xdata(), np.arange(1, 13))
        np.testing.assert_allclose(line.get_ydata(), error.mean(0), rtol=1e-12)
        low, high = stats.t.interval(0.95, 4, error.mean(0), stats.sem(error))
        corners = band.get_paths()[0].vertices
        assert corners[:, 1].min() == pytest.approx(low.min())
        assert corners[:, 1].max() == pytest.approx(high.max())
        assert unit in axes.get_ylabel() and axes.get_xlabel() == "frame"
    assert "5 runs" in figure.get_suptitle()


def test_one_run_has_a_line_and_no_band():
    figure = error_figure(3, {RE: fake_runs(RE, 1)})
    assert figure is not None and "one run" in figure.get_suptitle()
    assert all(len(axes.lines) == 1 and not axes.collections for axes in figure.axes)


def test_runs_that_all_failed_draw_nothing_and_break_nothing(tmp_path):
    runs = with_failed_seed(fake_runs(RE, 1), 0)
    assert names(write_figures({RE: runs}, tmp_path)) == ["figure_3.png", "figure_3.svg"]


def test_a_method_keeps_its_colour_whichever_others_are_there(results):
    def colours(figure):
        return {line.get_label(): to_hex(line.get_color()) for line in figure.axes[0].lines}

    all_methods, alone = error_figure(3, results), error_figure(3, {OSCILLATING: results[OSCILLATING]})
    assert len(set(colours(all_methods).values())) == 3
    assert colours(alone).items() <= colours(all_methods).items()
    assert colours(error_figure(5, results)) == colours(all_methods)


def test_scene_shows_the_features_and_where_they_go(results):
    figure = scene_figure(results)
    assert figure is not None and len(figure.axes) == 2
    for axes, direction in zip(figure.axes, ([0, 1], [-1, 0]), strict=True):
        arrows = [text for text in axes.texts if isinstance(text, Annotation) and text.arrow_patch is not None]
        assert len(arrows) == 6 + 1  # and the robot's
        for arrow in arrows[:6]:
            step = np.subtract(arrow.xy, arrow.xyann)
            np.testing.assert_allclose(step / np.linalg.norm(step), direction, atol=1e-12)
        (x_low, x_high), (y_low, y_high) = axes.get_xlim(), axes.get_ylim()
        assert all(x_low < arrow.xy[0] < x_high and y_low < arrow.xy[1] < y_high for arrow in arrows)
        assert axes.get_aspect() == 1 and "m)" in axes.get_xlabel() and "m)" in axes.get_ylabel()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:2] == ["156 static features", "6 dynamic features in frame 1"]


def test_scene_with_a_fast_mover_is_not_cut(results):
    cell = Cell(3, "forward", "lateral", 1.0, "RE", False)
    runs = results[cell].copy(deep=True)
    runs.landmark_true[4:, 0, 0] = 30.0
    figure = scene_figure({cell: runs})
    assert figure is not None and figure.axes[0].get_xlim()[1] > 30.0


@pytest.mark.parametrize("number", [3, 4, 5, 6, "6a"])
def test_labels_are_whole_and_do_not_overlap(results, number):
    with matplotlib.rc_context(RC):
        if number == "6a":
            results = {cell: runs for cell, runs in results.items() if cell.dynamic_motion == "lateral"}
        figure = error_figure(number, results) if number in (3, 4, 5) else scene_figure(results)
        assert figure is not None
        figure.draw_without_rendering()
        box = figure.get_tightbbox()
        width, height = figure.get_size_inches()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height
        texts = [figure._suptitle, *figure.legends[0].get_texts()]  # pyright: ignore[reportAttributeAccessIssue]
        for axes in figure.axes:
            texts += [axes.title, axes.xaxis.label, axes.yaxis.label]
            for axis in (
                axes.xaxis,
                axes.yaxis,
            ):  # matplotlib keeps labels of ticks beyond the axes without drawing them
                low, high = axis.get_view_interval()
                texts += [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
        boxes = [text.get_window_extent() for text in texts if text.get_text() and text.get_visible()]
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
