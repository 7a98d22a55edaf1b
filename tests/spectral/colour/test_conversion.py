from importlib import resources
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
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, read_spectra, write_spectra_csv

EVERY_NM = Bands.of(range(360, 831))


def samplings(low, high, least, most, *further):
    centers = st.lists(st.floats(low, high), min_size=least, max_size=most, unique_by=lambda x: round(x, 1))
    return centers.map(lambda values: Bands.of(sorted([*values, *further])))


def test_xyz_has_the_published_chromaticities():
    """CIE 15: sums of the 1931 colour matching functions at 1 nm, and coordinates of the spectrum locus."""
    xyz = xyz_matrix(EVERY_NM, torch.float64)
    white = torch.tensor([106.8655, 106.8569, 106.8923], dtype=torch.float64) / 106.8569
    assert_close(xyz.sum(0), white, atol=1e-4, rtol=0)
    locus = {450: (0.15664, 0.0177), 520: (0.0743, 0.8338), 600: (0.62704, 0.37249), 650: (0.72599, 0.27401)}
    for nm, expected in locus.items():
        narrow = xyz[EVERY_NM.nearest(nm)]
        assert_close(narrow[:2] / narrow.sum(), torch.tensor(expected).double(), atol=1e-3, rtol=0)


def test_the_shipped_observer_is_that_of_colour_science():
    with np.printoptions():
        from colour.colorimetry import MSDS_CMFS

    table = resources.files("unmix_plugin.spectral.colour") / "cie_1931_2_degree.csv"
    found = np.loadtxt(table.read_text(encoding="utf-8").splitlines(), delimiter=",", skiprows=1)
    observer = MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    assert np.array_equal(found, np.column_stack([observer.wavelengths, observer.values]))


def test_linear_rgb_is_the_published_srgb_matrix_up_to_the_white_of_each_channel():
    # IEC 61966-2-1, XYZ to linear sRGB; each column of the result scaled so that flat 1 is 1.
    to_rgb = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    bands = Bands.of(range(400, 701, 10))
    raw = xyz_matrix(bands, torch.float64) @ torch.tensor(to_rgb, dtype=torch.float64).T
    assert_close(rgb_matrix(bands, torch.float64), raw / raw.sum(0))


@given(samplings(385, 775, 4, 60, 455.03, 545.03, 615.03) | samplings(200, 2500, 1, 30))
def test_flat_spectrum_is_white_on_any_sampling_false_colour_too(bands):
    matrix = rgb_matrix(bands, torch.float64)
    white = torch.ones(len(bands), dtype=torch.float64) @ matrix
    assert_close(white, torch.ones(3, dtype=torch.float64))
    if colour_mode(bands) == "false-colour":
        assert float(matrix.min()) >= 0


def test_a_band_weighs_what_the_fine_bands_inside_its_interval_weigh_together():
    fine = xyz_matrix(Bands.of(np.arange(360.5, 830)), torch.float64)  # edges at whole nm
    coarse = xyz_matrix(Bands.of([430, 490, 550, 562, 580]), torch.float64)
    edges = [400, 460, 520, 556, 571, 589]
    sums = torch.stack([fine[low - 360 : high - 360].sum(0) for low, high in pairwise(edges)])
    assert_close(coarse, sums / sums[:, 1].sum())


TRUE = (range(400, 701, 10), range(450, 651, 10), np.linspace(400, 1000, 128), [450, 550, 650])
INFRARED = (range(700, 1001, 10), [1000, 2000])
FALSE = (*INFRARED, range(600, 701, 10), range(510, 780, 10), [499, 501, 601], [450, 650], [550])


@pytest.mark.parametrize(("mode", "all_centers"), [("true-colour", TRUE), ("false-colour", FALSE)])
def test_true_colour_needs_bands_in_blue_green_and_red(mode, all_centers):
    for centers in all_centers:
        bands = Bands.of(np.asarray(centers, dtype=float))
        assert colour_mode(bands) == mode
        assert describe_colour(bands).startswith(mode.replace("-", " "))


def test_false_colour_shows_the_longest_third_red_and_the_shortest_blue_and_says_so():
    bands, half = Bands.of([800, 850, 900, 950, 1000, 1050]), 0.5
    expected = torch.tensor([[0, 0, half]] * 2 + [[0, half, 0]] * 2 + [[half, 0, 0]] * 2, dtype=torch.float64)
    assert_close(rgb_matrix(bands, torch.float64), expected)
    assert describe_colour(bands) == "false colour: red 975-1075 nm, green 875-975 nm, blue 775-875 nm"
    assert_close(rgb_matrix(Bands.of([900])), torch.ones(1, 3))
    gap = Bands.of([400, 420, 440, 460, 640, 660, 680, 700])  # over which those beside it reach
    said = "false colour: red 603-710 nm, green of bands at 460 and 640 nm, blue 390-497 nm"
    assert describe_colour(gap) == said
    assert (rgb_matrix(gap)[:, 1] > 0).tolist() == [False] * 3 + [True] * 2 + [False] * 3


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda bands: band_composite_matrix(bands, (860, 500, 400)), "no band at 860 nm"),
        (lambda bands: band_composite_matrix(bands, (500, 400)), "three wavelengths .* found 2"),
        (lambda _: xyz_matrix(Bands.of([900, 1000, 1100])), "3 bands, 900-1100 nm hold no visible light"),
        (lambda _: parse_light("D66"), "there is no light 'D66'; nearest: D65"),
        (lambda _: parse_light(""), "known are, among others, A, D50"),
        (lambda _: parse_light("lamp.dat"), r"or give a \.csv file"),
    ],
)
def test_what_a_sensor_does_not_see_or_nobody_knows_is_refused(ask, message):
    with pytest.raises(SpectrumError, match=message):
        ask(Bands.of([400, 500, 600]))


@given(st.floats(-0.5, 2))
def test_srgb_encoding_inverts_on_tensors_and_arrays_alike(value):
    x = torch.tensor([value], dtype=torch.float64)
    assert_close(srgb_to_linear(linear_to_srgb(x)), x, atol=2e-7, rtol=0)
    assert_close(torch.from_numpy(encode_srgb(x.numpy())), linear_to_srgb(x))
    assert_close(torch.from_numpy(decode_srgb(x.numpy())), srgb_to_linear(x))
    # IEC 61966-2-1: code 128 of 255 decodes to 0.21586, code 10 (on the linear piece) to 0.0030353.
    linear = torch.tensor([0.0, 0.0030353, 0.215861, 1.0], dtype=torch.float64)
    codes = torch.tensor([0, 10, 128, 255], dtype=torch.float64) / 255
    assert_close(linear_to_srgb(linear), codes, atol=1e-5, rtol=0)


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


def test_standard_lights_have_the_values_of_their_standard():
    """CIE 15:2018, table T.1: D65 relative to 560 nm; A is a black body, within its table and beyond."""
    power = illuminant_power("D65", Bands.of([400, 401, 559, 560, 561, 699, 700]))
    np.testing.assert_allclose(power[[0, 3, 6]] / power[3], [0.8275, 1.0, 0.7161], atol=5e-3)
    narrow = Bands.of([559.9, 560, 560.1, 699.9, 700, 700.1, 899.9, 900, 900.1, 900.2])
    power = illuminant_power("A", narrow)[[1, 4, 7]]
    planck = [np.exp(-5 * np.log(nm)) / np.expm1(1.435e7 / 2848 / nm) for nm in (560, 700, 900)]
    np.testing.assert_allclose(power / power[0], np.divide(planck, planck[0]), rtol=1e-3)


GAPPED = Bands.of([*np.arange(1000.0, 1341, 10), *np.arange(1460.0, 1691, 10)])
UNEVEN = Bands.of([400, 410, 430, 480, 600])


@pytest.mark.parametrize(
    ("rows", "bands", "expected"),
    [
        # A line counts in its band wherever it lies between centres.
        ("380,0\n434,0\n435,1\n436,0\n720,0", Bands.of([410, 420, 430, 440, 450]), [0, 0, 1, 1, 0]),
        # A light that is given at the bands is taken as it is.
        ("450,1\n500,10\n550,2", Bands.of([450, 500, 550]), [0.1, 1.0, 0.2]),
        # One that is linear in wavelength is sampled in the middle of intervals.
        ("300,0\n800,5", UNEVEN, (UNEVEN.intervals_nm.mean(axis=1) - 300) / 315),
        # What one lacks in a gap of the bands is not missing in those beside it.
        ("1000,1\n1346,1\n1347,0\n1453,0\n1454,1\n1700,1", GAPPED, np.ones(len(GAPPED))),
    ],
)
def test_a_light_from_a_file_is_what_bands_see_of_it(tmp_path, rows, bands, expected):
    (tmp_path / "lamp.csv").write_text(f"wavelength,power\n{rows}\n")
    found = illuminant_power(tmp_path / "lamp.csv", bands)
    np.testing.assert_allclose(found, np.divide(expected, np.max(expected)), atol=1e-12)


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


@pytest.mark.parametrize(("name", "first", "last"), [("D50", 400, 700), ("FL2", 400, 700), ("A", 1000, 2500)])
def test_a_light_that_is_written_at_its_bands_and_read_again_is_the_same(tmp_path, name, first, last):
    """What a table rounds of wavelengths is not out of its reach."""
    bands = Bands.of(np.linspace(first, last, 48) + 1 / 3)
    power = illuminant_power(name, bands)
    write_spectra_csv(tmp_path / "lamp.csv", SpectraTable(bands, ("power",), power[None]))
    np.testing.assert_allclose(illuminant_power(tmp_path / "lamp.csv", bands), power, rtol=1e-6)
    read = read_spectra(tmp_path / "lamp.csv").resampled(bands)
    np.testing.assert_allclose(read.spectra, power[None], rtol=1e-6)


def test_lights_are_named_in_any_case_and_what_ends_in_csv_is_a_file():
    words = {"a": "A", " d65 ": "D65", "60 A/W (Soft White)": "60 A/W (Soft White)"}
    assert {word: parse_light(word) for word in words} == words
    assert parse_light("lamps/A.CSV") == Path("lamps/A.CSV")


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
    assert brightness(np.eye(len(GAPPED))[0], GAPPED) == pytest.approx(1 / len(GAPPED))
    infrared = Bands.of([800, 810, 900])
    share = infrared.widths_nm[2] / infrared.widths_nm.sum()
    assert brightness(np.array([0.0, 0.0, 1.0]), infrared) == pytest.approx(share)
