"""Built-in objects: shapes, surfaces, and folders in colours and bands."""

import json

import numpy as np
import OpenEXR
import pytest
import torch
import trimesh
from torch.testing import assert_close

from tests.factories.surfaces import generator
from tools.procedural_objects import SHAPES, seeded_lights, seeded_mesh, seeded_surface
from unmix_plugin.neumatex.demo import objects
from unmix_plugin.neumatex.demo.objects import demo_object_path, viewpoints
from unmix_plugin.neumatex.demo.surfaces import SpectralSurface, demo_mesh, demo_surface
from unmix_plugin.neumatex.fit.object_scene import load_object
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.reading.loader import load_scene


@pytest.mark.parametrize("seed", range(len(SHAPES)))
def test_shapes_are_closed_and_face_outwards(seed):
    mesh = seeded_mesh(seed, resolution=32)
    solid = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    assert solid.is_watertight
    assert solid.volume > 0.1
    a, b, c = mesh.corners().unbind(dim=1)
    geometric = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    agreement = (geometric * mesh.normals[mesh.faces[:, 0].long()]).sum(dim=-1)
    assert (agreement > 0.5).float().mean() > 0.95
    assert_close(mesh.vertices.abs().max(), torch.tensor(1.0))
    assert_close(mesh.vertices.max(dim=0).values, -mesh.vertices.min(dim=0).values, atol=1e-5, rtol=0)


def test_a_seed_repeats_and_another_differs():
    first, again, other = (seeded_mesh(seed, resolution=24) for seed in (0, 0, len(SHAPES)))
    assert torch.equal(first.vertices, again.vertices)
    assert first.vertices.shape != other.vertices.shape
    assert torch.equal(first.vertices, demo_mesh(resolution=24).vertices)
    positions = 2 * torch.rand(5000, 3, generator=generator()) - 1
    first, again, other = (seeded_surface(seed).parameters(positions) for seed in (0, 0, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert demo_surface().kinds == seeded_surface(0).kinds
    assert torch.equal(demo_surface().parameters(positions), first)
    assert bool(((first >= 0) & (first <= 1)).all())
    assert bool((first[:, :3].std(dim=0) > 0.01).all())


SIZE = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder, said = tmp_path_factory.mktemp("demo") / "object", []
    objects.write_object(
        folder, seeded_mesh(3), seeded_surface(3), seeded_lights(3)[:2], SIZE, 9, 3, said.append
    )
    assert len(said) == 2
    return folder


def _read(path):
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return torch.from_numpy(np.stack([channels[name].pixels for name in "RGBA"], axis=-1))


def test_objects_are_well_exposed_and_whole(folder):
    content = json.loads((folder / "transforms.json").read_text())
    pictures = torch.stack([_read(folder / frame["file_path"]) for frame in content["frames"]])
    assert pictures.shape == (9, SIZE, SIZE, 4)
    covered = pictures[pictures[..., 3] == 1][:, :3]
    assert 0.15 < covered.mean() < 0.6
    border = torch.cat([pictures[:, 0], pictures[:, -1], pictures[:, :, 0], pictures[:, :, -1]], dim=1)
    assert border.abs().max() == 0
    truth = sorted((folder / "truth" / "base_colour").glob("[!.]*"))
    assert [path.name for path in truth] == ["000.exr", "008.exr"]  # of evaluation views
    colours = _read(truth[1])
    assert torch.equal(colours[..., 3], _read(folder / "images" / "008.exr")[..., 3])
    assert colours[..., :3].max() <= 1.0001
    assert colours[colours[..., 3] > 0][:, :3].std() > 0.01


@pytest.mark.parametrize("name", ["demo-object", "demo-spectral-object"])
def test_a_default_object_is_written_once(tmp_path, monkeypatch, name):
    quick = {"DEFAULT_SIZE": 16, "DEFAULT_VIEWS": 2, "DEFAULT_BANDS": 4, "demo_mesh": lambda: demo_mesh(24)}
    for what, value in {**quick, "_EVALUATION_SAMPLES": 4, "_SPECTRAL_EVALUATION_SAMPLES": 4}.items():
        monkeypatch.setattr(objects, what, value)
    for what in ("DEFAULT_LIGHTS", "DEFAULT_SPECTRAL_LIGHTS"):
        monkeypatch.setattr(objects, what, getattr(objects, what)[:1])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    said = []
    path, again = (demo_object_path(name, said.append) for _ in range(2))
    assert (again, len(said)) == (path, 1)
    assert (load_object(path).bands is None) is (name == "demo-object")
    next((path / "images").glob("[!.]*")).unlink()
    assert len(list((demo_object_path(name, said.append) / "images").glob("[!.]*"))) == 2


def test_cameras_look_at_the_object_from_all_sides():
    cameras = viewpoints(24, 64, 1.2)
    places = cameras.camera_to_world[:, :, 3]
    assert_close(places.norm(dim=-1), torch.full((24,), 4.2))
    assert places.mean(dim=0)[:2].norm() < 0.6
    assert places[:, 2].min() < -2 < 3 < places[:, 2].max()
    for index in range(24):
        pixels, depths = cameras.project(torch.zeros(1, 3), index)
        assert_close(pixels, torch.full((1, 2), 32.0), atol=1e-3, rtol=0)
        assert depths > 0
    assert not torch.allclose(viewpoints(3, 64, 1.2, first=50).camera_to_world, cameras[:3].camera_to_world)


@pytest.fixture(scope="module")
def spectral_folder(tmp_path_factory):
    folder, lights = tmp_path_factory.mktemp("demo") / "object", objects.DEFAULT_SPECTRAL_LIGHTS[:2]
    objects.write_spectral_object(folder, seeded_mesh(3), lights, SIZE, 9, 6, 3)
    return folder


@pytest.mark.parametrize("kind", ["colours", "bands"])
def test_pictures_can_be_rendered_again_from_the_files_under_both_lights(folder, spectral_folder, kind):
    """Mesh, light, poses and materials together explain a picture."""
    scene = load_object(folder if kind == "colours" else spectral_folder)
    surface = seeded_surface(3)
    if scene.bands is not None:
        surface = SpectralSurface(3, scene.bands.centers_nm, seeded_mesh(3).vertices)
    for light in (scene, scene.lights[0]):
        traced = TracedObject(RayMesh(scene.mesh), light.environment, surface)
        cameras, picture = light.pictures.cameras, light.pictures.read(0)
        radiance, alpha = traced.picture(cameras, 0, 160, bounces=2, generator=generator(5))
        found, seen = torch.from_numpy(picture.numbers), alpha == 1
        # Floats of a few rays that may just meet the mesh or not; or 8 bits.
        assert_close(
            torch.from_numpy(picture.opacity), alpha, atol=0.26 if kind == "colours" else 1 / 255, rtol=0
        )
        assert (torch.from_numpy(picture.opacity) - alpha).abs().mean() < 2e-3
        # Single pixels are noisy in both; their means over a few hundred are not.
        assert_close(found[seen].mean(dim=0), radiance[seen].mean(dim=0), rtol=0.03, atol=0)
        error = (found[seen] - radiance[seen]).abs().mean() / radiance[seen].mean()
        assert float(error) < (0.12 if kind == "colours" else 0.06)


def test_truth_fits_the_surface_and_every_material_covers_a_part(spectral_folder):
    scene = load_object(spectral_folder)
    truth, other = scene.true_materials, scene.lights[0].environment.image[0, 0]
    assert truth is not None
    assert scene.bands is not None
    assert scene.lamp is not None
    assert not np.allclose(scene.lamp, other / other.max())  # the lamp of held-out light is another
    shares = scene.truth(0)["true_abundances"]
    like_any_other = load_scene(spectral_folder)
    assert like_any_other.material_names == truth.names
    assert (len(like_any_other.frames), len(like_any_other.eval_indices)) == (9, 2)
    assert (like_any_other.has_alpha, like_any_other.has_abundances) == (True, True)
    np.testing.assert_allclose(shares.sum(axis=-1)[scene.pictures.read(0).opacity > 0.5], 1, atol=2e-3)
    assert scene.truth(1) == {}
    vertices = seeded_mesh(3).vertices
    surface = SpectralSurface(3, scene.bands.centers_nm, vertices)
    means = surface.parameters(vertices)[:, :4].mean(dim=0)
    assert_close(means, torch.full((4,), 0.25), atol=0.02, rtol=0)
    assert_close(surface.family.endmembers.double(), torch.from_numpy(truth.spectra), atol=1e-6, rtol=0)
