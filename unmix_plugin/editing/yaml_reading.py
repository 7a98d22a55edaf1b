"""Recipes from YAML: plain data, checked line by line.

illuminant: A
edits:
  - rename: {endmember: 0, name: wood}
  - swap: [wood, 3]
  - replace: {endmember: 2, library: checker/red}
  - retint: {endmember: 4, colour: '#3366cc'}
  - remove: [5, 6]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import yaml

from unmix_plugin.editing import yaml_nodes as nodes
from unmix_plugin.editing.operations import (
    OPERATIONS,
    Endmember,
    FileSpectrum,
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
from unmix_plugin.editing.recipe import Light, Recipe
from unmix_plugin.editing.yaml_nodes import NodeError, fault, line_of
from unmix_plugin.errors import ConfigError, UnmixError

Reader: TypeAlias = Callable[[yaml.Node, Path], Operation]

_KINDS = [kind.kind for kind in OPERATIONS]


def read_recipe(path: Path) -> Recipe:
    """Read a recipe; files that it names by relative paths lie beside it.

    Raises:
        ConfigError: it can't be read, or anything in it is wrong; one message names every fault with its line.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"can't read the recipe {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"can't read the recipe {path}: it is no text in UTF-8") from error
    return recipe_from_yaml(text, str(path), path.parent)


def recipe_from_yaml(text: str, source: str = "recipe", folder: Path = Path()) -> Recipe:
    """A recipe from its text.

    Args:
        text: YAML.
        source: What messages call it.
        folder: Where files lie that it names by relative paths.
    Raises:
        ConfigError: anything in it is wrong; one message names every fault with its line.
    """
    faults: list[NodeError] = []
    try:
        operations, light = _read_document(text, folder.absolute(), faults)
    except NodeError as error:
        faults.append(error)
        operations, light = [], None
    if faults:
        raise ConfigError("\n".join(_with_place(error, source) for error in faults))
    return Recipe(tuple(operations), light, source)


def _read_document(text: str, folder: Path, faults: list[NodeError]) -> tuple[list[Operation], Light | None]:
    """What is in the text; faults of single edits are noted, others raised."""
    document = nodes.compose(text)
    if document is None:
        raise NodeError(None, "the recipe is empty; it needs edits or an illuminant")
    parts = nodes.mapping(document, "a recipe", (), ("edits", "illuminant"))
    if not parts:
        raise fault(document, "a recipe needs edits or an illuminant")
    light = _read_light(parts["illuminant"], folder) if "illuminant" in parts else None
    items = nodes.sequence(parts["edits"], "edits") if "edits" in parts else []
    read = [_read_noting(item, folder, faults) for item in items]
    return [operation for operation in read if operation is not None], light


def _read_noting(node: yaml.Node, folder: Path, faults: list[NodeError]) -> Operation | None:
    try:
        return _read_operation(node, folder)
    except NodeError as error:
        faults.append(error)
        return None


def _read_operation(node: yaml.Node, folder: Path) -> Operation:
    if not isinstance(node, yaml.MappingNode) or len(node.value) != 1:
        raise fault(node, f"an edit is one of {', '.join(_KINDS)} and what it takes, as in 'swap: [0, 1]'")
    [(key, value)] = node.value
    kind = nodes.text(key, "an edit")
    if kind not in _READERS:
        raise fault(key, f"there is no edit {kind!r}; {nodes.nearest(kind, _KINDS)}")
    try:
        return replace(_READERS[kind](value, folder), line=line_of(node))
    except UnmixError as error:
        raise fault(value, f"{kind}: {error}") from error


def _read_light(node: yaml.Node, folder: Path) -> Light:
    from unmix_plugin.spectral.colour.illuminants import parse_light

    extrapolate = False
    word = node
    if isinstance(node, yaml.MappingNode):
        parts = nodes.mapping(node, "illuminant", ("light",), ("extrapolate",))
        word, extrapolate = parts["light"], _flag(parts, "extrapolate")
    try:
        light = parse_light(nodes.text(word, "illuminant"))
    except UnmixError as error:
        raise fault(word, f"illuminant: {error}") from error
    return Light(folder / light if isinstance(light, Path) else light, extrapolate)


def _read_swap(node: yaml.Node, _: Path) -> Swap:
    items = nodes.sequence(node, "swap")
    if len(items) != 2:
        raise fault(node, f"swap takes two endmembers; found {len(items)}")
    return Swap(_endmember(items[0]), _endmember(items[1]))


def _read_replace(node: yaml.Node, folder: Path) -> Replace:
    parts = nodes.mapping(node, "replace", ("endmember",), ("library", "file", "spectrum", "extrapolate"))
    if ("library" in parts) == ("file" in parts):
        raise fault(node, "replace takes either library, the name of a measured material, or file")
    spectrum: LibrarySpectrum | FileSpectrum
    if "library" in parts:
        if "spectrum" in parts:
            raise fault(
                parts["spectrum"], "replace: spectrum says which of a file's spectra; library has the name"
            )
        spectrum = LibrarySpectrum(nodes.text(parts["library"], "library"))
    else:
        name = nodes.text(parts["spectrum"], "spectrum") if "spectrum" in parts else None
        spectrum = FileSpectrum(folder / nodes.text(parts["file"], "file"), name)
    return Replace(_endmember(parts["endmember"]), spectrum, _flag(parts, "extrapolate"))


def _read_retint(node: yaml.Node, _: Path) -> Retint:
    parts = nodes.mapping(node, "retint", ("endmember", "colour"), ("match",))
    endmember, colour = _endmember(parts["endmember"]), nodes.colour(parts["colour"], "colour")
    match = nodes.text(parts["match"], "match") if "match" in parts else "picture"
    if match not in ("picture", "spectrum"):
        raise fault(parts["match"], f"match must be picture or spectrum; found {match!r}")
    return Retint(endmember, colour, match)


def _read_scale(node: yaml.Node, _: Path) -> Scale:
    parts = nodes.mapping(node, "scale", ("endmember", "factor"))
    return Scale(_endmember(parts["endmember"]), nodes.number(parts["factor"], "factor"))


def _read_remove(node: yaml.Node, _: Path) -> Remove:
    return Remove(_endmembers(node))


def _read_isolate(node: yaml.Node, _: Path) -> Isolate:
    return Isolate(_endmembers(node))


def _read_rename(node: yaml.Node, _: Path) -> Rename:
    parts = nodes.mapping(node, "rename", ("endmember", "name"))
    return Rename(_endmember(parts["endmember"]), nodes.text(parts["name"], "name"))


def _read_gloss(node: yaml.Node, _: Path) -> Gloss:
    parts = nodes.mapping(node, "gloss", (), ("endmember", "scale", "colour"))
    if not {"scale", "colour"} & set(parts):
        raise fault(node, "gloss needs a scale or a colour")
    return Gloss(
        _endmember(parts["endmember"]) if "endmember" in parts else None,
        nodes.number(parts["scale"], "scale") if "scale" in parts else 1.0,
        nodes.colour(parts["colour"], "colour") if "colour" in parts else None,
    )


_READERS: dict[str, Reader] = {
    "swap": _read_swap,
    "replace": _read_replace,
    "retint": _read_retint,
    "scale": _read_scale,
    "remove": _read_remove,
    "isolate": _read_isolate,
    "rename": _read_rename,
    "gloss": _read_gloss,
}


def _endmember(node: yaml.Node) -> Endmember:
    value = nodes.scalar(node)
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise fault(node, f"an endmember is meant by its name or number; found {nodes.describe(node)}")
    return value


def _endmembers(node: yaml.Node) -> tuple[Endmember, ...]:
    items = node.value if isinstance(node, yaml.SequenceNode) else [node]
    return tuple(_endmember(item) for item in items)


def _flag(parts: dict[str, yaml.Node], name: str) -> bool:
    return nodes.boolean(parts[name], name) if name in parts else False


def _with_place(error: NodeError, source: str) -> str:
    return f"{source}: {error}" if error.line is None else f"{source}, line {error.line}: {error}"
