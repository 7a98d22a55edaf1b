"""Clearance is the distance to the nearest occupied cell, rounded down."""

import pytest
import torch
from scipy.ndimage import distance_transform_cdt

from unmix_plugin.operators.grid_cells import clearance_of


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 5, 7), (40, 9, 20), (50, 50, 50)])
def test_clearance_is_the_distance_along_the_farthest_axis_rounded_down(shape):
    occupied = torch.rand(shape, generator=torch.Generator().manual_seed(0)) < 1e-3
    occupied[shape[0] // 3, -1, 0] = True
    distance = torch.from_numpy(distance_transform_cdt(~occupied.numpy(), metric="chessboard"))
    steps = torch.tensor([0, 1, 2, 3, 5, 9, 17])
    expected = steps[torch.bucketize(distance, steps, right=True) - 1]
    assert torch.equal(clearance_of(occupied).long(), expected)


def test_an_empty_grid_is_clear_as_far_as_is_counted():
    assert (clearance_of(torch.zeros(4, 5, 6, dtype=torch.bool)) == 17).all()
