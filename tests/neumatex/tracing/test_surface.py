"""Planes and networks on a surface: laws of look-ups, shapes, and what an optimiser may move."""

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.neumatex.tracing.surface import LOG_VARIANCE_RANGE, PLANE_AXES, Triplane, look_up


def look_up_twin(planes: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
    """`look_up` in plain steps."""
    last = planes.shape[-1] - 1
    texels = (positions.clamp(-1, 1) + 1) / 2 * last
    low = texels.floor().clamp(0, last - 1).long()
    share = texels - low
    parts = []
    for plane, (column, row) in zip(planes, PLANE_AXES, strict=True):
        x, y, u, v = low[:, column], low[:, row], share[:, column], share[:, row]
        upper = plane[:, y, x] * (1 - u) + plane[:, y, x + 1] * u
        lower = plane[:, y + 1, x] * (1 - u) + plane[:, y + 1, x + 1] * u
        parts.append((upper * (1 - v) + lower * v).T)
    return torch.cat(parts, dim=-1)


def points(count: int, seed: int = 0, reach: float = 1.0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return (2 * torch.rand(count, 3, generator=g, dtype=torch.float64) - 1) * reach


@pytest.mark.parametrize("reach", [1.0, 1.3])
def test_look_ups_and_their_gradients_agree_with_the_twin(reach):
    planes = torch.randn(3, 5, 9, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    planes.requires_grad_()
    positions = points(200, reach=reach)
    actual, expected = look_up(planes, positions), look_up_twin(planes, positions)
    assert_close(actual, expected)
    cotangent = torch.randn(expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    found, wanted = (torch.autograd.grad(value, planes, cotangent)[0] for value in (actual, expected))
    assert_close(found, wanted)


def test_a_plane_that_is_linear_in_its_axes_is_read_back_exactly():
    grid = torch.linspace(-1, 1, 17, dtype=torch.float64)
    column, row = grid.expand(17, 17), grid[:, None].expand(17, 17)
    planes = torch.stack([column, row]).expand(3, 2, 17, 17)
    positions = points(100)
    assert_close(look_up(planes, positions), torch.cat([positions[:, list(axes)] for axes in PLANE_AXES], 1))


def test_a_point_moves_only_the_four_texels_around_it_in_each_plane():
    triplane = Triplane(9, resolution=8, generator=torch.Generator().manual_seed(0))
    triplane.parameters_at(torch.tensor([[0.1, -0.3, 0.62]])).sum().backward()
    assert triplane.planes.grad is not None
    touched = triplane.planes.grad.abs().sum(dim=1) > 0
    assert touched.flatten(1).sum(dim=1).tolist() == [4, 4, 4]
    # x = 0.1 lies between columns 3 and 4 of plane XY, y = -0.3 between its rows 2 and 3.
    assert touched[0, 2:4, 3:5].all()


def test_parameters_are_in_the_unit_interval_and_log_variances_in_theirs():
    triplane = Triplane(5, resolution=4, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        triplane.planes.mul_(1e3)
    positions = points(300).float()
    parameters, log_variance = triplane.parameters_at(positions), triplane.log_variance(positions)
    assert parameters.shape == log_variance.shape == (300, triplane.readers.num_parameters) == (300, 5)
    assert 0 <= parameters.min() < 0.1 < 0.9 < parameters.max() <= 1
    low, high = LOG_VARIANCE_RANGE
    assert low <= log_variance.min() <= log_variance.max() <= high


def test_others_that_are_mixed_are_those_of_each_share_weighted():
    drawn = torch.Generator().manual_seed(0)
    triplane = Triplane(5, resolution=8, generator=drawn, num_shares=3, mixes_others=True)
    assert triplane.readers.others_of_shares is not None
    own = torch.rand(3, 2, generator=drawn)
    with torch.no_grad():
        triplane.planes.mul_(1e2)
        triplane.readers.others_of_shares.copy_(own.logit())
    shares, others = triplane.parameters_at(points(100).float()).tensor_split([3], dim=1)
    assert_close(shares.sum(dim=1), torch.ones(100))
    assert shares.std() > 0.1
    assert_close(others, shares @ own)
