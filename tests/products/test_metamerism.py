"""The product of metamers: whose pairs are in the table, and swatches in the colours of the table."""

import csv
import io
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from PIL import Image

from unmix_plugin.errors import SpectrumError
from unmix_plugin.products import metamerism
from unmix_plugin.products.metamerism import export, find_metamers
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Metamerism
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, xyz_matrix
from unmix_plugin.spectral.colour.difference import lab_to_srgb, reflectance_to_lab
from unmix_plugin.spectral.library.material_library import LibraryMaterial, MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.run_materials import LIGHT_UNKNOWN

BANDS = Bands.of(np.linspace(400, 700, 31))
SCENE_LIGHT = illuminant_power("D50", BANDS)
GREY = np.full(31, 0.4)
BOTH = ("D65", "A")


def hidden(strength: float) -> np.ndarray:
    """A reflectance that D65 can't tell from the grey, but A can."""
    to_xyz = xyz_matrix(BANDS, torch.float64).numpy()
    in_day, in_lamp = ((illuminant_power(name, BANDS)[:, None] * to_xyz).T for name in ("D65", "A"))
    invisible = np.linalg.svd(in_day)[2][3:]
    added = (invisible @ in_lamp[0]) @ invisible
    return GREY + strength * added / np.abs(added).max()


def run_materials(*reflectances: np.ndarray, names: tuple[str, ...]) -> Materials:
    spectra = torch.tensor(np.stack(reflectances) * SCENE_LIGHT, dtype=torch.float32)
    return Materials(BANDS, spectra, torch.zeros(0, 31), names=names, light=torch.tensor(SCENE_LIGHT).float())


OWN = {"own/a": hidden(0.35), "own/b": GREY * 1.01}
LIBRARY = MaterialLibrary(tuple(LibraryMaterial(name, BANDS, values, "test") for name, values in OWN.items()))


MATERIALS = run_materials(GREY, hidden(0.25), names=("slate", "paint"))


@pytest.fixture(autouse=True)
def known(monkeypatch):
    """Has every product know `LIBRARY`, or what a test puts in its place."""
    library = [LIBRARY]
    monkeypatch.setattr(metamerism, "library_of", lambda *_: library[0])
    return library


def pairs_of(materials=MATERIALS, **asked):
    found = find_metamers(materials, Metamerism(lights=BOTH, **asked))
    return [{found.names[pair.first], found.names[pair.second]} for pair in found.pairs]


def exported(folder, materials, lights=BOTH, **asked):
    job = MagicMock(spec=Job, materials=materials, folder=folder, working=MagicMock(), say=MagicMock())
    written = export(job, Metamerism(lights=lights, **asked))
    assert written == [folder / "metamerism.csv", folder / "metamerism.png"]
    job.claim.assert_called_once_with(written)
    return job


def test_pairs_are_of_the_run_or_of_the_library_or_of_both_with_the_runs_first():
    assert pairs_of(surfaces="run") == [{"slate", "paint"}]
    assert pairs_of(surfaces="library") == [{"own/a", "own/b"}]
    every = pairs_of(surfaces="all")
    assert {"slate", "own/a"} in every
    assert {"slate", "paint"} in every
    assert every[-1] == {"own/a", "own/b"}


@pytest.mark.parametrize(("surfaces", "is_said"), [("run", True), ("all", True), ("library", False)])
def test_surfaces_of_a_run_in_unknown_light_are_said_to_be_radiance(surfaces, is_said, tmp_path):
    for unknown in (replace(MATERIALS, light=None), replace(MATERIALS, is_light_assumed=True)):
        job = exported(tmp_path, unknown, surfaces=surfaces)
        assert (((LIGHT_UNKNOWN,),) in job.say.call_args_list) == is_said
    assert exported(tmp_path, MATERIALS, surfaces=surfaces).say.call_count == 1


def test_bands_that_no_eye_sees_play_no_part(known):
    """Neither the lights nor the library reach 1000 nm."""
    wide = Bands.of(np.linspace(400, 1000, 61))
    spectra = torch.full((2, 61), 0.4)
    spectra[:, :31] = MATERIALS.endmembers
    light = torch.tensor(np.concatenate([SCENE_LIGHT, np.ones(30)])).float()
    ends = {f"own/to {end}": Bands.of((390, end)) for end in (600, 790)}
    greys = (LibraryMaterial(name, bands, np.full(2, 0.4), "test") for name, bands in ends.items())
    known[0] = MaterialLibrary((*greys, *LIBRARY.materials))
    materials = Materials(wide, spectra, torch.zeros(0, 61), names=MATERIALS.names, light=light)
    found = find_metamers(materials, Metamerism(lights=BOTH))
    assert found.bands == Bands.of(np.linspace(400, 780, 39))
    assert "own/to 790" in found.names
    assert "own/to 600" not in found.names  # which does not reach all bands
    assert {"slate", "paint"} in pairs_of(materials)
    infrared = Bands.of(np.linspace(800, 1000, 61))
    with pytest.raises(SpectrumError, match="no visible light"):
        find_metamers(Materials(infrared, spectra, torch.zeros(0, 61)), Metamerism(lights=BOTH))


@pytest.mark.parametrize("dark", [0.0, 1e-5])
def test_bands_that_the_scenes_light_leaves_dark_play_no_part(dark):
    """There an endmember says nothing of the material that it is."""
    light = SCENE_LIGHT * np.where(np.arange(31) < 4, dark, 1.0)
    spectra = torch.tensor(np.stack([GREY, LIBRARY.materials[0].reflectance]) * light + 1e-4).float()
    lit = {"names": ("slate", "a"), "light": torch.tensor(light).float()}
    materials = Materials(BANDS, spectra, torch.zeros(0, 31), **lit)
    found = find_metamers(materials, Metamerism(lights=BOTH))
    assert found.bands == Bands.of(np.linspace(440, 700, 27))
    own, same = (found.reflectance[found.names.index(name)] for name in ("a", "own/a"))
    np.testing.assert_allclose(own, same, atol=0.01)


def test_a_library_of_the_visible_range_serves_a_run_that_goes_far_beyond(tmp_path, monkeypatch):
    """Of which it covers less than half of the bands."""
    monkeypatch.undo()
    paints = tmp_path / "paints.csv"
    paints.write_text("wavelength,red,Red\n380,0.1,0.2\n580,0.3,0.2\n780,0.8,0.7\n")
    wide = Bands.of(np.linspace(400, 2500, 106))
    materials = Materials(wide, torch.full((1, 106), 0.4), torch.zeros(0, 106), names=("slate",))
    job = exported(tmp_path / "out", materials, library=(paints,))
    assert job.say.call_args.args[0].startswith("0 pairs of 3 materials, seen in D65, A over 20 bands")


def test_a_library_in_percent_is_refused_unless_it_says_so(tmp_path, monkeypatch):
    monkeypatch.undo()
    paints = tmp_path / "paints.csv"
    rows = np.stack([BANDS.centers_nm, 100 * GREY, 100 * hidden(0.25)], axis=1)
    np.savetxt(paints, rows, delimiter=",", header="wavelength,a %,b (%)", comments="")
    assert pairs_of(library=(paints,), surfaces="library") == [{"a", "b"}]
    np.savetxt(paints, rows, delimiter=",", header="wavelength,a,b", comments="")
    with pytest.raises(SpectrumError, match=r"a .paints.csv. must be in reflectances, 1 for white; found 40"):
        pairs_of(library=(paints,), surfaces="library")


def test_the_table_names_what_differs_and_swatches_have_the_colours_that_an_adapted_eye_sees(tmp_path):
    exported(tmp_path, MATERIALS, surfaces="run")
    [row] = csv.DictReader(io.StringIO((tmp_path / "metamerism.csv").read_text()))
    assert {row["first"], row["second"]} == {"slate", "paint"}
    assert (row["alike in"], row["different in"]) == ("D65", "A")
    assert float(row["CIEDE2000 in D65"]) < 0.05
    assert float(row["CIEDE2000 in A"]) > 4
    with Image.open(tmp_path / "metamerism.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3) / 255
    for name in BOTH:
        lab = reflectance_to_lab(np.stack([GREY, hidden(0.25)]), illuminant_power(name, BANDS), BANDS)
        for colour in lab_to_srgb(lab):
            assert (np.abs(pixels - colour).max(axis=1) < 0.01).sum() > 500
    assert pixels.reshape(-1, 3)[0].min() == 1


@pytest.mark.parametrize("lights", [BOTH, ("D65", "A", "FL2", "FL11", "E")])
def test_a_figure_without_pairs_is_drawn_all_the_same(tmp_path, lights):
    exported(tmp_path, run_materials(GREY, names=("slate",)), lights, surfaces="run")
    with Image.open(tmp_path / "metamerism.png") as picture:
        assert np.asarray(picture.convert("L")).min() < 50
    assert len((tmp_path / "metamerism.csv").read_text().splitlines()) == 1
