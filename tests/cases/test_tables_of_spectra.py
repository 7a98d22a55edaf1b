"""Tables of spectra of spreadsheets and spectrometers: read with the right values, or refused by their cause.

None is ever read wrong: not with another delimiter, another decimal sign, another unit, or a hundred times too large.
"""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.factories.forms import braced, spectra
from unmix_plugin.captures.wavelengths import parse_bands
from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.libraries import library_of, read_library
from unmix_plugin.spectral.library.spectra_csv import read_spectra
from unmix_plugin.spectral.sensor import read_sensor

NM = np.arange(400.0, 1001.0, 20.0)
SPECTRA = spectra(NM)
NAMES = ["brick", "grass (field #2) 350-2500nm", "stone [grey]"]


def check_library(path, names=("brick", "grass", "stone")):
    """That a library has the three spectra of `SPECTRA`, by these names."""
    found = read_library(path)
    assert [one.name for one in found] == list(names)
    for one, expected in zip(found, SPECTRA, strict=True):
        np.testing.assert_allclose(one.bands.centers_nm, NM, rtol=1e-4)
        np.testing.assert_allclose(one.reflectance, expected, atol=1e-4)


def table(
    delimiter=",", decimal=".", head="wavelength", first="", values=SPECTRA, names=("brick", "grass", "stone")
):
    """A table as a spreadsheet saves it."""
    rows = [[f"{nm:.1f}", *(f"{value:.6f}" for value in row)] for nm, row in zip(NM, values.T, strict=True)]
    lines = [delimiter.join(cell.replace(".", decimal) for cell in row) for row in rows]
    return first + "\r\n".join([delimiter.join([head, *names]), *lines, ""])


READ = {
    "plain": (table(), "utf-8"),
    "with a mark of its order": (table(), "utf-8-sig"),
    "percent stated": (
        table(values=SPECTRA * 100, names=("brick (%)", "grass (%)", "stone (%)")),
        "utf-8",
    ),
    "semicolons": (table(";"), "utf-8"),
    "decimal commas": (table(";", ","), "utf-8"),
    "tabs": (table("\t"), "utf-8"),
    "sep=": (table(";", ",", first="sep=;\r\n"), "utf-8"),
    "cp1252": (table(";", ",", head="Wellenlänge [nm]"), "cp1252"),
    "UTF-16": (table("\t", ","), "utf-16"),
    "UTF-16 without its mark": (table("\t", ","), "utf-16-le"),
    "quoted decimal commas": (re.sub(r"(\d+,\d+)", r'"\1"', table(";", ",").replace(";", "\t")), "utf-8"),
    "commas within quotes": (
        re.sub(r"[^;\r\n]+", r'"\g<0>"', table(";", ",")).replace(";", ","),
        "utf-8",
    ),
    "lines of words before the head": (
        table("\t", first="Instrument: ASD\r\n\r\n17 ms, 10 scans\r\n"),
        "utf-8",
    ),
    "units below the head": (
        table(";", ",", values=SPECTRA * 100).replace("stone\r\n", "stone\r\nnm;%;%;%\r\n"),
        "utf-8",
    ),
    "a delimiter at the end of each line": (table(";", ",").replace("\r\n", ";\r\n"), "utf-8"),
    "a column of deviations and one that counts": (
        "".join(
            f"{index or 'Band'};{line};{'0,01' if index else 'stone (std. dev.)'}\n"
            for index, line in enumerate(table(";", ",").split())
        ),
        "utf-8",
    ),
    "spectra in rows": (
        "\n".join(map(";".join, zip(*(line.split(";") for line in table(";", ",").split()), strict=True))),
        "utf-8",
    ),
}


@pytest.mark.parametrize("kind", READ)
def test_a_table_is_read(kind, tmp_path):
    text, encoding = READ[kind]
    (tmp_path / "library.csv").write_bytes(text.encode(encoding))
    check_library(tmp_path / "library.csv")


HEADS = {
    "nm": 1.0,
    "Wavelength (nm)": 1.0,
    "wavelength, nm": 1.0,
    "Lambda/nm": 1.0,
    "WAVELENGTH_NM": 1.0,
    "wavelength in nanometres": 1.0,
    "Wellenlänge": 1.0,
    "longueur d'onde [nm]": 1.0,
    "Wavelength (µm)": 1e-3,
    "wavelength_um": 1e-3,
    "\u03bb [\u03bcm]": 1e-3,
    "Wellenlänge in Mikrometer": 1e-3,
    "Wavelength/micrometers": 1e-3,
    "wavelength": 1e-3,
    "Wvl. (Angstrom)": 10.0,
}


@pytest.mark.parametrize("head", HEADS)
def test_the_unit_of_wavelengths_is_that_of_the_head_in_any_spelling(head, tmp_path):
    rows = "".join(f"{nm * HEADS[head]:.6g};{value:.6f}\n" for nm, value in zip(NM, SPECTRA[0], strict=True))
    (tmp_path / "brick.csv").write_text(
        f'"{head}";brick\n{rows}'.replace(".", ",").replace("Wvl,", "Wvl."), "utf-8"
    )
    [found] = read_library(tmp_path / "brick.csv")
    np.testing.assert_allclose(found.bands.centers_nm, NM, rtol=1e-5)
    np.testing.assert_allclose(found.reflectance, SPECTRA[0], atol=1e-6)


PERCENT = (
    "brick (%)",
    "brick [%]",
    "brick %",
    "brick_percent",
    "brick in %",
    "brick (in percent)",
    "brick / %",
)


@pytest.mark.parametrize("name", PERCENT)
def test_percent_are_divided_where_the_head_says_so_in_any_spelling(name, tmp_path):
    (tmp_path / "library.csv").write_text(
        table(";", ",", values=SPECTRA * 100, names=(name, "grass (%)", "stone (%)"))
    )
    check_library(tmp_path / "library.csv")


def test_one_reader_serves_lamps_sensors_panels_and_lists_of_wavelengths(tmp_path):
    for kind, (text, encoding) in READ.items():
        if kind != "lines of words before the head":
            (tmp_path / "table.csv").write_bytes(text.encode(encoding))
            assert parse_bands(str(tmp_path / "table.csv")).wavelengths_nm == pytest.approx(NM)
        (tmp_path / "table.csv").write_bytes(text.encode(encoding))
        sensor, table_ = read_sensor(tmp_path / "table.csv"), read_spectra(tmp_path / "table.csv")
        np.testing.assert_allclose(table_.spectra, SPECTRA, atol=1e-6)
        assert sorted(sensor.column_names) == ["brick", "grass", "stone"]


AMBIGUOUS = {
    "decimal commas between commas": ("wavelength,leaf\n400,0,0,25\n410,0,0,50\n", "decimal signs too"),
    "thousands": ("wavelength\tpower\n400\t998\n410\t1,002\n", "'1,002' .* as 1.002 and as 1002"),
    "points for thousands": ("nm;power\n990;1\n1.000;2\n", "'1.000' .* as 1 and as 1000"),
    "two decimal signs": ("wavelength;leaf\n400.5;0,25\n", "not a number"),
    "words among numbers": ("wavelength;leaf\n400;0,25\nend of file\n", "line 3 has|stands among"),
    "a number without a head beside another": (
        "400;0,1;0,2\n410;0,1;0,2\n",
        "what column 3 means is unknown",
    ),
}


@pytest.mark.parametrize("kind", AMBIGUOUS)
def test_what_can_be_read_in_two_ways_is_refused_with_both(kind, tmp_path):
    text, said = AMBIGUOUS[kind]
    (tmp_path / "table.csv").write_text(text)
    for read in (read_library, read_spectra):
        with pytest.raises(SpectrumError, match=f"table\\.csv.*({said})"):
            read(tmp_path / "table.csv")


@pytest.mark.parametrize("head", ["Wavenumber Reflectance", "cm-1 R", "Energy (eV) Reflectance"])
def test_numbers_that_are_no_wavelengths_are_refused(head, tmp_path):
    (tmp_path / "spectrum.txt").write_text(f"{head}\n400 0.25\n500 0.5\n")
    with pytest.raises(SpectrumError, match="names no wavelengths"):
        read_library(tmp_path / "spectrum.txt")


def test_three_decimals_beside_a_whole_number_are_decimals(tmp_path):
    (tmp_path / "table.csv").write_text("wavelength;leaf\n400,125;0,250\n402;0,375\n404,375;0,125\n")
    np.testing.assert_allclose(read_spectra(tmp_path / "table.csv").bands.centers_nm, [400.125, 402, 404.375])


def test_a_channel_that_was_measured_over_a_part_responds_to_nothing_beyond(tmp_path):
    rows = "400;;0,1\n500;0,2;0,4\n600;1,0;0,2\n700;0,1;NaN\n"
    (tmp_path / "camera.csv").write_text(f"Wellenlaenge (nm);red;blue\n{rows}")
    responses = read_sensor(tmp_path / "camera.csv").responses
    np.testing.assert_array_equal(responses.bands.centers_nm, [400, 500, 600, 700])
    np.testing.assert_array_equal(responses.spectra[responses.names.index("red")], [0, 0.2, 1, 0.1])
    np.testing.assert_array_equal(responses.spectra[responses.names.index("blue")], [0.1, 0.4, 0.2, 0])


def test_a_lamp_or_panel_with_its_uncertainty_is_one_spectrum(tmp_path):
    (tmp_path / "panel.csv").write_text(
        "Wavelength [nm];Reflectance [%];Uncertainty (k=2)\n400;98,7;0,5\n500;98,9;0,5\n"
    )
    table_ = read_spectra(tmp_path / "panel.csv")
    np.testing.assert_allclose(table_.spectra, [[0.987, 0.989]])


def test_percent_that_no_word_states_is_no_reflectance(tmp_path):
    (tmp_path / "library.csv").write_text(table(values=SPECTRA * 100))
    library = library_of([tmp_path / "library.csv"])
    with pytest.raises(SpectrumError, match="percent"):
        library.require_reflectance("brick", library.materials[0].reflectance, "replace")


def write_sli(
    root,
    stem="lib",
    header="lib.hdr",
    names=NAMES,
    order="<",
    nm=NM,
    values=SPECTRA,
    unit="Nanometers",
    **more,
):
    """An ENVI spectral library."""
    (root / f"{stem}.sli").write_bytes(values.astype(f"{order}f4").tobytes())
    entries = {"samples": len(nm), "lines": 3, "bands": 1, "data type": 4, "interleave": "bsq"}
    entries |= {
        "byte order": int(order == ">"),
        "file type": "ENVI Spectral Library",
        "wavelength units": unit,
    }
    entries |= {"spectra names": "{" + ", ".join(names) + "}", "wavelength": braced(nm)}
    entries |= {key.replace("_", " "): value for key, value in more.items()}
    (root / header).write_text("ENVI\n" + "".join(f"{key} = {value}\n" for key, value in entries.items()))


SLI = {
    "plain": {},
    "big-endian": {"order": ">"},
    "falling micrometres": {"nm": NM[::-1] / 1000, "values": SPECTRA[:, ::-1], "unit": "Micrometers"},
    "a scale factor": {"values": SPECTRA * 10000, "reflectance_scale_factor": 10000},
    "percent that the unit states": {"values": SPECTRA * 100, "y_units": "Reflectance (percent)"},
}


@pytest.mark.parametrize("kind", SLI)
def test_an_envi_library_is_read(kind, tmp_path):
    write_sli(tmp_path, **SLI[kind])
    check_library(tmp_path / "lib.hdr", NAMES)


def test_a_header_has_the_name_of_its_numbers_and_one_suffix_more(tmp_path):
    write_sli(tmp_path, header="lib.sli.hdr")
    check_library(tmp_path / "lib.sli.hdr", NAMES)


def test_suffixes_may_be_capitals(tmp_path):
    write_sli(tmp_path, header="lib.HDR")
    (tmp_path / "lib.sli").rename(tmp_path / "lib.SLI")
    check_library(tmp_path / "lib.HDR", NAMES)


def test_a_unit_called_unknown_is_told_by_the_numbers(tmp_path):
    write_sli(tmp_path, unit="Unknown")
    check_library(tmp_path / "lib.hdr", NAMES)


def test_names_in_quotes_may_have_commas(tmp_path):
    write_sli(tmp_path, names=['"Quartz, fine"', '"Grass, dry"', "limestone"])
    check_library(tmp_path / "lib.hdr", ["Quartz, fine", "Grass, dry", "limestone"])


def test_names_that_don_t_fit_their_spectra_are_refused(tmp_path):
    write_sli(tmp_path, names=["Quartz, fine", "Grass, dry", "limestone"])
    with pytest.raises(SpectrumError, match="names"):
        read_library(tmp_path / "lib.hdr")


def test_a_file_of_svc_is_in_percent_by_its_form(tmp_path):
    rows = "".join(
        f"{nm:.1f}  20000.00  {200 * value:.2f}  {value:.4f}\n"
        for nm, value in zip(NM, SPECTRA[0] * 100, strict=True)
    )
    head = "/*** Spectra Vista SIG Data ***/\nname= site.0001.sig\nfactors= 1.000, 1.000\nunits= Radiance, Radiance\n"
    for name in ("site.sig", "site_sig.txt"):
        (tmp_path / name).write_text(f"{head}data= \n{rows}")
        [found] = read_library(tmp_path / name)
        assert found.name == "site.0001"
        np.testing.assert_allclose(found.bands.centers_nm, NM)
        np.testing.assert_allclose(found.reflectance, SPECTRA[0], atol=1e-5)


def test_a_table_of_viewspec_has_a_spectrum_a_column(tmp_path):
    head = "Wavelength\tleaf00001.asd\tleaf00002.asd\tsoil00003.asd\n"
    rows = "".join(
        f"{nm:.0f}\t" + "\t".join(f"{one:.9f}" for one in row) + "\n"
        for nm, row in zip(NM, SPECTRA.T, strict=True)
    )
    (tmp_path / "viewspec.txt").write_text(head + rows)
    check_library(tmp_path / "viewspec.txt", ["leaf00001.asd", "leaf00002.asd", "soil00003.asd"])


@pytest.mark.parametrize(
    ("column", "factor"), [("Reflect. %", 100), ("Reflect. [1.0]", 1), ("Tgt./Ref. %", 100)]
)
def test_a_file_of_spectral_evolution_has_its_reflectance(column, factor, tmp_path):
    head = "Comment: \nFile Name: C:\\data\\rock_00001.sed\n<Metadata>\nMeasurement: REFLECTANCE\n"
    head += (
        "Units: W/m^2/sr/nm\nWavelength Range: 350,2500\nLatitude: n/a\nChannels: 2151\nColumns [5]:\nData:\n"
    )
    head += f"Chan.#\tWvl\tRad. (Ref.)\tRad. (Target)\t{column}\n"
    rows = "".join(
        f"{index}\t{nm:6.1f}\t  7.82E-02\t  1.2E-02\t  {value * factor:.5f}\n"
        for index, (nm, value) in enumerate(zip(NM, SPECTRA[0], strict=True))
    )
    (tmp_path / "rock_00001.sed").write_text(head + rows)
    [found] = read_library(tmp_path / "rock_00001.sed")
    assert found.name == "rock_00001"
    np.testing.assert_allclose(found.bands.centers_nm, NM)
    np.testing.assert_allclose(found.reflectance, SPECTRA[0], atol=1e-5)


def test_what_is_binary_is_refused_by_what_it_is(tmp_path):
    (tmp_path / "leaf.asd").write_bytes(b"ASD" + bytes(500))
    with pytest.raises(SpectrumError, match="ViewSpec"):
        read_library(tmp_path / "leaf.asd")
