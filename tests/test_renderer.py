"""The renderer of coefficients, apart from the model that owns it."""

import math

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin import renderer as renderer_module
from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.field import UnmixField, UnmixFieldConfig
from unmix_plugin.renderer import CoefficientRenderer, RendererConfig

BOX = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
PIXEL = 0.1


def make(
    box: SceneBox = BOX, is_open: bool = False, pixel: float = PIXEL
) -> tuple[CoefficientRenderer, UnmixField]:
    torch.manual_seed(0)
    field = UnmixField(UnmixFieldConfig(log2_rows_per_level=8), box, 3, 1, 1.0, PIXEL)
    return CoefficientRenderer(
        RendererConfig(), box, pixel, 8, is_open=is_open, close_rays=False
    ).eval(), field


def rays(num_rays: int) -> RayBundle:
    generator = torch.Generator().manual_seed(1)
    targets = torch.rand(num_rays, 3, generator=generator) - 0.5
    origins = torch.tensor([0.0, 0.0, 3.0]).repeat(num_rays, 1)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return RayBundle(origins, directions, torch.zeros(num_rays, dtype=torch.int64))


def test_a_homogeneous_box_absorbs_what_beer_lambert_says():
    renderer, field = make()
    bundle = rays(20)
    with torch.no_grad():
        field.table.zero_()  # then the network's output is zero, and the density its initial value
        rendered = renderer(field, bundle)
    t_near, t_far = BOX.intersect(bundle.origins, bundle.directions)
    assert rendered.num_samples == pytest.approx(((t_far - t_near) / renderer.step).sum().item(), rel=0.02)
    found = rendered.coefficients
    assert_close(found.accumulation, 1 - torch.exp(-(t_far - t_near)), atol=0.02, rtol=0)
    assert_close(found.abundances.sum(-1), found.accumulation)


@pytest.mark.parametrize("density", [0.1, 10.0])
def test_haze_counts_the_samples_that_matter_is_spread_over(density):
    """Closed form in a homogeneous box; a sample of depth 10 counts a few times one of depth 0.1, not 100 times."""
    renderer, field = make()
    bundle = rays(20)
    with torch.no_grad():
        field.table.zero_()
        field.log_initial_density = math.log(density / renderer.step)
        haze = renderer(field, bundle).haze
    t_near, t_far = BOX.intersect(bundle.origins, bundle.directions)
    carrying = [
        sum(
            math.exp(-i * density) * (1 - math.exp(-density)) > renderer.config.smallest_weight
            for i in range(int(length / renderer.step))
        )
        for length in (t_far - t_near).tolist()
    ]
    expected = sum(carrying) / 20 * math.log1p(density / 0.03)
    assert float(haze) == pytest.approx(expected, rel=0.05)


def test_an_untrained_open_scene_can_grow_matter_along_the_whole_of_a_ray():
    """Every sample takes part although it starts behind fog; with a hull the far ones are left out to save time."""
    bundle, found = rays(20), {}
    for is_open in (True, False):
        renderer, field = make(is_open=is_open, pixel=0.02)
        with torch.no_grad():
            field.table.zero_()
            field.log_initial_density = math.log(-math.log1p(-0.01) / renderer.step)
            rendered = renderer(field, bundle)
        haze_a_sample = math.log1p(-math.log1p(-0.01) / 0.03)
        found[is_open] = float(rendered.haze) * 20 / haze_a_sample / rendered.num_samples
    assert found[True] == pytest.approx(1, rel=0.01)
    assert found[False] < 0.8


def test_rays_rendered_in_chunks_are_those_rendered_together():
    renderer, field = make()
    bundle = rays(20)
    with torch.no_grad():
        together, in_chunks = renderer(field, bundle).coefficients, renderer.in_chunks(field, bundle, 7)
    assert_close(in_chunks.accumulation, together.accumulation)
    assert_close(in_chunks.scaled_abundances, together.scaled_abundances)


def test_a_render_does_not_look_at_the_corners_of_the_box_again(monkeypatch):
    """On a GPU each look would wait for all that was asked of it before."""
    renderer, field = make()
    renderer(field, rays(3))
    monkeypatch.setattr(renderer_module, "SceneBox", None)
    assert renderer(field, rays(3)).num_samples > 0


def occupied_after_training(is_open: bool = False, seen_weight: float = 0.05) -> torch.Tensor:
    """Share of each layer of cells, from the cameras' side on, that is occupied in dense matter seen from one side."""
    torch.manual_seed(0)
    field = UnmixField(UnmixFieldConfig(log2_rows_per_level=8), BOX, 3, 1, 10.0 / PIXEL, PIXEL)
    config = RendererConfig(seen_weight=seen_weight)
    renderer = CoefficientRenderer(config, BOX, PIXEL, 8, is_open=is_open, close_rays=False).train()
    views = torch.arange(2000) % 2
    targets = torch.rand(2000, 3) * 2 - 1
    origins = torch.tensor([[0.5, 0.0, 3.0], [-0.5, 0.0, 3.0]])[views]
    bundle = RayBundle(origins, torch.nn.functional.normalize(targets - origins, dim=-1), views)
    renderer(field, bundle)
    renderer.update_grid(field, step=0)
    return renderer.grid.occupied.float().mean(dim=(0, 1)).flip(0)


def test_what_no_training_ray_reaches_is_left_out():
    layers = occupied_after_training()
    assert layers[0] > 0.9
    assert not layers[3:].any()


def test_nothing_is_left_out_of_rooms_or_by_request():
    assert occupied_after_training(is_open=True).all()
    assert occupied_after_training(seen_weight=1.0).all()


def test_rendering_without_training_notes_nothing():
    renderer, field = make()
    renderer(field, rays(20))
    assert int(renderer.grid.sight.num_rays) == 0
