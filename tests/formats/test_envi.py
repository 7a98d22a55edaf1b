"""ENVI images and libraries, read back with Spectral Python."""

from typing import Any

import numpy as np
import pytest
import spectral.io.envi as envi

from tests.formats.cubes import BANDS, WAVELENGTHS_NM, full_disk, random_cube
from unmix_plugin.errors import RunError
from unmix_plugin.formats.envi import envi_cube_rows, write_envi_cube, write_envi_library
from unmix_plugin.spectral.bands import Bands


def opened(path) -> Any:
    return envi.open(f"{path}.hdr", f"{path}.img")


def test_another_reader_gets_the_same_float32_numbers(tmp_path):
    cube = random_cube()
    files = write_envi_cube(tmp_path / "deep" / "view", cube, BANDS, None, "numbers")
    assert files == [tmp_path / "deep" / "view.hdr", tmp_path / "deep" / "view.img"]
    read = opened(tmp_path / "deep" / "view").open_memmap()
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, cube)


def test_rows_in_blocks_make_the_same_file_as_all_at_once(tmp_path):
    cube = random_cube()
    write_envi_cube(tmp_path / "whole", cube, BANDS, None, "x")
    with envi_cube_rows(tmp_path / "parts", cube.shape, BANDS, None, "x") as add:
        add(cube[:3])
        add(cube[3:4])
        add(np.asfortranarray(cube[4:]))
    for suffix in (".hdr", ".img"):
        assert (tmp_path / f"parts{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()


def test_another_reader_gets_every_digit_of_the_wavelengths_and_their_unit(tmp_path):
    write_envi_cube(tmp_path / "view", random_cube(), BANDS, None, "x")
    bands = opened(tmp_path / "view").bands
    assert tuple(bands.centers) == WAVELENGTHS_NM
    np.testing.assert_allclose(bands.bandwidths, BANDS.widths_nm, atol=1e-6)
    assert bands.band_unit == "Nanometers"


def test_a_width_has_no_digits_of_rounding(tmp_path):
    """396.32 and 401.02 differ by 4.699999999999989 as floats."""
    write_envi_cube(tmp_path / "view", random_cube()[..., :2], Bands.of([396.32, 401.02]), None, "x")
    assert "fwhm = { 4.7, 4.7 }" in (tmp_path / "view.hdr").read_text()


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


def test_a_name_with_a_dot_keeps_it(tmp_path):
    write_envi_cube(tmp_path / "a.b", random_cube(), None, None, "x")
    assert {path.name for path in tmp_path.iterdir()} == {"a.b.hdr", "a.b.img"}


def test_a_disk_that_fills_up_leaves_neither_file_and_keeps_the_old_ones(tmp_path, monkeypatch):
    cube = random_cube()
    write_envi_cube(tmp_path / "old", cube, None, None, "x")
    full_disk(monkeypatch, after=100)
    for name in ("new", "old"):
        with pytest.raises(RunError, match=rf"can't write .*{name}\.img: No space left on device; make room"):
            write_envi_cube(tmp_path / name, cube + 1, None, None, "x")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old.hdr", "old.img"]
    np.testing.assert_array_equal(opened(tmp_path / "old").open_memmap(), cube)


def test_an_old_header_never_stands_beside_new_numbers(tmp_path, monkeypatch):
    write_envi_cube(tmp_path / "view", random_cube(), None, None, "x")
    wider = random_cube(width=6)
    full_disk(monkeypatch, after=wider.nbytes)
    with pytest.raises(RunError, match=r"view\.hdr"):
        write_envi_cube(tmp_path / "view", wider, None, None, "x")
    assert [path.name for path in tmp_path.iterdir()] == ["view.img"]


@pytest.mark.parametrize(
    ("wavelengths", "names", "said"),
    [(BANDS, None, "5 wavelengths for 4 bands"), (None, ["a"], "1 names for 4 bands")],
)
def test_wavelengths_and_names_must_be_as_many_as_the_bands(tmp_path, wavelengths, names, said):
    with pytest.raises(ValueError, match=said):
        write_envi_cube(tmp_path / "view", random_cube(bands=4), wavelengths, names, "x")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("given", [6, 8])
def test_too_few_or_too_many_rows_make_no_file(tmp_path, given):
    cube = random_cube(height=given)
    with (
        pytest.raises(ValueError, match=f"7 rows; got {given}"),
        envi_cube_rows(tmp_path / "view", (7, 5, 5), None, None, "x") as add,
    ):
        add(cube)
    assert list(tmp_path.iterdir()) == []


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


def test_widths_of_the_instrument_are_kept_beside_bands_that_were_left_out(tmp_path):
    bands = Bands(np.array([450.0, 460, 480]), np.full(3, 10.0))
    write_envi_library(tmp_path / "lib", np.ones((1, 3)), bands, ["white"])
    assert "fwhm = { 10.0, 10.0, 10.0 }" in (tmp_path / "lib.hdr").read_text()


def test_names_must_be_as_many_as_spectra(tmp_path):
    with pytest.raises(ValueError, match="2 names and 5 wavelengths"):
        write_envi_library(tmp_path / "lib", SPECTRA, BANDS, NAMES[:2])
