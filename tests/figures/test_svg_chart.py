import itertools
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.figures.svg_chart import Chart, Line, draw_chart, draw_legend

SVG = "{http://www.w3.org/2000/svg}"
X = np.linspace(400.0, 700.0, 4)


def chart(*values, **options):
    lines = [
        Line(X[: len(one)], np.array(one, dtype=float), f"line {i}", "#123456")
        for i, one in enumerate(values)
    ]
    return Chart(lines, "wavelength (nm)", "radiance", "a chart", **options)


def parsed(drawing):
    return ET.fromstring(drawing)


def paths(drawing):
    """Points of each line, as lists of strokes."""
    found = []
    for path in parsed(drawing).iter("path"):
        strokes = [part for part in path.attrib["d"].split("M") if part]
        found.append(
            [[tuple(map(float, point.split())) for point in stroke.split("L")] for stroke in strokes]
        )
    return found


def ticks(drawing, anchor):
    """Labels of an axis and their place along it."""
    key = "y" if anchor == "end" else "x"
    return {
        element.text: float(element.attrib[key])
        for element in parsed(drawing).iter("text")
        if element.attrib.get("class") == "tick" and element.attrib["text-anchor"] == anchor
    }


numbers = st.floats(-1e6, 1e6).map(lambda value: round(value, 6))


@given(st.lists(st.lists(numbers, min_size=1, max_size=4), min_size=1, max_size=3), st.booleans())
def test_every_point_lies_inside_the_chart_and_rises_with_its_value(values, from_zero):
    drawn = paths(draw_chart(chart(*values, from_zero=from_zero)))
    for given_values, strokes in zip(values, drawn, strict=True):
        points = [point for stroke in strokes for point in stroke]
        assert len(points) == len(given_values)
        assert all(61 <= x <= 627 and 11 <= y <= 257 for x, y in points)
        order = np.argsort(given_values, kind="stable")
        heights = [-points[index][1] for index in order]
        assert all(low <= high + 0.02 for low, high in itertools.pairwise(heights))


def test_a_line_has_a_gap_where_a_value_is_missing():
    [strokes] = paths(draw_chart(chart([1.0, np.nan, 2.0, 3.0])))
    assert [len(stroke) for stroke in strokes] == [1, 2]


def test_ticks_are_round_and_stand_where_their_values_are():
    drawing = draw_chart(chart([0.0, 0.25, 0.5, 1.0]))
    labels = ticks(drawing, "end")
    assert list(labels) == ["0", "0.2", "0.4", "0.6", "0.8", "1"]
    [[stroke]] = paths(drawing)
    assert labels["0"] - 4 == pytest.approx(stroke[0][1], abs=0.1)
    assert labels["1"] - 4 == pytest.approx(stroke[3][1], abs=0.1)
    assert list(ticks(drawing, "middle")) == ["400", "450", "500", "550", "600", "650", "700"]


def test_a_logarithmic_axis_has_equal_steps_for_equal_factors_and_leaves_out_what_is_not_positive():
    drawing = draw_chart(chart([0.001, 0.1, 10.0, 0.0], is_log=True))
    [[stroke]] = paths(drawing)
    assert len(stroke) == 3
    assert stroke[0][1] - stroke[1][1] == pytest.approx(stroke[1][1] - stroke[2][1], abs=0.05)
    assert list(ticks(drawing, "end")) == ["0.001", "0.01", "0.1", "1", "10"]


def test_zero_is_shown_where_it_has_to_be():
    assert "0" in ticks(draw_chart(chart([5.0, 6.0], from_zero=True)), "end")
    assert "0" not in ticks(draw_chart(chart([5.0, 6.0])), "end")


@pytest.mark.parametrize("values", [[np.nan, np.nan], [3.0, 3.0], [0.0], [1e-300, 2e-300]])
def test_lines_without_numbers_or_extent_are_drawn_too(values):
    assert parsed(draw_chart(chart(values))).tag.endswith("svg")
    assert parsed(draw_chart(chart(values, is_log=True))).tag.endswith("svg")


def test_names_cannot_break_out_of_the_drawing():
    line = Line(X, X, '<script>alert("1")</script>', '"/><script>')
    drawing = draw_chart(Chart([line], "<b>", "&", "<i>"))
    elements = {element.tag for element in parsed(drawing).iter()}
    assert elements == {"svg", "title", "line", "text", "path"}
    legend = ET.fromstring(draw_legend([line]))
    assert "".join(legend.itertext()) == '<script>alert("1")</script>'
