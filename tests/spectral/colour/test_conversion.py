"""Lights by name and from files: their values, what a band sees of them, and what is refused."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import (
    band_composite_matrix,
    brightness,
    colour_mode,
    describe_colour,
    illuminant_names,
    illuminant_power,
    linear_to_srgb,
    parse_light,
    rgb_matrix,
    srgb_to_linear,
    xyz_matrix,
)
from unmix_plugin.spectral.colour.srgb import decode_srgb, encode_srgb
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, read_spectra_csv, write_spectra_csv

visible = st.lists(st.floats(385, 775), min_size=4, max_size=60, unique_by=lambda x: round(x, 1)).map(
    lambda values: Bands.of(sorted([*values, 455.03, 545.03, 615.03]))
)
anywhere = st.lists(st.floats(200, 2500), min_size=1, max_size=30, unique_by=lambda x: round(x, 1)).map(
    lambda values: Bands.of(sorted(values))
)
EVERY_NM = Bands.of(range(360, 831))


def luminance(linear_rgb):
    return linear_rgb @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=linear_rgb.dtype)


def test_xyz_of_the_equal_energy_spectrum_has_the_chromaticity_of_illuminant_e():
    # Sums of the CIE 1931 colour matching functions at 1 nm (CIE 15): 106.8655, 106.8569, 106.8923.
    white = xyz_matrix(EVERY_NM, torch.float64).sum(0)
    assert_close(
        white, torch.tensor([106.8655, 106.8569, 106.8923], dtype=torch.float64) / 106.8569, atol=1e-4, rtol=0
    )


@pytest.mark.parametrize(
    ("wavelength_nm", "x", "y"),
    # Spectrum locus, CIE 15 table of chromaticity coordinates of the 1931 observer.
    [(450, 0.15664, 0.01770), (520, 0.07430, 0.83380), (600, 0.62704, 0.37249), (650, 0.72599, 0.27401)],
)
def test_one_narrow_band_has_the_published_chromaticity_of_its_wavelength(wavelength_nm, x, y):
    xyz = xyz_matrix(EVERY_NM, torch.float64)[EVERY_NM.nearest(wavelength_nm)]
    assert_close(xyz[:2] / xyz.sum(), torch.tensor([x, y], dtype=torch.float64), atol=1e-3, rtol=0)


def test_linear_rgb_is_the_published_srgb_matrix_up_to_the_white_of_each_channel():
    # IEC 61966-2-1, XYZ to linear sRGB; each column of the result scaled so that flat 1 is 1.
    to_rgb = torch.tensor(
        [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]],
        dtype=torch.float64,
    )
    bands = Bands.of(range(400, 701, 10))
    raw = xyz_matrix(bands, torch.float64) @ to_rgb.T
    assert_close(rgb_matrix(bands, torch.float64), raw / raw.sum(0))


@given(visible | anywhere)
def test_flat_spectrum_is_white_with_unit_luminance_on_any_sampling_false_colour_too(bands):
    matrix = rgb_matrix(bands, torch.float64)
    white = torch.ones(len(bands), dtype=torch.float64) @ matrix
    assert_close(white, torch.ones(3, dtype=torch.float64))
    assert_close(luminance(white), torch.tensor(1.0, dtype=torch.float64))
    if colour_mode(bands) == "false-colour":
        assert float(matrix.min()) >= 0


def test_a_band_weighs_what_the_fine_bands_inside_its_interval_weigh_together():
    fine = xyz_matrix(Bands.of(np.arange(360.5, 830)), torch.float64)  # edges at whole nm
    coarse = xyz_matrix(Bands.of([430, 490, 550, 562, 580]), torch.float64)
    edges = [400, 460, 520, 556, 571, 589]
    sums = torch.stack([fine[low - 360 : high - 360].sum(0) for low, high in pairwise(edges)])
    assert_close(coarse, sums / sums[:, 1].sum())


@pytest.mark.parametrize(
    ("centers", "mode"),
    [
        (range(400, 701, 10), "true-colour"),
        (range(450, 651, 10), "true-colour"),
        (np.linspace(400, 1000, 128), "true-colour"),
        ([450, 550, 650], "true-colour"),
        (range(700, 1001, 10), "false-colour"),
        (range(600, 701, 10), "false-colour"),
        (range(510, 780, 10), "false-colour"),
        ([499, 501, 601], "false-colour"),
        ([450, 650], "false-colour"),
        ([550], "false-colour"),
        ([1000, 2000], "false-colour"),
    ],
)
def test_true_colour_needs_bands_in_blue_green_and_red(centers, mode):
    bands = Bands.of(np.asarray(centers, dtype=float))
    assert colour_mode(bands) == mode
    assert describe_colour(bands).startswith(mode.replace("-", " "))


def test_false_colour_shows_the_longest_third_red_and_the_shortest_blue_and_says_so():
    bands, half = Bands.of([800, 850, 900, 950, 1000, 1050]), 0.5
    expected = torch.tensor([[0, 0, half]] * 2 + [[0, half, 0]] * 2 + [[half, 0, 0]] * 2, dtype=torch.float64)
    assert_close(rgb_matrix(bands, torch.float64), expected)
    said = "false colour: red 975-1075 nm, green 875-975 nm, blue 775-875 nm"
    assert describe_colour(bands) == said
    assert_close(rgb_matrix(Bands.of([900])), torch.ones(1, 3))


def test_a_third_without_bands_is_shown_by_those_beside_it_and_says_so():
    bands = Bands.of([400, 420, 440, 460, 640, 660, 680, 700])
    said = "false colour: red 603-710 nm, green of bands at 460 and 640 nm, blue 390-497 nm"
    assert describe_colour(bands) == said
    assert (rgb_matrix(bands)[:, 1] > 0).tolist() == [False] * 3 + [True] * 2 + [False] * 3


def test_band_composite_picks_the_nearest_band_of_each_channel():
    spectrum = torch.arange(31.0)
    picked = spectrum @ band_composite_matrix(Bands.of(range(400, 701, 10)), (698, 551, 404))
    assert picked.tolist() == [30.0, 15.0, 0.0]


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda bands: band_composite_matrix(bands, (860, 500, 400)), "no band at 860 nm"),
        (lambda bands: band_composite_matrix(bands, (500, 400)), "three wavelengths .* found 2"),
        (lambda _: xyz_matrix(Bands.of([900, 1000, 1100])), "3 bands, 900-1100 nm hold no visible light"),
        (lambda _: parse_light("D66"), "there is no light 'D66'; nearest: D65"),
        (lambda _: parse_light(""), "known are, among others, A, D50"),
        (lambda _: parse_light("lamp.txt"), r"or give a \.csv file"),
    ],
)
def test_what_a_sensor_does_not_see_or_nobody_knows_is_refused(ask, message):
    with pytest.raises(SpectrumError, match=message):
        ask(Bands.of([400, 500, 600]))


@given(st.floats(-0.5, 2))
def test_srgb_encoding_inverts(value):
    x = torch.tensor([value], dtype=torch.float64)
    assert_close(srgb_to_linear(linear_to_srgb(x)), x, atol=2e-7, rtol=0)
    assert_close(torch.from_numpy(encode_srgb(x.numpy())), linear_to_srgb(x))
    assert_close(torch.from_numpy(decode_srgb(x.numpy())), srgb_to_linear(x))


def test_srgb_encoding_has_the_standards_values():
    # IEC 61966-2-1: code 128 of 255 decodes to 0.21586, code 10 (on the linear piece) to 0.0030353.
    linear = torch.tensor([0.0, 0.0030353, 0.215861, 1.0], dtype=torch.float64)
    codes = torch.tensor([0, 10, 128, 255], dtype=torch.float64) / 255
    assert_close(linear_to_srgb(linear), codes, atol=1e-5, rtol=0)
    assert_close(srgb_to_linear(codes), linear, atol=1e-6, rtol=0)


@pytest.mark.parametrize("encode", [linear_to_srgb, srgb_to_linear])
def test_srgb_gradients_are_finite_and_right_at_zero_and_below(encode):
    x = torch.tensor([-0.3, 0.0, 1e-12, 0.02, 0.5, 1.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(encode, x)
    slope = 12.92 if encode is linear_to_srgb else 1 / 12.92
    (gradient,) = torch.autograd.grad(encode(x).sum(), x)
    assert_close(gradient[:3], torch.full((3,), slope, dtype=torch.float64))


VISIBLE = Bands.of(np.linspace(400, 700, 31))


def test_every_known_light_shines_on_the_bands_that_it_covers():
    assert {"A", "C", "D50", "D65", "E", "FL2", "LED-B1", "Cool White FL"} <= set(illuminant_names())
    wide, narrow = Bands.of(np.linspace(420, 680, 14)), Bands.of(np.linspace(400, 550, 14))
    for name in illuminant_names():
        power = illuminant_power(name, narrow if "Printer" in name else wide)
        assert power.min() >= 0
        assert power.max() == 1


def test_daylight_has_the_values_of_its_standard():
    """CIE 15:2018, table T.1: D65 relative to 560 nm."""
    narrow = Bands.of([400, 401, 559, 560, 561, 699, 700])
    power = illuminant_power("D65", narrow)
    np.testing.assert_allclose(power[[0, 3, 6]] / power[3], [0.8275, 1.0, 0.7161], atol=5e-3)


def test_the_incandescent_light_is_its_black_body_within_the_table_and_beyond():
    from colour.colorimetry import SDS_ILLUMINANTS

    table = SDS_ILLUMINANTS["A"]
    narrow = Bands.of([559.9, 560, 560.1, 699.9, 700, 700.1, 899.9, 900, 900.1, 900.2])
    power = illuminant_power("A", narrow)
    assert power[4] / power[1] == pytest.approx(table[700] / table[560], rel=1e-3)
    planck = [np.exp(-5 * np.log(nm)) / np.expm1(1.435e7 / 2848 / nm) for nm in (560, 900)]
    assert power[7] / power[1] == pytest.approx(planck[1] / planck[0], rel=1e-3)


@pytest.mark.parametrize(
    ("rows", "bands", "expected"),
    [
        # A line counts in its band wherever it lies between centres.
        ("380,0\n434,0\n435,1\n436,0\n720,0", [410, 420, 430, 440, 450], [0, 0, 1, 1, 0]),
        # A light that is given at the bands is taken as it is.
        ("450,1\n500,10\n550,2", [450, 500, 550], [0.1, 1.0, 0.2]),
    ],
)
def test_a_light_from_a_file_is_what_bands_see_of_it(tmp_path, rows, bands, expected):
    (tmp_path / "lamp.csv").write_text(f"wavelength,power\n{rows}\n")
    np.testing.assert_allclose(illuminant_power(tmp_path / "lamp.csv", Bands.of(bands)), expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wavelength,a,b\n300,1,1\n800,1,1\n", "a light has two columns, wavelength and power; found 3"),
        ("wavelength,power\n300,0\n800,0\n", "has no power in any of 31 bands"),
    ],
)
def test_a_file_must_hold_one_light_that_shines(tmp_path, text, message):
    (tmp_path / "lamp.csv").write_text(text)
    with pytest.raises(SpectrumError, match=message):
        illuminant_power(tmp_path / "lamp.csv", VISIBLE)


@pytest.mark.parametrize("name", ["D50", "FL2"])
def test_a_light_that_is_written_at_its_bands_and_read_again_is_the_same(tmp_path, name):
    bands = Bands.of(np.linspace(400, 700, 48))
    power = illuminant_power(name, bands)
    write_spectra_csv(tmp_path / "lamp.csv", SpectraTable(bands, ("power",), power[None]))
    np.testing.assert_allclose(illuminant_power(tmp_path / "lamp.csv", bands), power, rtol=1e-8)


def test_wavelengths_that_a_table_rounds_are_not_out_of_its_reach(tmp_path):
    bands = Bands.of(np.linspace(1000, 2500, 48) + 1 / 3)
    spectra = np.linspace(0.1, 1, 48)[None]
    write_spectra_csv(tmp_path / "table.csv", SpectraTable(bands, ("power",), spectra))
    read = read_spectra_csv(tmp_path / "table.csv").resampled(bands)
    np.testing.assert_allclose(read.spectra, spectra, rtol=1e-6)


def test_a_light_linear_in_wavelength_is_sampled_at_band_centres(tmp_path):
    path = tmp_path / "ramp.csv"
    path.write_text("wavelength,power\n300,0\n800,5\n")
    uneven = Bands.of([400, 410, 430, 480, 600])
    power = illuminant_power(path, uneven)
    middles = uneven.intervals_nm.mean(axis=1)
    np.testing.assert_allclose(power / power[0], (middles - 300) / (middles[0] - 300))


def test_what_a_light_lacks_in_a_gap_of_the_bands_is_not_missing_in_those_beside_it(tmp_path):
    path = tmp_path / "sun.csv"
    path.write_text("wavelength,power\n1000,1\n1346,1\n1347,0\n1453,0\n1454,1\n1700,1\n")
    nm = np.arange(1000.0, 1700, 10)
    bands = Bands.of(nm[(nm < 1345) | (nm > 1455)])
    np.testing.assert_allclose(illuminant_power(path, bands), 1.0)
    assert brightness(np.where(bands.centers_nm == 1340, 1.0, 0.0), bands) == pytest.approx(1 / len(bands))


@pytest.mark.parametrize(
    ("word", "light"),
    [
        ("a", "A"),
        (" d65 ", "D65"),
        ("fl2", "FL2"),
        ("60 A/W (Soft White)", "60 A/W (Soft White)"),
        ("lamps/A.CSV", Path("lamps/A.CSV")),
    ],
)
def test_lights_are_named_in_any_case_and_what_ends_in_csv_is_a_file(word, light):
    assert parse_light(word) == light


def test_a_light_that_does_not_reach_is_refused_by_how_much_and_held_when_asked():
    beyond = Bands.of(np.linspace(700, 900, 5))
    with pytest.raises(SpectrumError, match=r"light FL2: .* 120 nm above their range"):
        illuminant_power("FL2", beyond)
    held = illuminant_power("FL2", beyond, "hold")
    assert held[-1] == held[-2] > 0


def test_white_is_as_bright_as_its_luminance_or_without_colours_as_its_mean_radiance():
    assert brightness(np.ones(31), VISIBLE) == pytest.approx(1)
    green = np.exp(-(((VISIBLE.centers_nm - 555) / 30) ** 2))
    blue = np.exp(-(((VISIBLE.centers_nm - 440) / 30) ** 2))
    assert brightness(green, VISIBLE) > 10 * brightness(blue, VISIBLE)
    infrared = Bands.of([800, 810, 900])
    assert brightness(np.array([0.0, 0.0, 1.0]), infrared) == pytest.approx(
        infrared.widths_nm[2] / infrared.widths_nm.sum()
    )
