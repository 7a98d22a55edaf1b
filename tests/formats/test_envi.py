"""ENVI images and libraries, read back with Spectral Python."""

import contextlib
import time
from typing import Any

import numpy as np
import pytest
import spectral.io.envi as envi

from tests.formats.cubes import BANDS, WAVELENGTHS_NM, full_disk, random_cube
from unmix_plugin.errors import RunError, SpectrumError
from unmix_plugin.formats.envi import envi_cube_rows, read_library_table, write_envi_cube, write_envi_library
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


def test_names_must_be_as_many_as_spectra(tmp_path):
    with pytest.raises(ValueError, match="2 names and 5 wavelengths"):
        write_envi_library(tmp_path / "lib", SPECTRA, BANDS, NAMES[:2])


def written_by_spectral(folder, **changed):
    """A library of two spectra in three bands, written by Spectral Python; then lines of its header replaced."""
    values = np.array([[0.1, 0.25, 0.5], [0.3, 0.2, 0.7]], dtype=np.float32)
    header = {
        "wavelength": [400.5, 500, 700],
        "wavelength units": "Nanometers",
        "spectra names": ["oak", "fir tree"],
    }
    envi.SpectralLibrary(values, header).save(str(folder / "trees"))
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
        ({"lines": 20}, "has 24 bytes; 20 spectra of 3 values need 240"),
        ({"lines": "two"}, "'lines' is two; expected a whole number"),
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
