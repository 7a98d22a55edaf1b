"""Dark frames and white references, by column, by pixel, and of other widths than the cubes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.captures.file_factory import file_of
from unmix_plugin.captures.calibration.references import open_reference, panel_reference
from unmix_plugin.errors import ConfigError

HEIGHT, WIDTH, BANDS = 40, 24, 3
CUBE = file_of(np.zeros((HEIGHT, WIDTH, BANDS), np.uint16))
ALL = slice(None)
EVERY = np.arange(BANDS)


def _noisy(level: np.ndarray, seed: int = 0) -> np.ndarray:
    noise = 5.0 * np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH, BANDS))
    return np.rint(level + noise).astype(np.uint16)


def test_lines_that_differ_by_noise_alone_are_averaged_column_by_column():
    columns = 1000.0 + 20.0 * np.arange(WIDTH)[None, :, None] + np.zeros((HEIGHT, 1, BANDS))
    counts = _noisy(columns)
    found = open_reference(file_of(counts), "white reference", CUBE)
    assert not found.is_per_pixel
    np.testing.assert_allclose(found.rows(slice(3, 5), ALL, EVERY), counts.mean(axis=0)[None], rtol=1e-6)


def test_an_image_that_differs_from_row_to_row_is_used_pixel_by_pixel():
    rows = np.linspace(0.5, 1.0, HEIGHT)[:, None, None]
    counts = _noisy(2000.0 * rows + np.zeros((1, WIDTH, BANDS)))
    found = open_reference(file_of(counts), "white reference", CUBE)
    assert found.is_per_pixel
    np.testing.assert_array_equal(found.rows(slice(3, 5), slice(2, 6), EVERY), counts[3:5, 2:6])


def test_a_line_of_another_binning_is_interpolated_along_the_line():
    fine = np.arange(2 * WIDTH, dtype=np.float32)[None, :, None] + np.zeros((1, 1, BANDS), np.float32)
    found = open_reference(file_of(fine), "dark frame", CUBE)
    np.testing.assert_allclose(found.rows(ALL, ALL, EVERY)[0, :, 0], 2.0 * np.arange(WIDTH) + 0.5)
    coarse = np.arange(WIDTH // 2, dtype=np.float32)[None, :, None] + np.zeros((1, 1, BANDS), np.float32)
    line = open_reference(file_of(coarse), "dark frame", CUBE).rows(ALL, ALL, EVERY)[0, :, 0]
    np.testing.assert_allclose(line[1:-1], 0.5 * (np.arange(WIDTH) - 0.5)[1:-1])
    assert (line[0], line[-1]) == (0.0, WIDTH // 2 - 1)


def test_a_wider_white_is_averaged_over_its_columns_and_said_so():
    wide = np.random.default_rng(0).random((5, WIDTH + 7, BANDS)).astype(np.float32)
    found = open_reference(file_of(wide), "white reference", CUBE)
    np.testing.assert_allclose(found.rows(ALL, ALL, EVERY), wide.mean(axis=(0, 1))[None, None], rtol=1e-5)
    assert f"it is {WIDTH + 7} columns wide and the cubes {WIDTH}" in found.how


def test_a_panel_is_the_mean_of_its_rectangle():
    counts = _noisy(np.full((HEIGHT, WIDTH, BANDS), 800.0))
    found = panel_reference(file_of(counts), (2, 3, 4, 5), "a view")
    np.testing.assert_allclose(
        found.rows(ALL, ALL, EVERY)[0, 0], counts[2:6, 3:8].mean(axis=(0, 1)), rtol=1e-6
    )
    with pytest.raises(ConfigError, match="leaves the view of 40 rows and 24 columns"):
        panel_reference(file_of(counts), (38, 0, 4, 4), "a view")
