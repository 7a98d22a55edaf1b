"""The built-in spectral object: that its files explain its pictures, and that unmix-nerf can read it too."""

import json

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.demo import spectral_object as module
from unmix_plugin.neumatex.demo.shapes import demo_mesh
from unmix_plugin.neumatex.demo.spectral_object import demo_spectral_object, demo_spectral_object_path
from unmix_plugin.neumatex.demo.spectral_surface import SpectralSurface
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.scene.load_object import load_object
from unmix_plugin.neumatex.tracing.render_view import render_view
from unmix_plugin.scenes.reading.loader import load_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "object"
    said = []
    demo_spectral_object(folder, seed=3, size=20, views=9, bands=6, lights=1, say=said.append)
    assert len(said) == 2
    return folder


def test_pictures_can_be_rendered_again_from_the_files_under_both_lights(folder):
    scene = load_object(folder)
    mesh = demo_mesh(3)
    assert scene.bands is not None
    assert scene.lamp is not None
    surface = SpectralSurface(3, scene.bands.centers_nm, mesh.vertices)
    held_out = scene.lights[0]
    assert not np.allclose(
        scene.lamp, held_out.environment.image[0, 0] / held_out.environment.image[0, 0].max()
    )
    for pictures, light in ((scene.pictures, scene.environment), (held_out.pictures, held_out.environment)):
        generator = torch.Generator().manual_seed(5)
        radiance, alpha = render_view(
            surface, RayMesh(mesh), light, pictures.cameras, 0, samples=160, bounces=2, generator=generator
        )
        picture = pictures.read(0)
        assert picture.alpha is not None
        found, seen = torch.from_numpy(picture.numbers), alpha > 0.99
        assert_close(torch.from_numpy(picture.alpha), alpha, atol=1 / 255, rtol=0)
        error = (found[seen] - radiance[seen]).abs().mean() / radiance[seen].mean()
        assert float(error) < 0.06


def test_truth_fits_the_surface_and_every_material_covers_a_part(folder):
    scene = load_object(folder)
    truth = scene.true_materials
    assert truth is not None
    assert scene.bands is not None
    shares = truth.abundances(0)
    assert shares is not None
    alpha = scene.pictures.read(0).alpha
    assert alpha is not None
    np.testing.assert_allclose(shares.sum(axis=-1)[alpha > 0.5], 1, atol=2e-3)
    assert truth.abundances(1) is None
    vertices = demo_mesh(3).vertices
    surface = SpectralSurface(3, scene.bands.centers_nm, vertices)
    means = surface.parameters(vertices)[:, :4].mean(dim=0)
    assert_close(means, torch.full((4,), 0.25), atol=0.02, rtol=0)
    assert_close(surface.family.endmembers.double(), torch.from_numpy(truth.endmembers), atol=1e-6, rtol=0)


def test_it_is_a_spectral_scene_like_any_other(folder):
    scene = load_scene(folder)
    truth = load_object(folder).true_materials
    assert truth is not None
    assert scene.material_names == truth.names
    assert len(scene.eval_indices) == 2
    assert scene.has_alpha
    assert scene.has_abundances
    content = json.loads((folder / "transforms.json").read_text())
    assert len(content["frames"]) == 9


def test_impossible_numbers_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="--bands of a demo object must be 4 to 512; found 3"):
        demo_spectral_object(tmp_path / "object", bands=3)
    with pytest.raises(ConfigError, match="no environment 'clear-sy'"):
        demo_spectral_object(tmp_path / "object", size=16, views=2, light="clear-sy")


def test_the_default_object_is_written_once(tmp_path, monkeypatch):
    for name, number in {"SIZE": 16, "VIEWS": 2, "BANDS": 4, "LIGHTS": 0}.items():
        monkeypatch.setattr(module, f"DEFAULT_{name}", number)
    said = []
    folder = demo_spectral_object_path(tmp_path, said.append)
    assert demo_spectral_object_path(tmp_path, said.append) == folder
    assert len(said) == 1
    bands = load_object(folder).bands
    assert bands is not None
    assert len(bands) == 4
