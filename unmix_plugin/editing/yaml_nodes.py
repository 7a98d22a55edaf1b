"""YAML as plain data with the line of every value; only single plain values are ever constructed."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

import yaml

from unmix_plugin.errors import did_you_mean

_MAX_CHARACTERS = 100_000
"""PyYAML reads about 60,000 characters a second."""
_LONGEST_NUMBER = 40
_LONGEST_QUOTE = 60

_PLAIN_TAGS = frozenset(
    f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "timestamp")
)
_NUMBER_TAGS = frozenset(f"tag:yaml.org,2002:{kind}" for kind in ("int", "float"))

_HEXADECIMAL = re.compile(r"#?([0-9a-fA-F]{6})")


class NodeError(Exception):
    """Something in a YAML text is not what it should be."""

    def __init__(self, line: int | None, message: str) -> None:
        super().__init__(message)
        self.line = line
        """From 1; None if the text as a whole is meant."""


def compose(text: str) -> yaml.Node | None:
    """The text's only document as nodes; None if it is empty.

    Raises:
        NodeError: it is not YAML, has more than one document, or is too long or too deep.
    """
    if len(text) > _MAX_CHARACTERS:
        raise NodeError(None, f"{len(text)} characters are too many; at most {_MAX_CHARACTERS}")
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise NodeError(
            mark.line + 1 if mark else None, f"not YAML: {error.problem or error.context}"
        ) from error
    except (yaml.YAMLError, RecursionError, ValueError, OverflowError) as error:
        # The last two are PyYAML's own, of version numbers and escapes that no program can hold.
        raise NodeError(None, f"not YAML: {str(error).partition(chr(10))[0]}") from error


def line_of(node: yaml.Node) -> int:
    """The line on which a node begins, from 1."""
    return node.start_mark.line + 1


def fault(node: yaml.Node, message: str) -> NodeError:
    """A fault at a node."""
    return NodeError(line_of(node), message)


def mapping(
    node: yaml.Node, what: str, required: Collection[str], optional: Collection[str] = ()
) -> dict[str, yaml.Node]:
    """The values of a mapping by key.

    Raises:
        NodeError: it is not a mapping, or a key is unknown, repeated or missing.
    """
    known = [*required, *optional]
    if not isinstance(node, yaml.MappingNode):
        raise fault(node, f"{what} takes {', '.join(known)}; found {describe(node)}")
    found: dict[str, yaml.Node] = {}
    for key_node, value in node.value:
        key = text(key_node, "a key")
        if key not in known:
            raise fault(key_node, f"{what} has no {describe(key_node)}; {nearest(key, known)}")
        if key in found:
            raise fault(key_node, f"{what} has {key!r} twice")
        found[key] = value
    missing = [key for key in required if key not in found]
    if missing:
        raise fault(node, f"{what} needs {' and '.join(missing)}")
    return found


def sequence(node: yaml.Node, what: str, longest: int) -> list[yaml.Node]:
    """The items of a list.

    Raises:
        NodeError: it is not a list, or longer than allowed.
    """
    if not isinstance(node, yaml.SequenceNode):
        raise fault(node, f"{what} must be a list; found {describe(node)}")
    if len(node.value) > longest:
        raise fault(node, f"{what} has {len(node.value)} items; at most {longest}")
    return list(node.value)


def text(node: yaml.Node, what: str) -> str:
    """A string.

    Raises:
        NodeError: it is something else, such as a number without quotes.
    """
    value = scalar(node)
    if not isinstance(value, str):
        raise fault(node, f"{what} must be text; found {describe(node)}; put it in quotes if it is text")
    if any(letter == "\0" or "\ud800" <= letter <= "\udfff" for letter in value):
        raise fault(node, f"{what} has a character that no name or path can have; found {describe(node)}")
    return value


def number(node: yaml.Node, what: str) -> float:
    """A number.

    Raises:
        NodeError: it is something else.
    """
    value = scalar(node)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise fault(node, f"{what} must be a number; found {describe(node)}")
    return float(value)


def boolean(node: yaml.Node, what: str) -> bool:
    """True or false.

    Raises:
        NodeError: it is something else.
    """
    value = scalar(node)
    if not isinstance(value, bool):
        raise fault(node, f"{what} must be true or false; found {describe(node)}")
    return value


def colour(node: yaml.Node, what: str) -> tuple[float, float, float]:
    """An sRGB colour in [0, 1], from '#rrggbb' or three numbers in [0, 1].

    Raises:
        NodeError: it is neither.
    """
    expected = f"{what} must be '#rrggbb' in quotes, or three numbers in [0, 1]"
    if isinstance(node, yaml.SequenceNode):
        if len(node.value) != 3:
            raise fault(node, f"{expected}; found {len(node.value)} numbers")
        red, green, blue = (number(item, what) for item in node.value)
        return red, green, blue
    value = scalar(node)
    if value is None:
        raise fault(node, f"{expected}; found nothing (without quotes, # begins a comment)")
    digits = _HEXADECIMAL.fullmatch(value) if isinstance(value, str) else None
    if digits is None:
        raise fault(node, f"{expected}; found {describe(node)}")
    red, green, blue = (int(digits[1][i : i + 2], 16) / 255 for i in (0, 2, 4))
    return red, green, blue


def scalar(node: yaml.Node) -> Any:
    """A word, number, true, false, date or None; None, too, for lists and mappings.

    Raises:
        NodeError: its tag asks for something else to be constructed, or its text does not fit its tag.
    """
    if not isinstance(node, yaml.ScalarNode):
        return None
    if node.tag not in _PLAIN_TAGS:
        raise fault(node, f"only plain data is read; found a value with the tag {node.tag[:_LONGEST_QUOTE]}")
    # YAML 1.1 takes 1:30 for a number in base 60, which nobody means.
    if node.tag in _NUMBER_TAGS and (len(node.value) > _LONGEST_NUMBER or ":" in node.value):
        raise fault(node, f"can't read {describe(node)} as a number; put it in quotes if it is text")
    try:
        return yaml.constructor.SafeConstructor().construct_object(node)
    except (yaml.YAMLError, ValueError, KeyError, IndexError, OverflowError) as error:
        raise fault(node, f"can't read {describe(node)} as {node.tag.rpartition(':')[2]}") from error


def describe(node: yaml.Node) -> str:
    """What a message says that it found."""
    if isinstance(node, yaml.MappingNode):
        return "a mapping"
    if isinstance(node, yaml.SequenceNode):
        return f"a list of {len(node.value)}"
    shortened = node.value[:_LONGEST_QUOTE] + "..." if len(node.value) > _LONGEST_QUOTE else node.value
    return repr(shortened) if shortened else "nothing"


def nearest(word: str, known: Collection[str]) -> str:
    """Words that a reader may have meant, for the end of a message."""
    return did_you_mean(word[:_LONGEST_QUOTE], known) or f"known: {', '.join(known)}"
