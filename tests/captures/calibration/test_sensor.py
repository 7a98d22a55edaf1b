"""Bands that are left out, and where the detector ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.captures.test_camera_tags import EXIF, MICASENSE
from tests.factories.files import exposure_of_file, file_of
from unmix_plugin.captures.calibration.bands import (
    BandChoice,
    BandFault,
    DroppedBand,
    noise_shares,
    without_bad,
)
from unmix_plugin.captures.calibration.calibration import WhiteSample, count_stored, sampled_rows
from unmix_plugin.captures.calibration.references import (
    GivenReferences,
    ReferenceKind,
    open_reference,
    panel_reference,
)
from unmix_plugin.captures.cube import CameraTags, CaptureView, Linear
from unmix_plugin.captures.decide import find_saturation, saturated_bands
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.plan import plan_sensor, with_one_exposure
from unmix_plugin.captures.report import Code

WAVELENGTHS_NM = np.linspace(400.0, 900.0, 12)
NAMED = DroppedBand(BandFault.NAMED)
GENERATOR = np.random.default_rng(0)
SPECTRA = GENERATOR.random((3, 12)) * 0.6 + 0.2
MIXTURES = (GENERATOR.dirichlet(np.ones(3), 3000) @ SPECTRA).astype(np.float32)


def test_noise_is_found_beside_what_bands_share_and_not_told_from_too_few_pixels_or_bands():
    level = np.full(12, 0.01)
    level[7] = 0.3
    noisy = MIXTURES + level * np.random.default_rng(5).standard_normal(MIXTURES.shape)
    expected = level / np.sqrt((noisy**2).mean(axis=0))
    found = noise_shares(noisy.astype(np.float32))
    assert found[7] == pytest.approx(expected[7], rel=0.05)
    np.testing.assert_allclose(np.delete(found, 7), np.delete(expected, 7), rtol=0.5)
    assert np.isnan(noise_shares(MIXTURES[:20])).all()
    assert np.isnan(noise_shares(MIXTURES[:, :3])).all()


def test_dead_saturated_and_noisy_bands_are_left_out_with_the_reason():
    values = MIXTURES.copy()
    values[:, 2] = 0.5
    values[:, 7] += 3.0 * GENERATOR.standard_normal(len(values)).astype(np.float32)
    saturated = np.zeros(values.shape, bool)
    saturated[: len(values) // 3, 9] = True
    choice = BandChoice(WAVELENGTHS_NM, dropped={0: NAMED})
    found, _ = without_bad(choice, values[:, 1:], saturated[:, 1:], 0.5)
    assert {index: band.fault for index, band in found.dropped.items()} == {
        0: BandFault.NAMED,
        2: BandFault.DEAD,
        7: BandFault.NOISY,
        9: BandFault.SATURATED,
    }
    assert found.dropped[9].reason == "saturated in more than 20% of sampled pixels"
    assert found.dropped[7].reason.startswith("noise is ")
    np.testing.assert_array_equal(found.kept, [1, 3, 4, 5, 6, 8, 10, 11])


def test_what_is_wrong_with_every_band_drops_none():
    """A white background that saturates them, or nothing that they have in common."""
    choice = BandChoice(WAVELENGTHS_NM)
    saturated = np.zeros(MIXTURES.shape, bool)
    saturated[:2000] = True
    assert without_bad(choice, MIXTURES, saturated, 0.5) == (choice, [])
    independent = GENERATOR.random((3000, 12)).astype(np.float32)
    kept, remarks = without_bad(choice, independent, np.zeros_like(saturated), 0.3)
    assert kept.dropped == {}
    assert [(remark.code, remark.values["noisy"]) for remark in remarks] == [(Code.NOISY_BANDS_KEPT, 12)]


def test_bands_are_sorted_and_binned_by_wavelength_and_used_once():
    choice = BandChoice(np.array([700.0, 500.0, 600.0, 800.0, 550.0]), dropped={3: NAMED})
    np.testing.assert_array_equal(choice.kept, [1, 4, 2, 0])
    np.testing.assert_allclose(choice.centers_nm(2), [525.0, 650.0])
    assert list(BandChoice(np.array([500.0, 510.0, 500.0])).without_repeated().dropped) == [2]


@pytest.mark.parametrize(
    ("wavelengths_nm", "dropped", "expected"),
    [
        ([500, 510, 520, 530, 540], [], [505, 525]),
        ([500, 510, 520, 530, 540, 550, 560], [3], [505, 530, 555]),  # a single bad band
        ([*range(500, 600, 10)], [3, 4], [505, 555, 575]),
        ([*range(500, 620, 10)], [2, 3, 4, 6, 7, 8], [505, 595]),  # one band between two gaps
        ([*range(500, 560, 10)], [2, 3, 4], [505]),  # one behind the last
        ([500, 505, 507.5, 510, 512.5, 515], [2, 4], [502.5, 512.5]),  # bad ones of a second detector
        ([*range(500, 541, 10), *range(503, 537, 3)], [*range(5, 17)], [505, 525]),  # of a finer one
        ([1320, 1330, 1340, 1460, 1470, 1480, 1490], [], [1325, 1465, 1485]),  # cut out of the file
        ([500, 510, 510, 520, 530], [2], [505, 525]),  # of two bands of one wavelength the other is there
        ([450, 550, 610, 790], [], [500, 700]),
        ([500, 900], [], [700]),
    ],
)
def test_no_bin_spans_a_gap(wavelengths_nm, dropped, expected):
    named = BandChoice(np.array(wavelengths_nm, float), dropped=dict.fromkeys(dropped, NAMED))
    choice = named.without_incomplete_bins(2)
    np.testing.assert_allclose(choice.centers_nm(2), expected)
    assert {band.fault for band in choice.dropped.values()} <= {BandFault.NAMED, BandFault.BIN_INCOMPLETE}


def saturation_of(file):
    return find_saturation(count_stored([file], np.arange(6)))


@pytest.mark.parametrize(
    ("top", "facts", "part", "value", "expected"),
    [
        (4095, {}, np.s_[:0], 0, 4095.0),
        (3900, {}, np.s_[:0], 0, 3900.0),
        (60000, {}, np.s_[:0], 0, 65535.0),
        (4095, {"valid_range": (0.0, 10000.0)}, np.s_[::3], 65535, 4095.0),  # which are missing
        (60000, {}, np.s_[..., 3], 60000, 65535.0),  # a band that is stuck
    ],
)
def test_the_end_of_the_detector_is_a_plateau(top: int, facts, part, value: int, expected: float):
    counts = GENERATOR.normal(2000, 900, (64, 64, 6)).clip(0, top).astype(np.uint16)
    counts[part] = value
    assert saturation_of(file_of(counts, **facts)).stored == expected


@pytest.mark.filterwarnings("error")
def test_radiance_in_half_precision_is_no_counts():
    file = file_of(GENERATOR.uniform(0, 1, (16, 16, 6)).astype(np.float16))
    assert not count_stored([file], np.arange(6)).are_whole


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 4095.0), (1e-4, None), (-1.0, None)])
@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_counts_end_where_the_detector_does_in_wider_numbers_too(dtype, factor: float, expected):
    counts = GENERATOR.normal(2000, 900, (64, 64, 6)).clip(0, 4095).round()
    assert saturation_of(file_of((counts * factor).astype(dtype))).stored == expected


def test_a_rim_without_a_measurement_hides_no_saturation():
    counts = GENERATOR.normal(2000, 900, (64, 64, 6)).clip(0, 4095).round().astype(np.float32)
    counts[:, :5], counts[:, -5:], counts[:2], counts[-2:] = (np.nan,) * 4
    assert saturation_of(file_of(counts)).stored == 4095.0
    found = saturation_of(file_of(np.full_like(counts, np.nan)))
    assert found.stored is None
    assert "no sampled pixel has a measurement" in found.reason


def white_of(counts: np.ndarray, **facts):
    return open_reference(file_of(counts, **facts), ReferenceKind.WHITE, file_of(counts, **facts))


def test_missing_pixels_of_a_white_do_not_count_as_saturated():
    counts = GENERATOR.integers(2900, 3100, (16, 8, 3)).astype(np.uint16)
    counts[1:4, :, 2] = 4095
    counts[::8] = 65535
    found = saturated_bands(WhiteSample.of(white_of(counts, no_data=(65535.0,))), 65535.0)
    np.testing.assert_array_equal(found, [False, False, True])
    counts[sampled_rows(16)] = 65535  # nothing is left to look at
    assert not saturated_bands(WhiteSample.of(white_of(counts, no_data=(65535.0,))), 65535.0).any()


BLOWN = np.array([False, True, False])


@pytest.mark.parametrize(
    ("facts", "top", "dtype", "saturation"),
    [
        ({}, 4095, np.uint16, 4095.0),
        ({}, 4095, np.uint16, 65535.0),  # which no posed view tells
        ({"linear": Linear(np.full(3, 1e-4), np.zeros(3), "a header")}, 4095, np.uint16, 4095.0),
        ({"is_srgb": True}, 255, np.uint8, 255.0),
        ({"camera": CameraTags(MICASENSE, EXIF)}, 65520, np.uint16, 65520.0),
    ],
)
def test_a_blown_out_white_is_told_by_its_stored_numbers(facts, top, dtype, saturation):
    """Whatever values are made of these, and whether it is a file of its own or a part of a view."""
    noisy = GENERATOR.normal(0.8 * top, 0.03 * top, (40, 20, 3))
    noisy[..., BLOWN] *= 1.8
    counts = np.rint(noisy.clip(0, top)).astype(dtype)
    view = np.full((60, 50, 3), top // 3, dtype)
    view[7:47, 9:29] = counts
    panel = panel_reference(file_of(view, **facts), (7, 9, 40, 20), "a view")
    for white in (white_of(counts, **facts), panel):
        np.testing.assert_array_equal(saturated_bands(WhiteSample.of(white), saturation), BLOWN)


def together(cubes: dict[str, np.ndarray], facts: dict[str, dict]):
    """The sensors of files that one camera wrote, as they are brought to one exposure."""
    bands = np.array([500.0, 600.0, 700.0])
    files = {name: file_of(cube, bands, **facts[name]) for name, cube in cubes.items()}
    options = ProcessOptions("cubes", data=Path(), output_dir=Path())
    each = {name: [CaptureView(name, file, name)] for name, file in files.items()}
    sensors = {name: plan_sensor(own, options, GivenReferences(), own) for name, own in each.items()}
    return with_one_exposure(sensors, files).values()


@pytest.mark.parametrize(
    ("dtype", "scale", "facts", "said"),
    [
        (np.uint16, 3000.0, {}, "each is brought to that of the first view, 0.01"),
        (np.float32, 0.3, {}, "values are not divided by that, as they are at most about 1"),
        (np.uint8, 90.0, {"is_srgb": True}, "which can't be undone as cameras encode the brightness"),
    ],
)
def test_sensors_of_one_camera_have_one_exposure_or_it_is_said_why_not(dtype, scale, facts, said):
    """Views of two sizes, the second taken at twice the time."""
    light = GENERATOR.random((12, 10, 3)) + 0.2
    cubes = {name: (scale * ratio * light).astype(dtype) for name, ratio in (("10x12", 1), ("12x10", 2))}
    times = {name: {"exposure": exposure_of_file(time)} for name, time in (("10x12", 0.01), ("12x10", 0.02))}
    times = {name: facts | own for name, own in times.items()}
    upright, across = together(cubes, times)
    assert said in " ".join(remark.sentence for remark in upright.remarks)
    assert np.allclose(across.sample, upright.sample, rtol=1e-2) == (dtype == np.uint16)


def test_what_is_wrong_with_exposures_of_one_sensor_is_said_once():
    """One with times that can't be those of its bands, beside one without any."""
    cube = np.full((12, 10, 3), 1000, np.uint16) + np.arange(10, dtype=np.uint16)[:, None]
    times = {"a": [0.01, 0.02], "b": [0.01, 0.04]}
    times = {name: {"exposure": exposure_of_file(own)} for name, own in times.items()}
    for sensor in together({"a": cube, "b": cube}, times):
        (remark,) = sensor.remarks
        assert remark.code is Code.EXPOSURES_MISFIT
        assert "2 exposure times or gains for 3 bands" in remark.sentence
