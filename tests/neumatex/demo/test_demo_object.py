"""The folder of a built-in object: what is in it, and that its parts agree."""

import json

import numpy as np
import OpenEXR
import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.demo import demo_object as module
from unmix_plugin.neumatex.demo.demo_object import demo_object, demo_object_path
from unmix_plugin.neumatex.demo.layered_surface import LayeredSurface
from unmix_plugin.neumatex.demo.viewpoints import viewpoints
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.geometry.read_mesh import read_mesh
from unmix_plugin.neumatex.lighting.read_environment import read_environment
from unmix_plugin.neumatex.tracing.render_view import render_view

SIZE = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "object"
    said = []
    demo_object(folder, seed=3, size=SIZE, views=9, lights=1, say=said.append)
    assert len(said) == 2
    return folder


def _read(path):
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return torch.from_numpy(np.stack([channels[name].pixels for name in "RGBA"], axis=-1))


def _cameras(content):
    poses = torch.tensor([frame["transform_matrix"] for frame in content["frames"]])[:, :3]
    lens = [
        torch.tensor([[content[f"{what}_{axis}"] for axis in axes]] * len(poses))
        for what, axes in [("fl", "xy")]
    ]
    centres = torch.tensor([[content["cx"], content["cy"]]] * len(poses))
    return Cameras(poses, lens[0], centres, torch.zeros(len(poses), 4), content["w"], content["h"])


def test_pictures_can_be_rendered_again_from_the_files(folder):
    """Mesh, light, poses and materials together explain a picture, under both lights."""
    relit = next((folder / "relit").iterdir())
    rays = RayMesh(read_mesh(folder / "mesh.glb"))
    for part in (folder, relit):
        content = json.loads((part / "transforms.json").read_text())
        picture = _read(part / content["frames"][0]["file_path"])
        again, alpha = render_view(
            LayeredSurface(3),
            rays,
            read_environment(part / "environment.exr"),
            _cameras(content),
            0,
            samples=160,
            bounces=2,
            generator=torch.Generator().manual_seed(1),
        )
        assert_close(picture[..., 3], alpha, atol=0.26, rtol=0)
        assert (picture[..., 3] - alpha).abs().mean() < 2e-3
        inner = alpha == 1
        # Single pixels are noisy in both; their means over a few hundred are not.
        assert_close(picture[inner][:, :3].mean(dim=0), again[inner].mean(dim=0), rtol=0.03, atol=0)
        difference = (picture[..., :3] - again)[inner].abs().mean()
        assert difference < 0.12 * again[inner].mean()


def test_objects_are_well_exposed_and_whole(folder):
    content = json.loads((folder / "transforms.json").read_text())
    pictures = torch.stack([_read(folder / frame["file_path"]) for frame in content["frames"]])
    assert pictures.shape == (9, SIZE, SIZE, 4)
    covered = pictures[pictures[..., 3] == 1][:, :3]
    assert 0.15 < covered.mean() < 0.6
    border = torch.cat([pictures[:, 0], pictures[:, -1], pictures[:, :, 0], pictures[:, :, -1]], dim=1)
    assert border.abs().max() == 0


def test_base_colours_are_those_of_evaluation_views(folder):
    truth = sorted(path.name for path in (folder / "truth" / "base_colour").iterdir())
    assert truth == ["000.exr", "008.exr"]
    colours = _read(folder / "truth" / "base_colour" / "008.exr")
    assert torch.equal(colours[..., 3], _read(folder / "images" / "008.exr")[..., 3])
    assert colours[..., :3].max() <= 1.0001
    assert colours[colours[..., 3] > 0][:, :3].std() > 0.01


def test_a_folder_in_use_and_wrong_numbers_are_refused(folder):
    with pytest.raises(ConfigError, match="not empty"):
        demo_object(folder)
    with pytest.raises(ConfigError, match="--size of a demo object must be 16 to 1024; found 3"):
        demo_object(folder / "other", size=3)


def test_the_default_object_is_written_once(tmp_path, monkeypatch):
    for name, number in (("DEFAULT_SIZE", 16), ("DEFAULT_VIEWS", 2), ("DEFAULT_LIGHTS", 0)):
        monkeypatch.setattr(module, name, number)
    path = demo_object_path(tmp_path)
    written = (path / "images" / "001.exr").stat().st_mtime_ns
    assert demo_object_path(tmp_path) == path
    assert (path / "images" / "001.exr").stat().st_mtime_ns == written
    (path / "images" / "000.exr").unlink()
    assert (demo_object_path(tmp_path) / "images" / "000.exr").is_file()


def test_cameras_look_at_the_object_from_all_sides():
    cameras = viewpoints(24, 64, 1.2)
    places = cameras.camera_to_world[:, :, 3]
    assert_close(places.norm(dim=-1), torch.full((24,), 4.2))
    assert places.mean(dim=0)[:2].norm() < 0.6
    assert places[:, 2].min() < -2
    assert places[:, 2].max() > 3
    for index in range(24):
        pixels, depths = cameras.project(torch.zeros(1, 3), index)
        assert_close(pixels, torch.full((1, 2), 32.0), atol=1e-3, rtol=0)
        assert depths > 0
    assert not torch.allclose(viewpoints(3, 64, 1.2, first=50).camera_to_world, cameras[:3].camera_to_world)
