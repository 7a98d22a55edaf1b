import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from unmix_plugin.engine.printing import plot_text
from unmix_plugin.figures import plotting
from unmix_plugin.figures.paint import ColourScale
from unmix_plugin.figures.pictures import TitledPicture, draw_panels
from unmix_plugin.products.endmembers import draw_spectra
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import srgb_to_linear

X = np.linspace(400.0, 700.0, 4)
COLOUR = "#123456"


def drawn(*values):
    line = plotting.ChartLine(X[: len(values)], np.array(values, dtype=float), "line", COLOUR)
    return ET.fromstring(plotting.draw_chart(plotting.SpectraChart([line], "radiance", (640.0, 300.0))))


def strokes(drawing):
    """Points of every stroke of the line, y upwards."""
    found = []
    for path in drawing.iter("{http://www.w3.org/2000/svg}path"):
        if f"stroke: {COLOUR}" in path.attrib.get("style", ""):
            for part in path.attrib["d"].split("M")[1:]:
                numbers = np.array(re.findall(r"-?[\d.]+", part), dtype=float).reshape(-1, 2)
                found.append(numbers * [1, -1])
    return found


def test_lines_rise_with_their_values_inside_the_chart_above_zero():
    [points] = strokes(drawn(0.1, 0.4, 0.2, 0.3))
    assert np.argsort(points[:, 1]).tolist() == [0, 2, 3, 1]
    assert (np.diff(points[:, 0]) > 0).all()
    assert 0 < points[:, 0].min() < points[:, 0].max() < 640
    assert -300 < points[:, 1].min() < points[:, 1].max() < 0
    [above] = strokes(drawn(5.0, 6.0))
    assert np.ptp(above[:, 1]) < 0.3 * np.ptp(points[:, 1])  # in the upper part, where zero is shown


NONE = np.nan


DOTS = [([0.7], 1), ([1, 2, NONE, 3], 1), ([NONE, 1, NONE, 2], 2), ([1, 2, 3], 0)]


@pytest.mark.parametrize(("values", "num_dots"), DOTS)
def test_a_missing_value_is_a_gap_and_one_without_neighbours_a_dot(values, num_dots):
    drawing = drawn(*values)
    dots = drawing.iter("{http://www.w3.org/2000/svg}use")
    assert sum(COLOUR in dot.attrib.get("style", "") for dot in dots) == num_dots
    assert all(len(stroke) < len(values) for stroke in strokes(drawing) if np.isnan(values).any())


@pytest.mark.parametrize("values", [[np.nan, np.nan], [3.0, 3.0], [0.0], [1e-300, 2e-300]])
def test_lines_without_numbers_or_extent_are_drawn_too(values):
    assert drawn(*values).tag.endswith("svg")


BANDS = Bands.of(np.linspace(400, 700, 31))


def luminance(srgb):
    return srgb_to_linear(torch.from_numpy(srgb)).numpy() @ [0.2126, 0.7152, 0.0722]


def least_difference(colours):
    distances = np.linalg.norm(colours[:, None] - colours[None], axis=-1)
    return (distances + 9 * np.eye(len(colours))).min()


@pytest.mark.parametrize(("count", "least"), [(8, 0.15), (26, 0.12), (100, 0.05), (255, 0.04)])
def test_colours_are_told_apart_even_if_all_materials_look_the_same(count, least):
    colours = plotting.distinct_colours(np.full((count, 3), 0.45))
    assert colours.shape == (count, 3)
    assert least_difference(colours) > least
    assert 0 <= colours.min() < colours.max() <= 1


@settings(max_examples=20)
@given(st.lists(st.tuples(*[st.floats(0, 1)] * 3), min_size=2, max_size=10))
def test_colours_differ_and_stand_out_from_white_paper_and_black_text(own):
    colours = plotting.distinct_colours(np.array(own))
    assert least_difference(colours) > 0.1
    assert 0.055 < luminance(colours).min() <= luminance(colours).max() < 0.68
    for mark in (plotting.RIGHT, plotting.WRONG):
        assert np.abs(colours - mark).max(axis=1).min() > 0.15


def test_colours_that_are_told_apart_already_stay():
    own = np.array([[0.8, 0.2, 0.2], [0.2, 0.3, 0.8], [0.2, 0.65, 0.3]])
    np.testing.assert_allclose(plotting.distinct_colours(own), own, atol=0.03)
    np.testing.assert_array_equal(plotting.distinct_colours(own), plotting.distinct_colours(own))
    assert plotting.distinct_colours(np.zeros((0, 3))).shape == (0, 3)


def test_a_materials_own_colour_is_that_of_its_spectrum():
    wavelengths = torch.from_numpy(BANDS.centers_nm.copy())
    white, black = torch.ones(31), torch.zeros(31)
    red, blue = (wavelengths > 600).float(), (wavelengths < 480).float()
    colours = plotting.own_colours(torch.stack([white, black, red, blue]), BANDS)
    np.testing.assert_allclose(colours[:2], [[1.0] * 3, [0.0] * 3], atol=1e-6)
    assert colours[2:].argmax(axis=1).tolist() == [0, 2]


@pytest.mark.parametrize("name", ["5$ leaf $", "$\\frac$", "a $ b $ c $", "_leaf", "100 % $^{x$"])
def test_names_are_drawn_as_they_are_and_never_read_as_formulas(name):
    panel = TitledPicture(np.zeros((4, 4, 3)), name, (1.0, 0.0, 0.0))
    scale = ColourScale("viridis", 0.0, 1.0, name)
    assert draw_panels([[panel]], name, scale, [(name, (0.0, 1.0, 0.0))]).startswith(b"\x89PNG")
    assert b"<svg" in plotting.draw_chart(
        plotting.SpectraChart([plotting.ChartLine(np.arange(3), np.ones(3), name, "#000000")], name)
    )
    spectra, x = np.ones((2, 3)), np.arange(3)
    colours = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    assert draw_spectra(spectra, x, [name, "other"], colours, (name, name)).startswith(b"\x89PNG")
    as_named, by_letter = Figure(), Figure()
    as_named.text(0.1, 0.1, plot_text(name))
    by_letter.text(0.1, 0.1, f" {name}" if name[0] == "_" else name, parse_math=False)
    assert plotting.figure_bytes(as_named) == plotting.figure_bytes(by_letter)
