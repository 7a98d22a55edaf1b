import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.factories.scenes import make_scene
from tests.poses.test_training import config_for, trained
from tests.rendering.test_renderer import make, rays
from tests.rendering.test_unbounded import make as make_unbounded
from tests.rendering.test_unbounded import rays as rays_without_end
from unmix_plugin.engine.machine import operations_shared_among
from unmix_plugin.presets import WITH_ALPHA
from unmix_plugin.rendering import front_to_back
from unmix_plugin.rendering.front_to_back import composite

FEW, MANY = front_to_back.FEWEST_SAMPLES, front_to_back.SAMPLES_MARCHED
"""Samples of a ray evaluated at once, on a CPU and on a GPU."""


def textured(smallest_weight: float, opacity: float):
    """A renderer and a field of as many different densities and materials as a table holds."""
    renderer, field = make(smallest_weight, pixel=0.03, depth=-math.log1p(-opacity))
    torch.nn.init.normal_(field.table, std=1.0, generator=torch.Generator().manual_seed(2))
    return renderer, field


@pytest.mark.parametrize("opacity", [1e-4, 0.05, 0.9, 1 - 1e-10])
def test_with_nothing_left_out_both_ways_are_equal(opacity):
    renderer, field = textured(0.0, opacity)
    bundle = rays(40)
    with torch.no_grad():
        careful = renderer.render(field, bundle).coefficients.packed
    assert_close(composite(renderer, field, bundle).packed, careful, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("smallest", "opacity", "at_once"),
    [(1e-3, 0.05, FEW), (4e-3, 0.01, MANY), (4e-3, 0.3, FEW), (4e-3, 0.3, MANY), (1e-3, 0.9, MANY)],
)
def test_what_is_left_out_costs_no_more_than_in_the_careful_way(monkeypatch, smallest, opacity, at_once):
    """And a few smallest weights: light behind the end, samples that carry too little, and the bend of a network within
    merged samples."""
    monkeypatch.setattr("unmix_plugin.rendering.front_to_back.FEWEST_SAMPLES", at_once)
    renderer, field = textured(smallest, opacity)
    bundle = rays(80)
    with torch.no_grad():
        careful = renderer.render(field, bundle).coefficients
        exact = replace(renderer, smallest_weight=0.0).render(field, bundle).coefficients.packed
    fast = composite(renderer, field, bundle)
    assert_close(fast.abundances.sum(-1), fast.accumulation)
    unit = torch.ones_like(exact[0])
    unit[1] = 3.0  # distances: of the middle of the box
    errors = [((x.packed - exact).abs() / unit).mean(dim=0) for x in (fast, careful)]
    assert (errors[0] < errors[1] + 2 * smallest).all()


def test_two_threads_that_share_a_view_find_what_one_does():
    renderer, field = textured(4e-3, 0.3)
    bundle = rays(5001)
    alone = composite(renderer, field, bundle)
    with operations_shared_among(2):
        shared = composite(renderer, field, bundle)
    assert shared.num_endmembers == alone.num_endmembers
    assert_close(shared.packed, alone.packed, rtol=1e-4, atol=1e-5)
    assert not shared.packed.requires_grad


def test_a_ray_ends_where_no_sample_can_count_any_more(monkeypatch):
    renderer, field = textured(4e-3, 0.9)
    looked_at = []
    encode = type(field).encode

    def counted(self, positions, known=None):
        looked_at.append(len(positions))
        return encode(self, positions, known)

    monkeypatch.setattr(type(field), "encode", counted)
    with torch.no_grad():
        field.table.zero_()
    found = composite(renderer, field, rays(50))
    assert sum(looked_at) == 50 * front_to_back.FEWEST_SAMPLES
    assert_close(found.accumulation, torch.full((50,), 1 - 0.1**3))


@pytest.mark.parametrize(
    ("opacity", "at_once"), [(0.002, FEW), (0.1, FEW), (0.1, MANY), (0.02, MANY), (0.9, MANY)]
)
def test_no_ray_is_more_opaque_than_it_is_however_little_light_is_left(monkeypatch, opacity, at_once):
    """To take what lets little through for opaque would be a step in the pictures."""
    monkeypatch.setattr("unmix_plugin.rendering.front_to_back.FEWEST_SAMPLES", at_once)
    renderer, field = textured(4e-3, opacity)
    bundle = rays(200)
    with torch.no_grad():
        exact = replace(renderer, smallest_weight=0.0).render(field, bundle).coefficients.accumulation
    found = composite(renderer, field, bundle).accumulation
    assert (found <= exact + 1e-5).all()


@pytest.mark.parametrize("residual", [False, True])
def test_rays_that_miss_see_nothing(residual):
    renderer, field = make()
    bundle = rays(3)
    away = replace(bundle, directions=-bundle.directions)
    found = composite(replace(renderer, residual_on_last_sample=residual), field, away)
    assert found.packed.shape[0] == 3
    assert (found.packed == 0).all()


@pytest.mark.parametrize("opacity", [1e-3, 0.05])
def test_the_last_sample_takes_all_the_light_that_is_left_as_in_the_careful_way(opacity):
    renderer, field = textured(0.0, opacity)
    renderer = replace(renderer, residual_on_last_sample=True)
    bundle = rays(40)
    with torch.no_grad():
        careful = renderer.render(field, bundle).coefficients
    found = composite(renderer, field, bundle)
    assert_close(found.packed, careful.packed, rtol=1e-4, atol=1e-5)
    assert_close(found.accumulation, torch.ones(40))


@pytest.mark.parametrize("density", [1e-9, 0.3, 30.0])
def test_a_world_without_end_and_its_sky_are_those_of_the_careful_way(density):
    renderer, field = make_unbounded(density)
    bundle = rays_without_end(30)
    with torch.no_grad():
        careful = renderer.render(field, bundle).coefficients.packed
    assert_close(composite(renderer, field, bundle).packed, careful, rtol=1e-3, atol=1e-4)


def test_pictures_of_a_trained_scene_are_those_of_the_careful_renderer(tmp_path):
    """Merging and early termination decide every reported figure: they must stay far below a scene's own error."""
    make_scene(tmp_path / "scene")
    pipeline = trained(config_for(tmp_path, "fixed", steps=150)).pipeline
    model: Any = pipeline.model.eval()
    rays = pipeline.datamanager.eval_cameras.image_rays(0)
    smallest = WITH_ALPHA.smallest_weight
    exactly, quickly = (replace(model.renderer, smallest_weight=weight) for weight in (0.0, smallest))
    with torch.no_grad():
        exact, found = exactly.render(model.field, rays).coefficients, composite(quickly, model.field, rays)
        errors = (model.materials.spectra(found) - model.materials.spectra(exact)).abs()
    assert float(exact.accumulation.max()) > 0.8
    assert 0 < float(errors.square().mean().sqrt()) < 1e-3
    # Rays end where no sample can count any more, and samples that carry less are left out.
    assert float(errors.max()) < 3 * smallest
    assert float((found.accumulation - exact.accumulation).abs().max()) < 3 * smallest
