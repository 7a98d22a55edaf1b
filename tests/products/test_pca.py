"""Principal components as colours: the directions of largest variance, in pictures and in the table."""

import csv
import io

import numpy as np
import pytest
import torch
from PIL import Image

from tests.method_factory import make_scene
from tests.trained.camera_scenes import around
from unmix_plugin.products.pca import _find_components, _painted, _survey_view, _table
from unmix_plugin.trained.evaluation import render_view

SCENE = make_scene()
CAMERA = around()[1]


def test_components_are_the_directions_of_largest_variance_of_all_views_together():
    generator = torch.Generator().manual_seed(0)
    axes = torch.linalg.qr(torch.randn(5, 5, generator=generator)).Q[:, :3]
    spectra = 1 + torch.randn(4000, 3, generator=generator) * torch.tensor([0.5, 0.2, 0.05]) @ axes.T
    components = _find_components([spectra[:1000], spectra[1000:]], "spectra")
    cosines = (components.colours.axes.T @ axes.double()).diagonal().numpy()
    np.testing.assert_allclose(np.abs(cosines), 1, atol=0.01)
    variances = np.array([0.25, 0.04, 0.0025])
    np.testing.assert_allclose(components.explained, variances / variances.sum(), atol=0.01)


def test_a_component_that_tells_nothing_is_black_rather_than_noise():
    shares = torch.softmax(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    components = _find_components([shares], "abundances")
    assert components.explained[1] > 0.01
    assert components.explained[2] < 1e-9
    assert components.colours(shares.double()).amax(dim=0)[1:].tolist() == [1, 0]
    for nothing in (torch.ones(10, 5), torch.zeros(0, 5)):
        assert _find_components([nothing], "spectra").explained == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("of", "first"), [("spectra", "450"), ("abundances", "endmember_0")])
def test_a_picture_shows_the_components_of_its_pixels_and_the_table_gives_them_back(of, first):
    components = _find_components([_survey_view(SCENE, CAMERA, of)], of)
    view = render_view(SCENE, CAMERA)
    values = (view.spectra if of == "spectra" else view.shares).double()
    with Image.open(io.BytesIO(_painted("view", view, components))) as picture:
        pixels = np.asarray(picture)
    opacity = view.accumulation.numpy()[..., None]
    assert (opacity > 0.5).sum() > 20
    expected = opacity * components.colours(values).numpy() + 0.92 * (1 - opacity)
    np.testing.assert_allclose(pixels, 255 * expected, atol=0.6)
    assert (pixels[opacity[..., 0] == 0] == 235).all()
    rows = list(csv.reader(io.StringIO(_table(components, SCENE.materials).decode())))
    body = {row[0]: [float(cell or 0) for cell in row[1:]] for row in rows[1:]}
    names = list(body)[:-3]
    assert names[0] == first
    table = np.array([body[name] for name in names])
    low, high = (np.array(body[f"value of {end}"][1:]) for end in (0, 1))
    by_hand = np.clip(((values.numpy() - table[:, 0]) @ table[:, 1:] - low) / (high - low), 0, 1)
    np.testing.assert_allclose(components.colours(values), by_hand, atol=1e-6)
    np.testing.assert_allclose(body["explained variance"][1:], components.explained, rtol=1e-8)
