"""Recipes as YAML that reads as the same recipe."""

from __future__ import annotations

from typing import Any

import yaml

from unmix_plugin.editing.recipe import Recipe
from unmix_plugin.editing.yaml_fields import written_fields, written_operation


def recipe_to_yaml(recipe: Recipe) -> str:
    """The text of a recipe, without comments."""
    content: dict[str, Any] = {}
    if recipe.illuminant is not None:
        light = written_fields(recipe.illuminant)
        content["illuminant"] = light if recipe.illuminant.extrapolate else light["light"]
    content["edits"] = [{one.kind: written_operation(one)} for one in recipe.operations]
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=110)
