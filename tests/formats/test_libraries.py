"""Files of known spectra: tables, ENVI libraries, texts of ECOSTRESS and USGS."""

from pathlib import Path

import numpy as np
import pytest
import spectral.io.envi as envi
from spectral.database.ecostress import read_ecostress_file
from spectral.database.usgs import SampleData

from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.libraries import library_of, read_library
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import measured_library

NAN = np.nan


def spectra_of(path):
    """Names, wavelengths and values of each spectrum."""
    return [(one.name, one.bands.centers_nm.tolist(), one.reflectance.tolist()) for one in read_library(path)]


def written(folder, name, text):
    (folder / name).write_text(text)
    return folder / name


def written_by_spectral(folder, **changed):
    """A library of two spectra in three bands, written by Spectral Python; then lines of its header replaced."""
    values = np.array([[0.1, 0.25, 0.5], [0.3, 0.2, 0.7]], dtype=np.float32)
    header = {"wavelength": [400.5, 500, 700], "wavelength units": "Nanometers"}
    header |= {"spectra names": ["oak", "fir tree"]}
    envi.SpectralLibrary(values, header).save(str(folder / "trees"))
    path = folder / "trees.hdr"
    lines = path.read_text().splitlines()
    for key, value in changed.items():
        name = key.replace("_", " ")
        lines = [line for line in lines if not line.startswith(name)]
        lines += [] if value is None else [f"{name} = {value}"]
    path.write_text("\n".join(lines))
    return path, values


def test_libraries_of_spectral_python_are_read_exactly_with_their_scale_units_and_byte_order(tmp_path):
    path, values = written_by_spectral(tmp_path)
    for suffix in (".hdr", ".sli"):
        found = read_library(path.with_suffix(suffix))
        assert [one.name for one in found] == ["oak", "fir tree"]
        np.testing.assert_array_equal(found[0].bands.centers_nm, [400.5, 500, 700])
        np.testing.assert_array_equal([one.reflectance for one in found], values.astype(np.float64))
    changed = {"wavelength": "{ 0.4, 0.5,\n 0.7 }", "wavelength_units": "Micrometers", "byte_order": 1}
    path, values = written_by_spectral(tmp_path, **changed, reflectance_scale_factor=100)
    path.with_suffix(".sli").write_bytes((100 * values).astype(">f4").tobytes())
    found = read_library(path)
    np.testing.assert_allclose(found[0].bands.centers_nm, [400, 500, 700])
    np.testing.assert_allclose([one.reflectance for one in found], values, rtol=1e-6)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"wavelength": None}, "'wavelength' is missing or no list of numbers"),
        ({"wavelength": "{400, 500}"}, "'wavelength' has 2 values for 3 bands"),
        ({"wavelength_units": "Wavenumber"}, "'wavelength units' is 'Wavenumber'"),
        ({"lines": 20}, "has 24 bytes; 20 spectra of 3 values need 240"),
        ({"lines": 1, "spectra_names": "{oak}"}, "has 24 bytes; 1 spectra of 3 values need 12"),
        ({"data_type": 2}, "has 24 bytes; 2 spectra of 3 values need 12"),
        ({"lines": "two"}, "'lines' is two; expected a whole number"),
        (
            {"lines": "2\nreflectance scale factor: 10000"},
            "line 'reflectance scale factor: 10000' has no '='",
        ),
        ({"reflectance_scale_factor": 0}, "'reflectance scale factor' is 0"),
        ({"wavelength": "{0.4, 0.5, 0.7}"}, "look like micrometres"),
        ({"spectra_names": "{oak}"}, "1 'spectra names' for 2 spectra"),
    ],
)
def test_a_spoilt_envi_library_is_refused_with_its_name_and_the_fault(tmp_path, changed, said):
    path, _ = written_by_spectral(tmp_path, **changed)
    with pytest.raises(SpectrumError, match=said) as caught:
        read_library(path)
    assert str(path) in str(caught.value)


def test_missing_parts_of_an_envi_library_are_named(tmp_path):
    path, _ = written_by_spectral(tmp_path)
    path.with_suffix(".sli").unlink()
    with pytest.raises(SpectrumError, match=r"no file of numbers beside this header; expected trees\.sli"):
        read_library(path)
    with pytest.raises(SpectrumError, match=r"no header beside it; expected none\.hdr or none\.sli\.hdr"):
        read_library(tmp_path / "none.sli")
    path.write_text("something else")
    with pytest.raises(SpectrumError, match="its first line is not 'ENVI'"):
        read_library(path)


@pytest.mark.parametrize("header", ["trees.sli.hdr", "trees.HDR"])
def test_the_header_of_a_library_is_found_as_that_of_a_cube_is(tmp_path, header):
    path, spectra = written_by_spectral(tmp_path)
    path.rename(tmp_path / header)
    for named in (tmp_path / header, path.with_suffix(".sli")):
        found = np.array([one.reflectance for one in read_library(named)])
        np.testing.assert_allclose(found, spectra, rtol=1e-6)


@pytest.mark.parametrize(
    "stated", ["y units = Reflectance (percent)", "z plot titles = {Wavelength, Reflectance (%)}"]
)
def test_a_library_in_percent_by_its_header_is_divided_by_100(tmp_path, stated):
    path, spectra = written_by_spectral(tmp_path)
    plain = path.read_text()
    path.write_text(f"{plain}\n{stated}\n")
    np.testing.assert_allclose([one.reflectance for one in read_library(path)], spectra / 100, rtol=1e-6)
    path.write_text(f"{plain}\n{stated}\nreflectance scale factor = 10000\n")
    np.testing.assert_allclose([one.reflectance for one in read_library(path)], spectra / 10_000, rtol=1e-6)


def test_names_with_commas_stand_in_quotes_and_no_unit_is_nm(tmp_path):
    path, _ = written_by_spectral(tmp_path, spectra_names='{"oak, dry", birch}', wavelength_units="Unknown")
    assert [one.name for one in read_library(path)] == ["oak, dry", "birch"]
    with pytest.raises(SpectrumError, match="3 'spectra names' for 2 spectra; names with commas need quotes"):
        read_library(written_by_spectral(tmp_path, spectra_names="{oak, dry, birch}")[0])


def test_a_table_may_be_in_micrometres_percent_and_any_order_with_marks_for_what_is_missing(tmp_path):
    rows = "0.7,40,-1.23e34\n0.5,20,0.1\n0.6,30,-999\n0.4,-0.1,0.3\n0.8,nan,0.2\n"
    path = written(tmp_path, "mine.csv", f"Wavelength (um),clay (%),ash\n{rows}")
    (clay, ash) = read_library(path)
    assert (clay.name, clay.source, ash.origin) == ("clay", "mine.csv", (path, "ash"))
    np.testing.assert_allclose(clay.bands.centers_nm, [400, 500, 600, 700])
    np.testing.assert_allclose(clay.reflectance, [0, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(ash.reflectance, [0.3, 0.1, NAN, NAN, 0.2])


def test_percent_are_divided_where_the_head_says_so(tmp_path):
    for head in ("leaf %", "leaf%", "leaf_%", "leaf (%)", "leaf [Percent]", "leaf (per cent) "):
        table = written(tmp_path, "leaf.csv", f"wavelength,{head},clay 20 %\n400,5,0.5\n500,30,0.6\n")
        (leaf, clay) = read_library(table)
        assert (leaf.name, clay.name) == ("leaf", "clay 20 %")
        np.testing.assert_allclose([leaf.reflectance, clay.reflectance], [[0.05, 0.3], [0.5, 0.6]])
        [text] = read_library(written(tmp_path, "leaf.txt", f"Wavelength\t{head}\n400\t5\n500\t30\n"))
        np.testing.assert_allclose(text.reflectance, [0.05, 0.3])


@pytest.mark.parametrize("marker", ["-999", "-9999", "-1.23e34"])
def test_marks_for_what_is_missing_count_as_they_are_stored(tmp_path, marker):
    [leaf] = read_library(
        written(tmp_path, "leaf.csv", f"wavelength,leaf (%)\n400,5\n500,{marker}\n600,30\n")
    )
    np.testing.assert_allclose(leaf.reflectance, [0.05, NAN, 0.3])
    [maple] = read_library(written(tmp_path, "maple.txt", ECOSTRESS.replace("12.5", marker)))
    np.testing.assert_allclose(maple.reflectance, [0.05, 0.08, NAN, 0.44])


def test_in_ten_thousandths_marks_are_gaps_noise_is_0_and_other_negative_values_are_refused(tmp_path):
    path, _ = written_by_spectral(tmp_path, data_type=2, reflectance_scale_factor=10000)
    stored = np.array([[-9999, 5000, 7000], [-150, -999, 9000]])
    path.with_suffix(".sli").write_bytes(stored.astype("<i2").tobytes())
    oak, fir = read_library(path)
    np.testing.assert_allclose(oak.reflectance, [0.5, 0.7])
    np.testing.assert_allclose(fir.reflectance, [0, NAN, 0.9])
    path.with_suffix(".sli").write_bytes(np.where(stored == -150, -500, stored).astype("<i2").tobytes())
    with pytest.raises(SpectrumError, match=r"must not be negative; found -0\.05 in 'fir tree' at 400\.5 nm"):
        read_library(path)


ECOSTRESS = """Name: Acer  rubrum
Type: vegetation
Class: tree
First Column: X
Second Column: Y
X Units: Wavelength (micrometers)
Y Units: Reflectance (percent)
First X Value: 0.7
Last X Value: 0.4
Number of X Values: 4

  0.7000\t 44.0
  0.6000\t 12.5
  0.5000\t  8.0
  0.4000\t  5.0
"""


def test_bands_or_values_that_a_header_marks_are_gaps_and_gains_are_refused(tmp_path):
    for changed in ({"bbl": [1, 0, 1]}, {"data_ignore_value": 0.25}):
        path, _ = written_by_spectral(tmp_path, **changed)
        np.testing.assert_allclose(read_library(path)[0].reflectance, [0.1, NAN, 0.5])
    written_by_spectral(tmp_path, data_offset_values="{ -0.1 }")
    with pytest.raises(SpectrumError, match="'data offset values' can't be applied to spectra"):
        read_library(path)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # it leaves its file open
def test_a_text_of_ecostress_is_read_as_spectral_python_reads_it(tmp_path):
    path = written(tmp_path, "maple.spectrum.txt", ECOSTRESS)
    text = ECOSTRESS.replace("Number of X Values: 4", "Measurement: Directional\nNumber of X Values: 4")
    other = read_ecostress_file(str(written(tmp_path, "other.txt", text)))
    [(name, wavelengths, values)] = spectra_of(path)
    assert name == "Acer rubrum"
    np.testing.assert_allclose(wavelengths, np.array(vars(other)["x"]) * 1000)
    np.testing.assert_allclose(values, np.array(vars(other)["y"]) / 100)


def test_texts_of_usgs_are_read_with_their_wavelengths_and_without_deleted_channels(tmp_path):
    (tmp_path / "ChapterM").mkdir()
    path = tmp_path / "ChapterM" / "splib07a_Kaolinite.txt"
    title = " splib07a Record=11: Kaolinite CM3 BR93-34A   ASDFRb AREF\n"
    path.write_text(f"{title} -1.23e34\n 0.4\n-1.23e34\n 0.5\n")
    with pytest.raises(SpectrumError, match="4 values without wavelengths, and 0 lists of 4 wavelengths lie"):
        read_library(path)
    head = " splib07a Record=1: Wavelengths ASD 0.35-2.5 microns 2151 ch\n"
    (tmp_path / "splib07a_Wavelengths_ASD.txt").write_text(head + "0.5\n0.6\n0.7\n0.8\n")
    (tmp_path / "splib07a_Wavelengths_BECK.txt").write_text(head + "0.5\n0.6\n0.7\n")
    [(name, wavelengths, values)] = spectra_of(path)
    assert name == "Kaolinite CM3 BR93-34A ASDFRb AREF"
    np.testing.assert_allclose(wavelengths, [600, 700, 800])
    np.testing.assert_allclose(values, [0.4, NAN, 0.5])
    np.testing.assert_allclose(vars(SampleData.read_from_file(str(path)))["values"][1], 0.4)
    older = "USGS Digital Spectral Library splib06a\n(-1.23e34  indicates a deleted number)\n"
    older += "Olivine GDS70\ncopy of r 9\n"
    older += "  0.2051  -1.23e34  0.0\n  0.5  0.31  0.01\n  0.6  0.32  0.01\n"
    [(name, wavelengths, values)] = spectra_of(written(tmp_path, "olivine.asc", older))
    assert (name, wavelengths, values) == ("Olivine GDS70", [500.0, 600.0], [0.31, 0.32])


@pytest.mark.parametrize(
    "text",
    [
        "400\t0,25\n500\t1\n",
        "Wavelength;Reflectance\n400,0;0,25\n500,0;1,0\n",
        "  400 0,25 \n  500 1e0\n",
        "nm\tReflectance [%]\n400\t25,0\n500\t100\n",
        "400,0.25\n500,1\n",
        "400, 0.25\n500, 1\n",
        "nm value std\n400 0.25 0.1\n500 1 0.1\n",
    ],
)
def test_a_comma_is_a_decimal_mark_where_something_else_parts_the_columns(tmp_path, text):
    assert spectra_of(written(tmp_path, "sand.txt", text)) == [("sand", [400.0, 500.0], [0.25, 1.0])]


IN_WAVENUMBERS = ECOSTRESS.replace("(micrometers)", "(cm-1)").replace("Wavelength", "Wavenumber")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("x.csv", "name,value\n400,1\n", "the first column must be headed 'wavelength' .* found 'name'"),
        ("x.csv", "wavelength\n400\n", "there is no column beside the wavelengths"),
        ("x.csv", "wavelength,a,a\n400,1,1\n", "each spectrum needs a name of its own"),
        ("x.csv", "wavelength_nm,a\n0.4,1\n", "look like micrometres"),
        ("x.csv", "wavelength,a\n400,-999\n", "'a' has no value that was measured"),
        ("x.csv", "wavelength,a\n400,1\n500,-0.1\n", "must not be negative; found -0.1 in 'a' at 500 nm"),
        ("x.txt", "a\n1 0.2\n2 0.3\n3 0.3\n", "wavelengths of 1 to 3 count the bands"),
        ("x.txt", "hello\n", "there are no numbers in it"),
        ("x.txt", "400 1\nend\n", "'end' stands among the numbers"),
        ("x.txt", "400\n500\n", "no lines with a wavelength and a value"),
        ("x.txt", "Wavelength dry sand wet grass\n400 1 1\n", "line 2 has 3 values, the header has 5"),
        ("x.txt", "400, 1,2\n500, 1,2\n", "3 numbers, and what column 3 means is unknown; .* a head"),
        ("x.txt", "400\t0.1\n500\t0,1\t2.0\n", "line 2: '500 0,1 2.0' stands among the numbers"),
        ("x.txt", IN_WAVENUMBERS, "'X Units' is"),
        ("x.txt", ECOSTRESS.replace("Reflectance", "Transmittance"), "'Y Units' is .* expected reflectance"),
        ("x.pdf", "", r"a library is a \.csv, an ENVI spectral library"),
    ],
)
def test_what_is_no_library_is_refused_with_its_name_and_the_fault(tmp_path, name, text, said):
    with pytest.raises(SpectrumError, match=said) as caught:
        read_library(written(tmp_path, name, text))
    assert name in str(caught.value)


def test_own_files_are_the_library_alone_unless_the_built_in_ones_are_asked_for(tmp_path):
    first = written(tmp_path, "a.csv", "wavelength,moss,sand\n400,1,2\n550,3,3\n700,4,2\n")
    second = written(tmp_path, "b.csv", "wavelength,moss\n400,1\n550,2\n700,1\n")
    assert library_of([]).names == measured_library().names == library_of([Path("+builtin")]).names
    assert library_of([first]).names == ("moss", "sand")
    both = library_of([first, second, Path("+builtin")])
    assert both.names == ("moss", "sand", "moss (b.csv)", *measured_library().names)
    assert both.find("moss (b.csv)").origin == (second, "moss")


def test_a_folder_stands_for_the_libraries_in_it_whatever_the_suffix_of_their_numbers(tmp_path):
    written(tmp_path, "a.csv", "wavelength,moss\n400,1\n500,2\n")
    written(tmp_path, "maple.spectrum.txt", ECOSTRESS)
    written(tmp_path, "maple.ancillary.txt", "Genus: Acer\n")
    path, _ = written_by_spectral(tmp_path)
    (tmp_path / "image.hdr").write_text("ENVI\nfile type = ENVI Standard\n")
    assert library_of([tmp_path]).names == ("moss", "Acer rubrum", "oak", "fir tree")
    path.with_suffix(".sli").rename(tmp_path / "bandpass_trees.dat")
    path.rename(tmp_path / "bandpass_trees.hdr")
    assert library_of([tmp_path]).names == ("moss", "Acer rubrum", "oak", "fir tree")
    (tmp_path / "none").mkdir()
    with pytest.raises(SpectrumError, match="none: no library in this folder"):
        library_of([tmp_path / "none"])
    infrared = written(tmp_path, "ir.csv", "wavelength,clay\n1000,1\n1500,3\n2500,4\n")
    with pytest.raises(SpectrumError, match=r"from 1000 to 2500 nm, can.t be compared: each covers"):
        library_of([infrared], Bands.of(np.linspace(400, 700, 31)))


def test_a_library_is_refused_where_it_covers_too_little_of_what_is_lit(tmp_path):
    red = written(tmp_path, "red.csv", "wavelength,clay\n600,1\n700,3\n")
    bands = Bands.of(range(400, 710, 10))
    lights = {start: (bands.centers_nm >= start) * 1.0 for start in (400, 550, 690)}
    assert library_of([red], bands, lights[550]).names == ("clay",)
    for light in (None, lights[400], lights[690]):  # 11 of 31 bands, and 2 of 2
        with pytest.raises(SpectrumError, match=r"less than half of 31 bands, 400-700 nm, .* without light"):
            library_of([red], bands, light)


def test_several_spectra_in_a_text_have_a_head(tmp_path):
    for text in ("Wavelength sand grass\n400 0.1 1\n500 0.2 1\n", "nm;sand;grass\n400;0,1;1\n500;0,2;1\n"):
        expected = [("sand", [400.0, 500.0], [0.1, 0.2]), ("grass", [400.0, 500.0], [1.0, 1.0])]
        assert spectra_of(written(tmp_path, "x.txt", text)) == expected


def test_rows_that_were_left_out_are_a_gap_and_no_line(tmp_path):
    rows = "".join(f"{nm},0.5\n" for nm in range(1000, 2001, 10) if not 1380 < nm < 1520)
    library = library_of([written(tmp_path, "a.csv", f"wavelength,a\n{rows}")])
    assert library.reflectance("a", Bands.of([1300, 1380, 1520])).tolist() == [0.5] * 3
    with pytest.raises(SpectrumError, match="a was not measured at 1450 nm; leave that band out"):
        library.reflectance("a", Bands.of([1300, 1450]))
