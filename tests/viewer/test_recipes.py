"""Recipes as a panel builds them: one change of a kind an endmember, all of it undoable."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.factories.edited_scenes import lit_scene
from unmix_plugin.editing import (
    Gloss,
    Isolate,
    Light,
    Recipe,
    Remove,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
    edit_scene,
    recipe_from_yaml,
    recipe_to_yaml,
)
from unmix_plugin.viewer import recipes
from unmix_plugin.viewer.recipes import change_of, with_change, with_swap, with_visible

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)
CLAY = Rename(0, "clay")
SCENE = lit_scene()


def test_a_change_takes_the_place_of_those_of_which_it_leaves_nothing():
    recipe = Recipe((Scale(1, 2.0), CLAY))
    for change in (Scale(0, 2.0), Scale(0, 3.0)):
        recipe = with_change(recipe, change)
        assert recipe.operations == (Scale(1, 2.0), CLAY, change)
    assert (change_of(recipe, Scale, 0), change_of(recipe, Gloss, 0)) == (Scale(0, 3.0), None)
    coloured = with_change(recipe, Retint(0, RED))
    assert coloured.operations == (Scale(1, 2.0), CLAY, Retint(0, RED))
    brighter = with_change(coloured, Scale(0, 1.5))
    assert change_of(brighter, Retint, 0) == Retint(0, RED)
    replaced = with_change(brighter, Replace(0, "ColorChecker/blue"))
    assert replaced.operations == (Scale(1, 2.0), CLAY, Replace(0, "ColorChecker/blue"))
    by_hand = Recipe((Scale(0, 3.0), Retint(0, RED), Replace(0, "ColorChecker/blue")))
    assert change_of(by_hand, Scale, 0) is change_of(by_hand, Retint, 0) is None
    assert change_of(with_change(by_hand, Retint(0, BLUE)), Replace, 0) == Replace(0, "ColorChecker/blue")


@pytest.mark.parametrize("first", [Retint(0, RED), Scale(0, 2.0), Replace(0, "x/y")])
def test_a_swap_carries_the_changes_of_a_spectrum_along_but_not_names_and_gloss(first):
    recipe = with_swap(Recipe((CLAY, Gloss(0, 0.5), first)), Swap(0, 3))
    assert change_of(recipe, type(first), 3) == first
    assert change_of(recipe, type(first), 0) is None
    assert (change_of(recipe, Rename, 0), change_of(recipe, Gloss, 0)) == (CLAY, Gloss(0, 0.5))
    assert with_change(recipe, first).operations == (*recipe.operations, first)
    moved, glossy = replace(first, endmember=3), Gloss(0, 2.0)
    assert with_change(recipe, moved).operations == (CLAY, Gloss(0, 0.5), Swap(0, 3), moved)
    assert with_change(recipe, glossy).operations == (CLAY, first, Swap(0, 3), glossy)


endmembers, colours = st.integers(0, 2), st.tuples(*[st.floats(0.2, 0.8)] * 3)
panel_changes = st.one_of(
    st.builds(partial, st.just(Scale), endmembers, st.floats(0.1, 5.0)),
    st.builds(partial, st.just(Retint), endmembers, colours, st.just("spectrum")),
    st.builds(partial, st.just(Replace), endmembers, st.just("ColorChecker/red")),
    st.sampled_from([partial(Swap, 0, 1), partial(Swap, 1, 2), partial(Swap, 0, 2)]),
)


@settings(deadline=None, max_examples=30)
@given(st.lists(panel_changes, max_size=8))
def test_whatever_is_changed_fits_the_run_and_the_last_change_does_what_it_does_alone(changes):
    scene, recipe = SCENE, Recipe()
    for make in changes:
        change = make()
        before = edit_scene(scene, recipe).materials.endmembers
        recipe = with_swap(recipe, change) if isinstance(change, Swap) else with_change(recipe, change)
        after = edit_scene(scene, recipe).materials.endmembers
        if isinstance(change, Swap):
            places: dict[Any, Any] = {change.first: change.second, change.second: change.first}
            torch.testing.assert_close(after, torch.stack([before[places.get(i, i)] for i in range(3)]))
            continue
        assert change_of(recipe, type(change), change.endmember) == change
        others = [index for index in range(3) if index != change.endmember]
        torch.testing.assert_close(after[others], before[others])


def test_the_same_swap_twice_in_a_row_takes_it_back():
    recipe = with_swap(Recipe((Scale(0, 2.0),)), Swap(0, 1))
    assert with_swap(recipe, Swap(1, 0)).operations == (Scale(0, 2.0),)
    assert len(with_swap(recipe, Swap(0, 2)).operations) == 3


def test_visibility_is_one_edit_whatever_was_hidden_before():
    recipe = with_visible(Recipe((Scale(0, 2.0),)), {2, 1}, None)
    assert recipe.operations == (Scale(0, 2.0), Remove((1, 2)))
    assert [recipes.is_shown(recipe, index) for index in range(4)] == [True, False, False, True]
    alone = with_visible(recipe, {1}, 3)
    assert alone.operations == (Scale(0, 2.0), Isolate((3,)))
    assert [recipes.is_shown(alone, index) for index in range(4)] == [False, False, False, True]
    assert (recipes.named_by(alone, Isolate), recipes.named_by(alone, Remove)) == ({3}, set())
    assert with_visible(alone, set(), None).operations == (Scale(0, 2.0),)


def test_changes_are_undone_and_redone_in_order():
    history = recipes.RecipeHistory()
    made = [Recipe((Scale(0, float(factor)),)) for factor in range(1, 4)]
    for recipe in (*made, made[-1]):  # the last of which changes nothing
        history.take(recipe)
    assert [history.undone(), history.undone(), history.undone()] == [made[1], made[0], Recipe()]
    assert history.undone() is None
    assert history.redone() == made[0]
    history.take(made[2])
    assert history.redone() is None
    assert history.undone() == made[0]


def test_names_become_numbers_also_where_they_were_given_in_the_recipe():
    named = (Rename("b", "clay"), Swap("clay", "a"), Remove(("clay", 2)), Replace("a", "x/y"))
    as_they_are = (Gloss(None, 0.5), Scale("x", 2.0))  # the latter is left for whoever applies it
    expected = (Rename(1, "clay"), Swap(1, 0), Remove((1, 2)), Replace(0, "x/y"))
    found = recipes.numbered(Recipe((*named, *as_they_are)), ("a", "b", "c"))
    assert found.operations == (*expected, *as_they_are)


@pytest.mark.parametrize("isolated", [None, 2])
def test_what_a_panel_builds_is_what_is_read_from_its_file(isolated):
    recipe = Recipe(illuminant=Light("FL2"))
    recipe = with_change(recipe, Retint(0, (0.2, 0.4, 0.6)))
    recipe = with_change(recipe, Rename(1, "clay"))
    recipe = with_visible(with_swap(recipe, Swap(0, 2)), {0}, isolated)
    assert recipe_from_yaml(recipe_to_yaml(recipe)) == recipe


def test_changes_of_the_same_thing_in_quick_succession_are_undone_together():
    now = [0.0]
    history = recipes.RecipeHistory(clock=lambda: now[0])
    for factor in (1.1, 1.2, 1.3):
        history.take(with_change(history.present, Scale(0, factor)), (Scale, 0))
        now[0] += 0.1
    history.take(with_change(history.present, Scale(1, 2.0)), (Scale, 1))
    now[0] += 10.0
    history.take(with_change(history.present, Scale(1, 3.0)), (Scale, 1))
    assert history.undone() == Recipe((Scale(0, 1.3), Scale(1, 2.0)))
    assert history.undone() == Recipe((Scale(0, 1.3),))
    assert history.undone() == Recipe()
    assert history.undone() is None
    history.redone()
    history.take(with_change(history.present, Scale(0, 5.0)), (Scale, 0))  # after an undo: by itself
    assert history.undone() == Recipe((Scale(0, 1.3),))
    for factor in (4.0, 1.3):  # there and back again leaves nothing to undo
        history.take(with_change(history.present, Scale(0, factor)), (Scale, 0))
    assert history.undone() == Recipe()


def test_as_many_edits_are_kept_as_a_recipe_file_may_hold():
    edits = (
        Scale(0, 5.0),
        *(Scale(number, 2.0) for number in range(1, 255)),
        *(Swap(0, 1), Swap(1, 2)) * 370,
    )
    assert with_change(Recipe(edits), Gloss(None, 0.5)).operations == (*edits, Gloss(None, 0.5))
