import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import BOX, make_model, make_rays
from unmix_plugin.editing.edited_field import EditedField
from unmix_plugin.engine.geometry.space import RayBundle, UnitSpace
from unmix_plugin.engine.processes import Processes
from unmix_plugin.field import FieldSpace, UnmixField
from unmix_plugin.operators.compositing import scale_gradient
from unmix_plugin.operators.occupancy import OccupancyGrid, skip_distances
from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.rendering.grid_upkeep import update_grid
from unmix_plugin.rendering.renderer import VolumeRenderer
from unmix_plugin.settings import UnmixFieldConfig

SMALL = UnmixFieldConfig(finest_resolution=34, log2_rows_per_level=8)


def make(density: float = 1e-6) -> tuple[VolumeRenderer, UnmixField]:
    """A field that is as dense everywhere."""
    torch.manual_seed(0)
    field = UnmixField(SMALL, FieldSpace(BOX, density, is_unbounded=True), 3, 1)
    with torch.no_grad():
        field.table.zero_()
    cells = torch.ones(16, 16, 16)
    return VolumeRenderer(UnitSpace(BOX, True), skip_distances(cells > 0), 0.05, 0.0), field


def rays(num_rays: int) -> RayBundle:
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=generator), dim=-1)
    origins = torch.tensor([0.3, -0.2, 0.4]).repeat(num_rays, 1)
    return RayBundle(origins, directions, torch.zeros(num_rays, dtype=torch.int64))


def test_the_sky_fills_what_matter_leaves_and_is_no_matter():
    bundle = rays(20)
    for density in (1e-9, 0.3, 30.0):
        renderer, field = make(density)
        with torch.no_grad():
            found = renderer.render(field, bundle)
            sky = field.sky(bundle)
            field.sky_network = None
            bare = renderer.render(field, bundle)
        assert sky is not None
        left = 1 - found.coefficients.accumulation[:, None]
        assert_close(found.coefficients.accumulation, bare.coefficients.accumulation)
        assert_close(found.coefficients.abundances, bare.coefficients.abundances)
        light = found.coefficients.scaled_abundances - bare.coefficients.scaled_abundances
        assert_close(light, left * sky[:, -1:] * sky[:, :-1], atol=1e-6, rtol=0)
        assert_close(found.mixtures.sum(-1), torch.ones(20), atol=1e-5, rtol=0)
        assert_close(found.coefficients.abundances.sum(-1), found.coefficients.accumulation)


def test_a_world_without_end_absorbs_a_finite_part_of_the_light():
    """Optical depth of a density of 1 from the middle outwards: 1 in the cube, ln 2 up to r = 2, 1 beyond."""
    renderer, field = make(0.2)
    bundle = RayBundle(torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1, dtype=torch.int64))
    with torch.no_grad():
        found = replace(renderer, step=0.005).render(field, bundle).coefficients
    expected = 1 - math.exp(-0.2 * (2 + math.log(2)))
    assert float(found.accumulation) == pytest.approx(expected, abs=0.02)
    assert 0 < float(found.ray_distance) < 512


def test_rays_end_on_what_stands_outside_the_box():
    renderer, field = make(50.0)
    inner = renderer.is_occupied(torch.tensor([[3.0, 0.0, 0.0]]))
    assert bool(inner)
    occupied = renderer.skips == 0
    occupied[4:12, 4:12, 4:12] = False  # nothing in the box
    shell = VolumeRenderer(UnitSpace(BOX, True), skip_distances(occupied), 0.05, 0.0)
    with torch.no_grad():
        found = shell.render(field, rays(30)).coefficients
    assert (found.accumulation > 0.99).all()
    assert (found.ray_distance > 0.5).all()
    assert found.ray_distance.isfinite().all()


def test_removing_a_material_takes_its_light_out_of_the_sky():
    _, field = make()
    edited = EditedField(field, torch.tensor([True, False, True]), torch.ones(1, 3))
    before, after = field.sky(rays(5)), edited.sky(rays(5))
    assert before is not None
    assert after is not None
    assert (after[:, 1] == 0).all()
    assert_close(after[:, [0, 2, 3]], before[:, [0, 2, 3]])


def test_what_is_near_a_camera_learns_more_slowly_but_looks_the_same():
    values = torch.tensor([1.5, 2.5], requires_grad=True)
    scaled = scale_gradient(values, torch.tensor([0.25, 1.0]))
    assert torch.equal(scaled, values)
    scaled.sum().backward()
    assert values.grad is not None
    assert values.grad.tolist() == [0.25, 1.0]


def test_training_tells_the_grid_what_rays_meet_unless_alpha_carves_it():
    carved, boxed = make_model().train(), make_model(has_alpha=False).train()
    world = make_model(has_alpha=False, more_metadata={"is_unbounded": True}).train()
    torch.nn.init.zeros_(world.field.get_parameter("table"))
    rays = make_rays(200)
    batch = {"spectra": torch.rand(200, 5), "alpha": torch.ones(200), "pixels": torch.arange(200)}
    for model in (carved, boxed, world):
        model.generator = torch.Generator().manual_seed(0)
        model.update(model.get_train_loss_dict(rays, batch)[0])
    assert carved.grid.observed is None
    assert boxed.grid.observed is not None
    assert bool((boxed.grid.observed >= 0).any())
    assert world.grid.observed is not None
    is_met = world.grid.observed >= 0
    centre = world.renderer.space.to_unit(torch.zeros(1, 3))
    assert 0.5 < is_met.float().mean() < 1
    assert bool(is_met[tuple((centre[0] * 8).long())])
    density = world.field.get_density(torch.zeros(1, 3))[0]
    assert_close(world.grid.observed[is_met].mean(), density[0], rtol=0.5, atol=0)


def test_a_world_without_end_begins_with_cells_as_large_as_those_of_a_coarse_grid():
    """And with its own in the second half; a bounded scene has its own from the start."""
    blocks: list[int] = []

    class Watched(OccupancyGrid):
        def update(self, *args: Any, block: int = 1, **words: Any) -> None:
            blocks.append(block)

    for is_unbounded in (True, False):
        renderer = replace(make()[0], space=UnitSpace(BOX, is_unbounded))
        grid = Watched(torch.ones(128, 128, 128) > 0)
        for progress in (0.0, 0.4, 0.6):
            update_grid(grid, make()[1], renderer, Processes(), None, progress=progress)
    assert blocks == [2, 2, 1, 1, 1, 1]


def test_a_backdrop_may_stand_still_in_the_picture_and_a_sky_does_not():
    bundle = rays(20)
    aside = replace(bundle, offsets=torch.full((20, 2), 0.3))
    elsewhere = replace(bundle, origins=bundle.origins + 0.5)
    for is_unbounded in (False, True):
        field = UnmixField(SMALL, FieldSpace(BOX, 1.0, is_unbounded, has_backdrop=True), 3, 1)
        with torch.no_grad():
            here, others = field.sky(bundle), [field.sky(aside), field.sky(elsewhere)]
        assert here is not None
        for other in others:
            assert other is not None
            assert bool((here - other).abs().max() < 1e-6) == is_unbounded


def test_a_backdrop_brighter_and_darker_than_its_endmember_is_learnt():
    """As the light of a lens falls from the middle to the sides."""
    field = UnmixField(SMALL, FieldSpace(BOX, 1.0, has_backdrop=True), 3, 1)
    across = torch.linspace(-0.7, 0.7, 64)
    bundle = replace(rays(64), offsets=torch.stack([across, across], dim=1))
    wanted = 1.3 - 1.2 * across.square()
    assert field.sky_network is not None
    optimizer = torch.optim.Adam(field.sky_network.parameters(), lr=0.01)
    loss = wanted.new_ones(())
    for _ in range(300):
        sky = field.sky(bundle)
        assert sky is not None
        loss = (sky[:, -1] - wanted).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 1e-3


def test_a_bounded_field_has_a_sky_behind_all_matter_only_where_there_is_a_backdrop():
    bare = UnmixField(SMALL, FieldSpace(BOX, 1.0), 3, 1)
    assert bare.sky(rays(2)) is None
    assert not [name for name in bare.state_dict() if "sky" in name]
    field = UnmixField(SMALL, FieldSpace(BOX, 1e-9, has_backdrop=True), 3, 1)
    renderer = VolumeRenderer(UnitSpace(BOX), torch.zeros((8, 8, 8), dtype=torch.uint8), 0.05, 1e-3)
    bundle = rays(20)
    with torch.no_grad():
        found = renderer.render(field, bundle)
        quick = composite(renderer, field, bundle)
        sky = field.sky(bundle)
    assert field.has_sky
    assert sky is not None
    assert_close(found.mixtures, sky[:, :-1], atol=1e-4, rtol=1e-3)
    assert_close(found.coefficients.scaled_abundances, sky[:, -1:] * sky[:, :-1], atol=1e-4, rtol=1e-3)
    assert_close(quick.scaled_abundances, found.coefficients.scaled_abundances, atol=1e-4, rtol=1e-3)
    assert found.coefficients.accumulation.max() < 1e-4
