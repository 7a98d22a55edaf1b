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

from unmix_plugin.engine.decisions import Decision, decision_table
from unmix_plugin.errors import counted, name_some

_WIDTH = 110


class Kind(Enum):
    """What a remark is, by the heading that it stands under."""

    WRONG = "What looks wrong"
    MEASURED = "What was measured"
    DONE = "What was done"


def _wrong(template: str) -> tuple[Kind, str]:
    return Kind.WRONG, template


def _done(template: str) -> tuple[Kind, str]:
    return Kind.DONE, template


@unique
class Code(Enum):
    """All that may be remarked, with its kind and the template of its sentence."""

    NOTE = _done("{text}")
    """Of a reader or a layout, which has no code of its own for it."""
    FILE_WARNING = _wrong("{where}: {text}")
    """Of a reader, which has no code of its own for it."""
    CAPTURE_WARNING = _wrong("{text}")
    """Of a layout or a source of poses, which has no code of its own for it."""

    # Views that are left out.
    VIEW_BLACK = _wrong(
        "{where} is left out: it shows nothing, its brightness is {share} of the usual one; --keep-view {where} "
        "takes it back"
    )
    VIEW_OVEREXPOSED = _wrong(
        "{where} is left out: it is overexposed, {share} of what it shows is saturated and the rest is {times} "
        "times as bright as in the views around it; --keep-view {where} takes it back"
    )
    VIEW_EXPOSED_OTHERWISE = _wrong(
        "{where} is left out: it is {times} times as bright as the views around it, in all bands, from dark to "
        "bright: exposed otherwise than its file says; --keep-view {where} takes it back"
    )
    VIEW_BLURRED = _wrong(
        "{where} is left out: it is blurred, with {share} of the fine contrast of the views around it; --keep-view "
        "{where} takes it back"
    )
    VIEW_OF_OTHER_POSE = _wrong(
        "{where} is left out: its picture does not fit its pose ({miss_px:.0f} px off, {usual_px:.1f} px are usual): "
        "is it that of another view? --keep-view {where} takes it back"
    )
    VIEW_UNREADABLE = _wrong("{where} is left out, as its file can't be read: {why}")
    VIEW_NOT_WANTED = _done("{where} is left out, as --leave-out says")

    # Masks.
    NO_MASK_FOUND = _wrong(
        "no mask: files have no alpha channel and no backdrop was found that all views share, so that all of each "
        "picture is taken for the scene; right for rooms and landscapes (--mask none), otherwise give --mask white, "
        "black or files"
    )

    OPACITY_OF_SOME = _done(
        "{count} of {views} views {has} no alpha channel ({where}), so that of the others is not used: give all "
        "views one, or choose --mask"
    )
    BACKDROP_FOUND = _done(
        "a backdrop was found that all views share, {backdrops}, and is cut out: look at contact-sheet.png; "
        "--mask none keeps it"
    )

    # Pictures.
    PICTURES_ARE_SRGB = _done("pictures are taken as sRGB and brought to linear light")
    COLOURS_IN_ORDER = _done(
        "the channels of pictures are red, green and blue in this order: {red} nm is taken for red, {green} nm for "
        "green, {blue} nm for blue. If this is wrong, give --wavelengths {blue},{green},{red}"
    )
    ORIENTATION_IGNORED = _done(
        "EXIF's orientation of {turned} of {files} pictures is ignored, as poses and lenses refer to the stored "
        "pixels; if yours were made from turned pictures, store these turned"
    )

    # Values.
    ONE_LOST_ABOVE = _wrong(
        "values ({units}) were divided by {scale}, as more than {limit} are above 1{hint}: outputs of reflectance "
        "undo it, and exported radiance times {scale} is what was measured; --scale 1 keeps values, and cuts off those "
        "above 1"
    )
    ONE_LOST_BELOW = _wrong(
        "values ({units}) were divided by {scale}, as nearly all are below {limit}{hint}: outputs of reflectance "
        "undo it, and exported radiance times {scale} is what was measured; --scale 1 keeps values, and cuts off those "
        "above 1"
    )
    BELOW_BLACK = _wrong(
        "values lie below 0 by more than noise, and are written as 0: the dark frame is brighter than that of these "
        "views, or was taken off their numbers before"
    )
    SATURATED_BELOW_ONE = _wrong(
        "values are saturated from {end} on, and are written as 1, which is read as at least {scale}: expose less, "
        "or make that true with --scale {end}, which cuts off all above"
    )

    # Exposures.
    EXPOSURE_COUNTED_BEFORE = _done(
        "views were exposed {exposed} {unit}: values are not divided by that, as {source} says that they are "
        "reflectance or radiance already"
    )
    EXPOSURES_EVENED = _done(
        "views were exposed {exposed} {unit}: each is brought to that of {whose}, {common}"
    )
    EXPOSURE_UNKNOWN = _wrong("{missing:view} without exposure time: exposures are not compared")
    EXPOSURE_FACTOR_UNKNOWN = _wrong(
        "the {factor} is known of some files and not of {lacking}: exposures are not compared; write it into all, "
        "or none"
    )
    GAIN_TAKEN_AS_ONE = _wrong(
        "the gain is 1 in some files and not known of {lacking}, where it is taken for 1, too: values may be off "
        "by a factor"
    )
    WHITE_EXPOSURE_UNKNOWN = _wrong(
        "views were exposed {exposed} {unit}, the white reference does not say how long: reflectances may be off "
        "by a factor"
    )
    DARK_EXPOSED_OTHERWISE = _wrong(
        "the dark frame was exposed {of_dark} {unit}, what it is subtracted from {of_others}: dark current "
        "grows with exposure, so take a dark frame at each"
    )
    EXPOSURES_OF_PICTURES = _wrong(
        "pictures were exposed {exposed} {unit}, which can't be undone as cameras bend the brightness of pictures:"
        " fix the exposure"
    )
    EXPOSURES_OF_REFLECTANCES = _wrong(
        "views were exposed {exposed} {unit}: values are not divided by that, as they are at most about 1 and "
        "taken for reflectances. If they grow with the exposure, as raw numbers do, give a white reference, or "
        "divide them by it yourself"
    )
    EXPOSURES_MISFIT = _wrong(
        "{where}: {numbers} exposure times or gains for {bands:band}: exposures may differ and were not compared. "
        "Give one number, or one a band, with points as decimal marks"
    )
    EXPOSURE_UNITS_MISSING = _wrong(
        "{factor} have no unit in some files ({sources}): values may be off by a factor"
    )
    EXPOSURE_OF_SOME_SENSORS = _wrong(
        "exposures of {lacking} are not known or not compared, those of {known} are: values of these lenses or "
        "cameras may be off by a factor"
    )
    UNLIKE_MEANINGS = _wrong(
        "values of lenses or cameras are not of one kind ({kinds:5}): they may be off by a factor against each "
        "other"
    )

    # Bands.
    WHITE_SATURATED = _wrong(
        "{file}: the white is saturated in {bands}: these bands are left out; take it again with a shorter "
        "exposure"
    )
    NOISY_BANDS_KEPT = _done(
        "{noisy} of {bands} bands have noise above {limit} of their signal; all are kept"
    )

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


def report_text(
    title: str,
    wrong: Sequence[str],
    measured: Sequence[str],
    done: Sequence[str],
    decided: Sequence[Decision] = (),
) -> str:
    """One page of text: what looks wrong, what was decided, what was measured, what was done."""
    wrong, parts = wrong or ["none of the checks found a fault"], [title, ""]
    for heading, lines in zip(Kind, (wrong, measured, done), strict=True):
        parts.append(heading.value)
        parts += [
            textwrap.fill(line, _WIDTH, initial_indent="- ", subsequent_indent="  ", break_long_words=False)
            for line in lines
        ]
        parts.append("")
        if heading is Kind.WRONG and decided:
            indent = " " * (max(len(one.subject) for one in decided) + 11)
            table = decision_table(decided)
            parts += ["What was decided"]
            parts += [
                textwrap.fill(line, _WIDTH, subsequent_indent=indent, break_long_words=False)
                for line in table
            ]
            parts.append("")
    return "\n".join(parts)
