import pytest
import torch
from torch import nn

from tests.factories.models import BOX, NUM_BANDS, losses_of, make_model, make_rays
from tests.light.test_lamp import model_with_lamp
from unmix_plugin.engine.geometry.space import RayBundle, UnitSpace
from unmix_plugin.light.shading import LampShading
from unmix_plugin.losses.terms import light_near_cameras, normals_error, stray_light
from unmix_plugin.model import UnmixModel

SPACE = UnitSpace(BOX, is_unbounded=True)
CELL = 1 / 64
NAN = float("nan")


def stray(weights, cells_off, ray_indices, surfaces):
    """Of samples so many cells away from the middle of the box along x."""
    positions, rays = torch.full((len(weights), 3), 0.5), torch.tensor(ray_indices)
    positions[:, 0] += CELL * torch.tensor(cells_off)
    return stray_light(torch.as_tensor(weights), positions, rays, torch.tensor(surfaces), SPACE)


def test_light_counts_in_full_at_the_surface_and_not_at_all_far_from_it():
    surfaces = [[0.0, 0.0, 0.0]]
    for cells_off, expected in ((0.0, 0.0), (0.9, 0.0), (-2.0, 0.5), (3.1, 1.0), (20.0, 1.0)):
        found = stray([1.0], [cells_off], [0], surfaces)
        assert float(found) == pytest.approx(expected, abs=1e-5)


def test_what_a_ray_lets_through_is_stray_and_rays_without_a_known_surface_are_not_asked():
    surfaces = [[0.0, 0.0, 0.0], [NAN, NAN, NAN], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    found = stray([0.6, 0.2, 1.0], [0.0, 30.0, 30.0], [0, 0, 1], surfaces)
    assert float(found) == pytest.approx((0.4 + 0 + 1 + 1) / 4)


def test_it_draws_light_to_the_surface_alone():
    weights = torch.tensor([0.3, 0.3], requires_grad=True)
    stray(weights, [0.0, 10.0], [0, 0], [[0.0, 0.0, 0.0]]).backward()
    assert weights.grad is not None
    assert weights.grad.tolist() == [-1.0, 0.0]


def test_it_fades_out_and_needs_pixels_with_known_surfaces():
    model = make_model(has_alpha=False, more_metadata={"is_unbounded": True})
    batch = {"spectra": torch.zeros(2, NUM_BANDS), "alpha": torch.ones(2)}
    guided = {**batch, "surfaces": torch.tensor([[0.1, 0.2, 0.3], [NAN, NAN, NAN]])}
    begin_step = model.get_training_callbacks()[0].func
    found = []
    for progress in (0.0, 0.25, 0.5):
        begin_step(1, progress)
        rendered = (batch["spectra"], torch.zeros(2))
        assert "surface" not in losses_of(model, batch, *rendered)
        found.append(float(losses_of(model, guided, *rendered).get("surface", 0.0)))
    assert found == pytest.approx([0.15, 0.0375, 0.0])


def test_light_costs_the_square_of_how_near_a_camera_it_starts():
    origins = torch.tensor([[1.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0]])
    rays = RayBundle(origins, -origins, torch.tensor([7, 7, 2]))
    reach = 1.2  # both cameras stand a unit from the middle
    places = torch.tensor([[1.0, 0, 0], [1.0 - reach / 2, 0, 0], [-1.0, reach / 2, 0], [0.0, 9.0, 0.0]])
    weights = torch.tensor([0.5, 1.0, 1.0, 1.0], requires_grad=True)
    found = light_near_cameras(weights, SPACE.to_unit(places), rays, SPACE)
    assert found.item() == pytest.approx((0.5 + 0.25 + 0.25 + 0.0) / 3, abs=1e-4)
    found.backward()
    assert weights.grad is not None
    assert (weights.grad[:3] > 0).all()
    assert weights.grad[3] == 0


def growing_downwards(positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Densities whose surfaces face up, and features."""
    return torch.exp(-5 * positions[:, 2]), positions


def shading_of(normal: tuple[float, float, float]) -> LampShading:
    """That has this normal everywhere."""
    shading = LampShading(3, 4, torch.tensor(normal))
    for values in shading.parameters():
        nn.init.zeros_(values)
    return shading


@pytest.mark.parametrize(("normal", "expected"), [((0, 0, 1.0), 0), ((1.0, 0, 0), 1), ((0, 0, -1.0), 2)])
def test_the_error_is_one_less_the_cosine_to_densities_own_normals_and_0_without_samples(normal, expected):
    generator = torch.Generator().manual_seed(0)
    for count, wanted in ((40, expected), (0, 0.0)):
        places, weights = torch.rand(count, 3), torch.rand(count)
        error = normals_error(growing_downwards, shading_of(normal), places, weights, generator)
        assert float(error.detach()) == pytest.approx(wanted, abs=1e-6)


def losses(model: UnmixModel, progress: float) -> dict[str, torch.Tensor]:
    """Of a step when that part of the training is over."""
    model.train()
    model.generator = torch.Generator().manual_seed(0)
    before, *_ = model.get_training_callbacks()
    before.func(1, progress)
    batch = {"spectra": torch.rand(60, NUM_BANDS), "alpha": torch.ones(60), "pixels": torch.arange(60)}
    return model.get_train_loss_dict(make_rays(60), batch)[1]


def test_normals_are_guided_less_and_less_and_only_where_a_lamp_moves():
    guided = losses(model_with_lamp(), 0.1)
    guided["normals"].backward()
    assert float(guided["normals"].detach()) > 0
    later = losses(model_with_lamp(), 0.9)
    assert float(later["normals"].detach()) < 0.02 * float(guided["normals"].detach())
    assert "normals" not in losses(model_with_lamp(), 1.0)
    assert "normals" not in losses(make_model(), 0.1)


def test_what_guides_normals_leaves_the_light_and_the_materials_alone():
    model = model_with_lamp()
    losses(model, 0.1)["normals"].backward()
    moved = {name for name, value in model.named_parameters() if value.grad is not None and value.grad.any()}
    shading = {name for name in moved if name.startswith("field.lamp_shading")}
    assert shading
    assert moved - shading <= {"field.table", *(f"field.density_network.{i}.weight" for i in (0, 2))}
