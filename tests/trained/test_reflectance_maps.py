"""Outputs made of reflectance: indices and targets in a render."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.method_factory import CAMERA, WAVELENGTHS_NM, make_scene
from unmix_plugin.editing.apply import relight
from unmix_plugin.editing.recipe import Light
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import seen_reflectance
from unmix_plugin.trained.reflectance_maps import parse_reflectance_map

LIGHT = [0.5, 0.8, 1.0, 0.9, 0.6]
INDEX = "index:(r650-r500)/(r650+r500)"


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    """A file of one reflectance."""
    path = tmp_path_factory.mktemp("targets") / "paint.csv"
    rows = [f"{nm},{0.1 + 0.15 * index}" for index, nm in enumerate(WAVELENGTHS_NM)]
    path.write_text("wavelength,paint\n" + "\n".join(rows) + "\n")
    return path


def test_reflectance_is_what_is_seen_over_the_light_and_nan_where_hardly_anything_is():
    spectra = torch.tensor([[0.2, 0.4], [0.1, 0.2], [0.1, 0.2]])
    opacity = torch.tensor([1.0, 0.5, 0.4])
    found = seen_reflectance(spectra, opacity, torch.tensor([0.5, 1.0]), 0.5)
    assert_close(found[:2], torch.tensor([[0.4, 0.4], [0.4, 0.4]]))
    assert found[2].isnan().all()


def test_where_the_light_is_unknown_radiance_stands_for_reflectance():
    spectra = torch.tensor([[0.2, 0.4]])
    assert_close(seen_reflectance(spectra, torch.ones(1), None, 0.5), spectra)


def test_a_band_that_the_light_leaves_dark_has_no_reflectance():
    found = seen_reflectance(torch.tensor([[0.0, 0.4]]), torch.ones(1), torch.tensor([0.0, 1.0]), 0.5)
    assert found[0].isnan().tolist() == [True, False]


def test_an_index_of_a_view_is_that_of_its_reflectance():
    scene = make_scene(light=LIGHT)
    view = scene.look(CAMERA)
    found = scene.render(CAMERA, [INDEX])[INDEX]
    seen = seen_reflectance(view.spectra, view.opacity, scene.light, 0.5)
    at_500, at_650 = (seen[..., WAVELENGTHS_NM.index(nm)] for nm in (500, 650))
    assert found.isfinite().sum() > 20
    assert_close(found, (at_650 - at_500) / (at_650 + at_500), equal_nan=True)
    assert (found.isnan() == (view.opacity < 0.5)).all()


@pytest.mark.parametrize("method", ["angle", "mf", "ace"])
def test_outputs_of_reflectance_do_not_change_with_the_light(target, method):
    """ACE divides by covariances of almost nothing: what rounding leaves there is a thousandth."""
    scene = make_scene(light=LIGHT)
    lit = relight(scene, Light("A"))
    assert lit.light is not None
    assert not np.allclose(lit.light, LIGHT)
    for name in (INDEX, f"target:{method}:{target}"):
        before, after = (one.render(CAMERA, [name])[name] for one in (scene, lit))
        assert before.isfinite().any()
        assert_close(after, before, equal_nan=True, atol=1e-3, rtol=1e-3)


def test_a_target_threshold_gives_zeros_and_ones(target):
    scene = make_scene(light=LIGHT)
    angles = scene.render(CAMERA, [f"target:{target}"])[f"target:{target}"]
    limit = round(float(angles.nanmedian()), 4)
    passed = f"target:{target}<{limit}"
    found = scene.render(CAMERA, [passed])[passed]
    assert_close(found, torch.where(angles.isnan(), torch.nan, (angles < limit).float()), equal_nan=True)
    assert 0 < found.nanmean() < 1


def test_what_a_map_is_names_the_index_or_the_target(target):
    bands = Bands.of(WAVELENGTHS_NM)
    assert "r650" in parse_reflectance_map(INDEX, bands).what
    assert "paint" in parse_reflectance_map(f"target:ace:{target}", bands).what
