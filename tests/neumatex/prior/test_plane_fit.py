"""Planes that are fitted to what is said of points."""

import torch
from torch.testing import assert_close

from unmix_plugin.neumatex.prior.plane_fit import RESOLUTION, Estimates, fit_loss, fit_planes
from unmix_plugin.neumatex.triplane import Readers, point_features


def estimates(log_variance: float = -6.0) -> Estimates:
    """A material that changes smoothly over a sphere."""
    g = torch.Generator().manual_seed(0)
    positions = torch.nn.functional.normalize(torch.randn(1, 300, 3, generator=g), dim=-1)
    parameters = (0.5 + 0.3 * torch.sin(2 * positions)).repeat(1, 1, 2)[..., :5]
    return Estimates(positions, parameters, torch.full((1, 300, 5), log_variance))


def readers() -> Readers:
    return Readers(5, generator=torch.Generator().manual_seed(1))


def test_a_fit_moves_the_planes_to_what_is_said_and_leaves_the_readers():
    said, networks = estimates(), readers()
    before = [parameter.clone() for parameter in networks.parameters()]
    planes = fit_planes(networks, said, steps=120)
    assert planes.shape == (1, 3, 12, RESOLUTION, RESOLUTION)
    assert not planes.requires_grad
    features = point_features(planes[0], said.positions[0])
    with torch.no_grad():
        assert (networks.material(features) - said.parameters[0]).square().mean().sqrt() < 0.05
        assert (
            networks.log_variance(features) + 6.0
        ).abs().mean() < 1.2  # from 1.5 and more; these readers were never trained
    for parameter, old in zip(networks.parameters(), before, strict=True):
        assert torch.equal(parameter, old)


def test_points_that_are_sure_count_more():
    said, networks = estimates(), readers()
    planes = torch.zeros(1, 3, 12, RESOLUTION, RESOLUTION)
    moved = said.parameters.clone()
    moved[:, 0] = 0.0
    unsure = said.log_variance.clone()
    unsure[:, 0] = 0.0
    sure_loss, unsure_loss = (
        fit_loss(networks, planes, Estimates(said.positions, moved, variance))
        - fit_loss(networks, planes, Estimates(said.positions, said.parameters, variance))
        for variance in (said.log_variance, unsure)
    )
    assert_close(unsure_loss, sure_loss * torch.exp(torch.tensor(-3.0)), rtol=1e-3, atol=1e-7)


def test_objects_are_fitted_apart():
    said, networks = estimates(), readers()
    both = Estimates(*(torch.cat([part, part.flip(1) * 0.9]) for part in vars(said).values()))
    alone = fit_planes(networks, said, steps=10)
    together = fit_planes(networks, both, steps=10)
    assert_close(together[:1], alone, atol=2e-3, rtol=0)
