"""Recipes as YAML: plain data, checked line by line, and written so that it reads as the same recipe.

    illuminant: A
    edits:
      - rename: {endmember: 0, name: wood}
      - swap: [wood, 3]
      - replace: {endmember: 2, library: ColorChecker/red}
      - retint: {endmember: 4, colour: '#3366cc'}
      - remove: [5, 6]

The fields of each edit's dataclass say what can be written, and what may be left out. Of YAML only single plain values
are ever constructed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml

from unmix_plugin.editing.recipe import (
    OPERATIONS,
    Colour,
    Endmember,
    Gloss,
    Light,
    LightName,
    Operation,
    Recipe,
)
from unmix_plugin.errors import ConfigError, UnmixError, did_you_mean
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.limits import read_bounded
from unmix_plugin.spectral.colour.conversion import parse_light

_MOST_CHARACTERS = 100_000
"""PyYAML reads about 60,000 characters a second."""
MOST_EDITS = 1000
_MOST_ENDMEMBERS = 255
"""That one edit may name; no run has more."""
_LONGEST_NUMBER, _LONGEST_QUOTE = 40, 60
_TAG = "tag:yaml.org,2002:"
_PLAIN = ("str", "int", "float", "bool", "null", "timestamp")
_KINDS = {kind.kind: kind for kind in OPERATIONS}
_T = TypeVar("_T")


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe; relative paths in it start from its folder.

    Raises:
        ConfigError: it can't be read, or anything in it is wrong; one message names every fault with its line.
    """
    path = Path(path)
    try:
        text = read_bounded(path, 4 * _MOST_CHARACTERS).decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"can't read the recipe {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"can't read the recipe {path}: it is not text in UTF-8") from error
    return recipe_from_yaml(text, str(path), path.parent)


def recipe_from_yaml(text: str, source: str = "recipe", folder: Path = Path()) -> Recipe:
    """A recipe from its text.

    Args:
        text: YAML.
        source: What messages call it.
        folder: Where relative paths start.
    Raises:
        ConfigError: anything in it is wrong; one message names every fault with its line.
    """
    faults: list[_NodeError] = []
    operations, light = [], None
    try:
        document = _compose(text)
        parts = _mapping(document, "a recipe", (), ("edits", "illuminant"))
        if not parts:
            raise _NodeError(document, "a recipe needs edits or an illuminant")
        if "illuminant" in parts:
            light = _read_light(parts["illuminant"], folder.absolute())
        for node in _sequence(parts["edits"], "edits", MOST_EDITS) if "edits" in parts else []:
            try:
                operations.append(_read_edit(node, folder.absolute()))
            except _NodeError as error:  # noqa: PERF203 - one message names every fault
                faults.append(error)
    except _NodeError as error:
        faults.append(error)
    if faults:
        places = [source if one.line is None else f"{source}, line {one.line}" for one in faults]
        raise ConfigError("\n".join(f"{place}: {one}" for place, one in zip(places, faults, strict=True)))
    return Recipe(tuple(operations), light, source)


def recipe_to_yaml(recipe: Recipe) -> str:
    """The text of a recipe, without comments; its paths are absolute, so that it can lie anywhere."""
    content: dict[str, Any] = {}
    if recipe.illuminant is not None:
        light = _written(recipe.illuminant)
        content["illuminant"] = light if recipe.illuminant.extrapolate else light["light"]
    content["edits"] = edits = []
    for one in recipe.operations:
        found: Any = _written(one)
        if one.is_list:
            found = next(iter(found.values())) if len(found) == 1 else list(found.values())
        edits.append({one.kind: found})
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=110)


def _written(value: Operation | Light) -> dict[str, Any]:
    """A dataclass as a mapping that reads as the same; what has its default is left out, but a factor of gloss."""
    found: dict[str, Any] = {}
    for name, default in _defaults(type(value)).items():
        part = getattr(value, name)
        if part is None or (part == default and name != "scale"):
            continue
        if name == "colour" and all(round(255 * x) / 255 == x for x in part):
            part = css_colour(part)  # which is exact
        elif isinstance(part, Path):
            part = str(part.absolute())
        found[name] = list(part) if isinstance(part, tuple) else part
    return found


def _defaults(kind: type) -> dict[str, Any]:
    """The fields that a recipe has of a dataclass, and their defaults; MISSING for those that it must have."""
    return {one.name: one.default for one in fields(kind) if not one.kw_only}


class _NodeError(Exception):
    """Something in a YAML text is not what it should be."""

    def __init__(self, where: yaml.Node | int | None, message: str) -> None:
        """`where`: a node, a line from 1, or None if the text as a whole is meant."""
        super().__init__(message)
        self.line = where.start_mark.line + 1 if isinstance(where, yaml.Node) else where


# Edits from nodes.


def _read_edit(node: yaml.Node, folder: Path) -> Operation:
    if not isinstance(node, yaml.MappingNode) or len(node.value) != 1:
        known = ", ".join(_KINDS)
        raise _NodeError(node, f"an edit is one of {known} and what it takes, as in 'swap: [0, 1]'")
    [(key, value)] = node.value
    name = _text(key, "an edit")
    if name not in _KINDS:
        raise _NodeError(key, f"there is no edit {_describe(key)}; {_nearest(name, _KINDS)}")
    kind = _KINDS[name]
    try:
        found = _read_list(value, kind, folder) if kind.is_list else _read_fields(value, kind, name, folder)
    except UnmixError as error:
        raise _NodeError(value, f"{name}: {error}") from error
    if kind is Gloss and not any(key.value in ("scale", "colour") for key, _ in value.value):
        raise _NodeError(value, "gloss needs scale or colour")
    return replace(found, line=node.start_mark.line + 1)


def _read_light(node: yaml.Node, folder: Path) -> Light:
    """A light by name or file alone, or as a mapping."""
    if not isinstance(node, yaml.MappingNode):
        node = yaml.MappingNode(node.tag, [(yaml.ScalarNode(f"{_TAG}str", "light"), node)])
    return _read_fields(node, Light, "illuminant", folder)


def _read_list(node: yaml.Node, kind: type[Operation], folder: Path) -> Operation:
    """An edit whose fields are a list, or its only field."""
    names = [*_defaults(kind)]
    items = [node] if len(names) == 1 else _sequence(node, kind.kind, _MOST_ENDMEMBERS)
    if len(items) != len(names):
        raise _NodeError(node, f"{kind.kind} takes a list of {len(names)}; found {len(items)}")
    pairs = zip(names, items, strict=True)
    return kind(**{name: _READERS[name](item, kind.kind, folder) for name, item in pairs})


def _read_fields(node: yaml.Node, kind: type[_T], what: str, folder: Path) -> _T:
    defaults = _defaults(kind)
    required = [name for name, default in defaults.items() if default is MISSING]
    parts = _mapping(node, what, required, [name for name in defaults if name not in required])
    return kind(**{name: _READERS[name](part, name, folder) for name, part in parts.items()})


# Values from nodes; each raises a `_NodeError` where it is something else.


def _compose(text: str) -> yaml.Node:
    if len(text) > _MOST_CHARACTERS:
        raise _NodeError(None, f"{len(text)} characters are too many; at most {_MOST_CHARACTERS}")
    try:
        document = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else None
        raise _NodeError(line, f"not YAML: {error.problem or error.context}") from error
    except (yaml.YAMLError, RecursionError, ValueError, OverflowError) as error:
        # The last two are PyYAML's own, of version numbers and escapes that no program can hold.
        raise _NodeError(None, f"not YAML: {str(error).partition(chr(10))[0]}") from error
    if document is None:
        raise _NodeError(None, "the recipe is empty; it needs edits or an illuminant")
    return document


def _mapping(
    node: yaml.Node, what: str, required: Collection[str], optional: Collection[str]
) -> dict[str, yaml.Node]:
    """The values of a mapping by key, none of them unknown, repeated or missing."""
    known = [*required, *optional]
    if not isinstance(node, yaml.MappingNode):
        raise _NodeError(node, f"{what} takes {', '.join(known)}; found {_describe(node)}")
    found: dict[str, yaml.Node] = {}
    for key_node, value in node.value:
        key = _text(key_node, "a key")
        if key not in known:
            raise _NodeError(key_node, f"{what} has no {_describe(key_node)}; {_nearest(key, known)}")
        if key in found:
            raise _NodeError(key_node, f"{what} has {key!r} twice")
        found[key] = value
    missing = [key for key in required if key not in found]
    if missing:
        raise _NodeError(node, f"{what} needs {' and '.join(missing)}")
    return found


def _sequence(node: yaml.Node, what: str, longest: int) -> list[yaml.Node]:
    if not isinstance(node, yaml.SequenceNode):
        raise _NodeError(node, f"{what} must be a list; found {_describe(node)}")
    if len(node.value) > longest:
        raise _NodeError(node, f"{what} has {len(node.value)} items; at most {longest}")
    return list(node.value)


def _scalar(node: yaml.Node) -> Any:
    """A word, number, true, false, date or None; None, too, for lists and mappings."""
    if not isinstance(node, yaml.ScalarNode):
        return None
    kind = node.tag.removeprefix(_TAG)
    if kind not in _PLAIN:
        tag = node.tag[:_LONGEST_QUOTE]
        raise _NodeError(node, f"only plain data is read; found a value with the tag {tag}")
    # YAML 1.1 takes 1:30 for a number in base 60, which nobody means.
    if kind in ("int", "float") and (len(node.value) > _LONGEST_NUMBER or ":" in node.value):
        raise _NodeError(node, f"can't read {_describe(node)} as a number; put it in quotes if it is text")
    try:
        return yaml.constructor.SafeConstructor().construct_object(node)
    except (yaml.YAMLError, ValueError, KeyError, IndexError, OverflowError) as error:
        raise _NodeError(node, f"can't read {_describe(node)} as {kind}") from error


def _plain(node: yaml.Node, what: str, kinds: tuple[type, ...], expected: str) -> Any:
    """A value of some types, of which true and false are none but bool."""
    value = _scalar(node)
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise _NodeError(node, f"{what} must be {expected}; found {_describe(node)}")
    return value


def _text(node: yaml.Node, what: str, _: Path = Path()) -> str:
    value = _plain(node, what, (str,), "text, in quotes if it looks like something else")
    if any(letter == "\0" or "\ud800" <= letter <= "\udfff" for letter in value):
        found = _describe(node)
        raise _NodeError(node, f"{what} has a character that no name or path can have; found {found}")
    return value


def _number(node: yaml.Node, what: str, _: Path = Path()) -> float:
    return float(_plain(node, what, (int, float), "a number"))


def _boolean(node: yaml.Node, what: str, _: Path) -> bool:
    return _plain(node, what, (bool,), "true or false")


def _path(node: yaml.Node, what: str, folder: Path) -> Path:
    return folder / _text(node, what)


def _colour(node: yaml.Node, what: str, _: Path) -> Colour:
    """An sRGB colour in [0, 1], from '#rrggbb' or three numbers in [0, 1]."""
    expected = f"{what} must be '#rrggbb' in quotes, or three numbers in [0, 1]"
    if isinstance(node, yaml.SequenceNode):
        if len(node.value) != 3:
            raise _NodeError(node, f"{expected}; found {len(node.value)} numbers")
        red, green, blue = (_number(item, what) for item in node.value)
        return red, green, blue
    value = _scalar(node)
    if value is None:
        raise _NodeError(node, f"{expected}; found nothing (without quotes, # begins a comment)")
    digits = re.fullmatch(r"#?([0-9a-fA-F]{6})", value) if isinstance(value, str) else None
    if digits is None:
        raise _NodeError(node, f"{expected}; found {_describe(node)}")
    red, green, blue = (int(digits[1][i : i + 2], 16) / 255 for i in (0, 2, 4))
    return red, green, blue


def _endmember(node: yaml.Node, _: str, __: Path) -> Endmember:
    return _plain(node, "an endmember", (str, int), "given by its name or number")


def _endmembers(node: yaml.Node, what: str, folder: Path) -> tuple[Endmember, ...]:
    is_list = isinstance(node, yaml.SequenceNode)
    items = _sequence(node, what, _MOST_ENDMEMBERS) if is_list else [node]
    return tuple(_endmember(item, what, folder) for item in items)


def _light(node: yaml.Node, _: str, folder: Path) -> LightName:
    try:
        light = parse_light(_text(node, "illuminant"))
    except UnmixError as error:
        raise _NodeError(node, f"illuminant: {error}") from error
    return folder / light if isinstance(light, Path) else light


_READERS: dict[str, Callable[[yaml.Node, str, Path], Any]] = {
    **dict.fromkeys(("first", "second", "endmember"), _endmember),
    "endmembers": _endmembers,
    **dict.fromkeys(("library", "spectrum", "name", "match"), _text),
    "file": _path,
    "colour": _colour,
    **dict.fromkeys(("factor", "scale"), _number),
    "extrapolate": _boolean,
    "light": _light,
}
"""How the value of each field is read: node, what messages call it, folder of relative paths."""


def _describe(node: yaml.Node) -> str:
    """What a message says that it found."""
    if isinstance(node, yaml.MappingNode):
        return "a mapping"
    if isinstance(node, yaml.SequenceNode):
        return f"a list of {len(node.value)}"
    shortened = node.value[:_LONGEST_QUOTE] + "..." if len(node.value) > _LONGEST_QUOTE else node.value
    return repr(shortened) if shortened else "nothing"


def _nearest(word: str, known: Collection[str]) -> str:
    return did_you_mean(word[:_LONGEST_QUOTE], known) or f"known: {', '.join(known)}"
