"""Reading an object with spectral pictures, and one message for each thing that is wrong with its light."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from tests.neumatex.object_factory import write_object
from tests.neumatex.spectral_factory import (
    ENDMEMBERS,
    LAMP,
    WAVELENGTHS,
    write_cubes,
    write_spectral_object,
    write_table,
)
from unmix_plugin.errors import UnmixError
from unmix_plugin.neumatex.scene.load_object import load_object
from unmix_plugin.neumatex.scene.pixel_list import PixelList


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_spectral_object(tmp_path_factory.mktemp("object") / "ball")


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "ball"))


def change(folder: Path, **keys) -> None:
    path = folder / "transforms.json"
    content = {**json.loads(path.read_text()), **keys}
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def test_light_has_the_lamps_spectrum_here_and_where_it_is_held_out(made):
    scene = load_object(made)
    assert scene.bands is not None
    assert scene.bands.centers_nm.tolist() == WAVELENGTHS
    assert scene.lamp is not None
    assert_allclose(scene.lamp, LAMP)
    assert_allclose(scene.environment.image[0, 0], LAMP, rtol=1e-6)
    assert_allclose(scene.lights[0].environment.image[0, 0], 0.5 * LAMP, rtol=1e-6)


def test_a_held_out_light_may_have_its_own_lamp_and_an_option_replaces_the_objects(folder):
    write_table(folder / "relit" / "dim" / "lamp.csv", ("power",), LAMP[None, ::-1])
    change(folder / "relit" / "dim", illuminant_path="lamp.csv")
    assert_allclose(load_object(folder).lights[0].environment.image[0, 0], 0.5 * LAMP[::-1], rtol=1e-6)
    lamp = load_object(folder, "E").lamp
    assert lamp is not None
    assert_allclose(lamp, np.ones(5))


def test_true_materials_are_read(made):
    truth = load_object(made).true_materials
    assert truth is not None
    assert truth.names == ("blue", "red")
    assert_allclose(truth.endmembers, ENDMEMBERS)
    shares = truth.abundances(0)
    assert shares is not None
    assert shares[3, 12].tolist() == [1, 0]


def _store_integers(folder: Path) -> None:
    for path in (folder / "cubes").glob("*.npy"):
        np.save(path, np.rint(np.load(path) * 10000).astype(np.uint16))


def test_cubes_of_integers_are_divided_by_the_value_scale(made, folder):
    _store_integers(folder)
    change(folder, value_scale=10000.0)
    expected, found = (load_object(path).pictures.read(1).numbers for path in (made, folder))
    assert_allclose(found, expected, atol=1e-4)


def test_pixels_that_a_mask_leaves_out_are_not_trained_on(made, folder):
    scene = load_object(made)
    view = scene.split.train[0]
    width, height = scene.pictures.cameras.size(view)
    black = np.full((height, width), 255, np.uint8)
    black[:, : width // 2] = 0
    Image.fromarray(black).save(folder / "mask.png")
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    frames[view]["mask_path"] = "mask.png"
    change(folder, frames=frames)
    pixels, all_pixels = (PixelList.of(object_, 10**6, 0) for object_ in (load_object(folder), scene))
    masked = (all_pixels.views == 0) & (all_pixels.corners[:, 0] < width // 2)
    assert masked.any()
    assert len(pixels.views) == int((~masked).sum())


def _fewer_bands(folder: Path) -> None:
    for path in (folder / "relit" / "dim" / "cubes").glob("*.npy"):
        np.save(path, np.load(path)[..., :4])


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda folder: change(folder, illuminant_path=None), "light's spectrum is not known"),
        (lambda folder: change(folder, illuminant_path="none.csv"), "none.csv"),
        (lambda folder: change(folder, wavelengths=None), "no 'wavelengths' for pictures of 5 bands"),
        (lambda folder: change(folder, wavelengths=[450, 550]), "2 'wavelengths' for pictures of 5 bands"),
        (lambda folder: change(folder, wavelengths=[450, 500, 550, 600, 900]), "do not reach"),
        (lambda folder: change(folder, tone_mapping="srgb"), "expected linear light"),
        (lambda folder: _store_integers(folder), "holds uint16; expected floats, or 'value_scale'"),
        (lambda folder: change(folder, materials=["blue"]), "endmembers_path"),
        (_fewer_bands, "pictures of 4 bands, wavelengths of 5 bands"),
        (lambda folder: write_cubes(folder / "relit" / "dim", 2, 1.0, wavelengths=[1, 2]), "wavelengths"),
    ],
)
def test_light_that_is_not_known_in_every_band_is_refused(folder, spoil, expected):
    spoil(folder)
    with pytest.raises(UnmixError, match=expected):
        load_object(folder)


def test_a_lamp_is_not_for_pictures_in_colours(tmp_path):
    with pytest.raises(UnmixError, match="pictures have 3 colours; leave it out"):
        load_object(write_object(tmp_path / "ball"), "D65")
