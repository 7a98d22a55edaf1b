"""Figures: nothing cut off, neutral where nothing is, and colours that keep their meaning."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from tests.factories.models import around_endmembers
from unmix_plugin.figures.look import NEUTRAL
from unmix_plugin.figures.paint import ColourScale
from unmix_plugin.figures.pictures import TitledPicture, draw_panels, in_rows
from unmix_plugin.products import evaluation as evaluation_module
from unmix_plugin.products.endmembers import write_endmembers
from unmix_plugin.products.evaluation import (
    draw_colour,
    draw_matched_abundances,
    draw_matched_segmentation,
    material_look,
)
from unmix_plugin.products.views import colour_panel, draw_abundances, draw_segmentation, segmentation_scores
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.evaluation import Evaluation, PredictedView, SceneTruth, ViewTruth
from unmix_plugin.trained.run_materials import endmember_colours

SCALE = ColourScale("viridis", 0.0, 1.0, "abundance")


def decoded(data: bytes) -> np.ndarray:
    """A PNG as (H, W, 3) in [0, 1]."""
    with Image.open(io.BytesIO(data)) as picture:
        return np.asarray(picture.convert("RGB")) / 255


def assert_has_white_margins(data: bytes) -> None:
    """The outermost pixels are white: what was drawn ends before them."""
    picture = decoded(data)
    for edge in (picture[:4], picture[-4:], picture[:, :4], picture[:, -4:]):
        assert edge.min() == 1.0
    assert picture.min() < 0.2


def materials(count: int, num_bands: int = 8) -> Materials:
    spectra = torch.rand(count, num_bands, generator=torch.Generator().manual_seed(0))
    return Materials(Bands.of(np.linspace(400, 700, num_bands)), spectra, torch.zeros(0, num_bands))


def rendered(given: Materials, height: int = 12, width: int = 16) -> PredictedView:
    """Random abundances; nothing in the left quarter."""
    generator = torch.Generator().manual_seed(1)
    shares = torch.softmax(9 * torch.rand(height, width, len(given.endmembers), generator=generator), dim=-1)
    shares[:, : width // 4] = 0
    ids = shares.argmax(dim=-1).to(torch.uint8)
    ids[:, : width // 4] = 255
    return PredictedView(shares @ given.endmembers, shares.sum(dim=-1), shares, ids, shares)


@pytest.mark.parametrize("count", [1, 3, 26])
def test_no_figure_is_cut_off_however_many_materials(count, tmp_path):
    given = materials(count, 32)
    view = rendered(given)
    assert_has_white_margins(draw_abundances("view", view, given))
    assert_has_white_margins(draw_segmentation("view", view, given))
    write_endmembers(tmp_path, given, around_endmembers(given))
    plot = decoded((tmp_path / "endmembers.png").read_bytes())
    assert plot[:, -2:].min() == 1.0
    assert plot.min() < 0.2


@pytest.mark.parametrize(("height", "width"), [(4, 40), (40, 4), (1, 1), (700, 20)])
def test_pictures_of_any_shape_fit_their_page(height, width):
    panels = [TitledPicture(np.zeros((height, width, 3)), "a title that is rather long", (0.5, 0.5, 0.5))] * 3
    legend = [("a material with a long name indeed", (1.0, 0.0, 0.0))] * 7
    assert_has_white_margins(draw_panels(in_rows(panels, 2), "heading", SCALE, legend))


def test_a_sky_is_seen_rather_than_what_pictures_lie_on():
    given = materials(3)
    view = rendered(given)
    assert_close(view.coverage, view.accumulation)
    flat = colour_panel(view, given.bands).image
    np.testing.assert_allclose(flat[:, :4], NEUTRAL, atol=1e-6)
    world = colour_panel(replace(view, has_sky=True), given.bands).image
    np.testing.assert_allclose(world[:, :4], 0.0, atol=1e-6)
    np.testing.assert_allclose(world[:, 4:], flat[:, 4:], atol=1e-6)


def test_the_segmentation_figure_shows_the_colours_of_the_endmembers():
    given = materials(4)
    view = rendered(given)
    picture = decoded(draw_segmentation("view", view, given)).reshape(-1, 3)
    for index, colour in enumerate(endmember_colours(given)):
        near = np.abs(picture - colour).max(axis=1) < 0.02
        assert near.any() == bool((view.segmentation == index).any())


def test_scores_are_what_the_ids_were_chosen_by():
    given = materials(4)
    view = rendered(given)
    cosines = torch.rand(12, 16, 4)
    view = replace(view, material_scores=cosines)
    torch.testing.assert_close(segmentation_scores(view, given), view.abundances)
    probe = segmentation_scores(view, replace(given, segmentation="probe"))
    torch.testing.assert_close(probe[:, 4:], cosines[:, 4:])
    assert float(probe[:, :4].abs().max()) == 0.0


@pytest.mark.parametrize("num_true", [2, 3, 5])
def test_evaluation_figures_are_whole_with_more_as_many_and_fewer_materials(num_true):
    given = materials(3)
    view = rendered(given)
    truth = SceneTruth(given.bands, num_true, torch.rand(num_true, 8).double())
    labels = (view.segmentation % num_true).masked_fill(view.segmentation == 255, 255)
    abundances = torch.nn.functional.one_hot(labels.long() % num_true, num_true).float()
    valid = torch.ones(12, 16, dtype=torch.bool)
    seen = ViewTruth("view", view.spectra, valid, view.accumulation, labels, abundances)
    evaluation = Evaluation(truth, given.endmembers)
    evaluation.add(seen, view)
    look, matching = material_look(evaluation), evaluation.segmentation().matching
    assert_has_white_margins(draw_colour(seen, view, truth.bands, 30.0))
    assert_has_white_margins(draw_matched_abundances(seen, view, evaluation, look))
    ids = view.segmentation.numpy()
    assert_has_white_margins(draw_matched_segmentation("view", labels.numpy(), ids, look, matching))
    assert_has_white_margins(draw_matched_segmentation("view", None, ids, look, matching))


def test_an_error_is_drawn_only_where_pixels_count(monkeypatch):
    given = materials(3)
    view = rendered(given)
    valid = torch.ones(12, 16, dtype=torch.bool)
    valid[:, 8:] = False
    measured = ViewTruth("view", view.spectra * valid[..., None] * 0.5, valid)  # invalid pixels read as 0
    drawn = []
    monkeypatch.setattr(evaluation_module, "draw_panels", lambda rows, *_: drawn.extend(rows[0]) or b"")
    draw_colour(measured, view, given.bands, 30.0)
    error = next(panel.image for panel in drawn if panel.title == "error")
    np.testing.assert_allclose(error[:, 8:], NEUTRAL)
    assert np.ptp(error[:, 4:8]) > 0.1


def test_a_matched_endmember_has_the_colour_of_its_material_and_a_surplus_one_its_own():
    given = materials(3)
    evaluation = Evaluation(SceneTruth(given.bands, 2, torch.rand(2, 8).double()), given.endmembers)
    look = material_look(evaluation)
    ((first, second, third),) = look.predicted(np.array([[0, 1, 2]], dtype=np.uint8), {0: 1, 2: 0})
    np.testing.assert_array_equal(first, look.true_colours[1])
    np.testing.assert_array_equal(third, look.true_colours[0])
    assert min(np.abs(second - colour).max() for colour in look.true_colours) > 0.05
