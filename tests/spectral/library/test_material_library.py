import contextlib
import math
import time

import numpy as np
import pytest
from colour.characterisation import SDS_COLOURCHECKERS
from colour.quality.datasets import SDS_TCS
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from spectral.io.envi import SpectralLibrary

from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.envi import read_library_table
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import (
    LibraryMaterial,
    MaterialLibrary,
    continuum_removed,
    measured_library,
)
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.trained.library_matches import library_with

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
    np.testing.assert_allclose(continuum_removed((slope * dip)[None], wavelengths)[0], dip, atol=1e-6)


@given(st.lists(st.floats(0.01, 1.0), min_size=4, max_size=12))
def test_the_continuum_is_the_upper_convex_hull(values):
    spectrum, wavelengths = np.array(values), np.linspace(400, 700, len(values))
    removed = continuum_removed(spectrum[None], wavelengths)[0]
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


def written_by_spectral(folder, **changed):
    """A library of two spectra in three bands, written by Spectral Python; then lines of its header replaced."""
    values = np.array([[0.1, 0.25, 0.5], [0.3, 0.2, 0.7]], dtype=np.float32)
    header = {
        "wavelength": [400.5, 500, 700],
        "wavelength units": "Nanometers",
        "spectra names": ["oak", "fir tree"],
    }
    SpectralLibrary(values, header).save(str(folder / "trees"))
    path = folder / "trees.hdr"
    lines = path.read_text().splitlines()
    for key, value in changed.items():
        name = key.replace("_", " ")
        lines = [line for line in lines if not line.startswith(name)] + (
            [] if value is None else [f"{name} = {value}"]
        )
    path.write_text("\n".join(lines))
    return path, values


@pytest.mark.parametrize("suffix", [".hdr", ".sli"])
def test_libraries_that_spectral_python_wrote_are_read_exactly(tmp_path, suffix):
    path, values = written_by_spectral(tmp_path)
    table = read_library_table(path.with_suffix(suffix))
    assert table.names == ("oak", "fir tree")
    np.testing.assert_array_equal(table.bands.centers_nm, [400.5, 500, 700])
    np.testing.assert_array_equal(table.spectra, values.astype(np.float64))


def test_envi_scale_units_and_byte_order_are_followed(tmp_path):
    changed = {"wavelength": "{ 0.4, 0.5,\n 0.7 }", "wavelength_units": "Micrometers", "byte_order": 1}
    path, values = written_by_spectral(tmp_path, **changed, reflectance_scale_factor=100)
    path.with_suffix(".sli").write_bytes((100 * values).astype(">f4").tobytes())
    table = read_library_table(path)
    np.testing.assert_allclose(table.bands.centers_nm, [400, 500, 700])
    np.testing.assert_allclose(table.spectra, values, rtol=1e-6)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"wavelength": None}, "'wavelength' is missing or no list of numbers"),
        ({"wavelength": "{400, 500}"}, "'wavelength' has 2 values for 3 bands"),
        ({"wavelength_units": "Wavenumber"}, "'wavelength units' is 'Wavenumber'"),
        ({"data_type": 6}, "'data type' is 6, complex"),
        ({"lines": 20}, "has 24 bytes; 20 spectra of 3 values need 240"),
        ({"lines": "two"}, "'lines' is two; expected a whole number"),
        ({"lines": -1}, "'lines' is -1; expected a whole number of at least 1"),
        ({"lines": "inf"}, "'lines' is inf; expected a whole number"),
        ({"samples": "1e400"}, "'samples' is 1e400; expected a whole number"),
        ({"header_offset": "nan"}, "'header offset' is nan; expected a whole number"),
        ({"reflectance_scale_factor": 0}, "'reflectance scale factor' is 0"),
        ({"wavelength": "{0.4, 0.5, 0.7}"}, "look like micrometres"),
        ({"spectra_names": "{oak}"}, "1 'spectra names' for 2 spectra"),
        ({"data_ignore_value": 0.25}, "must be finite; found nan in 'oak' at 500 nm"),
    ],
)
def test_a_spoilt_envi_library_is_refused_with_its_name_and_the_fault(tmp_path, changed, said):
    path, _ = written_by_spectral(tmp_path, **changed)
    with pytest.raises(SpectrumError, match=said) as caught:
        read_library_table(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "filling",
    [
        *(" " * 200_000 + "\n", "\n" * 200_000, "a" * 200_000, "=" * 200_000, "{\n" * 100_000),
        *("\n" + " " * 200_000 + "x\n", "\na =" + "\n" * 200_000, "\n" + "description = {{}\n" * 20_000),
    ],
)
def test_a_long_envi_header_takes_time_in_proportion(tmp_path, filling):
    path, _ = written_by_spectral(tmp_path)
    path.write_text(path.read_text() + filling)
    started = time.process_time()
    with contextlib.suppress(SpectrumError):
        read_library_table(path)
    assert time.process_time() - started < 2.0


def test_missing_parts_of_an_envi_library_are_named(tmp_path):
    path, _ = written_by_spectral(tmp_path)
    path.with_suffix(".sli").unlink()
    with pytest.raises(SpectrumError, match=r"no file of numbers beside this header; expected trees\.sli"):
        read_library_table(path)
    with pytest.raises(SpectrumError, match=r"none\.hdr: can't read"):
        read_library_table(tmp_path / "none.sli")
    path.write_text("something else")
    with pytest.raises(SpectrumError, match="its first line is not 'ENVI'"):
        read_library_table(path)
