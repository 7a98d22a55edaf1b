"""Laws of the scene of a mesh with materials: what it shows, under which light, and that nothing changes it."""

from functools import reduce

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close

from tests.factories.surfaces import CAMERAS, FRAME, PBR, TURN, make_object, uneven_light
from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.formats.exr import write_exr
from unmix_plugin.neumatex.fit.trained_object import OWN_LIGHT
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.trained.model_scene import EstimatedScene, LightChoice, RelightableScene
from unmix_plugin.trained.protocol import RenderableScene


@pytest.fixture(scope="module")
def scene():
    return make_object()


CAMERA = CAMERAS[0].resized(24, 18)


def test_it_offers_what_commands_and_viewer_ask_of_scenes(scene):
    assert all(isinstance(scene, kind) for kind in (RenderableScene, RelightableScene, EstimatedScene))
    view = scene.look(CAMERA)
    empty, solid = view.opacity == 0, view.opacity == 1
    assert empty.any()
    for output in scene.outputs:
        channels = () if output.kind == "map" else (3,)
        assert view[output.name].shape == (18, 24, *channels), output.name
        assert view[output.name].isfinite().all()
        assert (view[output.name][empty] == 0).all(), output.name
    assert_close(view["rgb"][solid], scene.curve(view["linear_rgb"][solid]))
    with pytest.raises(ConfigError, match=r"no output named 'rouhness' \(did you mean roughness\?\)"):
        scene.render(CAMERA, ["rouhness"])


def test_what_is_shown_of_the_material_is_that_of_the_surface_that_is_seen(scene):
    middle = scene.probe(CAMERA, 12, 9)
    position, values = torch.as_tensor(middle.position).float(), middle.values
    assert float(position.norm()) == pytest.approx(0.6, abs=0.02)
    truth = PBR.parameters(position[None])[0].numpy()
    assert_allclose(values["base_colour"], truth[:3], atol=1e-5)
    assert_allclose(values["roughness"][0], truth[3], atol=1e-5)
    assert_allclose(values["uncertainty"][0], np.exp(-2), atol=1e-6)
    camera = FRAME.to_world(CAMERAS[0].camera_to_world[0, :, 3].double().numpy())
    assert_allclose(values["depth"][0], np.linalg.norm(camera - middle.world_position), rtol=0.02)
    assert_allclose(FRAME.to_model(middle.world_position[None])[0], middle.position, atol=1e-9)
    assert_allclose(values["normals"] @ TURN.T, middle.position / 0.6, atol=0.05)  # back in model space


def test_light_adds_up_and_materials_do_not_change_with_it(scene):
    """Twice the light is twice the radiance; two stops of exposure are four times."""
    brighter = scene.with_light(LightChoice(exposure_stops=2.0))
    before, after = scene.look(CAMERA), brighter.look(CAMERA)
    assert_close(after["linear_rgb"], 4 * before["linear_rgb"])
    for name in ("base_colour", "roughness", "normals", "depth"):
        assert_close(after[name], before[name])
    assert_close(scene.look(CAMERA)["rgb"], before["rgb"])


def test_light_that_is_turned_once_round_is_the_same_and_half_round_another(scene):
    round_once, half, before = (
        scene.with_light(LightChoice(rotation_deg=angle)).look(CAMERA)["linear_rgb"]
        for angle in (360.0, 180.0, 0.0)
    )
    assert_close(round_once, before, atol=2e-3, rtol=0.05)
    assert float((half - before).abs().mean()) > 0.2 * float(before.mean())


def test_light_can_be_exchanged_for_the_first_again_or_the_same_from_a_file(scene, tmp_path):
    image, other = uneven_light().image.numpy(), scene.with_light(LightChoice("studio"))
    path = write_exr(tmp_path / "light.exr", {name: image[..., i] for i, name in enumerate("RGB")}, {})
    assert other.lights == scene.lights
    for choice in (OWN_LIGHT, str(path)):
        back = other.with_light(LightChoice(choice))
        assert_close(back.look(CAMERA)["linear_rgb"], scene.look(CAMERA)["linear_rgb"])
    with pytest.raises(SceneError, match="no such environment map"):
        scene.with_light(LightChoice(str(tmp_path / "other.exr")))
    with pytest.raises(ConfigError, match=r"no environment 'studoi' \(did you mean studio\?\)"):
        scene.with_light(LightChoice("studoi"))


def test_estimates_are_independent_and_their_mean_comes_near_the_finished_view(scene):
    def mean_of(numbers):
        views = (scene.estimate(CAMERA, 1, number) for number in numbers)
        return reduce(lambda mean, view: mean.averaged(view), views)

    def error(colours):
        return float((colours - truth).square().mean().sqrt())

    mean, truth = mean_of(range(12)), mean_of(range(99, 140))["linear_rgb"]
    assert (mean.num_estimates, mean.num_wanted, scene.num_estimates) == (12, 4, 4)
    first = error(scene.estimate(CAMERA, 1, 0)["linear_rgb"])
    assert error(mean["linear_rgb"]) < 0.6 * first
    assert error(make_object(bounces=1).look(CAMERA, 1)["linear_rgb"]) < first


def test_each_strip_of_a_picture_has_noise_of_its_own(scene, monkeypatch):
    """Strips as far above the middle as others are below it, too."""
    seeds, light_of_rays = [], TracedObject.light_of_rays

    def noted(traced, hits, samples, bounces, generator):
        seeds.append(generator.initial_seed())
        return light_of_rays(traced, hits, samples, bounces, generator)

    monkeypatch.setattr(TracedObject, "light_of_rays", noted)
    for row in range(0, 18, 3):
        scene.look(CAMERA.crop(0, row, 24, 3), 1)
    assert len(set(seeds)) == len(seeds) == 6
