import math

import numpy as np
import pytest
from colour.characterisation import SDS_COLOURCHECKERS
from colour.quality.datasets import SDS_TCS
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.envi import read_library_table
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import (
    LibraryMaterial,
    MaterialLibrary,
    _continuum_removed,
    measured_library,
)
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.trained.run_materials import library_with

VISIBLE = Bands.of(np.linspace(400, 700, 31))
NUM_MEASURED = 183 if "CIE 2024" in SDS_TCS else 182
"""Asian skin is in colour-science from 0.4.7 on."""


def small_library() -> MaterialLibrary:
    centers = np.array([400.0, 500.0, 600.0, 700.0])
    rows = {"a/flat": [0.5, 0.5, 0.5, 0.5], "a/red": [0.1, 0.1, 0.5, 0.9], "b/red": [0.1, 0.2, 0.3, 0.8]}
    return MaterialLibrary(
        tuple(LibraryMaterial(name, Bands(centers), np.array(row), "made up") for name, row in rows.items())
    )


def test_measured_reflectances_are_those_of_colour_science():
    library = measured_library()
    assert len(library.names) == NUM_MEASURED
    carrot = SDS_COLOURCHECKERS["PMC"]["Carrot"]
    np.testing.assert_array_equal(library.reflectance("pmc/Carrot", VISIBLE), carrot.values)
    for material in library.materials:
        assert 0 <= material.reflectance.min() < material.reflectance.max() <= 1
        assert material.bands.centers_nm[0] >= 360
        assert material.bands.centers_nm[-1] <= 830


def test_flat_ends_that_nobody_measured_are_cut_off():
    extended = [one for one in measured_library().materials if one.name.startswith(("cqs/", "cie2017/"))]
    assert len(extended) == 114
    for material in extended:
        values = material.reflectance
        assert values[0] != values[1], material.name
        assert values[-1] != values[-2], material.name


@settings(max_examples=25)
@given(st.integers(0, NUM_MEASURED - 1), st.floats(0.05, 20.0))
def test_a_material_finds_itself_at_any_brightness(index, gain):
    library = measured_library()
    material = library.materials[index]
    bands = Bands.of(material.bands.centers_nm[material.bands.centers_nm % 10 == 0])
    spectrum = gain * library.reflectance(material.name, bands)
    best = library.nearest(spectrum[None], bands)[0][0]
    assert best.angle_rad == pytest.approx(0, abs=1e-7)
    assert best.name == material.name


def test_radiance_is_compared_after_its_light_is_divided_out():
    library, light = measured_library(), np.linspace(0.1, 1.0, 31)
    radiance = light * library.reflectance("pmc/Banana", VISIBLE)
    assert library.nearest(radiance[None], VISIBLE, light)[0][0].name == "pmc/Banana"
    assert library.nearest(radiance[None], VISIBLE, light)[0][0].angle_rad < 1e-6
    assert library.nearest(radiance[None], VISIBLE)[0][0].angle_rad > 0.03


def test_matches_are_sorted_and_as_many_as_asked_for():
    spectra = np.array([[0.2, 0.2, 0.2, 0.2], [0.1, 0.1, 0.5, 0.9]])
    bands = Bands.of([400, 500, 600, 700])
    found = small_library().nearest(spectra, bands, count=2)
    assert [[match.name for match in row] for row in found] == [["a/flat", "b/red"], ["a/red", "b/red"]]
    flat, red = np.full(4, 0.5), np.array([0.1, 0.2, 0.3, 0.8])
    angle = math.acos(flat @ red / np.linalg.norm(flat) / np.linalg.norm(red))
    assert found[0][1].angle_rad == pytest.approx(angle, abs=1e-12)
    assert len(small_library().nearest(spectra, bands, count=9)[0]) == 3


def test_only_shared_lit_bands_are_compared_and_their_number_is_told():
    bands = Bands.of([300, 400, 500, 600, 700, 800])
    spectrum = np.array([9.0, 0.5, 0.5, 0.5, 0.5, 9.0])
    match = small_library().nearest(spectrum[None], bands)[0][0]
    assert (match.name, match.num_bands) == ("a/flat", 4)
    assert match.angle_rad == pytest.approx(0, abs=1e-7)
    dark = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    assert small_library().nearest(spectrum[None], bands, dark)[0][0].num_bands == 3


def test_materials_that_hardly_overlap_are_passed_over():
    assert small_library().nearest(np.ones((1, 9)), Bands.of(np.arange(400, 1300, 100)))[0] == []
    assert small_library().nearest(np.ones((1, 2)), Bands.of([500, 600]))[0] == []


def test_continuum_removal_leaves_the_absorptions_alone():
    wavelengths = np.linspace(400, 700, 31)
    slope = 0.2 + 0.6 * (wavelengths - 400) / 300
    dip = 1 - 0.5 * np.exp(-(((wavelengths - 550) / 20) ** 2))
    np.testing.assert_allclose(_continuum_removed((slope * dip)[None], wavelengths)[0], dip, atol=1e-6)


@given(st.lists(st.floats(0.01, 1.0), min_size=4, max_size=12))
def test_the_continuum_is_the_upper_convex_hull(values):
    spectrum, wavelengths = np.array(values), np.linspace(400, 700, len(values))
    removed = _continuum_removed(spectrum[None], wavelengths)[0]
    assert removed.max() <= 1 + 1e-12
    scaled = (wavelengths - 400) / 300
    below = np.stack([np.append(scaled, [0.0, 1.0]), np.append(spectrum, [-9.0, -9.0])], axis=1)
    equations = ConvexHull(below).equations
    upper = equations[equations[:, 1] > 1e-9]
    continuum = np.min([(-offset - a * scaled) / b for a, b, offset in upper], axis=0)
    np.testing.assert_allclose(spectrum / removed, continuum, rtol=1e-6)


def test_a_comparison_of_absorptions_ignores_the_slope():
    wavelengths = np.linspace(400, 700, 31)
    dip = 1 - 0.5 * np.exp(-(((wavelengths - 550) / 20) ** 2))
    other = 1 - 0.5 * np.exp(-(((wavelengths - 500) / 20) ** 2))
    slope = np.linspace(0.2, 0.8, 31)
    materials = (
        LibraryMaterial("dip", VISIBLE, 0.8 * dip, ""),
        LibraryMaterial("other", VISIBLE, slope * other, ""),
    )
    spectrum = (slope * dip)[None]
    assert MaterialLibrary(materials).nearest(spectrum, VISIBLE)[0][0].name == "other"
    assert MaterialLibrary(materials).nearest(spectrum, VISIBLE, comparison="continuum")[0][0].name == "dip"


def test_a_material_is_found_by_its_full_or_its_short_name_in_any_case():
    library = small_library()
    assert library.find("A/Red").name == "a/red"
    assert library.find(" FLAT ").name == "a/flat"
    with pytest.raises(SpectrumError, match="'red' may be any of a/red, b/red; give the full name"):
        library.find("red")


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(SpectrumError, match="the library has no 'carot'; nearest: pmc/Carrot"):
        measured_library().find("carot")
    with pytest.raises(SpectrumError, match="it has 3 materials, among them a/flat"):
        small_library().find("zzz")


def test_nothing_is_extrapolated_unless_asked_for():
    library, wide = small_library(), Bands.of([380, 500, 720])
    with pytest.raises(SpectrumError, match=r"a/red: .* 20 nm below and 20 nm above their range"):
        library.reflectance("a/red", wide)
    np.testing.assert_array_equal(library.reflectance("a/red", wide, beyond="hold"), [0.1, 0.1, 0.9])


def test_own_reflectances_come_first_and_hide_those_of_the_same_name():
    own = SpectraTable(
        Bands.of([400, 500, 700]), ("a/red", "leaf"), np.array([[0.9, 0.1, 0.1], [0.1, 0.5, 0.1]])
    )
    library = small_library().extended(own, "mine.csv")
    assert library.names == ("a/red", "leaf", "a/flat", "b/red")
    assert library.find("a/red").source == "mine.csv"
    with pytest.raises(SpectrumError, match="different names; found 'x' twice"):
        MaterialLibrary((LibraryMaterial("x", VISIBLE, np.ones(31), ""),) * 2)


def test_own_files_extend_the_measured_library(tmp_path):
    table = SpectraTable(Bands.of([400, 550, 700]), ("moss",), np.array([[0.05, 0.3, 0.1]]))
    write_spectra_csv(tmp_path / "mine.csv", table)
    library = library_with([tmp_path / "mine.csv"])
    assert len(library.names) == NUM_MEASURED + 1
    assert library.find("moss").source == "mine.csv"
    with pytest.raises(SpectrumError, match=r"a library is a \.csv, or an ENVI spectral library"):
        read_library_table(tmp_path / "mine.txt")
