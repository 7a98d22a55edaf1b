"""Dark frames and white references, and from stored numbers to values, some rows at a time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.factories.files import file_of
from unmix_plugin.captures.calibration.calibration import Calibration, Raster
from unmix_plugin.captures.calibration.references import (
    GivenReferences,
    ReferenceKind,
    SensorReferences,
    ViewReferences,
    find_missing,
    find_references,
    open_reference,
    panel_reference,
)
from unmix_plugin.captures.cube import CaptureView, Cube, Linear
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.errors import CaptureError, ConfigError

LINES, SAMPLES, NUM = 40, 24, 3
EMPTY = file_of(np.zeros((LINES, SAMPLES, NUM), np.uint16))
ALL = slice(None)
ALL_BANDS = np.arange(NUM)


def reference(
    stored: np.ndarray, kind: ReferenceKind = ReferenceKind.WHITE, cube: Cube | None = None, **facts
):
    """Of a file with these numbers, for a cube that is like it."""
    file = file_of(stored, **facts)
    return open_reference(file, kind, cube or file_of(stored))


def noisy(level: np.ndarray) -> np.ndarray:
    noise = 5.0 * np.random.default_rng(0).standard_normal((LINES, SAMPLES, NUM))
    return np.rint(level + noise).astype(np.uint16)


def test_lines_that_differ_by_noise_alone_are_averaged_and_images_used_pixel_by_pixel():
    counts = noisy(1000.0 + 20.0 * np.arange(SAMPLES)[None, :, None])
    found = reference(counts)
    assert not found.is_per_pixel
    np.testing.assert_allclose(found.rows(slice(3, 5), ALL, ALL_BANDS), counts.mean(axis=0)[None], rtol=1e-6)
    counts = noisy(np.linspace(1000.0, 2000.0, LINES)[:, None, None])
    found = reference(counts)
    assert found.is_per_pixel
    np.testing.assert_array_equal(found.rows(slice(3, 5), slice(2, 6), ALL_BANDS), counts[3:5, 2:6])
    wide = np.random.default_rng(0).random((5, SAMPLES + 7, NUM)).astype(np.float32)
    found = reference(wide, cube=EMPTY)
    np.testing.assert_allclose(found.rows(ALL, ALL, ALL_BANDS), wide.mean(axis=(0, 1))[None, None], rtol=1e-5)
    assert f"it is {SAMPLES + 7} columns wide and the cubes {SAMPLES}" in found.how


def test_a_line_of_another_binning_is_interpolated_along_the_line():
    def line_of(samples: int) -> np.ndarray:
        ramp = np.tile(np.arange(samples, dtype=np.float32)[None, :, None], NUM)
        return reference(ramp, ReferenceKind.DARK, EMPTY).rows(ALL, ALL, ALL_BANDS)[0, :, 0]

    np.testing.assert_allclose(line_of(2 * SAMPLES), 2.0 * np.arange(SAMPLES) + 0.5)
    line = line_of(SAMPLES // 2)
    np.testing.assert_allclose(line[1:-1], 0.5 * (np.arange(SAMPLES) - 0.5)[1:-1])
    assert (line[0], line[-1]) == (0.0, SAMPLES // 2 - 1)


HEIGHT, WIDTH, BANDS = 12, 8, 4
EVERY = np.arange(BANDS)
WHOLE = Raster.of(HEIGHT, WIDTH, None, 1)


def _cube():
    counts = np.random.default_rng(0).integers(100, 4000, (HEIGHT, WIDTH, BANDS)).astype(np.uint16)
    return counts, file_of(counts)


@settings(deadline=None)
@given(st.integers(1, HEIGHT), st.integers(1, 3))
def test_blocks_of_any_size_give_the_same_values(rows: int, binning: int):
    counts, file = _cube()
    raster = Raster.of(HEIGHT, WIDTH, None, binning)
    calibration = Calibration(raster, EVERY, saturation=3500.0)
    whole = calibration.rows(file, 0, raster.height)
    for first, last in raster.blocks(BANDS, rows * WIDTH * BANDS):
        part = calibration.rows(file, first, last)
        np.testing.assert_array_equal(part.values, whole.values[first:last])
        np.testing.assert_array_equal(part.saturated, whole.saturated[first:last])
    h, w, n = raster.height, raster.width, binning
    squares = counts[: h * n, : w * n].reshape(h, n, w, n, BANDS)
    np.testing.assert_allclose(whole.values, squares.mean(axis=(1, 3)), rtol=1e-6)
    np.testing.assert_array_equal(whole.saturated, (squares >= 3500).mean(axis=(1, 3)) >= 0.5)


def test_columns_in_which_the_white_is_not_above_the_dark_are_missing():
    counts, file = _cube()
    light = np.full((1, WIDTH, BANDS), 3000, np.uint16)
    light[0, 3, 2] = 40
    dark = reference(np.full_like(light, 50), ReferenceKind.DARK, file)
    white = replace(reference(light, cube=file), dark=dark, reflectance=np.ones(BANDS))
    found = Calibration(WHOLE, EVERY, references=SensorReferences(ViewReferences(dark, white))).rows(
        file, 0, HEIGHT
    )
    np.testing.assert_array_equal(found.missing, np.arange(WIDTH)[None, :] == 3 + np.zeros((HEIGHT, 1)))
    assert (found.values[:, 3] == 0).all()
    np.testing.assert_allclose(found.values[:, 4], (counts[:, 4] - 50.0) / 2950, rtol=1e-5)


@pytest.mark.parametrize("is_image", [False, True])
@pytest.mark.parametrize("is_in_view", [True, False])
def test_a_white_of_one_value_leaves_no_trace_of_the_dark_of_columns_or_pixels(is_image, is_in_view):
    """What the panel is above the dark behind it is the same for all pixels, whatever these have of their own."""
    generator = np.random.default_rng(0)
    dark_levels = np.rint(900.0 + 120.0 * generator.standard_normal((LINES if is_image else 1, SAMPLES, NUM)))
    if is_image:
        dark_levels += 500.0 * (np.arange(LINES)[:, None, None] >= LINES // 2)
    truth = generator.choice([0.25, 0.5], (LINES, SAMPLES, 1)) + np.zeros(NUM)
    truth[2:8, 3:9] = 1.0
    cube = file_of((8000 * truth + dark_levels).astype(np.uint16))
    dark = reference(np.broadcast_to(dark_levels, truth.shape).astype(np.uint16), ReferenceKind.DARK, cube)
    assert dark.is_per_pixel == is_image
    if is_in_view:
        white = panel_reference(cube, (2, 3, 6, 6), "a view")
    else:  # wider than the cubes, of which the mean dark is all that is known
        level = 8000.0 + dark_levels.mean(axis=(0, 1)) + np.zeros((3, SAMPLES + 7, 1))
        white = reference(level.astype(np.float32), cube=cube)
    white = replace(white, dark=dark, reflectance=np.ones(NUM))
    np.testing.assert_allclose(white.signal, 8000, rtol=1e-6)
    calibration = Calibration(
        Raster.of(LINES, SAMPLES, None, 1),
        ALL_BANDS,
        references=SensorReferences(ViewReferences(dark, white)),
    )
    np.testing.assert_allclose(calibration.rows(cube, 0, LINES).values, truth, rtol=1e-5)


def test_a_reference_has_gains_where_the_cubes_have_them():
    stored = np.full((4, 3, 2), 100, np.uint16)
    gains, offsets = np.array([0.5, 2.0]), np.array([1.0, -1.0])
    cube = file_of(stored, linear=Linear(gains, offsets, "its header"))
    found = open_reference(cube, ReferenceKind.WHITE, cube)
    np.testing.assert_allclose(found.mean[0, 0], stored[0, 0] * gains + offsets)
    for pair in ((cube, file_of(stored)), (file_of(stored), cube)):
        with pytest.raises(CaptureError, match=r"no gains or scale.*its header"):
            open_reference(pair[0], ReferenceKind.WHITE, pair[1])


@given(st.integers(0, 5), st.integers(0, 5), st.integers(1, 3), st.floats(5.0, 500.0), st.floats(-20.0, 40.0))
def test_the_lens_of_the_file_comes_back_from_that_of_the_result(
    top: int, left: int, binning: int, focal: float, center: float
):
    raster = Raster.of(30, 40, (top, left, 20, 24), binning)
    lens = Lens(40, 30, (focal, focal + 1.0), (center, center + 2.0), (0.1, 0.0, 0.0, 0.01))
    back = raster.lens_of_file(raster.lens(lens), 30, 40)
    np.testing.assert_allclose(back.focal_px, lens.focal_px)
    np.testing.assert_allclose(back.center_px, lens.center_px, atol=1e-9)
    assert (back.width, back.height, back.distortion) == (40, 30, lens.distortion)


@pytest.mark.parametrize("is_image", [False, True])
def test_pixels_of_a_reference_without_a_measurement_are_left_out_of_it(is_image: bool):
    light = np.full((LINES, SAMPLES, NUM), 3000, np.uint16)
    if is_image:  # of which each pixel counts
        light[LINES // 2 :] = 1000
    truth = light.astype(np.float64)
    light[:4, 5] = 65535
    white = reference(light, no_data=(65535.0,))
    assert white.is_per_pixel == is_image
    assert is_image or (white.mean == 3000).all()
    counts = np.random.default_rng(0).integers(100, 4000, light.shape).astype(np.uint16)
    known = replace(white, reflectance=np.ones(NUM))
    raster = Raster.of(LINES, SAMPLES, None, 1)
    found = Calibration(raster, ALL_BANDS, references=SensorReferences(ViewReferences(white=known))).rows(
        file_of(counts), 0, LINES
    )
    measured = ~found.missing
    assert measured[4:].all()
    assert (~measured[:4, 5]).all() == is_image
    np.testing.assert_allclose(found.values[measured], (counts / truth)[measured], rtol=1e-5)
    light[:, 5] = 65535
    with pytest.raises(CaptureError, match="has columns without a measurement"):
        reference(light, no_data=(65535.0,))


def test_a_dark_frame_of_zeros_is_measured_where_zero_means_no_data_too():
    counts = np.random.default_rng(0).integers(0, 2, (LINES, SAMPLES, NUM)).astype(np.uint16)
    counts[:, :3] = 0
    dark = reference(counts, ReferenceKind.DARK, no_data=(0.0,))
    np.testing.assert_allclose(dark.mean[0], counts.mean(axis=0), rtol=1e-6)
    with pytest.raises(CaptureError, match="has columns without a measurement"):
        reference(counts, no_data=(0.0,))


def test_what_a_reference_lacks_is_told_by_all_of_its_bands():
    lines, columns = np.indices((LINES // 2, SAMPLES))
    light = np.full((LINES, SAMPLES, 5), 1000, np.uint16)
    light[: LINES // 2, :, :4] = (2000 * ((lines + columns) % 2))[..., None]
    assert not reference(light, no_data=(0.0,)).is_per_pixel


@pytest.mark.parametrize("no_data", [(), (65535.0,)])
def test_a_panel_is_the_mean_of_what_was_measured_in_its_rectangle(no_data: tuple[float, ...]):
    counts, _ = _cube()
    counts[2:4, 3] = 65535
    panel = panel_reference(file_of(counts, no_data=no_data), (2, 3, 2, 3), "a view")
    expected = counts[2:4, 4 if no_data else 3 : 6].mean(axis=(0, 1))
    np.testing.assert_allclose(panel.rows(ALL, ALL, EVERY)[0, 0], expected, rtol=1e-6)
    with pytest.raises(CaptureError, match="no pixel of --white-rectangle holds a measurement"):
        panel_reference(file_of(counts, no_data=(65535.0,)), (2, 3, 2, 1), "a view")
    with pytest.raises(ConfigError, match="leaves the image of 12 rows and 8 columns"):
        panel_reference(file_of(counts), (10, 0, 4, 4), "a view")


@pytest.mark.parametrize(
    ("name", "dtype", "facts", "has_dark"),
    [
        ("leaf", np.uint16, {}, True),
        ("reflectance_target", np.uint16, {}, True),  # which is raw all the same
        ("REFLECTANCE_212", np.float32, {}, False),
        ("leaf", np.uint16, {"reflectance_source": "header field 'reflectance scale factor'"}, False),
    ],
)
def test_dark_lines_of_raw_numbers_are_a_dark_frame_whatever_they_are_called(name, dtype, facts, has_dark):
    counts = np.full((6, 4, 2), 300, dtype)
    counts[4:] = 90
    file = replace(file_of(counts, **facts), path=Path(f"{name}.hdr"), shape=(4, 4, 2), dark_lines=2)
    options, view = ProcessOptions("cubes", Path(), Path()), CaptureView("leaf", file)
    found = (
        find_references([view], np.array([500.0, 600.0]), options, GivenReferences(), [view]).of(file).dark
    )
    assert (found is not None) == has_dark
    assert found is None or (found.mean == 90).all()


@pytest.mark.parametrize(
    ("stored", "facts", "expected"),
    [
        ([[7, 5], [7, 7], [1, 2]], {"no_data": (7.0,)}, [True, True, False]),
        ([[0, 5], [0, 0], [1, 2]], {"no_data": (0.0,)}, [False, True, False]),  # which is dark, too
        ([[0, 5], [0, 0], [1, 2]], {"no_data": (-1.0,)}, [False, False, False]),
        ([[7, 5], [0, 0], [1, 8]], {"no_data": (7.0, 0.0, 8.0)}, [True, True, True]),
        ([[5, 6], [4, 6], [5, 9]], {"valid_range": (5.0, 8.0)}, [False, True, True]),
        ([[1.0, np.nan], [1.0, 2.0], [np.inf, 1.0]], {}, [True, False, True]),
    ],
)
def test_pixels_without_a_measurement_in_some_band_are_missing(stored, facts, expected):
    numbers = np.array([stored], np.float32 if np.isinf(stored).any() else np.uint16)
    np.testing.assert_array_equal(find_missing(numbers, file_of(numbers, **facts))[0], expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("stored", "text", "expected"),
    [
        (np.finfo(np.float32).min, "-3.402823e+38", True),
        (np.finfo(np.float32).min, "-3.40282e+38", True),
        (np.finfo(np.float32).min, "-3.4028234663852886e+38", True),
        (np.finfo(np.float32).max, "-3.402823e+38", False),
        (1e20, "1e20", True),
        (np.float32(-0.1), "-0.1", None),
        (-9999.0, "-9999", True),
        (-9998.9, "-9999", False),
        (1e-30, "0", False),
    ],
)
def test_a_no_data_value_is_found_up_to_the_digits_of_its_text(dtype, stored, text, expected):
    """Numbers of single precision are no more exact in a file of double precision."""
    numbers = np.array([[[stored, 0.5]]], dtype)
    expected = dtype == np.float32 if expected is None else expected
    assert find_missing(numbers, file_of(numbers, no_data=(float(text),))).item() == expected
