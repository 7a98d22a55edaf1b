"""Line charts are drawn as they should; colours of materials: near their own, told apart, visible."""

import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unmix_plugin.figures.plotting import (
    RIGHT,
    WRONG,
    ChartLine,
    LineChart,
    distinct_colours,
    draw_chart,
    own_colours,
)
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import srgb_to_linear

X = np.linspace(400.0, 700.0, 4)
COLOUR = "#123456"


def chart(*values, **options):
    lines = [ChartLine(X[: len(one)], np.array(one, dtype=float), "line", COLOUR) for one in values]
    return LineChart(lines, "wavelength (nm)", "radiance", **options)


def strokes(drawing):
    """Points of every stroke of every line, y upwards."""
    found = []
    for path in ET.fromstring(drawing).iter("{http://www.w3.org/2000/svg}path"):
        if f"stroke: {COLOUR}" in path.attrib.get("style", ""):
            for part in path.attrib["d"].split("M")[1:]:
                numbers = np.array(re.findall(r"-?[\d.]+", part), dtype=float).reshape(-1, 2)
                found.append(numbers * [1, -1])
    return found


def test_lines_rise_with_their_values_inside_the_chart():
    [points] = strokes(draw_chart(chart([0.1, 0.4, 0.2, 0.3])))
    assert np.argsort(points[:, 1]).tolist() == [0, 2, 3, 1]
    assert (np.diff(points[:, 0]) > 0).all()
    assert points[:, 0].min() > 0
    assert points[:, 0].max() < 640
    assert points[:, 1].max() < 0
    assert points[:, 1].min() > -300
    over_all, above = (strokes(draw_chart(chart([5.0, 6.0], from_zero=flag)))[0] for flag in (False, True))
    assert np.ptp(above[:, 1]) < 0.3 * np.ptp(over_all[:, 1])  # in the upper part, where zero is shown


def test_a_line_has_a_gap_where_a_value_is_missing():
    found = strokes(draw_chart(chart([1.0, 2.0, np.nan, 3.0])))
    assert len(found[0]) == 2
    assert sum(len(part) for part in found) <= 3


@pytest.mark.parametrize(
    ("values", "is_log", "count"),
    [
        ([0.7], False, 1),
        ([1.0, 2.0, np.nan, 3.0], False, 1),
        ([np.nan, 1.0, np.nan, 2.0], False, 2),
        ([1.0, -1.0, 2.0, 3.0], True, 1),
        ([1.0, 2.0, 3.0], False, 0),
    ],
)
def test_a_value_without_neighbours_is_a_dot(values, is_log, count):
    drawing = ET.fromstring(draw_chart(chart(values, is_log=is_log)))
    dots = [
        use
        for use in drawing.iter("{http://www.w3.org/2000/svg}use")
        if COLOUR in use.attrib.get("style", "")
    ]
    assert len(dots) == count


def test_a_logarithmic_axis_has_equal_steps_for_equal_factors_and_leaves_out_what_is_not_positive():
    [points] = strokes(draw_chart(chart([0.001, 0.1, 10.0, 0.0], is_log=True)))
    assert len(points) == 3
    assert points[1, 1] - points[0, 1] == pytest.approx(points[2, 1] - points[1, 1], abs=0.05)


@pytest.mark.parametrize("values", [[np.nan, np.nan], [3.0, 3.0], [0.0], [1e-300, 2e-300]])
@pytest.mark.parametrize("is_log", [False, True])
def test_lines_without_numbers_or_extent_are_drawn_too(values, is_log):
    assert ET.fromstring(draw_chart(chart(values, is_log=is_log))).tag.endswith("svg")


BANDS = Bands.of(np.linspace(400, 700, 31))


def luminance(srgb):
    """Relative luminance of sRGB colours, [0, 1]."""
    return srgb_to_linear(torch.from_numpy(srgb)).numpy() @ [0.2126, 0.7152, 0.0722]


def least_difference(colours):
    """Smallest distance of two colours in sRGB."""
    distances = np.linalg.norm(colours[:, None] - colours[None], axis=-1)
    return (distances + 9 * np.eye(len(colours))).min()


@pytest.mark.parametrize(("count", "least"), [(8, 0.15), (26, 0.12), (100, 0.05), (255, 0.04)])
def test_colours_are_told_apart_even_if_all_materials_look_the_same(count, least):
    colours = distinct_colours(np.full((count, 3), 0.45))
    assert colours.shape == (count, 3)
    assert least_difference(colours) > least
    assert colours.min() >= 0
    assert colours.max() <= 1


@settings(max_examples=20)
@given(st.lists(st.tuples(*[st.floats(0, 1)] * 3), min_size=2, max_size=10))
def test_colours_differ_and_stand_out_from_white_paper_and_black_text(own):
    colours = distinct_colours(np.array(own))
    assert least_difference(colours) > 0.1
    assert luminance(colours).max() < 0.68
    assert luminance(colours).min() > 0.055
    for mark in (RIGHT, WRONG):
        assert np.abs(colours - mark).max(axis=1).min() > 0.15


def test_colours_that_are_told_apart_already_stay():
    own = np.array([[0.8, 0.2, 0.2], [0.2, 0.3, 0.8], [0.2, 0.65, 0.3]])
    np.testing.assert_allclose(distinct_colours(own), own, atol=0.03)
    np.testing.assert_array_equal(distinct_colours(own), distinct_colours(own))
    assert distinct_colours(np.zeros((0, 3))).shape == (0, 3)


def test_a_materials_own_colour_is_that_of_its_spectrum():
    wavelengths = torch.from_numpy(BANDS.centers_nm.copy())
    white, black = torch.ones(31), torch.zeros(31)
    red, blue = (wavelengths > 600).float(), (wavelengths < 480).float()
    colours = own_colours(torch.stack([white, black, red, blue]), BANDS)
    np.testing.assert_allclose(colours[0], 1.0, atol=1e-6)
    np.testing.assert_allclose(colours[1], 0.0, atol=1e-6)
    assert colours[2].argmax() == 0
    assert colours[3].argmax() == 2
