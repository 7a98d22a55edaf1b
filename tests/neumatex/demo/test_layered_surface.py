"""Surfaces of built-in objects: parameters in range, varied, functions of position alone."""

import torch

from unmix_plugin.neumatex.demo.layered_surface import LayeredSurface
from unmix_plugin.neumatex.materials.layered import LayeredFamily


def _positions():
    return 2 * torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) - 1


def test_parameters_are_in_range_and_vary():
    seen = set()
    for seed in range(12):
        surface = LayeredSurface(seed)
        parameters = surface.parameters(_positions())
        assert parameters.shape == (5000, surface.family.num_parameters)
        assert bool(((parameters >= 0) & (parameters <= 1)).all())
        assert bool((parameters[:, :3].std(dim=0) > 0.01).all())
        seen |= set(surface.kinds)
    assert len(seen) == 7


def test_every_layer_is_used_by_some_object():
    largest = torch.stack([LayeredSurface(seed).parameters(_positions()).amax(dim=0) for seed in range(12)])
    named = dict(zip(LayeredFamily.PARAMETERS, largest.amax(dim=0).tolist(), strict=True))
    assert all(value > 0.3 for value in named.values()), named


def test_a_seed_repeats_and_another_differs():
    first, again, other = (LayeredSurface(seed).parameters(_positions()) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
