"""Which views a prior takes."""

import pytest
import torch

from tests.neumatex.prior.objects import ring
from unmix_plugin.neumatex.prior.views import PosedViews, well_spread


def test_of_a_ring_the_views_taken_are_evenly_spread():
    angles = torch.arange(12) * (2 * torch.pi / 12)
    positions = torch.stack([angles.cos(), angles.sin(), torch.zeros(12)], dim=-1) * 3
    assert well_spread(positions, 4) == [0, 3, 6, 9]


def test_no_view_is_taken_twice_even_if_cameras_coincide():
    assert well_spread(torch.ones(5, 3), 4) == sorted(set(well_spread(torch.ones(5, 3), 4)))
    assert well_spread(torch.eye(3), 12) == [0, 1, 2]


def test_every_camera_needs_its_picture_and_alpha():
    with pytest.raises(ValueError, match="1 pictures and 2 alphas for 2 cameras"):
        PosedViews(ring(2, 8), [torch.zeros(8, 8, 3)], [torch.zeros(8, 8)] * 2)


def test_chosen_views_keep_picture_alpha_and_camera_together():
    pictures = [torch.full((8, 8, 3), float(index)) for index in range(3)]
    alphas = [torch.full((8, 8), float(index)) for index in range(3)]
    views = PosedViews(ring(3, 8), pictures, alphas)[[2, 0]]
    assert [float(picture[0, 0, 0]) for picture in views.pictures] == [2.0, 0.0]
    assert [float(alpha[0, 0]) for alpha in views.alphas] == [2.0, 0.0]
    assert torch.equal(views.cameras.camera_to_world, ring(3, 8).camera_to_world[[2, 0]])
