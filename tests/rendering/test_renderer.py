import math
from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from tests.factories.models import BOX
from unmix_plugin.engine.geometry.space import RayBundle, UnitSpace
from unmix_plugin.errors import ConfigError
from unmix_plugin.field import FieldSpace, UnmixField
from unmix_plugin.operators.compositing import volume_weights
from unmix_plugin.operators.marching import PackedSamples
from unmix_plugin.operators.occupancy import skip_distances
from unmix_plugin.presets import WITH_ALPHA, WITHOUT_ALPHA
from unmix_plugin.rendering import renderer as rendering
from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.rendering.renderer import VisibleSamples, VolumeRenderer, visible_samples
from unmix_plugin.settings import RendererConfig, UnmixFieldConfig

PIXEL = 0.1


def make(
    smallest_weight: float = WITH_ALPHA.smallest_weight, pixel: float = PIXEL, depth: float | None = None
) -> tuple[VolumeRenderer, UnmixField]:
    """With `depth` every sample has that optical depth."""
    torch.manual_seed(0)
    field = UnmixField(
        UnmixFieldConfig(finest_resolution=34, log2_rows_per_level=8), FieldSpace(BOX, 1.0), 3, 1
    )
    cells, step = torch.ones(8, 8, 8) > 0, pixel / 1.5
    if depth is not None:
        nn.init.zeros_(field.table)
        field.log_initial_density = math.log(depth / step)
    return VolumeRenderer(
        UnitSpace(BOX), skip_distances(cells), step, smallest_weight, rays_per_chunk=7
    ), field


def rays(num_rays: int) -> RayBundle:
    generator = torch.Generator().manual_seed(1)
    targets = torch.rand(num_rays, 3, generator=generator) - 0.5
    origins = torch.tensor([0.0, 0.0, 3.0]).repeat(num_rays, 1)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return RayBundle(origins, directions, torch.zeros(num_rays, dtype=torch.int64))


def samples_of(renderer: VolumeRenderer, bundle: RayBundle) -> PackedSamples:
    return renderer.march(bundle.origins, bundle.directions, torch.zeros(len(bundle))).samples()


def test_a_homogeneous_box_absorbs_what_beer_lambert_says():
    renderer, field = make(depth=PIXEL / 1.5)
    bundle = rays(20)
    with torch.no_grad():
        rendered = renderer.render(field, bundle)
    t_near, t_far = BOX.intersect(bundle.origins, bundle.directions)
    assert rendered.num_samples == pytest.approx(((t_far - t_near) / renderer.step).sum().item(), rel=0.02)
    found = rendered.coefficients
    assert_close(found.accumulation, 1 - torch.exp(-(t_far - t_near)), atol=0.02, rtol=0)
    assert_close(found.abundances.sum(-1), found.accumulation)


@pytest.mark.parametrize("density", [0.1, 10.0])
def test_sparsity_counts_the_samples_that_density_is_spread_over(density):
    """Closed form in a homogeneous box; a sample of depth 10 counts a few times one of depth 0.1, not 100 times."""
    renderer, field = make(depth=density)
    bundle = rays(20)
    with torch.no_grad():
        spread = renderer.render(field, bundle).sparsity
    t_near, t_far = BOX.intersect(bundle.origins, bundle.directions)
    numbers = torch.arange(1000)
    carries = torch.exp(-numbers * density) * (1 - math.exp(-density)) > renderer.smallest_weight
    carrying = carries & (numbers < ((t_far - t_near) / renderer.step).int()[:, None])
    expected = float(carrying.sum()) / 20 * math.log1p(density / 0.03)
    assert float(spread) == pytest.approx(expected, rel=0.05)


def test_a_softmax_that_is_sure_still_learns_that_it_should_not_be(monkeypatch):
    """The certainty of even abundances is the opacity times log K; where one share is 1, its gradient stays."""
    renderer, field = make(depth=PIXEL / 1.5)
    bundle = rays(20)
    with torch.no_grad():
        rendered = renderer.render(field, bundle)
        opacity = rendered.coefficients.accumulation.mean()
        assert_close(rendered.certainty, opacity * math.log(field.num_endmembers))
    logits = torch.tensor([[0.0, 40.0, 5.0]], requires_grad=True)
    outputs = field.get_outputs

    def surely(positions, *others):
        abundances = logits.softmax(dim=1).expand(len(positions), -1)
        return {**outputs(positions, *others), "abundances": abundances}

    monkeypatch.setattr(field, "get_outputs", surely)
    renderer.render(field, bundle).certainty.backward()
    assert_close(logits.grad, opacity * torch.tensor([[-1 / 3, 2 / 3, -1 / 3]]))


def test_without_alpha_an_untrained_scene_can_grow_dense_along_the_whole_of_a_ray():
    """Every sample takes part although it starts behind semi-transparent density; with alpha, far ones are left out."""
    bundle, found = rays(20), {}
    for preset in (WITHOUT_ALPHA, WITH_ALPHA):
        renderer, field = make(preset.first_smallest_weight, pixel=0.02, depth=-math.log1p(-0.01))
        with torch.no_grad():
            rendered = renderer.render(field, bundle)
        spread_a_sample = math.log1p(-math.log1p(-0.01) / 0.03)
        found[preset] = float(rendered.sparsity) * 20 / spread_a_sample / rendered.num_samples
    assert found[WITHOUT_ALPHA] == pytest.approx(1, rel=0.01)
    assert found[WITH_ALPHA] < 0.8


def test_rays_rendered_in_chunks_are_those_rendered_together():
    renderer, field = make()
    bundle = rays(20)
    together = composite(replace(renderer, rays_per_chunk=20), field, bundle)
    assert_close(composite(renderer, field, bundle).packed, together.packed)


def test_rendering_changes_nothing_and_draws_nothing_from_the_global_generator():
    renderer, field = make()
    before = {name: value.clone() for name, value in field.state_dict().items()}
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    generator = torch.Generator().manual_seed(4)
    jittered = renderer.render(field, rays(20), generator).coefficients.packed
    assert torch.equal(torch.rand(1), expected)
    assert all(torch.equal(value, before[name]) for name, value in field.state_dict().items())
    assert not torch.equal(jittered, renderer.render(field, rays(20)).coefficients.packed)
    again = renderer.render(field, rays(20), torch.Generator().manual_seed(4)).coefficients.packed
    assert torch.equal(jittered, again)


def test_points_are_asked_cell_by_cell_and_outside_the_box_is_nothing():
    renderer, _ = make()
    renderer.skips[:4] = 1
    points = torch.tensor([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [1.5, 0.0, 0.0]])
    assert renderer.is_occupied(points).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"samples_per_pixel": 0.0}, "samples-per-pixel of 0.01 to 100 or auto"),
        ({"smallest_weight": 1.0}, r"smallest-weight in \[0, 1\) or auto"),
        ({"visible_weight": 0.0}, r"visible-weight in \(0, 1\] or auto"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        RendererConfig(**settings)


def num_evaluated(found: VisibleSamples) -> int:
    return sum(len(part.densities) for part in found.evaluated)


@pytest.mark.parametrize("smallest_weight", [0.0, 4e-3, 0.2])
@pytest.mark.parametrize("opacity", [1e-4, 0.05, 0.9])
@pytest.mark.parametrize("at_first", [None, 8, 32])
def test_samples_found_from_the_front_are_those_of_all(smallest_weight, opacity, at_first):
    renderer, field = make(smallest_weight, depth=-math.log1p(-opacity))
    bundle, step = rays(30), renderer.step
    with torch.no_grad():
        field.table.normal_(std=3.0, generator=torch.Generator().manual_seed(2))
        samples = samples_of(renderer, bundle)
        found = visible_samples(
            field, samples, bundle, step=step, smallest_weight=smallest_weight, at_first=at_first
        )
        encoded = field.encode(rendering.points_of(bundle, samples.ray_indices, samples.t)[0])
        densities, features = field.density_of(encoded)
        keep = volume_weights(densities * step, samples.packed_info) > smallest_weight
    assert torch.equal(found.samples.t, samples.t[keep])
    assert torch.equal(found.samples.packed_info, samples.select(keep).packed_info)
    assert torch.equal(found.of([part.encoded for part in found.evaluated]), encoded[keep])
    assert_close(found.of([part.densities for part in found.evaluated]), densities[keep])
    assert_close(found.of([part.features for part in found.evaluated]), features[keep])
    assert num_evaluated(found) <= len(samples)


def test_what_lies_behind_an_opaque_front_is_not_evaluated_and_rays_that_miss_have_no_samples():
    renderer, field = make(pixel=0.02, depth=10.0)
    bundle = rays(30)
    with torch.no_grad():
        samples = samples_of(renderer, bundle)
        found = visible_samples(
            field, samples, bundle, step=renderer.step, smallest_weight=renderer.smallest_weight
        )
    assert num_evaluated(found) == 30 * 8
    assert len(samples) > 10 * num_evaluated(found)
    assert len(found.samples) == 30
    away = replace(bundle, directions=-bundle.directions)
    found = visible_samples(field, samples_of(renderer, away), away, step=renderer.step, smallest_weight=0.1)
    assert (
        len(found.samples),
        len(found.of([part.encoded for part in found.evaluated])),
        num_evaluated(found),
    ) == (0, 0, 0)


def test_a_picture_without_gradients_is_that_with_them():
    renderer, field = make()
    bundle = rays(20)
    with torch.no_grad():
        field.table.normal_(generator=torch.Generator().manual_seed(2))
    with_gradients = renderer.render(field, bundle).coefficients.packed
    assert with_gradients.requires_grad
    with torch.no_grad():
        assert_close(renderer.render(field, bundle).coefficients.packed, with_gradients.detach())
