"""What a report counts of views, and the sections it makes of them."""

import base64
import io
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.factories.pages import Outline, assert_self_contained
from unmix_plugin.figures.look import NEUTRAL
from unmix_plugin.formats.files import eight_bits
from unmix_plugin.formats.html import picture_url
from unmix_plugin.products.report.pictures import (
    ReportViews,
    TrueMaterials,
    material_cards,
    segmentation_section,
)
from unmix_plugin.products.report.report import figure_rows, render_page, view_values
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import measured_library
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.evaluation import Evaluation, PredictedView, SceneTruth, ViewTruth

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
    return PredictedView(wrong, alpha, shares, labels, shares), truth


def gathered(offsets, with_truth=True, materials=MATERIALS) -> Any:
    truth = SceneTruth(BANDS, 3, SPECTRA.double(), ("clay", "leaf", "paint"))
    evaluation = Evaluation(truth, materials.endmembers, materials.names) if with_truth else None
    views = ReportViews(materials, evaluation, {"view_0"})
    for index, offset in enumerate(offsets):
        view, measured = striped(f"view_{index}", offset)
        views.add(f"view_{index}", view, measured if with_truth else None)
    return views


NOTHING: dict[str, Any] = dict.fromkeys(("page", "light_unknown", "figures"))
NOTHING |= dict.fromkeys(("num_known", "num_main"), 0)
NOTHING |= {key: [] for key in ("cards", "regions", "unexplained", "unknown", "versions")}
NOTHING |= {"figures_source": "", "summary": "", "about": "", "quantity": "radiance", "settings": "{}"}
TEXTS = {"title": "Title <x>", "subtitle": "run", "notes": ["so & so"], "facts": [("<b>", "</dl>")]}


def outline(views: ReportViews, **others) -> Outline:
    return assert_self_contained(render_page({**NOTHING, **TEXTS, **view_values(views), **others}))


def shown_texts(views: ReportViews, **others) -> dict[str, str]:
    """Text of each section."""
    return outline(views, **others).section_texts


def test_error_against_wavelength_and_proportions_are_over_pixels_that_show_matter():
    views = gathered([0.1, 0.0])
    expected = [[0.1 / math.sqrt(2), 0, 0, 0, 0], [-0.05, 0, 0, 0, 0]]
    np.testing.assert_allclose(views.error_of_bands, expected, atol=1e-7)
    np.testing.assert_allclose(views.proportions, 1 / 3)
    assert gathered([]).proportions.tolist() == [0, 0, 0]
    texts = shown_texts(views)
    assert "mean of predicted less measured" in texts["error"]
    assert len(view_values(views)["segmentation"]["pictures"]) == 2 * 3
    assert texts["segmentation"].count("1.000") == 3  # as matched with the labels
    assert "<clay>" in texts["segmentation"]


def test_worst_views_are_those_of_lowest_psnr():
    views = gathered([0.02, 0.1, 0.05, 0.01])
    assert [view.name for view in views.worst_first] == ["view_1", "view_2", "view_0", "view_3"]
    text = shown_texts(views)["worst"]
    assert text.index("view_1") < text.index("view_2") < text.index("view_0")
    assert "view_3" not in text


def test_without_the_scene_there_is_nothing_measured_and_no_error():
    texts = shown_texts(gathered([0.0, 0.0], with_truth=False))
    assert "error" not in texts
    assert "worst" not in texts
    assert "measured" not in texts["views"]
    assert "leaf & stem" in texts["segmentation"]
    assert "intersection over union" not in texts["segmentation"]


def test_text_is_escaped_and_links_lead_to_the_sections():
    page = outline(gathered([0.0]), settings="<script>alert(1)</script>")
    assert "Title <x>" in page.text
    assert "so & so" in page.section_texts["scene"]
    assert "<b></dl>" in page.section_texts["scene"]
    assert "<script>alert(1)</script>" in page.section_texts["settings"]
    assert page.links == [f"#{name}" for name in page.ids]


@pytest.mark.parametrize("count", [1, 26])
def test_there_is_a_map_for_each_endmember_in_the_views_chosen(count):
    bands, shares = Bands.of(np.linspace(400, 700, 31)), torch.full((4, 5, count), 1 / count)
    materials = Materials(bands, torch.rand(count, 31), torch.zeros(0, 31))
    views, ids = ReportViews(materials, None, {"second"}), torch.zeros(4, 5, dtype=torch.uint8)
    view = PredictedView(shares @ materials.endmembers, torch.ones(4, 5), shares, ids, shares)
    views.add("first", view, None)
    views.add("second", view, None)
    [(name, maps)] = view_values(views)["shares"]
    assert name == "second"
    assert [one.caption for one in maps] == list(materials.names)
    text = shown_texts(views)["abundances"]
    assert "first" not in text
    assert all(name in text for name in materials.names)


def test_each_endmember_has_the_known_materials_that_it_is_like_and_its_true_one():
    truth = TrueMaterials(["clay", "leaf", "paint"], SPECTRA.double().numpy())
    library = measured_library()
    cards = material_cards(MATERIALS, np.array([0.5, 0.3, 0.2]), np.ones(5), library, truth)
    text = shown_texts(gathered([]), cards=cards)["materials"]
    assert text.count("true: clay") == 1
    assert text.count("known material") == len(NAMES) + 1
    assert "50.0% of what is seen" in text
    found = library.nearest(SPECTRA.numpy(), BANDS)
    for card, matches in zip(cards, found, strict=True):
        alike = [match.name for match in matches if match.angle_rad <= 0.1]
        lines = [line.label for line in card["chart"].lines]
        assert [name for name in lines if name in library.names] == alike
        assert (card["nearest"] is None) == bool(alike)
    zigzag = replace(MATERIALS, endmembers=torch.tensor([[0.9, 0.0, 0.9, 0.0, 0.9]]).repeat(3, 1))
    text = shown_texts(gathered([]), cards=material_cards(zigzag, np.zeros(3), np.ones(5), library, None))
    assert text["materials"].count("Not like anything known; the nearest is ") == 3
    assert "known material</th>" not in text["materials"]
    infrared = Materials(Bands.of([1000, 1100, 1200, 1300, 1400]), SPECTRA, torch.zeros(0, 5))
    unknown = material_cards(infrared, np.zeros(3), None, library, None)
    text = shown_texts(gathered([]), cards=unknown, light_unknown="taken as flat")["materials"]
    assert "taken as flat" in text
    assert "true:" not in text
    assert text.count("No known material covers enough of the bands.") == 3


def test_figures_come_with_their_definitions_or_with_what_to_do():
    rows = figure_rows({"ssim": 0.9, "psnr": 31.25, "miou": None, "definitions": {"psnr": "as it was then"}})
    assert [name for name, *_ in rows] == ["psnr", "ssim"]
    others = {"num_main": 1, "unknown": ["miou"], "figures_source": "From a file."}
    text = shown_texts(gathered([]), figures=rows, **others)["figures"]
    for part in ("31.25", "as it was then", "the truth for it: miou.", "From a file."):
        assert part in text
    assert "run unmix-eval" in shown_texts(gathered([]))["figures"]


def test_a_picture_holds_its_pixels_and_a_large_one_is_shrunk():
    def decoded(pixels: np.ndarray) -> np.ndarray:
        data = base64.b64decode(picture_url(pixels, 640).removeprefix("data:image/png;base64,"))
        return np.asarray(Image.open(io.BytesIO(data)))

    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    np.testing.assert_array_equal(decoded(pixels), pixels)
    np.testing.assert_array_equal(decoded(pixels / 255), pixels)
    for size, expected in (((10, 1280), (5, 640)), ((2000, 1), (640, 1))):
        assert decoded(np.zeros((*size, 3))).shape[:2] == expected


def test_pixels_that_do_not_count_show_no_label_no_error_and_no_agreement():
    view, truth = striped("masked", 0.5)
    hidden = torch.zeros(10, 12, dtype=torch.bool)
    hidden[3:7, 2:9] = True
    wrong = replace(view, segmentation=(view.segmentation + 1) % 3)
    views = gathered([])
    views.add("masked", wrong, replace(truth, valid=~hidden))
    [shown] = views.shown
    assert (shown.labels[hidden] == 255).all()
    assert (shown.labels[8] != 255).all()
    grey = eight_bits(np.full(3, NEUTRAL))
    assert (shown.error[hidden] == grey).all()
    assert (shown.error[8] != grey).any(axis=-1).all()
    agreement = segmentation_section(views)["pictures"][-1].image
    np.testing.assert_allclose(agreement[hidden], NEUTRAL)
    assert (agreement[8] != NEUTRAL).any(axis=-1).all()


def test_the_gain_fitted_to_a_view_counts_in_its_pictures_and_errors():
    view, truth = striped("bright")
    gain = torch.linspace(0.5, 1.0, 5)
    views = gathered([])
    views.add("bright", replace(view, gain=gain), replace(truth, spectra=truth.spectra * gain))
    [shown] = views.shown
    np.testing.assert_allclose(views.error_of_bands, 0, atol=1e-7)
    np.testing.assert_array_equal(shown.predicted, shown.measured)


def test_confidence_is_a_mean_over_what_has_a_material_and_haze_does_not_lower_it():
    view, _ = striped("view")
    haze = view.accumulation.clone()
    haze[0] = 0.4
    sure = torch.where(view.segmentation == 255, 0.0, 0.8)
    views = ReportViews(MATERIALS, None, ())
    views.add("view", replace(view, accumulation=haze, confidence=sure), None)
    assert views.confidence == pytest.approx(0.8)
