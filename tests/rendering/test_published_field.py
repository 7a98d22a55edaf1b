from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import BOX, NUM_BANDS, make_model, make_rays, scene_of
from unmix_plugin.engine.runs.config_json import config_from_json, config_to_json
from unmix_plugin.errors import ConfigError
from unmix_plugin.field import FieldSpace, PublishedField
from unmix_plugin.method_config import unmix_nerf_published
from unmix_plugin.settings import UnmixFieldConfig, UnmixModelConfig

SIZES: dict[str, Any] = {
    "num_levels": 3,
    "log2_rows_per_level": 8,
    "finest_resolution": 32,
    "hidden_width": 16,
}
SMALL = UnmixFieldConfig(temperature=0.4, scale="per-endmember", **SIZES)


@pytest.fixture
def field() -> PublishedField:
    torch.manual_seed(0)
    made = PublishedField(SMALL, FieldSpace(BOX, 2.0), 3, NUM_BANDS)
    with torch.no_grad():
        made.table.normal_(std=0.5)
    return made


def points(count: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=-1)
    return torch.rand(count, 3, generator=g) * 2 - 1, directions


def test_abundances_sum_to_one_and_scales_only_darken_each_endmember_by_its_own(field):
    positions, directions = points()
    density, features = field.get_density(positions)
    outputs = field.get_outputs(positions, directions, features)
    assert_close(outputs["abundances"].sum(-1), torch.ones(50))
    scales = outputs["scaled_abundances"] / outputs["abundances"]
    assert (scales < 1).all()
    assert (scales.std(dim=-1) > 1e-4).all()
    assert (outputs["specular_coefficients"].std(dim=-1) > 1e-4).all()
    assert density.min() > 0
    assert_close(field.abundances_of(features), outputs["abundances"])


def test_the_view_dependent_part_sees_the_direction_and_materials_do_not(field):
    positions, directions = points()
    features = field.get_density(positions)[1]
    one, other = (field.get_outputs(positions, along, features) for along in (directions, -directions))
    assert torch.equal(one["scaled_abundances"], other["scaled_abundances"])
    assert not torch.allclose(one["specular_coefficients"], other["specular_coefficients"])


def test_a_known_encoding_changes_no_value_and_no_gradient(field):
    positions, _ = points()
    with torch.no_grad():
        known = field.encode(positions)
    found = []
    for encoded in (field.encode(positions), field.encode(positions, known)):
        density, features = field.density_of(encoded)
        (gradient,) = torch.autograd.grad(density.sum() + features.sum(), field.table)
        found.append((density.detach(), gradient))
    assert_close(found[0], found[1])


def test_the_registered_settings_are_written_down_and_read_back_and_refuse_what_is_not_published():
    config = unmix_nerf_published.config
    assert config_from_json(config_to_json(config), config) == config
    with pytest.raises(ConfigError, match="light fixed or per-view: the field as published has no shading"):
        replace(config.pipeline.model, light="camera")
    assert isinstance(config.pipeline.model, UnmixModelConfig)
    assert config.pipeline.model.field.scale == "per-endmember"
    with pytest.raises(ConfigError, match="a scale per-endmember: the method as published has no shared one"):
        replace(config.pipeline.model, field=replace(SMALL, scale="shared"))


def test_a_model_as_published_has_one_specular_value_a_band_and_the_probe_chooses():
    published = unmix_nerf_published.config.pipeline.model
    assert isinstance(published, UnmixModelConfig)
    assert published.as_published
    own = {name: getattr(published, name) for name in ("specular", "segmentation", "losses")}
    model = make_model(field=SMALL, as_published=True, **own)
    assert isinstance(model.field, PublishedField)
    assert model.field.num_specular == NUM_BANDS
    assert model.materials.margin_error is None
    batch = {"spectra": torch.rand(8, NUM_BANDS), "alpha": torch.ones(8), "pixels": torch.arange(8)}
    _, losses, _ = model.get_train_loss_dict(make_rays(8), batch)
    assert set(losses) == {"spectral", "rgb"}
    total, parameters = torch.stack([*losses.values()]).sum(), [*model.field.parameters()]
    gradients = torch.autograd.grad(total, parameters, allow_unused=True)
    assert all(x is not None and bool(x.isfinite().all()) for x in gradients)
    scene = scene_of(model)
    view = scene.look(scene.views[0].camera)
    probabilities, scores = view["probe_probabilities"], view["material_scores"]
    assert_close(probabilities.sum(-1), torch.ones(probabilities.shape[:2]))
    assert torch.equal(probabilities.argmax(-1), scores.argmax(-1))
    seen = view.opacity > 0.5
    assert torch.equal(view["segmentation"][seen].long(), probabilities.argmax(-1)[seen])
