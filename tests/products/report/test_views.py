"""What a report counts of views, and the sections it makes of them."""

import math

import numpy as np
import pytest
import torch

from tests.figures.test_html_page import Outline
from unmix_plugin.figures.html_page import Section
from unmix_plugin.products.report.materials import materials_section
from unmix_plugin.products.report.pictures import (
    abundances_section,
    error_section,
    segmentation_section,
    views_section,
    worst_section,
)
from unmix_plugin.products.report.run import figures_section, read_metrics
from unmix_plugin.products.report.views import ReportViews, evenly
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.composition import Materials
from unmix_plugin.spectral.library.material_library import measured_library
from unmix_plugin.trained.evaluation import Evaluation, SceneTruth, ViewTruth
from unmix_plugin.trained.view_rendering import RenderedView

BANDS = Bands.of([450, 500, 550, 600, 650])
SPECTRA = torch.tensor([[0.9, 0.1, 0.1, 0.2, 0.3], [0.1, 0.8, 0.3, 0.1, 0.1], [0.2, 0.2, 0.2, 0.9, 0.6]])
NAMES = ("<clay>", "leaf & stem", "paint")
MATERIALS = Materials(BANDS, SPECTRA, torch.zeros(0, 5), names=NAMES)


def striped(name, offset=0.0):
    """Stripes of three materials, nothing in the first row; measured, and predicted with an error in the first band."""
    labels = (torch.arange(12) // 4).to(torch.uint8).repeat(10, 1)
    shares = torch.nn.functional.one_hot(labels.long(), 3).float()
    alpha = torch.ones(10, 12)
    alpha[0], labels[0], shares[0] = 0.0, 255, 0.0
    spectra = shares @ SPECTRA
    truth = ViewTruth(name, spectra, torch.ones(10, 12, dtype=torch.bool), alpha, labels, shares)
    wrong = spectra.clone()
    wrong[1:, :, 0] -= offset
    return RenderedView(wrong, alpha, shares, labels, shares), truth


def gathered(offsets, with_truth=True, materials=MATERIALS):
    truth = SceneTruth(BANDS, 3, SPECTRA.double(), ("clay", "leaf", "paint"))
    evaluation = Evaluation(truth, materials.endmembers, materials.names) if with_truth else None
    views = ReportViews(materials, evaluation, {"view_0"})
    for index, offset in enumerate(offsets):
        view, measured = striped(f"view_{index}", offset)
        views.add(f"view_{index}", view, measured if with_truth else None)
    return views


def outline(section: Section | None) -> Outline:
    assert section is not None
    return Outline(section.html)


def test_error_against_wavelength_is_over_pixels_that_show_matter():
    views = gathered([0.1, 0.0])
    np.testing.assert_allclose(views.rmse_of_bands, [0.1 / math.sqrt(2), 0, 0, 0, 0], atol=1e-7)
    np.testing.assert_allclose(views.bias_of_bands, [-0.05, 0, 0, 0, 0], atol=1e-7)
    assert "mean of predicted less measured" in outline(error_section(views)).text


def test_worst_views_are_those_of_lowest_psnr():
    views = gathered([0.02, 0.1, 0.05, 0.01])
    assert [view.name for view in views.worst_first] == ["view_1", "view_2", "view_0", "view_3"]
    text = outline(worst_section(views)).text
    assert text.index("view_1") < text.index("view_2") < text.index("view_0")
    assert "view_3" not in text


def test_proportions_are_of_what_is_seen():
    np.testing.assert_allclose(gathered([0.0]).proportions, 1 / 3)
    assert gathered([]).proportions.tolist() == [0, 0, 0]


def test_without_the_scene_there_is_nothing_measured_and_no_error():
    views = gathered([0.0, 0.0], with_truth=False)
    assert error_section(views) is None
    assert worst_section(views) is None
    assert "measured" not in outline(views_section(views)).text
    shown = outline(segmentation_section(views))
    assert "leaf & stem" in shown.text
    assert "intersection over union" not in shown.text


def test_with_labels_segmentation_is_scored_and_matched():
    shown = outline(segmentation_section(gathered([0.0])))
    assert len(shown.fetched) == 3
    assert shown.text.count("1.000") == 3
    assert "<clay>" in shown.text


@pytest.mark.parametrize("count", [1, 3, 7, 8, 26])
def test_there_is_a_map_for_each_endmember_in_the_views_chosen(count):
    bands = Bands.of(np.linspace(400, 700, 31))
    materials = Materials(bands, torch.rand(count, 31), torch.zeros(0, 31))
    views = ReportViews(materials, None, {"second"})
    shares = torch.full((4, 5, count), 1 / count)
    view = RenderedView(
        shares @ materials.endmembers, torch.ones(4, 5), shares, torch.zeros(4, 5, dtype=torch.uint8), shares
    )
    views.add("first", view, None)
    views.add("second", view, None)
    shown = outline(abundances_section(views))
    assert len(shown.fetched) == count + 1  # and the strip of colours
    assert "first" not in shown.text


def test_each_endmember_has_its_three_nearest_known_materials_and_its_true_one():
    truth = (["clay", "leaf", "paint"], SPECTRA.double().numpy())
    section = materials_section(MATERIALS, np.array([0.5, 0.3, 0.2]), np.ones(5), measured_library(), truth)
    shown = outline(section)
    assert shown.text.count("true: clay") == 2  # in the drawing and in the table
    assert shown.text.count("known material") == len(NAMES) + 1
    assert "50.0% of what is seen" in shown.text
    assert "taken as flat" not in shown.text
    for matches in measured_library().nearest(SPECTRA.numpy(), BANDS):
        for match in matches:
            assert match.name in shown.text
    unknown = materials_section(MATERIALS, np.zeros(3), None, measured_library(), None)
    assert "taken as flat" in unknown.html
    assert "true:" not in unknown.html


def test_bands_that_no_known_material_covers_are_said():
    infrared = Materials(Bands.of([1000, 1100, 1200, 1300, 1400]), SPECTRA, torch.zeros(0, 5))
    section = materials_section(infrared, np.zeros(3), None, measured_library(), None)
    assert "No known material covers enough of the bands." in section.html


def test_figures_come_with_their_definitions_or_with_what_to_do():
    section = figures_section(
        {"psnr": 31.25, "miou": None, "definitions": {"psnr": "as it was then"}}, "From a file."
    )
    text = outline(section).text
    assert "31.25" in text
    assert "as it was then" in text
    assert "no truth" in text
    assert "run unmix-eval" in figures_section(None, "").html


def test_lines_that_a_killed_run_left_incomplete_are_passed_over(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1, "loss": 0.5}\n[1]\n{"step": 2, "lo')
    assert read_metrics(path) == [{"step": 1, "loss": 0.5}]
    assert read_metrics(tmp_path / "none") == []


@pytest.mark.parametrize(
    ("count", "expected"), [(1, [0]), (2, [0, 9]), (4, [0, 3, 6, 9]), (10, list(range(10)))]
)
def test_an_even_choice_has_both_ends(count, expected):
    assert evenly(range(10), count) == expected
