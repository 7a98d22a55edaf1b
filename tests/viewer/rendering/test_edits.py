"""Recipes on a model that may be training: the model is left alone, and edits are made once, not for every block."""

import pytest
import torch
from torch.testing import assert_close

from tests.viewer.view_factory import make_source
from unmix_plugin.editing import Gloss, Light, Recipe, Remove, Rename, Retint, Scale, Swap, sample_seen
from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.rendering import edits
from unmix_plugin.viewer.rendering.edits import Edit


def unseen(_):
    raise AssertionError("this edit does not depend on pictures")


def test_no_edit_is_the_model_itself(source):
    assert Edit().apply(source._model, 0, unseen) is source._model


def test_an_edit_leaves_the_model_alone(source):
    before = source._model.endmembers.detach().clone()
    edited = Edit(Recipe((Scale(0, 2.0), Rename(1, "clay")), Light("A"))).apply(source._model, 0, unseen)
    assert_close(source._model.endmembers.detach(), before)
    assert edited.materials.names[1] == "clay"
    assert not torch.allclose(edited.materials.endmembers, before)


def test_an_edited_model_is_made_once_for_a_model_that_stays(source, monkeypatch):
    made = []
    original = edits.edit_model
    monkeypatch.setattr(edits, "edit_model", lambda *args: made.append(1) or original(*args))
    edit = Edit(Recipe((Scale(0, 2.0),)))
    first = edit.apply(source._model, 5, unseen)
    assert all(edit.apply(source._model, 5, unseen) is first for _ in range(10))
    assert made == [1]


def test_an_edited_model_follows_a_training_but_not_every_step(source, monkeypatch):
    edit = Edit(Recipe((Scale(0, 0.5),)))
    first = edit.apply(source._model, 1, unseen)
    assert edit.apply(source._model, 2, unseen) is first
    monkeypatch.setattr(edits, "_RENEWAL_S", 0.0)
    with torch.no_grad():
        source._model.endmembers.fill_(0.4)
    assert_close(edit.apply(source._model, 3, unseen).endmembers[0], torch.full((5,), 0.2))


def test_pictures_are_looked_at_only_for_edits_that_depend_on_them(source):
    asked = []

    def see(model):
        asked.append(model)
        return sample_seen(model, source.scene.train_cameras)

    Edit(Recipe((Retint(0, (0.5, 0.4, 0.3), "spectrum"),))).apply(source._model, 0, see)
    assert asked == []
    Edit(Recipe((Retint(0, (0.5, 0.4, 0.3)),))).apply(source._model, 0, see)
    assert asked == [source._model]


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


def test_an_edit_that_does_not_fit_says_so(tmp_path):
    source = make_source(tmp_path)
    with pytest.raises(ConfigError, match="there is no endmember 7"):
        Edit(Recipe((Scale(7, 2.0),))).apply(source._model, 0, unseen)
