"""Heat maps over two numbers: every mean in its place, on fitting axes, marks that are seen or said to be outside."""

import numpy as np
import pytest
from invented_choice import TH1, TH2, invented_choice

from vcjax.report.landscape import PANELS, landscape_figure
from vcjax.tuning.choice import Choice
from vcjax.tuning.landscape import as_grid


@pytest.fixture
def choice() -> Choice:
    return invented_choice()


def test_the_landscape_shows_every_mean_in_its_place(choice):
    grid = as_grid(choice)
    figure = landscape_figure(grid, "title", {"before": choice.before, "after": choice.after}, [[choice.before] * 2])
    for axes, name in zip(figure.axes, PANELS, strict=False):
        (mesh,) = axes.collections
        np.testing.assert_allclose(mesh.get_array(), grid[name].mean(("scene", "seed")).T)
        corners = mesh.get_coordinates()
        np.testing.assert_allclose(corners[0, 0], [4 / np.sqrt(2), 3 / np.sqrt(3)])
        np.testing.assert_allclose(corners[-1, -1], [16 * np.sqrt(2), 27 * np.sqrt(3)])
        assert axes.get_xscale() == axes.get_yscale() == "log"
    linear = grid.assign_coords({TH1: [1.0, 2.0, 3.0]})
    assert landscape_figure(linear, "title").axes[0].get_xlim() == (0.5, 3.5)
    two = landscape_figure(grid.isel({TH1: [0, 2]}).isel({TH2: [1, 2]}), "title").axes[0]
    assert (two.get_xscale(), two.get_yscale()) == ("log", "linear") and two.get_xlim() == pytest.approx((2, 32))
    far = grid.isel({TH1: [0, 2]}).assign_coords({TH1: [2.0, 64.0]})
    assert landscape_figure(far, "title").axes[0].get_xlim() == pytest.approx((2 / 32**0.5, 64 * 32**0.5))


def test_a_mark_outside_of_the_grid_is_said_to_be_there(choice):
    for th1, label in ((9.0, "before"), (9e3, "before: outside")):
        figure = landscape_figure(as_grid(choice), "title", {"before": choice.before | {TH1: th1}})
        assert [text.get_text() for text in figure.legends[0].get_texts()] == [label]
