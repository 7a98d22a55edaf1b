"""Tables of spectra of spreadsheets and spectrometers: read with the right values, or refused by their cause.

None is ever read wrong: not with another delimiter, another decimal sign, another unit, or a hundred times too large.
"""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.cases.inputs import braced, spectra
from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.libraries import library_of, read_library
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
}
REFUSED = {
    "semicolons": (table(";"), "utf-8"),
    "decimal commas": (table(";", ","), "utf-8"),
    "tabs": (table("\t"), "utf-8"),
    "sep=": (table(";", ",", first="sep=;\r\n"), "utf-8"),
    "cp1252": (table(";", ",", head="Wellenlänge [nm]"), "cp1252"),
    "UTF-16": (table("\t", ","), "utf-16"),
}


@pytest.mark.parametrize("kind", READ)
def test_a_table_is_read(kind, tmp_path):
    text, encoding = READ[kind]
    (tmp_path / "library.csv").write_bytes(text.encode(encoding))
    check_library(tmp_path / "library.csv")


@pytest.mark.parametrize("kind", REFUSED)
def test_a_table_in_another_form_is_not_read_wrong(kind, tmp_path):
    text, encoding = REFUSED[kind]
    (tmp_path / "table.csv").write_bytes(text.encode(encoding))
    for read in (read_library, read_sensor):
        with pytest.raises(SpectrumError, match=r"table\.csv"):
            read(tmp_path / "table.csv")


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


def test_a_file_of_svc_is_refused_by_its_suffix(tmp_path):
    rows = "".join(
        f"{nm:.1f}  20000.00  {200 * value:.2f}  {value:.2f}\n"
        for nm, value in zip(NM, SPECTRA[0] * 100, strict=True)
    )
    (tmp_path / "site.sig").write_text(
        f"/*** Spectra Vista SIG Data ***/\nunits= Radiance, Radiance\ndata= \n{rows}"
    )
    with pytest.raises(SpectrumError, match=re.escape("site.sig")):
        read_library(tmp_path / "site.sig")


def test_a_table_of_viewspec_is_refused_for_its_further_columns(tmp_path):
    head = "Wavelength\tleaf00001.asd\tleaf00002.asd\tsoil00003.asd\n"
    rows = "".join(
        f"{nm:.0f}\t" + "\t".join(f"{one:.9f}" for one in row) + "\n"
        for nm, row in zip(NM, SPECTRA.T, strict=True)
    )
    (tmp_path / "viewspec.txt").write_text(head + rows)
    with pytest.raises(SpectrumError, match="column"):
        read_library(tmp_path / "viewspec.txt")
