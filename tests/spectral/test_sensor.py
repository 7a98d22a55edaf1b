from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable
from unmix_plugin.spectral.sensor import SpectralResponses, read_sensor

BANDS = Bands.of(np.linspace(400, 700, 31))
"""Cover 395-705 nm."""


def sensor(wavelengths_nm, **responses) -> SpectralResponses:
    values = np.array(list(responses.values()), dtype=np.float64)
    return SpectralResponses("toy", SpectraTable(Bands.of(wavelengths_nm), tuple(responses), values))


def box(low: float, high: float) -> SpectralResponses:
    """One channel that responds evenly from one wavelength to another."""
    return sensor([low, high], box=[1, 1])


def write(folder: Path, text: str) -> Path:
    path = folder / "camera.csv"
    path.write_text(text)
    return path


@settings(deadline=None, max_examples=30)
@given(st.tuples(*[st.floats(0.01, 1)] * 4), st.tuples(*[st.floats(0, 1)] * 3))
def test_a_flat_spectrum_is_1_in_every_channel(first, second):
    seen = sensor([410, 433, 570.5, 690], a=first, b=[*second, 1.7]).seen_by(BANDS)
    assert seen.matrix.shape == (31, 2)
    assert seen.matrix.min() >= 0
    np.testing.assert_allclose(np.ones(31) @ seen.matrix, 1, rtol=1e-12)


def test_a_channel_that_is_a_band_or_lies_in_one_gives_that_band():
    uneven = Bands.of([420, 440, 500, 510, 600])
    for index, (low, high) in enumerate(uneven.intervals_nm):
        seen = box(low, high).seen_by(uneven)
        np.testing.assert_allclose(seen.matrix[:, 0], np.eye(5)[index], atol=1e-12)
    seen = sensor([400, 546, 547, 548, 700], line=[0, 0, 1, 0, 0]).seen_by(BANDS)
    assert seen.bands == Bands.of([547])
    np.testing.assert_allclose(seen.matrix[:, 0], BANDS.centers_nm == 550, atol=1e-12)


@pytest.mark.parametrize(("center", "half_width"), [(550, 47), (545, 12.5), (480, 80)])
def test_a_linear_spectrum_is_seen_as_at_the_centre_of_a_symmetric_response(center, half_width):
    seen = sensor([center - half_width, center, center + half_width], peak=[0, 1, 0]).seen_by(BANDS)
    assert seen.bands == Bands.of([center])
    ramp = 0.002 * (BANDS.centers_nm - 350)
    np.testing.assert_allclose(ramp @ seen.matrix, 0.002 * (center - 350), rtol=1e-12)


def test_bands_weigh_as_much_as_of_the_response_lies_in_them():
    """By brute force: means of a finely sampled response."""
    table, response = [430.0, 452.0, 520.0, 521.0, 600.0], [0.2, 1.0, 0.6, 0.0, 0.3]
    fine = np.arange(430, 600, 0.01) + 0.005
    values = np.interp(fine, table, response)
    shares = np.histogram(fine, BANDS.edges_nm, weights=values)[0]
    seen = sensor(table, odd=response).seen_by(BANDS)
    np.testing.assert_allclose(seen.matrix[:, 0], shares / shares.sum(), atol=1e-5)
    assert seen.bands.centers_nm[0] == pytest.approx((fine @ values) / values.sum(), abs=1e-2)


def test_channels_are_sorted_by_their_centres():
    nm = [450, 500, 550, 600, 650]
    seen = sensor(nm, red=[0, 0, 0, 1, 1], blue=[1, 1, 0, 0, 0], green=[0, 0, 1, 0, 0]).seen_by(BANDS)
    assert seen.names == ("blue", "green", "red")
    assert seen.matrix[BANDS.centers_nm == 450, 0] > 0
    assert seen.matrix[BANDS.centers_nm == 650, 2] > 0
    assert seen.description == "seen through toy: blue 488.889 nm, green 550 nm, red 611.111 nm"


def test_channels_beyond_the_bands_are_left_out_and_named():
    nm = [450, 550, 550.1, 1564.9, 1565, 1655]
    seen = sensor(nm, SWIR1=[0, 0, 0, 0, 1, 1], visible=[1, 1, 0, 0, 0, 0]).seen_by(BANDS)
    assert seen.names == ("visible",)
    assert seen.notes == ("left out SWIR1 (1565-1655 nm): the bands cover 395-705 nm",)
    with pytest.raises(SpectrumError, match=r"'toy' sees nothing: .* 395-705 nm, .*SWIR1 \(1565-1655 nm\)"):
        sensor(nm, SWIR1=[0, 0, 0, 0, 1, 1]).seen_by(BANDS)


def test_a_channel_in_a_gap_of_the_bands_is_left_out_and_one_beside_it_is_as_without_the_gap():
    nm = np.arange(1000.0, 1701, 10)
    every, some = Bands.of(nm), Bands.of(nm[(nm < 1345) | (nm > 1455)])
    both = sensor([1310, 1330, 1344, 1390, 1400, 1410], dry=[0, 1, 0, 0, 0, 0], wet=[0, 0, 0, 0, 1, 0])
    seen = both.seen_by(some)
    assert seen.names == ("dry",)
    [note] = seen.notes
    assert note.startswith("left out wet (139")
    assert note.endswith("the bands cover 995-1345, 1455-1705 nm")
    whole = both.seen_by(every)
    assert (whole.names, whole.notes) == (("dry", "wet"), ())
    np.testing.assert_allclose(seen.matrix[:35, 0], whole.matrix[:35, 0], atol=1e-12)


def test_a_channel_may_have_a_hundredth_of_its_response_beyond_the_bands():
    for beyond, is_kept in ((0.009, True), (0.011, False)):
        both = sensor(
            [500, 600, 600.001, 605, 605.001, 705 - 100 * (1 - beyond), 705 + 100 * beyond],
            inside=[1, 1, 0, 0, 0, 0, 0],
            over=[0, 0, 0, 0, 1, 1, 1],
        )
        seen = both.seen_by(BANDS)
        assert (("over" in seen.names), len(seen.notes)) == (is_kept, not is_kept)
        np.testing.assert_allclose(seen.matrix.sum(axis=0), 1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wavelength,a,b\n500,1,0\n600,1,0\n", "channel 'b' is zero at all wavelengths"),
        ("wavelength,a,b\n500,0,1\n550,1,0\n600,0,1\n", "'a' and 'b' have the same centre, 550 nm"),
        ("wavelength,a\n500,1\n", "at least two wavelengths"),
        ("band,a\n500,1\n600,1\n", "first column must be headed 'wavelength'"),
    ],
)
def test_a_file_is_a_sensor_named_after_it_and_a_bad_one_refused_with_its_name(tmp_path, text, said):
    found = read_sensor(write(tmp_path, "wavelength,nir,red\n600,0,1\n650,0,1\n651,1,0\n700,1,0\n"))
    assert (found.name, found.seen_by(BANDS).names) == ("camera", ("red", "nir"))
    with pytest.raises(SpectrumError, match=rf"camera\.csv: .*{said}"):
        read_sensor(write(tmp_path, text))
