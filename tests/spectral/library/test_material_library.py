import math

import numpy as np
import pytest
from colour.characterisation import SDS_COLOURCHECKERS
from hypothesis import given, settings
from hypothesis import strategies as st

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import LibraryMaterial, MaterialLibrary, measured_library

VISIBLE = Bands.of(np.linspace(400, 700, 31))
NUM_MEASURED = 174


def small_library() -> MaterialLibrary:
    centers = np.array([400.0, 500.0, 600.0, 700.0])
    rows = {"a/flat": [0.5, 0.5, 0.5, 0.5], "a/red": [0.1, 0.1, 0.5, 0.9], "b/red": [0.1, 0.2, 0.3, 0.8]}
    made = (LibraryMaterial(name, Bands(centers), np.array(row), "made up") for name, row in rows.items())
    return MaterialLibrary(tuple(made))


def test_measured_reflectances_are_those_of_colour_science():
    library = measured_library()
    names = library.names
    assert len(names) == NUM_MEASURED
    assert all(name.rpartition("/")[2][0].isalpha() for name in names)
    assert not [name for name in names if "skin" in name or "smurf" in name.lower() or "Caucasian" in name]
    # The colours of numbered samples are those that they are known by: Davis and Ohno 2010, table 1.
    assert {"CQS/blue 10", "CQS/purple 13"} < set(names)
    carrot = SDS_COLOURCHECKERS["PMC"]["Carrot"]
    np.testing.assert_array_equal(library.reflectance("memory colours/carrot", VISIBLE), carrot.values)
    for material in library.materials:
        assert 0 <= material.reflectance.min() < material.reflectance.max() <= 1
        assert material.bands.centers_nm[0] >= 360
        assert material.bands.centers_nm[-1] <= 830
        if material.name.startswith(("CQS/", "CIE 224/")):  # flat ends that nobody measured are cut off
            assert not (np.diff(material.reflectance)[[0, -1]] == 0).any()


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
    radiance = light * library.reflectance("memory colours/banana", VISIBLE)
    assert library.nearest(radiance[None], VISIBLE, light)[0][0].name == "memory colours/banana"
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
    many = Bands.of(np.linspace(400, 700, 13))  # of which most are dark
    blue = np.where(many.centers_nm < 500, 1.0, 0.0)
    red = np.interp(many.centers_nm, bands.centers_nm[1:5], [0.1, 0.1, 0.5, 0.9])
    [match] = small_library().nearest((red * blue)[None], many, blue, count=1)[0]
    assert (match.name, match.num_bands) == ("a/flat", 4)  # as red is flat there
    assert small_library().comparable(many, np.where(many.centers_nm < 450, 1.0, 0.0)).tolist() == [False] * 3
    four = Bands.of([400, 500, 600, 700])
    for spectra, own in (  # that hardly overlap, or are black or not finite, resemble nothing
        (np.ones((1, 9)), Bands.of(np.arange(400, 1300, 100))),
        (np.ones((1, 2)), Bands.of([500, 600])),
        (np.zeros((1, 4)), four),
        (np.array([[0.1, math.nan, 0.2, 0.3]]), four),
    ):
        assert small_library().nearest(spectra, own) == [[]]


def test_a_comparison_of_absorptions_ignores_the_slope_also_of_materials_that_begin_at_0():
    wavelengths = np.linspace(400, 700, 31)
    dip = 1 - 0.5 * np.exp(-(((wavelengths - 550) / 20) ** 2))
    other = 1 - 0.5 * np.exp(-(((wavelengths - 500) / 20) ** 2))
    slope = np.linspace(0.2, 0.8, 31)
    made = {"dip": 0.8 * dip, "other": slope * other}
    both = MaterialLibrary(tuple(LibraryMaterial(name, VISIBLE, row, "") for name, row in made.items()))
    spectrum = (slope * dip)[None]
    assert both.nearest(spectrum, VISIBLE)[0][0].name == "other"
    assert both.nearest(spectrum, VISIBLE, comparison="continuum")[0][0].name == "dip"
    edge = LibraryMaterial("edge", VISIBLE, np.linspace(0, 0.8, 31) ** 2, "")
    half = edge.reflectance[None] / 2
    [match] = MaterialLibrary((edge,)).nearest(half, VISIBLE, comparison="continuum")[0]
    assert match.angle_rad == pytest.approx(0, abs=1e-6)


def test_a_material_is_found_by_its_full_or_its_short_name_in_any_case():
    library = small_library()
    assert library.find("A/Red").name == "a/red"
    assert library.find(" FLAT ").name == "a/flat"
    flat = tuple(LibraryMaterial(name, VISIBLE, np.ones(31), "") for name in ("Leaf", "leaf", "x/LEAF"))
    cases = MaterialLibrary(flat)
    assert [cases.find(name).name for name in ("Leaf", "leaf")] == ["Leaf", "leaf"]
    for where, name, said in (
        (library, "red", "'red' may be any of a/red, b/red; give the full name"),
        (cases, "LEAF", "'LEAF' may be any of Leaf, leaf; give the full name"),
        (measured_library(), "carot", "the library has no 'carot'; nearest: memory colours/carrot"),
        (library, "zzz", "it has 3 materials, among them a/flat"),
    ):
        with pytest.raises(SpectrumError, match=said):
            where.find(name)
    with pytest.raises(SpectrumError, match="different names; found 'Leaf' twice"):
        MaterialLibrary((flat[0],) * 2)


def test_where_a_material_was_not_measured_it_is_neither_compared_nor_made_up():
    values = np.array([0.1, 0.2, math.nan, 0.4, 0.5])
    holed = LibraryMaterial("holed", Bands.of([400, 500, 600, 700, 800]), values, "")
    library, bands = MaterialLibrary((holed,)), Bands.of([400, 450, 600, 750, 800])
    angles, counts = library.angles(np.array([[0.2, 0.3, 77.0, 0.9, 1.0]]), bands)
    assert (angles[0, 0], counts[0]) == (pytest.approx(0, abs=1e-7), 4)
    with pytest.raises(SpectrumError, match="holed was not measured at 600 nm"):
        library.reflectance("holed", bands)
    np.testing.assert_allclose(library.reflectance("holed", bands, "hold"), [0.1, 0.15, 0.3, 0.45, 0.5])
    wide = Bands.of([380, 500, 720])
    with pytest.raises(SpectrumError, match=r"a/red: .* 20 nm below and 20 nm above their range"):
        small_library().reflectance("a/red", wide)
    held = small_library().reflectance("a/red", wide, beyond="hold")
    np.testing.assert_array_equal(held, [0.1, 0.1, 0.9])
