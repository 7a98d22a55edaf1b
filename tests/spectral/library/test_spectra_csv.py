import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import (
    SpectraTable,
    read_spectra,
    resample_spectra,
    write_spectra_csv,
)

VALUES = np.array([[0.1, 0.5, 0.2], [0, 1, 2.5]])
SMALL = SpectraTable(Bands.of([400, 500, 600]), ("leaf", "soil, dry"), VALUES)


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "spectra.csv"
    path.write_bytes(text.encode(encoding))
    return path


@given(values=st.lists(st.floats(0, 10, width=32), min_size=6, max_size=6))
def test_float32_spectra_survive_a_file_exactly(values, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "e.csv"
    spectra = np.array(values, dtype=np.float32).reshape(2, 3)
    write_spectra_csv(path, SpectraTable(SMALL.bands, SMALL.names, spectra.astype(np.float64)))
    table = read_spectra(path)
    np.testing.assert_array_equal(table.spectra.astype(np.float32), spectra)
    assert (table.bands, table.names) == (SMALL.bands, SMALL.names)
    assert path.read_text().startswith('wavelength,leaf,"soil, dry"\n400,')


def test_a_byte_order_mark_blank_lines_spaces_and_windows_line_ends_are_read(tmp_path):
    text = "Wavelength, leaf ,soil\r\n400,0.1,0.2\r\n\r\n500, 0.3 ,0.4\r\n,,\r\n"
    table = read_spectra(written(tmp_path, text, "utf-8-sig"))
    assert table.names == ("leaf", "soil")
    np.testing.assert_array_equal(table.spectra, [[0.1, 0.3], [0.2, 0.4]])
    np.testing.assert_array_equal(table.bands.centers_nm, [400, 500])


def test_wavelengths_may_fall_and_rows_without_a_measurement_at_the_ends_are_left_out(tmp_path):
    table = read_spectra(written(tmp_path, "wavelength,leaf\n700,nan\n600,0.3\n500,0.2\n400,\n"))
    np.testing.assert_array_equal(table.bands.centers_nm, [500, 600])
    np.testing.assert_array_equal(table.spectra, [[0.2, 0.3]])


def test_columns_in_percent_are_divided_as_those_of_libraries_are(tmp_path):
    table = read_spectra(written(tmp_path, "wavelength,leaf (%),clay 20 %\n400,5,0.5\n500,30,0.6\n"))
    assert table.names == ("leaf", "clay 20 %")
    np.testing.assert_allclose(table.spectra, [[0.05, 0.3], [0.5, 0.6]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "file is empty"),
        ("\n\n", "file is empty"),
        ("furlongs,leaf\n400,1\n", "first column must be headed 'wavelength' .* found 'furlongs'"),
        ("wavelength\n400\n", "no column beside the wavelengths"),
        ("wavelength,leaf\n", "no row of values"),
        ("wavelength,leaf,leaf\n400,1,1\n", "must differ; found 'leaf' 2 times"),
        ("wavelength,leaf,\n400,1,1\n", "each spectrum needs a name"),
        ("wavelength,leaf\n400,1\n\n500,1,2\n", "line 4 has 3 values, the header has 2"),
        ("wavelength,leaf\n400,1\n500,bright\n", "line 3, column 'leaf': 'bright' is not a number"),
        ("wavelength,leaf\n400,1\n500,\n600,1\n", "spectra must be finite; found nan in 'leaf' at 500 nm"),
        ("wavelength,leaf\n400,1\n500,nan\n600,1\n", "spectra must be finite; found nan in 'leaf' at 500"),
        ("wavelength,leaf,soil\n400,1,1\n500,,1\n", "spectra must be finite; found nan in 'leaf' at 500"),
        ("wavelength,leaf\n400,inf\n", "spectra must be finite; found inf in 'leaf' at 400 nm"),
        ("wavelength,leaf,soil\n400,1,1\n500,1,-0.5\n", "not be negative; found -0.5 in 'soil' at 500 nm"),
        ("wavelength,leaf\n500,1\n500,1\n", "strictly increase; found 500 nm at index 0 then 500 nm"),
        ("wavelength,leaf\n-4,1\n", "be positive; found -4 nm"),
    ],
)
def test_a_faulty_file_is_refused_with_its_name_and_the_place(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(SpectrumError, match=f"spectra.csv: .*{message}"):
        read_spectra(path)


def test_a_file_that_is_missing_a_folder_or_no_text_is_refused(tmp_path):
    (tmp_path / "spectra.csv").write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00wavelength,leaf\n400,1\n")
    missing = r"nowhere\.csv: can't read spectra: No such file"
    for name, said in (("nowhere.csv", missing), ("", "read spectra"), ("spectra.csv", "is no text")):
        with pytest.raises(SpectrumError, match=said):
            read_spectra(tmp_path / name)


@given(st.floats(-1, 1), st.lists(st.floats(401, 599), min_size=1, max_size=9, unique_by=round))
def test_resampling_is_exact_for_straight_spectra(slope, centers):
    bands = Bands.of(sorted(centers))
    straight = 1.5 + slope * (SMALL.bands.centers_nm - 500) / 100
    expected = 1.5 + slope * (bands.centers_nm - 500) / 100
    np.testing.assert_allclose(resample_spectra(straight, SMALL.bands, bands), expected)


def test_resampling_interpolates_linearly_and_keeps_leading_axes():
    resampled = resample_spectra(SMALL.spectra[None], SMALL.bands, Bands.of([425, 560]))
    np.testing.assert_allclose(resampled, [[[0.2, 0.32], [0.25, 1.9]]])
    np.testing.assert_array_equal(SMALL.resampled(Bands.of([400, 500, 600])).spectra, SMALL.spectra)
    ends = SMALL.resampled(Bands.of([400 - 1e-9, 600 + 1e-9]))  # rounding is no extrapolation
    np.testing.assert_allclose(ends.spectra, [[0.1, 0.2], [0, 2.5]])
    with pytest.raises(SpectrumError, match="spectra of 2 values do not fit 3 bands"):
        resample_spectra(np.ones((4, 2)), SMALL.bands, SMALL.bands)
    with pytest.raises(SpectrumError, match=r"need spectra of shape \(2, 3\); found \(3, 2\)"):
        SpectraTable(SMALL.bands, SMALL.names, SMALL.spectra.T)


def test_extrapolation_is_refused_with_the_distance():
    for centers, said in (([390, 500], "10 nm below"), ([399, 601.5], "1 nm below and 1.5 nm above")):
        with pytest.raises(SpectrumError, match=said):
            SMALL.resampled(Bands.of(centers))
