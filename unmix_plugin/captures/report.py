"""Remarks on a capture: a code for logic and tests, with its values, and one sentence for people, which is made where
it is printed.

A code's kind tells where the sentence goes: among what looks wrong, what was measured, or what was done. In a template,
`{count:view}` is a number of views in words, a sequence is its first few items (`{names:5}`: five), `{where}` names the
views or files that a remark is about, and `{count}` counts them.
"""

from __future__ import annotations

import string
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, unique
from typing import Any

from unmix_plugin.errors import counted, name_some

_WIDTH = 110


class Kind(Enum):
    """What a remark is, by the heading that it stands under."""

    WRONG = "What looks wrong"
    MEASURED = "What was measured"
    DONE = "What was done"


_WRONG, _MEASURED, _DONE = Kind


@unique
class Code(Enum):
    """All that may be remarked, with its kind and the template of its sentence."""

    FILE_NOTE = _DONE, "{text}"
    """Of a reader, which has no code of its own for it."""
    FILE_WARNING = _WRONG, "{where}: {text}"
    """Of a reader, which has no code of its own for it."""
    CAPTURE_WARNING = _WRONG, "{text}"
    """Of a layout or a source of poses, which has no code of its own for it."""

    def __init__(self, kind: Kind, template: str) -> None:
        self.kind = kind
        self.template = template

    @property
    def looks_wrong(self) -> bool:
        """Whether values, wavelengths or geometry may be wrong."""
        return self.kind is Kind.WRONG


class _Sentences(string.Formatter):
    """Sequences as their first few items, numbers of things in words."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, tuple | list):
            return name_some([str(item) for item in value], int(format_spec or 3))
        if isinstance(value, int) and len(format_spec) > 1 and format_spec.isalpha():
            return counted(value, format_spec)
        return super().format_field(value, format_spec)


@dataclass(frozen=True)
class Remark:
    """One remark: what, with which values, on which views or files."""

    code: Code
    values: Mapping[str, Any] = field(default_factory=dict)
    """By the names in the template of the code; JSON-able."""
    where: tuple[str, ...] = ()
    """Names of the views, lenses or files that it is about; empty where it is about all."""

    @staticmethod
    def of(code: Code, where: Iterable[str] = (), **values: Any) -> Remark:
        """A remark with its values as keywords."""
        return Remark(code, values, tuple(where))

    @property
    def sentence(self) -> str:
        """For people.

        >>> Remark.of(Code.FILE_WARNING, ["a.hdr", "b.hdr"], text="cut short").sentence
        'a.hdr, b.hdr: cut short'
        """
        known = {"where": self.where, "count": len(self.where), **self.values}
        return _Sentences().vformat(self.code.template, (), known)

    def to_json(self) -> dict[str, Any]:
        """For the record."""
        return {"code": self.code.name.lower(), "where": list(self.where), "values": dict(self.values)}


def merged(remarks: Iterable[Remark]) -> list[Remark]:
    """Each remark once, in their order; of equal ones, one that names all views or files.

    >>> twice = [Remark.of(Code.FILE_WARNING, [name], text="cut short") for name in "ab"]
    >>> [remark.where for remark in merged(twice)]
    [('a', 'b')]
    """
    found: dict[tuple[Code, str], Remark] = {}
    for remark in remarks:
        key = remark.code, repr(sorted(remark.values.items()))
        known = found.get(key)
        names = remark.where if known is None else dict.fromkeys((*known.where, *remark.where))
        found[key] = replace(remark, where=tuple(names))
    return list(found.values())


def sentences(remarks: Iterable[Remark], kind: Kind) -> list[str]:
    """The sentences of one kind."""
    return [remark.sentence for remark in merged(remarks) if remark.code.kind is kind]


def report_text(title: str, wrong: Sequence[str], measured: Sequence[str], done: Sequence[str]) -> str:
    """One page of text: what looks wrong, what was measured, what was done."""
    wrong, parts = wrong or ["none of the checks found a fault"], [title, ""]
    for heading, lines in zip(Kind, (wrong, measured, done), strict=True):
        parts.append(heading.value)
        parts += [
            textwrap.fill(line, _WIDTH, initial_indent="- ", subsequent_indent="  ", break_long_words=False)
            for line in lines
        ]
        parts.append("")
    return "\n".join(parts)
