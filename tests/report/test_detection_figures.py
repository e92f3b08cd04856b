"""Figures of what methods found: how each method looks."""

import numpy as np
import pytest

from vcjax.report.detection_figures import found_figure
from vcjax.report.detection_roc import curves_table, roc_figure
from vcjax.report.style import METHOD_STYLES
from vcjax.study.detection_methods import METHODS
from vcjax.study.detection_scores import Counts


def looks(figure) -> dict:
    """Colour and marker of the lines by name."""
    containers = figure.axes[0].containers
    return {each.get_label(): (each.lines[0].get_color(), each.lines[0].get_marker()) for each in containers}


def test_a_method_looks_the_same_whichever_others_are_there():
    def found(methods):
        cell = {"dynamic_motion": "lateral", "amplitude_m": 0.1, "dynamic_speed_m_s": 1.0}
        share = {"found_fraction": {"mean": 0.5, "se": 0.1}}
        return found_figure({"num_seeds": 2, "cells": [cell | share | {"detector": name} for name in methods]})

    def curves(methods):
        counts = Counts(*(np.array([1, 2]) for _ in range(4)))
        return roc_figure(curves_table({(name, 0.1): {9.0: counts} for name in methods}))

    for draw in (found, curves):
        alone, among = looks(draw(["RE+velocity_glr"])), looks(draw(["VC", "RE", "RE+velocity_glr"]))
        assert alone["RE+velocity_glr"] == among["RE+velocity_glr"] and len(set(among.values())) == 3


@pytest.mark.parametrize("name", METHODS)
def test_every_method_has_a_look_of_its_own(name):
    assert [METHOD_STYLES[name]] == [style for style in METHOD_STYLES.values() if style == METHOD_STYLES[name]]
