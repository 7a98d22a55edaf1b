"""Lights by name and from files: their values, what a band sees of them, and what is refused."""

import numpy as np
import pytest

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import (
    brightness,
    illuminant_names,
    illuminant_power,
    parse_light,
)

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


def test_a_line_counts_in_its_band_wherever_it_lies_between_centres(tmp_path):
    path = tmp_path / "line.csv"
    path.write_text("wavelength,power\n380,0\n434,0\n435,1\n436,0\n720,0\n")
    power = illuminant_power(path, VISIBLE)
    np.testing.assert_allclose(power[VISIBLE.centers_nm == 430], 1.0)
    np.testing.assert_allclose(power[VISIBLE.centers_nm == 440], 1.0)
    assert power.sum() == pytest.approx(2)


def test_a_light_linear_in_wavelength_is_sampled_at_band_centres(tmp_path):
    path = tmp_path / "ramp.csv"
    path.write_text("wavelength,power\n300,0\n800,5\n")
    uneven = Bands.of([400, 410, 430, 480, 600])
    power = illuminant_power(path, uneven)
    widths = uneven.edges_nm
    middles = (widths[1:] + widths[:-1]) / 2
    np.testing.assert_allclose(power / power[0], (middles - 300) / (middles[0] - 300))


@pytest.mark.parametrize(
    ("word", "light"), [("a", "A"), (" d65 ", "D65"), ("fl2", "FL2"), ("60 A/W (Soft White)", None)]
)
def test_lights_are_named_in_any_case(word, light):
    assert parse_light(word) == (light or word)


def test_what_ends_in_csv_is_a_file(tmp_path):
    assert parse_light(f"{tmp_path}/A.CSV") == tmp_path / "A.CSV"


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("D66", "there is no light 'D66'; nearest: D65"),
        ("", "known are, among others, A, D50"),
        ("lamp.txt", r"or give a \.csv file"),
    ],
)
def test_an_unknown_light_is_refused_with_the_nearest(word, message):
    with pytest.raises(SpectrumError, match=message):
        parse_light(word)


def test_a_light_that_does_not_reach_is_refused_by_how_much_and_held_when_asked():
    beyond = Bands.of(np.linspace(700, 900, 5))
    with pytest.raises(SpectrumError, match=r"light FL2: .* 120 nm above their range"):
        illuminant_power("FL2", beyond)
    held = illuminant_power("FL2", beyond, "hold")
    assert held[-1] == held[-2] > 0


def test_a_file_must_hold_one_light_that_shines(tmp_path):
    path = tmp_path / "lamp.csv"
    path.write_text("wavelength,a,b\n300,1,1\n800,1,1\n")
    with pytest.raises(SpectrumError, match="a light has two columns, wavelength and power; found 3"):
        illuminant_power(path, VISIBLE)
    path.write_text("wavelength,power\n300,0\n800,0\n")
    with pytest.raises(SpectrumError, match="has no power in any of 31 bands"):
        illuminant_power(path, VISIBLE)


def test_white_is_as_bright_as_its_luminance_or_without_colours_as_its_mean_radiance():
    assert brightness(np.ones(31), VISIBLE) == pytest.approx(1)
    green = np.exp(-(((VISIBLE.centers_nm - 555) / 30) ** 2))
    blue = np.exp(-(((VISIBLE.centers_nm - 440) / 30) ** 2))
    assert brightness(green, VISIBLE) > 10 * brightness(blue, VISIBLE)
    infrared = Bands.of([800, 810, 900])
    assert brightness(np.array([0.0, 0.0, 1.0]), infrared) == pytest.approx(
        infrared.widths_nm[2] / infrared.widths_nm.sum()
    )
