import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from unmix_plugin.figures.plotting import ChartLine, LineChart, draw_chart

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


def test_a_line_has_a_gap_where_a_value_is_missing():
    found = strokes(draw_chart(chart([1.0, 2.0, np.nan, 3.0])))
    assert len(found[0]) == 2
    assert sum(len(part) for part in found) <= 3


def test_a_logarithmic_axis_has_equal_steps_for_equal_factors_and_leaves_out_what_is_not_positive():
    [points] = strokes(draw_chart(chart([0.001, 0.1, 10.0, 0.0], is_log=True)))
    assert len(points) == 3
    assert points[1, 1] - points[0, 1] == pytest.approx(points[2, 1] - points[1, 1], abs=0.05)


def test_zero_is_shown_where_it_has_to_be():
    """The line then lies in the upper part of the chart, and not over all of it."""
    over_all, above = (strokes(draw_chart(chart([5.0, 6.0], from_zero=flag)))[0] for flag in (False, True))
    assert np.ptp(above[:, 1]) < 0.3 * np.ptp(over_all[:, 1])


@pytest.mark.parametrize("values", [[np.nan, np.nan], [3.0, 3.0], [0.0], [1e-300, 2e-300]])
@pytest.mark.parametrize("is_log", [False, True])
def test_lines_without_numbers_or_extent_are_drawn_too(values, is_log):
    assert ET.fromstring(draw_chart(chart(values, is_log=is_log))).tag.endswith("svg")


def test_the_same_chart_is_the_same_file():
    assert draw_chart(chart([1.0, 2.0])) == draw_chart(chart([1.0, 2.0]))
