"""Recipes on a scene that may be training: the scene is left alone, and edits are made once, not for every block."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from tests.method_factory import make_model, scene_of
from tests.viewer.view_factory import ring
from unmix_plugin.editing import Gloss, Light, Recipe, Remove, Rename, Retint, Scale, Swap, sample_seen
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.rendering import scene as edits
from unmix_plugin.viewer.rendering.scene import Edit


@pytest.fixture
def scene():
    """A scene that nothing trains."""
    return scene_of(make_model(), ring())


def unseen(_):
    raise AssertionError("this edit does not depend on pictures")


def test_no_edit_is_the_scene_itself(scene):
    assert Edit().apply(scene, 0, unseen) is scene


def test_an_edit_leaves_the_scene_alone(scene):
    before = scene.materials.endmembers.clone()
    edited = Edit(Recipe((Scale(0, 2.0), Rename(1, "clay")), Light("A"))).apply(scene, 0, unseen)
    assert isinstance(edited, TrainedScene)
    assert_close(scene.materials.endmembers, before)
    assert edited.materials.names[1] == "clay"
    assert not torch.allclose(edited.materials.endmembers, before)


def test_an_edited_scene_is_made_once_for_a_scene_that_stays(scene, monkeypatch):
    made = []
    original = edits.edit_scene
    monkeypatch.setattr(edits, "edit_scene", lambda *args: made.append(1) or original(*args))
    edit = Edit(Recipe((Scale(0, 2.0),)))
    first = edit.apply(scene, 5, unseen)
    assert all(edit.apply(scene, 5, unseen) is first for _ in range(10))
    assert made == [1]


def test_an_edited_scene_follows_a_training_but_not_every_step(scene, monkeypatch):
    edit = Edit(Recipe((Scale(0, 0.5),)))
    first = edit.apply(scene, 1, unseen)
    assert edit.apply(scene, 2, unseen) is first
    monkeypatch.setattr(edits, "_RENEWAL_S", 0.0)
    trained = replace(scene, materials=replace(scene.materials, endmembers=torch.full((3, 5), 0.4)))
    renewed = edit.apply(trained, 3, unseen)
    assert isinstance(renewed, TrainedScene)
    assert_close(renewed.materials.endmembers[0], torch.full((5,), 0.2))


def test_pictures_are_looked_at_only_for_edits_that_depend_on_them(scene):
    asked = []

    def see(unedited):
        asked.append(unedited)
        return sample_seen(unedited)

    Edit(Recipe((Retint(0, (0.5, 0.4, 0.3), "spectrum"),))).apply(scene, 0, see)
    assert asked == []
    Edit(Recipe((Retint(0, (0.5, 0.4, 0.3)),))).apply(scene, 0, see)
    assert asked == [scene]


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
    assert edit.changes_geometry is renders
    assert edit.reuses(Edit()) is not renders
    assert Edit().reuses(edit) is not renders
    assert edit.reuses(edit)


def test_an_edit_that_does_not_fit_says_so(scene):
    with pytest.raises(ConfigError, match="there is no endmember 7"):
        Edit(Recipe((Scale(7, 2.0),))).apply(scene, 0, unseen)
