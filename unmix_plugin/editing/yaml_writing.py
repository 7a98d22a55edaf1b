"""Recipes as YAML that reads as the same recipe."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import yaml

from unmix_plugin.editing.operations import (
    Colour,
    Gloss,
    Isolate,
    LibrarySpectrum,
    Operation,
    Remove,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
)
from unmix_plugin.editing.recipe import Recipe


def recipe_to_yaml(recipe: Recipe) -> str:
    """The text of a recipe, without comments."""
    content: dict[str, Any] = {}
    if recipe.illuminant is not None:
        light = str(recipe.illuminant.light)
        held = {"light": light, "extrapolate": True}
        content["illuminant"] = held if recipe.illuminant.extrapolate else light
    content["edits"] = [{one.kind: _WRITERS[type(one)](one)} for one in recipe.operations]
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=110)


def _swap(one: Swap) -> list[Any]:
    return [one.first, one.second]


def _replace(one: Replace) -> dict[str, Any]:
    found: dict[str, Any] = {"endmember": one.endmember}
    if isinstance(one.spectrum, LibrarySpectrum):
        found["library"] = one.spectrum.name
    else:
        found["file"] = str(one.spectrum.path)
        found |= {} if one.spectrum.name is None else {"spectrum": one.spectrum.name}
    return found | ({"extrapolate": True} if one.extrapolate else {})


def _retint(one: Retint) -> dict[str, Any]:
    match = {} if one.match == "picture" else {"match": one.match}
    return {"endmember": one.endmember, "colour": _written(one.colour), **match}


def _scale(one: Scale) -> dict[str, Any]:
    return {"endmember": one.endmember, "factor": one.factor}


def _transparent(one: Remove | Isolate) -> list[Any]:
    return list(one.endmembers)


def _rename(one: Rename) -> dict[str, Any]:
    return {"endmember": one.endmember, "name": one.name}


def _gloss(one: Gloss) -> dict[str, Any]:
    found: dict[str, Any] = {} if one.endmember is None else {"endmember": one.endmember}
    found["scale"] = one.scale
    return found | ({} if one.colour is None else {"colour": _written(one.colour)})


_WRITERS: dict[type[Operation], Callable[..., Any]] = {
    Swap: _swap,
    Replace: _replace,
    Retint: _retint,
    Scale: _scale,
    Remove: _transparent,
    Isolate: _transparent,
    Rename: _rename,
    Gloss: _gloss,
}


def _written(colour: Colour) -> str | list[float]:
    """As #rrggbb where that says all of it."""
    digits = [round(255 * value) for value in colour]
    if all(digit / 255 == value for digit, value in zip(digits, colour, strict=True)):
        return "#" + "".join(f"{digit:02x}" for digit in digits)
    return list(colour)
