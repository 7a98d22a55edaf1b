"""Dataclasses to and from YAML: their fields say what can be written, of what type, and what may be left out.

A field whose type is a union of dataclasses stands for the fields of one of them: those of `Replace.spectrum` are
written as `library`, or as `file` and `spectrum`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from unmix_plugin.editing import yaml_nodes as nodes
from unmix_plugin.editing.operations import Colour, Endmember, Operation
from unmix_plugin.editing.recipe import LightName
from unmix_plugin.editing.yaml_nodes import fault
from unmix_plugin.errors import UnmixError
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.spectral.colour.conversion import parse_light

T = TypeVar("T")

MOST_ENDMEMBERS = 255
"""That one edit may name; no run has more."""


def read_operation(node: yaml.Node, kind: type[Operation], folder: Path) -> Operation:
    """An edit from what follows its name.

    Raises:
        NodeError: it is not what the edit's fields ask for.
        ConfigError: a value is out of its range.
    """
    if not kind.is_list:
        found = read_fields(node, kind, kind.kind, folder)
        if kind.needs_one_of and not any(key.value in kind.needs_one_of for key, _ in node.value):
            raise fault(node, f"{kind.kind} needs {' or '.join(kind.needs_one_of)}")
        return found
    hints = _types(kind)
    if len(hints) == 1:
        return kind(*(read_value(hint, node, kind.kind, folder) for hint in hints.values()))
    items = nodes.sequence(node, kind.kind, MOST_ENDMEMBERS)
    if len(items) != len(hints):
        raise fault(node, f"{kind.kind} takes a list of {len(hints)}; found {len(items)}")
    pairs = zip(hints.values(), items, strict=True)
    return kind(*(read_value(hint, item, kind.kind, folder) for hint, item in pairs))


def read_fields(node: yaml.Node, kind: type[T], what: str, folder: Path) -> T:
    """A dataclass from a mapping of its fields.

    Raises:
        NodeError: a key is unknown, repeated or missing, or a value is of another type.
    """
    own = {one.name: one for one in _written_fields(kind) if not _options(kind, one.name)}
    inlined = {one.name: _options(kind, one.name) for one in _written_fields(kind) if one.name not in own}
    optional = [name for name, one in own.items() if one.default is not MISSING]
    other = [
        one.name for options in inlined.values() for option in options for one in _written_fields(option)
    ]
    parts = nodes.mapping(node, what, [name for name in own if name not in optional], [*other, *optional])
    values: dict[str, Any] = {
        name: read_value(_types(kind)[name], parts[name], name, folder) for name in own if name in parts
    }
    for name, options in inlined.items():
        values[name] = _read_option(node, parts, options, what, folder)
    return kind(**values)


def read_value(hint: Any, node: yaml.Node, what: str, folder: Path) -> Any:
    """A value of a field's type.

    Raises:
        NodeError: it is of another.
    """
    if get_origin(hint) is Literal:
        word, allowed = nodes.text(node, what), get_args(hint)
        if word not in allowed:
            raise fault(node, f"{what} must be {' or '.join(allowed)}; found {nodes.describe(node)}")
        return word
    return _READERS[hint](node, what, folder)


def written_fields(value: Any) -> dict[str, Any]:
    """A dataclass as a mapping that reads as the same; what has its default is left out."""
    found: dict[str, Any] = {}
    always = value.needs_one_of[:1] if isinstance(value, Operation) else ()
    for one in _written_fields(type(value)):
        part = getattr(value, one.name)
        if _options(type(value), one.name):
            found |= written_fields(part)
        elif part != one.default or one.name in always:
            found[one.name] = _written(_types(type(value))[one.name], part)
    return found


def written_operation(edit: Operation) -> Any:
    """What follows the name of an edit."""
    found = written_fields(edit)
    if not edit.is_list:
        return found
    return next(iter(found.values())) if len(found) == 1 else list(found.values())


def _read_option(
    node: yaml.Node, parts: dict[str, yaml.Node], options: list[type], what: str, folder: Path
) -> Any:
    """The one of several dataclasses whose first field is there."""
    keys = {option: [one.name for one in _written_fields(option)] for option in options}
    chosen = [option for option in options if keys[option][0] in parts]
    if len(chosen) != 1:
        raise fault(node, f"{what} takes either {' or '.join(names[0] for names in keys.values())}")
    [kind] = chosen
    for option in options:
        for name in keys[option]:
            if name in parts and name not in keys[kind]:
                raise fault(
                    parts[name], f"{what}: {name} goes with {keys[option][0]}, not with {keys[kind][0]}"
                )
    types = _types(kind)
    return kind(
        **{key: read_value(types[key], parts[key], key, folder) for key in keys[kind] if key in parts}
    )


def _written_fields(kind: type) -> list[Field[Any]]:
    return [one for one in fields(kind) if not one.kw_only]


@lru_cache
def _types(kind: type) -> dict[str, Any]:
    """The types of a dataclass's fields, None taken out: what may be left out is not written as null."""
    hints = get_type_hints(kind)
    return {one.name: _without_none(hints[one.name]) for one in _written_fields(kind)}


def _without_none(hint: Any) -> Any:
    if get_origin(hint) not in (Union, UnionType):
        return hint
    return Union[tuple(part for part in get_args(hint) if part is not NoneType)]  # noqa: UP007


def _options(kind: type, name: str) -> list[Any]:
    """The dataclasses that a field may hold; none for a plain value."""
    return [option for option in get_args(_types(kind)[name]) if is_dataclass(option)]


def _endmember(node: yaml.Node, _: str, __: Path) -> Endmember:
    value = nodes.scalar(node)
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise fault(node, f"an endmember is given by its name or number; found {nodes.describe(node)}")
    return value


def _endmembers(node: yaml.Node, what: str, folder: Path) -> tuple[Endmember, ...]:
    """A list of them, or one alone."""
    is_list = isinstance(node, yaml.SequenceNode)
    items = nodes.sequence(node, what, MOST_ENDMEMBERS) if is_list else [node]
    return tuple(_endmember(item, what, folder) for item in items)


def _light(node: yaml.Node, _: str, folder: Path) -> LightName:
    try:
        light = parse_light(nodes.text(node, "illuminant"))
    except UnmixError as error:
        raise fault(node, f"illuminant: {error}") from error
    return folder / light if isinstance(light, Path) else light


_READERS: dict[Any, Callable[[yaml.Node, str, Path], Any]] = {
    str: lambda node, what, _: nodes.text(node, what),
    float: lambda node, what, _: nodes.number(node, what),
    bool: lambda node, what, _: nodes.boolean(node, what),
    Path: lambda node, what, folder: folder / nodes.text(node, what),
    Colour: lambda node, what, _: nodes.colour(node, what),
    Endmember: _endmember,
    tuple[Endmember, ...]: _endmembers,
    LightName: _light,
}
"""How a value of each type of field is read: node, what messages call it, folder of relative paths."""


def _written(hint: Any, value: Any) -> Any:
    if hint == Colour:
        return _written_colour(value)
    return str(value) if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value


def _written_colour(colour: Colour) -> str | list[float]:
    """As #rrggbb if that is exact."""
    is_exact = all(round(255 * value) / 255 == value for value in colour)
    return css_colour(colour) if is_exact else list(colour)
