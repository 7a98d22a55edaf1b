"""The product of metamers: whose pairs are in the table, and swatches in the colours of the table."""

import csv
import io
from typing import Literal
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from PIL import Image

from unmix_plugin.errors import SpectrumError
from unmix_plugin.products.metamerism import (
    _find_metamers,
    _metamerism_paths,
    _write_metamerism,
    export_metamerism,
)
from unmix_plugin.products.product import Job
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, xyz_matrix
from unmix_plugin.spectral.colour.difference import lab_to_srgb, reflectance_to_lab
from unmix_plugin.spectral.library.material_library import LibraryMaterial, MaterialLibrary
from unmix_plugin.spectral.materials import Materials

BANDS = Bands.of(np.linspace(400, 700, 31))
SCENE_LIGHT = illuminant_power("D50", BANDS)
GREY = np.full(31, 0.4)
BOTH = ("all", ("D65", "A"), 2.0, 4.0)


def hidden(strength: float) -> np.ndarray:
    """A reflectance that D65 can't tell from the grey, but A can."""
    to_xyz = xyz_matrix(BANDS, torch.float64).numpy()
    in_day, in_lamp = ((illuminant_power(name, BANDS)[:, None] * to_xyz).T for name in ("D65", "A"))
    invisible = np.linalg.svd(in_day)[2][3:]
    added = (invisible @ in_lamp[0]) @ invisible
    return GREY + strength * added / np.abs(added).max()


def run_materials(*reflectances: np.ndarray, names: tuple[str, ...]) -> Materials:
    spectra = torch.tensor(np.stack(reflectances) * SCENE_LIGHT, dtype=torch.float32)
    return Materials(BANDS, spectra, torch.zeros(0, 31), names=names)


LIBRARY = MaterialLibrary(
    (
        LibraryMaterial("own/a", BANDS, hidden(0.35), "test"),
        LibraryMaterial("own/b", BANDS, GREY * 1.01, "test"),
    )
)


def with_grey(name: str, *wavelengths_nm: float) -> MaterialLibrary:
    """The library with a grey before it."""
    grey = LibraryMaterial(name, Bands.of(wavelengths_nm), np.full(len(wavelengths_nm), 0.4), "test")
    return MaterialLibrary((grey, *LIBRARY.materials))


MATERIALS = run_materials(GREY, hidden(0.25), names=("slate", "paint"))


def pairs_of(surfaces: Literal["run", "library", "all"]) -> list[set[str]]:
    found = _find_metamers(MATERIALS, SCENE_LIGHT, LIBRARY, surfaces, *BOTH[1:])
    return [{found.names[pair.first], found.names[pair.second]} for pair in found.pairs]


def test_pairs_are_of_the_run_or_of_the_library_or_of_both_with_the_runs_first():
    assert pairs_of("run") == [{"slate", "paint"}]
    assert pairs_of("library") == [{"own/a", "own/b"}]
    every = pairs_of("all")
    assert {"slate", "own/a"} in every
    assert {"slate", "paint"} in every
    assert every[-1] == {"own/a", "own/b"}


def test_materials_that_do_not_reach_all_bands_are_passed_over():
    longer = with_grey("own/short", 500, 600)
    found = _find_metamers(MATERIALS, SCENE_LIGHT, longer, *BOTH)
    assert "own/short" not in found.names


def test_bands_that_no_eye_sees_play_no_part():
    """Neither the lights nor the library reach 1000 nm."""
    wide = Bands.of(np.linspace(400, 1000, 61))
    spectra = torch.full((2, 61), 0.4)
    spectra[:, :31] = MATERIALS.endmembers
    light = np.concatenate([SCENE_LIGHT, np.ones(30)])
    library = with_grey("own/wide", 390, 790)
    found = _find_metamers(
        Materials(wide, spectra, torch.zeros(0, 61), names=MATERIALS.names), light, library, *BOTH
    )
    assert found.bands == Bands.of(np.linspace(400, 780, 39))
    assert {"slate", "own/wide"} <= set(found.names)
    assert {"slate", "paint"} in [{found.names[pair.first], found.names[pair.second]} for pair in found.pairs]
    infrared = Bands.of(np.linspace(800, 1000, 61))
    with pytest.raises(SpectrumError, match="no visible light"):
        _find_metamers(Materials(infrared, spectra, torch.zeros(0, 61)), None, library, *BOTH)


def test_a_library_of_the_visible_range_serves_a_run_that_goes_far_beyond(tmp_path):
    """Of which it covers less than half of the bands."""
    paints = tmp_path / "paints.csv"
    paints.write_text("wavelength,red,Red\n380,0.1,0.2\n580,0.3,0.2\n780,0.8,0.7\n")
    wide = Bands.of(np.linspace(400, 2500, 106))
    materials = Materials(wide, torch.full((1, 106), 0.4), torch.zeros(0, 106), names=("slate",))
    job = MagicMock(
        spec=Job, materials=materials, folder=tmp_path / "out", working=MagicMock(), say=MagicMock()
    )
    job.scene.light_power = None
    export_metamerism(job, *BOTH, [paints])
    assert job.say.call_args.args[0].startswith("0 pairs of 3 materials, seen in D65, A over 20 bands")


def test_the_table_names_materials_lights_and_differences(tmp_path):
    found = _find_metamers(MATERIALS, SCENE_LIGHT, LIBRARY, "run", *BOTH[1:])
    assert _write_metamerism(tmp_path / "new", found) == _metamerism_paths(tmp_path / "new")
    rows = list(csv.DictReader(io.StringIO((tmp_path / "new" / "metamerism.csv").read_text())))
    [row] = rows
    assert {row["first"], row["second"]} == {"slate", "paint"}
    assert (row["alike in"], row["different in"]) == ("D65", "A")
    assert float(row["CIEDE2000 in D65"]) < 0.05
    assert float(row["CIEDE2000 in A"]) > 4


def test_swatches_have_the_colours_that_an_adapted_eye_sees(tmp_path):
    found = _find_metamers(MATERIALS, SCENE_LIGHT, LIBRARY, "run", *BOTH[1:])
    _write_metamerism(tmp_path, found)
    with Image.open(tmp_path / "metamerism.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3) / 255
    for name in ("D65", "A"):
        lab = reflectance_to_lab(np.stack([GREY, hidden(0.25)]), illuminant_power(name, BANDS), BANDS)
        for colour in lab_to_srgb(lab):
            assert (np.abs(pixels - colour).max(axis=1) < 0.01).sum() > 500
    assert pixels.reshape(-1, 3)[0].min() == 1


@pytest.mark.parametrize("lights", [("D65", "A"), ("D65", "A", "FL2", "FL11", "E")])
def test_a_figure_without_pairs_is_drawn_all_the_same(tmp_path, lights):
    grey = run_materials(GREY, names=("slate",))
    found = _find_metamers(grey, None, MaterialLibrary(()), "all", lights, 2.0, 4.0)
    assert found.pairs == []
    _write_metamerism(tmp_path, found)
    with Image.open(tmp_path / "metamerism.png") as picture:
        assert np.asarray(picture.convert("L")).min() < 50
    assert len((tmp_path / "metamerism.csv").read_text().splitlines()) == 1
