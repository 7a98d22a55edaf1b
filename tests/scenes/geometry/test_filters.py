import numpy as np
import pytest
from scipy import ndimage

from unmix_plugin.scenes.geometry.filters import gaussian_blur, inner_cells, mean_3x3, without_specks


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_a_mean_over_neighbours_is_that_of_scipy(rng):
    for shape in [(1, 1), (1, 7), (40, 33)]:
        picture = (rng.random(shape) * (rng.random(shape) > 0.3)).astype(np.float32)
        np.testing.assert_array_equal(mean_3x3(picture), ndimage.uniform_filter(picture, 3))


def test_a_blur_is_that_of_scipy_also_of_grids_smaller_than_its_reach(rng):
    for cells in (3, 20):
        grid = (rng.random((cells, cells, cells)) > 0.5).astype(np.float32)
        np.testing.assert_array_equal(gaussian_blur(grid, 2.0), ndimage.gaussian_filter(grid, 2.0))


def test_inner_cells_and_masks_without_specks_are_those_of_scipy(rng):
    grid = rng.random((6, 7, 8)) > 0.2
    np.testing.assert_array_equal(inner_cells(grid), ndimage.binary_erosion(grid, border_value=1))
    mask = rng.random((30, 20)) > 0.4
    np.testing.assert_array_equal(without_specks(mask), ndimage.binary_opening(mask, np.ones((2, 2))))
