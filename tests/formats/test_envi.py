"""ENVI images and libraries, read back with Spectral Python."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import spectral.io.envi as envi

from tests.factories.cubes import BANDS, WAVELENGTHS_NM, full_disk, random_cube
from unmix_plugin.errors import RunError
from unmix_plugin.formats.envi import envi_cube_rows, write_envi_cube, write_envi_library
from unmix_plugin.spectral.bands import Bands


def opened(path) -> Any:
    return envi.open(f"{path}.hdr", f"{path}.img")


def test_another_reader_gets_the_same_float32_numbers_and_every_digit_of_the_wavelengths(tmp_path):
    cube, base = random_cube(), tmp_path / "deep" / "view"
    assert write_envi_cube(base, cube, BANDS, None, "numbers") == [Path(f"{base}.hdr"), Path(f"{base}.img")]
    read = opened(base)
    assert read.open_memmap().dtype == np.float32
    np.testing.assert_array_equal(read.open_memmap(), cube)
    assert tuple(read.bands.centers) == WAVELENGTHS_NM
    np.testing.assert_allclose(read.bands.bandwidths, BANDS.widths_nm, atol=1e-6)
    assert read.bands.band_unit == "Nanometers"


def test_rows_in_blocks_make_the_same_file_as_all_at_once(tmp_path):
    cube = random_cube()
    write_envi_cube(tmp_path / "whole", cube, BANDS, None, "x")
    with envi_cube_rows(tmp_path / "parts", cube.shape, BANDS, None, "x") as add:
        add(cube[:3])
        add(cube[3:4])
        add(np.asfortranarray(cube[4:]))
    for suffix in (".hdr", ".img"):
        assert (tmp_path / f"parts{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()


@pytest.mark.parametrize(
    ("bands", "fwhm"),
    [
        (Bands.of([396.32, 401.02]), "{ 4.7, 4.7 }"),  # which differ by 4.699999999999989 as floats
        (Bands(np.array([450.0, 460, 480]), np.full(3, 10.0)), "{ 10.0, 10.0, 10.0 }"),  # a band is left out
    ],
)
def test_widths_are_those_of_the_instrument_without_digits_of_rounding(tmp_path, bands, fwhm):
    write_envi_cube(tmp_path / "a.view", random_cube(bands=len(bands)), bands, None, "x")
    assert {path.name for path in tmp_path.glob("[!.]*")} == {"a.view.hdr", "a.view.img"}
    assert f"fwhm = {fwhm}" in (tmp_path / "a.view.hdr").read_text()


def test_names_survive_but_for_what_the_format_has_no_way_to_say(tmp_path):
    names = ["wood", "red, lacquered", "{odd}", "two\nlines", "Lärche"]
    write_envi_cube(tmp_path / "view", random_cube(), None, names, "shares {of} something,\nas seen")
    metadata = opened(tmp_path / "view").metadata
    assert metadata["band names"] == ["wood", "red- lacquered", "(odd)", "two lines", "Lärche"]
    assert metadata["description"] == "shares (of) something, as seen"
    assert "wavelength" not in metadata


def test_a_visible_spectrum_is_shown_by_its_red_green_and_blue(tmp_path):
    write_envi_cube(tmp_path / "view", random_cube(), Bands.of([460, 500, 550, 600, 640]), None, "x")
    assert opened(tmp_path / "view").metadata["default bands"] == ["5", "3", "1"]


def test_a_disk_that_fills_up_leaves_neither_file_and_keeps_the_old_ones(tmp_path, monkeypatch):
    cube = random_cube()
    write_envi_cube(tmp_path / "old", cube, None, None, "x")
    full_disk(monkeypatch, after=100)
    for name in ("new", "old"):
        with pytest.raises(RunError, match=rf"can't write .*{name}\.img: No space left on device; make room"):
            write_envi_cube(tmp_path / name, cube + 1, None, None, "x")
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == ["old.hdr", "old.img"]
    np.testing.assert_array_equal(opened(tmp_path / "old").open_memmap(), cube)


def test_an_old_header_never_stands_beside_new_numbers(tmp_path, monkeypatch):
    write_envi_cube(tmp_path / "view", random_cube(), None, None, "x")
    wider = random_cube(width=6)
    full_disk(monkeypatch, after=wider.nbytes + 100)  # with the line in the list of files
    with pytest.raises(RunError, match=r"view\.hdr"):
        write_envi_cube(tmp_path / "view", wider, None, None, "x")
    assert [path.name for path in tmp_path.glob("[!.]*")] == ["view.img"]


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda at: write_envi_cube(at, random_cube(bands=4), BANDS, None, "x"), "5 wavelengths for 4 bands"),
        (lambda at: write_envi_cube(at, random_cube(bands=4), None, ["a"], "x"), "1 names for 4 bands"),
        (lambda at: write_envi_library(at, SPECTRA, BANDS, NAMES[:2]), "2 names and 5 wavelengths"),
        (lambda at: write_rows(at, random_cube(height=6)), "7 rows; got 6"),
        (lambda at: write_rows(at, random_cube(height=8)), "7 rows; got 8"),
    ],
)
def test_wavelengths_names_and_rows_must_be_as_many_as_were_promised(tmp_path, write, said):
    with pytest.raises(ValueError, match=said):
        write(tmp_path / "view")
    assert list(tmp_path.iterdir()) == []


def write_rows(at, rows):
    with envi_cube_rows(at, (7, 5, 5), None, None, "x") as add:
        add(rows)


SPECTRA = np.random.default_rng(1).random((3, len(WAVELENGTHS_NM)))
NAMES = ("wood", "clay, wet", "leaf")


def test_another_reader_gets_spectra_names_and_wavelengths(tmp_path):
    files = write_envi_library(tmp_path / "lib", SPECTRA, BANDS, NAMES, "radiance")
    assert files == [tmp_path / "lib.hdr", tmp_path / "lib.sli"]
    library: Any = envi.open(str(files[0]), str(files[1]))
    assert isinstance(library, envi.SpectralLibrary)
    np.testing.assert_array_equal(library.spectra, SPECTRA.astype(np.float32))
    assert library.names == ["wood", "clay- wet", "leaf"]
    bands: Any = library.bands
    assert tuple(bands.centers) == WAVELENGTHS_NM
    assert bands.band_unit == "Nanometers"
