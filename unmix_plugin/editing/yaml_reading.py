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

from dataclasses import replace
from pathlib import Path

import yaml

from unmix_plugin.editing import yaml_nodes as nodes
from unmix_plugin.editing.operations import OPERATIONS, Operation
from unmix_plugin.editing.recipe import Light, Recipe
from unmix_plugin.editing.yaml_fields import read_fields, read_operation
from unmix_plugin.editing.yaml_nodes import NodeError, fault, line_of
from unmix_plugin.errors import ConfigError, UnmixError

MOST_EDITS = 1000

_KINDS = {kind.kind: kind for kind in OPERATIONS}


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe; relative paths in it start from its folder.

    Raises:
        ConfigError: it can't be read, or anything in it is wrong; one message names every fault with its line.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
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
    """What is in the text; faults of single edits are collected, others raised."""
    document = nodes.compose(text)
    if document is None:
        raise NodeError(None, "the recipe is empty; it needs edits or an illuminant")
    parts = nodes.mapping(document, "a recipe", (), ("edits", "illuminant"))
    if not parts:
        raise fault(document, "a recipe needs edits or an illuminant")
    light = _read_light(parts["illuminant"], folder) if "illuminant" in parts else None
    items = nodes.sequence(parts["edits"], "edits", MOST_EDITS) if "edits" in parts else []
    read = [_read_or_note(item, folder, faults) for item in items]
    return [operation for operation in read if operation is not None], light


def _read_or_note(node: yaml.Node, folder: Path, faults: list[NodeError]) -> Operation | None:
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
    if kind not in _KINDS:
        raise fault(key, f"there is no edit {nodes.describe(key)}; {nodes.nearest(kind, _KINDS)}")
    try:
        return replace(read_operation(value, _KINDS[kind], folder), line=line_of(node))
    except UnmixError as error:
        raise fault(value, f"{kind}: {error}") from error


def _read_light(node: yaml.Node, folder: Path) -> Light:
    """A light by name or file alone, or as a mapping."""
    if not isinstance(node, yaml.MappingNode):
        node = yaml.MappingNode(node.tag, [(yaml.ScalarNode("tag:yaml.org,2002:str", "light"), node)])
    return read_fields(node, Light, "illuminant", folder)


def _with_place(error: NodeError, source: str) -> str:
    return f"{source}: {error}" if error.line is None else f"{source}, line {error.line}: {error}"
