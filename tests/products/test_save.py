"""One output of a view as a file: the same numbers, and words where it can't be."""

from dataclasses import replace
from typing import Any

import numpy as np
import OpenEXR
import pytest
import spectral.io.envi as envi
import torch
from PIL import Image

from tests.factories.models import make_scene, with_a_sky
from tests.factories.renders import read_exr
from unmix_plugin import save
from unmix_plugin.errors import ConfigError, RunError


@pytest.fixture(scope="module")
def view():
    scene = make_scene()
    return scene.look(scene.views[0].camera)


@pytest.mark.parametrize("name", ["rgb", "abundances", "segmentation", "depth", "pca", "band:550nm"])
def test_png_is_a_picture_of_the_views_size_or_of_tiles_of_it(view, tmp_path, name):
    with Image.open(save(view, name, tmp_path / "picture.png")) as picture:
        width, height = picture.size
    assert (width, height) >= (view.camera.width, view.camera.height)
    assert name == "abundances" or (width, height) == (view.camera.width, view.camera.height)


def test_pixels_of_a_world_with_a_sky_are_opaque_where_they_show_light(view, tmp_path):
    world = replace(view, scene=replace(view.scene, field=with_a_sky(view.scene.field)))
    with Image.open(save(world, "rgb", tmp_path / "world.png")) as picture:
        pixels = np.asarray(picture) / 255
    assert (pixels[..., 3] == 1).all()
    np.testing.assert_allclose(pixels[..., :3], view["rgb"].numpy(), atol=0.51 / 255)
    for name in ("rgb", "abundances"):
        with Image.open(save(view if name == "rgb" else world, name, tmp_path / "table.png")) as picture:
            assert np.asarray(picture)[..., 3].min() < 255


def test_every_suffix_holds_the_numbers_of_the_view_and_a_file_that_is_there_is_replaced(view, tmp_path):
    save(view, "depth", tmp_path / "cube.npy")
    np.testing.assert_array_equal(np.load(save(view, "spectral", tmp_path / "cube.npy")), view["spectral"])
    image: Any = envi.open(save(view, "spectral", str(tmp_path / "some.cube.hdr")))
    np.testing.assert_array_equal(np.array(image.open_memmap()), view["spectral"].numpy())
    np.testing.assert_allclose(image.bands.centers, view.scene.bands.centers_nm)
    channels = read_exr(save(view, "linear_rgb", tmp_path / "picture.exr"))
    np.testing.assert_array_equal(np.stack([channels[name] for name in "RGB"], axis=-1), view["linear_rgb"])
    (tmp_path / "file").touch()
    with pytest.raises(RunError):
        save(view, "depth", tmp_path / "file" / "depth.npy")


def test_names_of_materials_are_layers_and_bands_and_reflectance_is_called_so(view, tmp_path):
    def of(**changed):
        return replace(view, scene=replace(view.scene, materials=replace(view.scene.materials, **changed)))

    named = of(names=("oak, old", "v1.2", "V1_2"))
    channels = read_exr(save(named, "abundances", tmp_path / "shares.exr"))
    for index, name in enumerate(("oak, old", "v1_2", "V1_2_1")):
        np.testing.assert_array_equal(channels[f"abundances.{name}"], view["abundances"][..., index])
    image: Any = envi.open(save(named, "abundances", tmp_path / "shares.hdr"))
    assert image.metadata["band names"] == ["oak- old", "v1.2", "V1_2"]
    flat = save(of(light=torch.ones(len(view.scene.bands))), "spectral", tmp_path / "flat.exr")
    np.testing.assert_array_equal(read_exr(flat)["T.500,000000nm"], view["spectral"][..., 1])
    header = OpenEXR.File(str(flat)).header()
    assert header["comments"] == "spectral: reflectance on black, 1 = full scale"
    assert "emissiveUnits" not in header


@pytest.mark.parametrize(
    ("name", "file", "message"),
    [
        ("rgb", "view.jpg", r"the suffix '.jpg' says no format; give one of .npy, .png, .exr, .hdr"),
        ("rgb", "view.exr", "ask for linear_rgb"),
        ("spectral", "view.png", "a PNG shows colours"),
        ("rbg", "view.png", "there is no output named 'rbg'"),
    ],
)
def test_what_cannot_be_written_is_said(view, tmp_path, name, file, message):
    with pytest.raises(ConfigError, match=message):
        save(view, name, tmp_path / file)
    assert list(tmp_path.iterdir()) == []
