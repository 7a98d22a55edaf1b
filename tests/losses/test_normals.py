"""Densities guide the normals that a lamp's light teaches."""

import pytest
import torch
from torch import nn

from tests.light.test_lamp import model_with_lamp
from tests.method_factory import NUM_BANDS, make_model, make_rays
from unmix_plugin.light.shading import LampShading
from unmix_plugin.losses.normals import normals_error
from unmix_plugin.model import UnmixModel


def growing_downwards(positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Densities whose surfaces face up, and features."""
    return torch.exp(-5 * positions[:, 2]), positions


def shading_of(normal: tuple[float, float, float]) -> LampShading:
    """That has this normal everywhere."""
    shading = LampShading(3, 4, torch.tensor(normal))
    for values in shading.parameters():
        nn.init.zeros_(values)
    return shading


@pytest.mark.parametrize(
    ("normal", "expected"),
    [((0.0, 0.0, 1.0), 0.0), ((1.0, 0.0, 0.0), 1.0), ((0.0, 0.0, -1.0), 2.0)],
)
def test_the_error_is_one_less_the_cosine_to_the_densities_own_normals(normal, expected):
    generator = torch.Generator().manual_seed(0)
    error = normals_error(growing_downwards, shading_of(normal), torch.rand(40, 3), torch.rand(40), generator)
    assert float(error.detach()) == pytest.approx(expected, abs=1e-6)


def test_without_samples_there_is_no_error():
    shading = shading_of((0.0, 0.0, 1.0))
    error = normals_error(growing_downwards, shading, torch.zeros(0, 3), torch.zeros(0), None)
    assert float(error.detach()) == 0


def losses(model: UnmixModel, progress: float) -> dict[str, torch.Tensor]:
    """Of a step when that part of the training is over."""
    model.train()
    model.generator = torch.Generator().manual_seed(0)
    before, *_ = model.get_training_callbacks()
    before.func(1, progress)
    batch = {"spectra": torch.rand(60, NUM_BANDS), "alpha": torch.ones(60), "pixels": torch.arange(60)}
    return model.get_loss_dict(model.get_outputs(make_rays(60)), batch)


def test_normals_are_guided_less_and_less_and_only_where_a_lamp_moves():
    guided = losses(model_with_lamp(), 0.1)
    guided["normals"].backward()
    assert float(guided["normals"].detach()) > 0
    assert float(losses(model_with_lamp(), 0.9)["normals"].detach()) < 0.02 * float(
        guided["normals"].detach()
    )
    assert "normals" not in losses(model_with_lamp(), 1.0)
    assert "normals" not in losses(make_model(), 0.1)


def test_what_guides_normals_leaves_the_light_and_the_materials_alone():
    model = model_with_lamp()
    losses(model, 0.1)["normals"].backward()
    moved = {name for name, value in model.named_parameters() if value.grad is not None and value.grad.any()}
    shading = {name for name in moved if name.startswith("field.lamp_shading")}
    assert shading
    assert moved - shading <= {"field.table", *(f"field.density_network.{i}.weight" for i in (0, 2))}
