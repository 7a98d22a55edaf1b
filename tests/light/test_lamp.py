from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from tests.factories.models import BOX, CAMERA, CONFIG, initial_data, make_model, make_rays, scene_of
from unmix_plugin.editing.edited_field import EditedField
from unmix_plugin.engine.geometry.key_poses import rotation_matrix
from unmix_plugin.errors import ConfigError
from unmix_plugin.light.lamp import Lamp, MovingLamp
from unmix_plugin.light.shading import FINEST, Lamplight, ShadowDetail, lamplight, visible_part
from unmix_plugin.model import UnmixModel
from unmix_plugin.operators.occupancy import skip_distances
from unmix_plugin.settings import UnmixModelConfig

TURNTABLE = Lamp("turntable", (0.0, 0.0, 0.1), (0.0, 0.0, 1.0), (-1.0, 2.0, 3.0))
NUMBERS = TURNTABLE.numbers()


def turned(points: torch.Tensor, angle: float) -> torch.Tensor:
    return points @ rotation_matrix(torch.tensor([[0.0, 0.0, angle]]))[0].T


def wall(cells: int = 64) -> torch.Tensor:
    """A plate across the box at x = 0.5, for z > 0."""
    opaque = torch.zeros(cells, cells, cells, dtype=torch.uint8)
    opaque[cells * 3 // 4 : cells * 3 // 4 + 12, :, cells // 2 :] = 1
    return opaque


@pytest.mark.parametrize("frame", ["turntable", "camera"])
def test_the_lamp_turns_with_the_camera_about_the_axis(frame):
    lamp = MovingLamp(Lamp(frame, TURNTABLE.middle, TURNTABLE.axis, TURNTABLE.place))
    origins = torch.tensor([[4.0, 1.0, 2.0], [0.5, -3.0, 1.0]])
    found = lamp.positions(turned(origins, 0.7))
    assert_close(found, turned(lamp.positions(origins), 0.7))


def test_only_in_the_cameras_frame_the_lamp_goes_up_with_the_camera():
    low, high = torch.tensor([[4.0, 0.0, 0.1]]), torch.tensor([[0.4, 0.0, 4.0]])
    table = MovingLamp(TURNTABLE)
    held = MovingLamp(Lamp("camera", TURNTABLE.middle, TURNTABLE.axis, TURNTABLE.place))
    assert_close(table.positions(low), torch.tensor([[3.0, -1.0, 2.1]]))
    assert_close(table.positions(high), table.positions(low))
    assert_close(held.positions(low), table.positions(low))
    assert (held.positions(high) - held.positions(low)).norm() > 2


def test_what_stands_before_the_lamp_casts_a_shadow_and_what_stands_behind_does_not():
    positions = torch.tensor([[-0.5, 0.0, 0.5], [-0.5, 0.0, -0.5], [0.99, 0.0, 0.5]])
    lamps = positions + torch.tensor([5.0, 0.0, 0.0])
    found = visible_part(positions, lamps, BOX, skip_distances(wall() != 0))
    assert found[0] < 0.01
    assert_close(found[1:], torch.ones(2))


def test_shadows_come_nearer_and_get_sharper_until_training_ends():
    plate = torch.zeros(64, 64, 64, dtype=torch.uint8)
    plate[:, :, 32:36] = 1
    below = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.7]])
    lamps, skips = below + torch.tensor([0.0, 0.0, 5.0]), skip_distances(plate != 0)
    details = [ShadowDetail.at(progress) for progress in (0.0, 0.5, 1.0)]
    first, middle, last = (visible_part(below, lamps, BOX, skips, detail) for detail in details)
    assert torch.equal(visible_part(below, lamps, BOX, skips), last)
    assert bool((first > middle).all() & (middle > last).all())
    assert float(last.max()) < 0.05
    assert ShadowDetail.at(1.0) == FINEST


def test_the_slope_of_the_visible_part_follows_what_moving_the_lamp_changes():
    """Against differences of the blurred visible part, near a shadow's edge."""
    positions = torch.tensor([-0.5, 0.0, -0.1]) + 0.05 * torch.randn(4000, 3)
    origins = torch.tensor([[4.0, 0.0, 0.0]]).repeat(4000, 1)
    lamp = MovingLamp(Lamp("turntable", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.3, 4.0)))

    def mean_visible(change: float) -> torch.Tensor:
        with torch.no_grad():
            lamp.change.copy_(torch.tensor([0.0, change, 0.0]))
        skips, generator = skip_distances(wall() != 0), torch.Generator().manual_seed(0)
        lit = lamplight(lamp, origins, positions, BOX, skips, ShadowDetail.at(0.0), generator)
        return lit.visible.mean()

    high, low = (float(mean_visible(change).detach()) for change in (0.05, -0.05))
    expected = (high - low) / 0.1
    mean_visible(0.0).backward()
    assert lamp.change.grad is not None
    assert expected < -0.3
    assert float(lamp.change.grad[1]) == pytest.approx(expected, rel=0.25)


def cast_shadows(model: UnmixModel, opaque: torch.Tensor) -> None:
    assert model.grid.opaque is not None
    assert model.grid.opaque_skips is not None
    model.grid.opaque.copy_(opaque)
    model.grid.opaque_skips.copy_(skip_distances(opaque != 0))


def lit_by(numbers: tuple[float, ...], cells: int = 8) -> UnmixModel:
    config = replace(CONFIG, light="camera", lamp=numbers)
    model = config.setup(scene_box=BOX, metadata={**make_model().metadata, "grid_resolution": cells})
    assert isinstance(model, UnmixModel)
    return model


def model_with_lamp() -> UnmixModel:
    """A model whose lamp has a wall in its way, on the side of x > 0.5."""
    model = lit_by(NUMBERS, 64)
    with torch.no_grad():
        data = {**initial_data(), "reachable": np.ones((64, 64, 64), bool)}
        model.initialise(data, torch.Generator().manual_seed(0))
        model.field.get_parameter("table").normal_(std=0.5)
    cast_shadows(model, wall())
    return model.eval()


def test_shadows_change_brightness_and_not_abundances():
    model, rays = model_with_lamp(), make_rays(60)
    shaded = model.get_outputs(rays)
    cast_shadows(model, torch.zeros_like(wall()))
    lit = model.get_outputs(rays)
    assert_close(shaded["abundances"], lit["abundances"])
    assert_close(shaded["accumulation"], lit["accumulation"])
    assert (lit["spectral"] - shaded["spectral"]).abs().max() > 0.01


def test_a_scene_keeps_its_shadows_while_training_goes_on():
    model = model_with_lamp()
    scene = scene_of(model)
    before = scene.render(CAMERA, ["spectral"])["spectral"]
    cast_shadows(model, torch.zeros_like(wall()))
    with torch.no_grad():
        model.field.get_parameter("lamp.change").add_(0.5)
    assert_close(scene.render(CAMERA, ["spectral"])["spectral"], before)
    assert (scene_of(model).render(CAMERA, ["spectral"])["spectral"] - before).abs().max() > 1e-3


def test_a_loaded_model_casts_the_same_shadows():
    model, other = model_with_lamp(), model_with_lamp()
    with torch.no_grad():
        model.field.get_parameter("lamp.change").add_(0.5)
    cast_shadows(model, wall().flip(0))
    other.load_state_dict(model.state_dict())
    rays = make_rays(20)
    assert_close(other.get_outputs(rays)["spectral"], model.get_outputs(rays)["spectral"])


def test_training_gives_the_lamp_a_gradient():
    model = model_with_lamp().train()
    model.generator = torch.Generator().manual_seed(0)
    model.get_outputs(make_rays(200))["spectral"].sum().backward()
    gradient = model.field.get_parameter("lamp.change").grad
    assert gradient is not None
    assert gradient.abs().max() > 0
    groups = model.get_param_groups()
    assert any(value is model.field.get_parameter("lamp.change") for value in groups["networks"])


def test_an_edited_field_stands_in_the_same_light():
    model = model_with_lamp()
    edited = EditedField.over(model.field, torch.ones(3, dtype=torch.bool), torch.ones(1, 3))
    rays = make_rays(20)
    found, expected = (model.renderer.render(one, rays).coefficients for one in (edited, model.field))
    assert_close(found.packed, expected.packed)


def test_a_point_without_a_view_is_lit_squarely_and_without_gloss():
    field: Any = model_with_lamp().field
    positions = torch.rand(30, 3) - 0.5
    along = normalize(torch.randn(30, 3), dim=1)
    _, features = field.get_density(positions)
    normals, _ = field.lamp_shading.surface(features)
    facing = field.get_outputs(positions, torch.zeros(30, 3), features, Lamplight(torch.ones(30), normals))
    found = field.get_outputs(positions, torch.zeros(30, 3), features)
    assert_close(found["scaled_abundances"], facing["scaled_abundances"])
    dark = field.get_outputs(positions, along, features, Lamplight(torch.zeros(30), normals))
    assert_close(found["specular_coefficients"], dark["specular_coefficients"])
    assert (facing["specular_coefficients"] - dark["specular_coefficients"]).abs().max() > 1e-4


def test_gloss_follows_the_lamp_and_not_the_eye_alone():
    field: Any = model_with_lamp().field
    positions, along = torch.rand(30, 3) - 0.5, normalize(torch.randn(30, 3), dim=1)
    _, features = field.get_density(positions)
    one, other = (
        field.get_outputs(positions, along, features, Lamplight(torch.ones(30), normalize(side, dim=1)))
        for side in (-along + 0.1, -along + 1.5)
    )
    assert_close(one["abundances"], other["abundances"])
    assert (one["specular_coefficients"] - other["specular_coefficients"]).abs().max() > 1e-4


@pytest.mark.parametrize(("numbers", "words"), [(NUMBERS, "follows from shadows"), ((), "no shadows tell")])
def test_the_lamp_follows_from_the_data(numbers, words):
    """Where it is not known shading depends on the direction of view."""
    data = {**initial_data(), "light": np.array("camera"), "lamp": np.array(numbers)}
    config, reasons = UnmixModelConfig(num_endmembers=3).resolve_auto(lambda: data, torch.Generator())
    assert config.lamp == numbers
    assert words in reasons
    model = lit_by(numbers)
    assert (model.field.moving_lamp is None, model.grid.opaque is None) == (numbers == (),) * 2


@pytest.mark.parametrize("light", ["auto", "fixed", "per-view"])
def test_a_lamp_is_refused_in_a_light_that_does_not_move_with_the_camera(light):
    said = f"light camera where numbers of a lamp are given .got light {light}, lamp"
    with pytest.raises(ConfigError, match=said):
        UnmixModelConfig(light=light, lamp=NUMBERS)
    with pytest.raises(ConfigError, match="ten numbers"):
        UnmixModelConfig(lamp=(0.0, 1.0))
    assert UnmixModelConfig(light=light, lamp=()).lamp == ()
    assert UnmixModelConfig(light="camera", lamp=NUMBERS).lamp == NUMBERS
    assert Lamp.of_numbers(NUMBERS) == TURNTABLE


def test_an_axis_of_another_length_moves_no_lamp_and_none_at_all_is_refused():
    assert Lamp.of_numbers((*NUMBERS[:6], 5.0, *NUMBERS[7:])) == TURNTABLE
    for at in (4, 7):
        with pytest.raises(ConfigError, match="axis and way not 0"):
            UnmixModelConfig(light="camera", lamp=(*NUMBERS[:at], 0.0, 0.0, 0.0, *NUMBERS[at + 3 :]))
