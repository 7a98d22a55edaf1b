"""Samples found from the front are those that looking at all finds; what light can't reach is not looked at."""

import math

import pytest
import torch
from torch.testing import assert_close

from tests.rendering.test_renderer import make, rays
from unmix_plugin.operators.compositing import volume_weights
from unmix_plugin.rendering.lit_samples import points_of, samples_carrying_weight


@pytest.mark.parametrize("smallest_weight", [0.0, 4e-3, 0.2])
@pytest.mark.parametrize("opacity", [1e-4, 0.05, 0.9])
def test_samples_found_from_the_front_are_those_of_all(smallest_weight, opacity):
    renderer, field = make(smallest_weight=smallest_weight)
    bundle, step = rays(30), renderer.step
    with torch.no_grad():
        field.table.normal_(std=3.0, generator=torch.Generator().manual_seed(2))
        field.log_initial_density = math.log(-math.log1p(-opacity) / step)
        samples = renderer._march(bundle, None)
        found = samples_carrying_weight(field, samples, bundle, step, smallest_weight)
        encoded = field.encode(points_of(samples, bundle)[0])
        densities, features = field.density_of(encoded)
        keep = volume_weights(densities * step, samples.packed_info) > smallest_weight
    assert torch.equal(found.samples.t, samples.t[keep])
    assert torch.equal(found.samples.packed_info, samples.select(keep).packed_info)
    assert torch.equal(found.encoded(), encoded[keep])
    assert_close(found.densities(), densities[keep])
    assert_close(found.features(), features[keep])
    assert found.num_looked_at <= len(samples)


def test_what_lies_behind_an_opaque_front_is_not_looked_at():
    renderer, field = make(pixel=0.02)
    bundle = rays(30)
    with torch.no_grad():
        field.table.zero_()
        field.log_initial_density = math.log(10 / renderer.step)
        samples = renderer._march(bundle, None)
        found = samples_carrying_weight(field, samples, bundle, renderer.step, renderer.smallest_weight)
    assert found.num_looked_at == 30 * 8
    assert len(samples) > 10 * found.num_looked_at
    assert len(found.samples) == 30


def test_rays_that_miss_have_no_samples():
    renderer, field = make()
    bundle = rays(3)
    away = type(bundle)(bundle.origins, -bundle.directions, bundle.camera_indices)
    found = samples_carrying_weight(field, renderer._march(away, None), away, renderer.step, 0.1)
    assert (len(found.samples), len(found.encoded()), found.num_looked_at) == (0, 0, 0)


def test_a_picture_without_gradients_is_that_with_them():
    renderer, field = make()
    bundle = rays(20)
    with torch.no_grad():
        field.table.normal_(generator=torch.Generator().manual_seed(2))
    with_gradients = renderer.render(field, bundle).coefficients.packed
    assert with_gradients.requires_grad
    with torch.no_grad():
        assert_close(renderer.render(field, bundle).coefficients.packed, with_gradients.detach())
