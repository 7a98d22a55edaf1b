"""Recipes on a scene that may be training, and what training views measured of it."""

import math
import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import make_model, make_scene, scene_of
from tests.factories.views import ring
from unmix_plugin.editing import Gloss, Light, Recipe, Remove, Retint, Scale, Swap, sample_seen
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import Coefficients, Materials
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene
from unmix_plugin.viewer.rendering import aids as aids_module
from unmix_plugin.viewer.rendering import scene as scene_module
from unmix_plugin.viewer.rendering.aids import SceneAids
from unmix_plugin.viewer.rendering.scene import Edit, MeasuredViews


@pytest.fixture
def trained():
    """A scene that nothing trains."""
    return scene_of(make_model(), ring())


def unseen(_):
    raise AssertionError("this edit does not depend on pictures")


def test_an_edited_scene_is_made_once_and_follows_a_training_but_not_every_step(trained, monkeypatch):
    made, original = [], scene_module.edit_scene
    monkeypatch.setattr(scene_module, "edit_scene", lambda *args: made.append(1) or original(*args))
    edit = Edit(Recipe((Scale(0, 0.5),)))
    first = edit.apply(trained, 1, unseen)
    assert all(edit.apply(trained, version, unseen) is first for version in (1, 1, 2))
    assert made == [1]
    monkeypatch.setattr(scene_module, "_EDIT_RENEWAL_S", 0.0)
    later = replace(trained, materials=replace(trained.materials, endmembers=torch.full((3, 5), 0.4)))
    renewed = edit.apply(later, 3, unseen)
    assert isinstance(renewed, TrainedScene)
    assert_close(renewed.materials.endmembers[0], torch.full((5,), 0.2))
    assert Edit().apply(trained, 0, unseen) is trained
    with pytest.raises(ConfigError, match="there is no endmember 7"):
        Edit(Recipe((Scale(7, 2.0),))).apply(trained, 0, unseen)


def test_pictures_are_looked_at_only_for_edits_that_depend_on_them(trained):
    asked = []

    def see(scene):
        asked.append(scene.field)
        return sample_seen(scene)

    colour = (0.5, 0.4, 0.3)
    for edit, expected in ((Retint(0, colour, "spectrum"), []), (Retint(0, colour), [trained.field])):
        Edit(Recipe((edit,))).apply(trained, 0, see)
        assert asked == expected


def test_what_cameras_see_is_sampled_again_only_where_parts_go(trained, source, monkeypatch):
    sampled = []
    monkeypatch.setattr(aids_module, "sample_seen", lambda scene: sampled.append(1) or sample_seen(scene))
    aids = SceneAids(replace(source, take=lambda: trained))
    for removed, times in (((), 1), ((1,), 2), ((1, 2), 3)):
        for colour in ((0.5, 0.4, 0.3), (0.3, 0.4, 0.5)):
            before = (Remove(removed),) if removed else ()
            Edit(Recipe((*before, Retint(0, colour)))).apply(trained, 0, aids.see)
        assert len(sampled) == times


@pytest.mark.parametrize(
    ("recipe", "renders"),
    [
        (Recipe(), False),
        (Recipe((Scale(0, 2.0), Swap(0, 1)), Light("A")), False),
        (Recipe((Gloss(None, 0.5),)), False),
        (Recipe((Gloss(0, 0.5),)), True),
        (Recipe((Remove((0,)),)), True),
    ],
)
def test_pictures_are_rendered_anew_only_where_shapes_or_gloss_change(recipe, renders):
    edit = Edit(recipe)
    assert edit.reuses(Edit()) is not renders
    assert Edit().reuses(edit) is not renders
    assert edit.reuses(edit)


BALL = 0.5


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "demo"
    make_demo_scene(folder, 24, 6, 8)
    return load_scene(folder)


@pytest.fixture
def views(scene, source, monkeypatch):
    """The scene's views around a ball that stands for what the scene renders."""
    monkeypatch.setattr(TrainedScene, "look", lambda _, camera, **__: ball_frame(camera))
    return MeasuredViews(scene, source)


@pytest.fixture
def ball_of(scene):
    """A view of the ball from a camera, as a run on the scene has it."""
    return lambda camera: ball_frame(camera, [scene.cameras[index] for index in scene.train_indices])


def ball_frame(camera, trained_on=()):
    """A view of a ball at the middle of model space: solid, and endmember 0 only."""
    bundle = camera.image_rays(0)
    along = -(bundle.directions * bundle.origins).sum(dim=-1)
    nearest = (bundle.origins.square().sum(dim=-1) - along.square()).clamp(min=0)
    hits = ((nearest < BALL**2) & (along > 0)).float()
    distance = along - (BALL**2 - nearest).clamp(min=0).sqrt()
    shares = hits[:, None] * torch.tensor([1.0, 0.0, 0.0])
    coefficients = Coefficients.of(hits, hits * distance, shares, shares, torch.zeros(len(hits), 1))
    bands = Bands.of([450.0, 490.0, 530.0, 570.0, 610.0, 650.0])
    materials = Materials(bands, torch.full((3, 6), 0.25), torch.zeros(1, 6))
    own = tuple(RunView(f"train_{index:03d}", one, "train") for index, one in enumerate(trained_on))
    ball = replace(make_scene(), materials=materials, views=own)
    return MaterialView(ball, camera, coefficients.unflatten(camera.height, camera.width))


def difference(scene, index, gain: Any = 1.0, light: Any = 1.0):
    """Between the ball and what a view measured, as exposed and lit as the ball."""
    measured = torch.from_numpy(scene.cube(index))
    return ((measured / gain - 0.25).abs() * light).mean(dim=-1)


def test_the_error_at_a_training_view_is_the_difference_to_its_picture(views, scene, ball_of):
    index = scene.train_indices[2]
    frame = ball_of(scene.cameras[index])
    errors, is_known, name = views.error(frame)
    hits = frame.coefficients.accumulation > 0.5
    assert (name, bool(hits.any())) == (scene.frames[index].name, True)
    assert torch.equal(is_known, hits)
    assert_close(errors, torch.where(hits, difference(scene, index), 0.0), atol=1e-6, rtol=0)


def test_from_between_two_views_only_what_the_nearest_sees_has_an_error(views, scene, ball_of):
    camera = scene.cameras[scene.train_indices[0]]
    sine, cosine = math.sin(0.9), math.cos(0.9)
    turn = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    frame = ball_of(replace(camera, camera_to_world=turn @ camera.camera_to_world))
    _, is_known, _ = views.error(frame)
    hits = frame.coefficients.accumulation > 0.5
    assert 0 < int(is_known.sum()) < int(hits.sum())
    assert not bool((is_known & ~hits).any())


def test_pixels_that_do_not_count_are_no_measurement(scene, source, views, ball_of, tmp_path):
    shutil.copytree(scene.root, tmp_path / "holed")
    index = scene.train_indices[1]
    cube = np.load(scene.frames[index].cube_path)
    cube[:, : cube.shape[1] // 2 + 2] = np.nan
    np.save(tmp_path / "holed" / scene.frames[index].cube_path.relative_to(scene.root), cube)
    holed = MeasuredViews(load_scene(tmp_path / "holed", SceneOptions(invalid_pixels="mask")), source)
    camera = scene.cameras[index]
    frame = ball_of(camera)
    _, was_known, _ = views.error(frame)
    _, is_known, _ = holed.error(frame)
    assert torch.equal(is_known, was_known & torch.from_numpy(np.isfinite(cube).all(axis=-1)))
    assert 0 < int(is_known.sum()) < int(was_known.sum())


LIGHT = torch.tensor([0.2, 0.4, 0.6, 0.8, 1.0, 0.5])
GAIN = torch.linspace(0.5, 2.0, 6)


@pytest.mark.parametrize(
    ("shift_px", "light", "gain"), [(2.0, None, None), (0.0, LIGHT, None), (0.0, None, GAIN)]
)
def test_what_was_measured_is_seen_lit_and_exposed_alike(views, scene, ball_of, shift_px, light, gain):
    def shift(camera):
        return replace(camera, center_px=camera.center_px + shift_px)

    index = scene.train_indices[2]
    camera = shift(scene.cameras[index])
    frame = ball_of(camera)
    gains = torch.ones(len(scene.train_indices), 6)
    gains[2] = 1.0 if gain is None else gain
    materials = frame.materials
    if light is not None:
        materials = replace(materials, endmembers=materials.endmembers * light, light=light)
    corrected = tuple(replace(one, camera=shift(one.camera)) for one in frame.scene.views)
    shown = replace(frame.scene, views=corrected, view_gains=gains, materials=materials)
    errors, is_known, _ = views.error(replace(frame, scene=shown))
    expected = difference(scene, index, gains[2], 1.0 if light is None else light)
    assert_close(errors[is_known], expected[is_known], atol=1e-6, rtol=0)


def test_an_error_is_shown_though_the_scene_was_read_late(views, scene, ball_of, source, monkeypatch):
    camera, render = scene.cameras[scene.train_indices[1]], aids_module.reference_rays
    aids = SceneAids(replace(source, take=lambda: ball_of(camera).scene))

    def slowly(*arguments):
        aids.measured = views
        return render(*arguments)

    monkeypatch.setattr(aids_module, "reference_rays", slowly)
    found: Any = aids.for_layers(ball_of(camera).scene)
    assert found.measured is views
