"""Light from elsewhere than the surface that a pixel is known to show."""

import pytest
import torch

from tests.method_factory import NUM_BANDS, make_model
from unmix_plugin.engine.geometry.space import SceneBox, UnitSpace
from unmix_plugin.losses.surfaces import stray_light
from unmix_plugin.losses.training_losses import LossConfig

SPACE = UnitSpace(SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])), is_unbounded=True)
CELL = 1 / 64
NAN = float("nan")


def stray(weights, cells_off, ray_indices, surfaces):
    """Of samples so many cells away from the middle of the box along x."""
    positions = torch.full((len(weights), 3), 0.5)
    positions[:, 0] += CELL * torch.tensor(cells_off)
    return stray_light(
        torch.as_tensor(weights), positions, torch.tensor(ray_indices), torch.tensor(surfaces), SPACE
    )


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
    model = make_model(has_alpha=False, losses=LossConfig(surface=0.2, surface_until=0.5, abundances=0.0))
    batch = {"spectra": torch.zeros(2, NUM_BANDS), "alpha": torch.ones(2)}
    outputs = {
        "spectral": torch.zeros(4, NUM_BANDS),
        "accumulation": torch.zeros(4),
        "spread": torch.zeros(()),
        "weights": torch.zeros(0),
        "positions": torch.zeros(0, 3),
        "rays": torch.zeros(0, dtype=torch.int64),
    }
    begin_step = model.get_training_callbacks()[0].func
    found = []
    for progress in (0.0, 0.25, 0.5):
        begin_step(1, progress)
        assert "surface" not in model.get_loss_dict(outputs, batch)
        guided = {**batch, "surfaces": torch.tensor([[0.1, 0.2, 0.3], [NAN, NAN, NAN]])}
        found.append(float(model.get_loss_dict(outputs, guided).get("surface", 0.0)))
    assert found == pytest.approx([0.1, 0.025, 0.0])
