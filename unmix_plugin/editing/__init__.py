"""Edits of materials and light as plain data, and the scenes that they make: one code for exports and the viewer.

They act on endmembers, densities and gloss, never on pixels, so they look the same in every view.
"""

from unmix_plugin.editing.apply import assumption_of_light, changes_geometry, edit_scene
from unmix_plugin.editing.edited_field import sample_seen
from unmix_plugin.editing.recipe import (
    Colour,
    Endmember,
    Gloss,
    Isolate,
    Light,
    Operation,
    Recipe,
    Remove,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
)
from unmix_plugin.editing.recipe_files import read_recipe, recipe_from_yaml, recipe_to_yaml

__all__ = [
    "Colour",
    "Endmember",
    "Gloss",
    "Isolate",
    "Light",
    "Operation",
    "Recipe",
    "Remove",
    "Rename",
    "Replace",
    "Retint",
    "Scale",
    "Swap",
    "assumption_of_light",
    "changes_geometry",
    "edit_scene",
    "read_recipe",
    "recipe_from_yaml",
    "recipe_to_yaml",
    "sample_seen",
]
