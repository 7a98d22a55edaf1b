"""Cubes, abundances, segmentations and endmembers in other people's formats, read back with their readers."""

import csv
from dataclasses import replace
from typing import Any

import numpy as np
import OpenEXR
import pytest
import spectral.io.envi as envi
import torch
from PIL import Image

from tests.method_factory import make_scene
from tests.trained.camera_scenes import around
from unmix_plugin.products import abundances, cubes, segmentation
from unmix_plugin.products.endmembers import _endmember_paths, _write_endmembers
from unmix_plugin.products.spectrum import _facts, _ProbedPlace
from unmix_plugin.trained.evaluation import render_view
from unmix_plugin.trained.run_materials import endmember_colours

SCENE = make_scene()
MATERIALS = SCENE.materials
VIEW = render_view(SCENE, around()[0])
NAME = "view.0"


@pytest.fixture(scope="module")
def written_cubes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cubes")
    formats = ("envi", "exr", "npy")
    cubes._write_view(formats, folder, NAME, VIEW, MATERIALS)
    assert set(folder.iterdir()) == set(abundances.view_paths(formats, folder, NAME))
    return folder


def test_every_format_of_a_cube_holds_the_same_float32_spectra(written_cubes):
    expected = VIEW.spectra.numpy()
    assert expected.max() > 0.05
    from_envi: Any = envi.open(str(written_cubes / f"{NAME}.hdr"), str(written_cubes / f"{NAME}.img"))
    np.testing.assert_array_equal(from_envi.open_memmap(), expected)
    assert from_envi.bands.centers == [450.0, 500.0, 550.0, 600.0, 650.0]
    np.testing.assert_array_equal(np.load(written_cubes / f"{NAME}.npy"), expected)
    channels = OpenEXR.File(str(written_cubes / f"{NAME}.exr"), separate_channels=True).channels()
    for index, wavelength in enumerate((450, 500, 550, 600, 650)):
        np.testing.assert_array_equal(channels[f"S0.{wavelength},000000nm"].pixels, expected[..., index])
    np.testing.assert_array_equal(channels["A"].pixels, VIEW.accumulation.numpy())


def test_images_of_reflectance_are_called_so_and_hold_it_in_reflective_channels(tmp_path):
    flat = replace(MATERIALS, light=torch.ones(len(MATERIALS.bands)))
    cubes._write_view(("exr",), tmp_path, NAME, VIEW, flat)
    file = OpenEXR.File(str(tmp_path / f"{NAME}.exr"), separate_channels=True)
    assert file.header()["comments"] == f"{NAME}: reflectance on black, 1 = full scale"
    assert "emissiveUnits" not in file.header()
    np.testing.assert_array_equal(file.channels()["T.500,000000nm"].pixels, VIEW.spectra.numpy()[..., 1])


def test_every_format_of_abundances_holds_the_same_float32_shares_by_their_names(tmp_path):
    formats, named = ("npy", "png", "envi", "exr"), replace(MATERIALS, names=("oak, old", "v1.2", "löss"))
    abundances._write_view(formats, tmp_path, NAME, VIEW, named)
    assert set(tmp_path.iterdir()) == set(abundances.view_paths(formats, tmp_path, NAME))
    expected = VIEW.abundances.numpy()
    np.testing.assert_array_equal(np.load(tmp_path / f"{NAME}.npy"), expected)
    from_envi: Any = envi.open(str(tmp_path / f"{NAME}.hdr"), str(tmp_path / f"{NAME}.img"))
    np.testing.assert_array_equal(from_envi.open_memmap(), expected)
    channels = OpenEXR.File(str(tmp_path / f"{NAME}.exr"), separate_channels=True).channels()
    for index, name in enumerate(("oak, old", "v1_2", "löss")):
        np.testing.assert_array_equal(channels[f"abundances.{name}"].pixels, expected[..., index])
    alike = replace(MATERIALS, names=("v1.2", "v1_2", "V1.2"))
    abundances._write_view(["exr"], tmp_path, NAME, VIEW, alike)
    channels = OpenEXR.File(str(tmp_path / f"{NAME}.exr"), separate_channels=True).channels()
    for index, name in enumerate(("v1_2", "v1_2_1", "V1_2_2")):
        np.testing.assert_array_equal(channels[f"abundances.{name}"].pixels, expected[..., index])


def test_spectral_python_opens_the_endmembers_as_a_library(tmp_path):
    _write_endmembers(tmp_path, MATERIALS)
    assert sorted(tmp_path.iterdir()) == sorted(_endmember_paths(tmp_path))
    library: Any = envi.open(str(tmp_path / "endmembers.hdr"), str(tmp_path / "endmembers.sli"))
    assert library.names == list(MATERIALS.names)
    np.testing.assert_array_equal(library.spectra, SCENE.materials.endmembers.numpy())
    np.testing.assert_array_equal(library.bands.centers, MATERIALS.bands.centers_nm)


@pytest.mark.parametrize("method", ["abundances", "probe"])
def test_the_material_of_a_pixel_is_that_of_its_label(method):
    scene = replace(SCENE, materials=replace(MATERIALS, segmentation=method))
    camera = around()[0]
    ids = scene.look(camera)["segmentation"]
    for row, column in (ids < 255).nonzero()[::40].tolist():
        place = _ProbedPlace("", {}, scene.probe(camera, column, row), None, ())
        assert _facts(place, scene.materials)["material"] == MATERIALS.names[int(ids[row, column])]


def test_labels_are_ids_whose_palette_and_legend_name_the_materials(tmp_path):
    segmentation._write_view(tmp_path, NAME, VIEW, MATERIALS)
    with Image.open(segmentation._view_paths(tmp_path, NAME)[2]) as labels:
        ids, colours = np.asarray(labels), np.asarray(labels.convert("RGB"))
        assert labels.mode == "P"
    np.testing.assert_array_equal(ids, VIEW.segmentation.numpy())
    assert len(np.unique(ids)) > 2
    legend = segmentation._legend_bytes(MATERIALS).decode().splitlines()
    rows = {int(row["id"]): row for row in csv.DictReader(legend)}
    assert [rows[index]["name"] for index in (0, 1, 2, 255)] == [*MATERIALS.names, "nothing"]
    for index in np.unique(ids):
        expected = [int(rows[int(index)][name]) for name in ("red", "green", "blue")]
        assert (colours[ids == index] == expected).all()
    np.testing.assert_allclose(
        [int(rows[1][name]) for name in ("red", "green", "blue")],
        255 * endmember_colours(MATERIALS)[1],
        atol=0.5,
    )
