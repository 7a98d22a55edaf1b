"""What the field guarantees at every point."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import BOX, CONFIG, WAVELENGTHS_NM
from unmix_plugin.errors import ConfigError
from unmix_plugin.field import FieldSpace, UnmixField
from unmix_plugin.light.shading import direction_features
from unmix_plugin.settings import UnmixFieldConfig

PIXELS = (0.02, 0.01, 0.006, 0.0045, 0.003, 0.001)
"""Edges of a pixel, scene units; BOX is 2 long."""


def make_field(
    num_specular: int = 2,
    scale: str = "shared",
    temperature: float = 1.0,
    coarse_to_fine: bool = False,
    **settings,
) -> UnmixField:
    torch.manual_seed(0)
    config = replace(CONFIG.field, finest_resolution=8, scale=scale, temperature=temperature)
    space = FieldSpace(BOX, 2.0, coarse_to_fine=coarse_to_fine)
    field = UnmixField(config, space, 3, num_specular, **settings)
    torch.nn.init.normal_(field.table)
    torch.nn.init.normal_(field.material_network[-1].weight)  # pyright: ignore[reportArgumentType]
    return field


def evaluate(field: UnmixField, count: int = 50):
    positions = torch.rand(count, 3) * 2 - 1
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    density, features = field.get_density(positions)
    return density, field.get_outputs(positions, directions, features)


@pytest.mark.parametrize("scale", ["shared", "per-endmember"])
def test_abundances_lie_on_the_simplex_and_scales_only_darken(scale):
    density, outputs = evaluate(make_field(scale=scale))
    assert (density > 0).all()
    assert_close(outputs["abundances"].sum(-1), torch.ones(50))
    assert (outputs["abundances"] >= 0).all()
    ratio = outputs["scaled_abundances"] / outputs["abundances"]
    assert ((ratio > 0) & (ratio < 1)).all()
    is_shared = (ratio - ratio[:, :1]).abs().max() < 1e-5
    assert is_shared == (scale == "shared")


def test_an_untrained_field_has_the_initial_density():
    field = make_field()
    torch.nn.init.zeros_(field.table)
    assert_close(evaluate(field)[0], torch.full((50,), 2.0))


def test_a_lower_temperature_makes_purer_abundances():
    soft, hard = (evaluate(make_field(temperature=t))[1]["abundances"].amax(-1).mean() for t in (1.0, 0.1))
    assert hard > soft + 0.1


@pytest.mark.parametrize("lit_by_camera", [False, True])
def test_only_the_specular_part_depends_on_direction_and_shading_where_the_light_moves(lit_by_camera):
    field = make_field(lit_by_camera=lit_by_camera)
    positions = torch.rand(20, 3) * 2 - 1
    _, features = field.get_density(positions)
    along = torch.tensor([[0.0, 0.0, 1.0]]).expand(20, 3)
    up, down = (field.get_outputs(positions, directions, features) for directions in (along, -along))
    assert_close(up["abundances"], down["abundances"])
    assert_close(up["abundances"], field.abundances_of(features))
    assert ((up["scaled_abundances"] - down["scaled_abundances"]).abs().max() > 1e-3) == lit_by_camera
    assert (up["specular_coefficients"] - down["specular_coefficients"]).abs().max() > 1e-3
    assert (up["specular_coefficients"] > 0).all()
    assert evaluate(make_field(num_specular=0))[1]["specular_coefficients"].shape == (50, 0)


def test_the_view_dependent_part_of_a_dark_scene_starts_as_much_darker():
    fields = (make_field(exposure=exposure) for exposure in (1.0, 100.0))
    bright, dark = (evaluate(field)[1]["specular_coefficients"] for field in fields)
    assert 30 < (bright / dark).median() < 100


def test_a_lamp_can_be_so_bright_that_a_small_part_of_a_pixel_saturates_it():
    field = make_field()
    first = evaluate(field)[1]["specular_coefficients"].median()
    assert 0.02 < first < 0.1
    positions = torch.zeros(1, 3)
    _, features = field.get_density(positions)
    direction = torch.tensor([[0.0, 0.0, 1.0]])
    optimizer = torch.optim.Adam(field.specular_network.parameters(), lr=0.05)
    brightness = torch.zeros(1, 2)
    for _ in range(200):
        brightness = field.get_outputs(positions, direction, features.detach())["specular_coefficients"]
        optimizer.zero_grad()
        (brightness - 4).square().sum().backward()
        optimizer.step()
    assert_close(brightness, torch.full((1, 2), 4.0), atol=0.1, rtol=0)


def test_a_point_that_grew_too_dense_can_still_be_thinned():
    field = make_field()
    field.log_initial_density = 40.0
    density, _ = field.get_density(torch.zeros(1, 3))
    *_, last_layer = field.density_network.parameters()
    (gradient,) = torch.autograd.grad(density.sum(), last_layer)
    assert torch.isfinite(density).all()
    assert gradient[0].abs().max() > 1


def test_direction_features_are_orthogonal_over_the_sphere():
    directions = torch.nn.functional.normalize(torch.randn(200_000, 3, dtype=torch.float64), dim=-1)
    features = direction_features(directions)
    correlation = torch.corrcoef(features.T)
    assert_close(correlation, torch.eye(15, dtype=torch.float64), atol=0.02, rtol=0)
    assert features.mean(0).abs().max() < 0.02


def test_levels_have_more_rows_where_a_scene_is_many_pixels_large_unless_their_number_is_set():
    edge = float(BOX.size.max())

    def settled(config: UnmixFieldConfig, pixel: float) -> UnmixFieldConfig:
        metadata = {"wavelengths_nm": WAVELENGTHS_NM, "has_alpha": True, "pixel_size": pixel}
        return replace(CONFIG, field=config).settled(edge, metadata).field

    def rows(config: UnmixFieldConfig) -> list[Any]:
        return [settled(config, pixel).log2_rows_per_level for pixel in PIXELS]

    sizes = rows(UnmixFieldConfig())
    assert (sizes[0], sizes[-1]) == (16, 19)
    assert sizes == sorted(sizes)
    assert len(set(sizes)) == 4
    assert set(rows(UnmixFieldConfig(log2_rows_per_level=12))) == {12}
    fine = UnmixFieldConfig(cells_per_pixel=2.0)
    assert [settled(fine, size).finest_resolution for size in (0.01, 0.04)] == [400, 100]
    for number in (3, 25):
        with pytest.raises(ConfigError, match="log2-rows-per-level of 4 to 24 or auto"):
            UnmixFieldConfig(log2_rows_per_level=number)
