"""One page of text: what looks wrong, what was measured, what was done."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unmix_plugin.captures.checks.coverage import few_views, overlap, ring
from unmix_plugin.captures.checks.moving_light import moving_light
from unmix_plugin.captures.checks.pictures import blur, exposure, pixels
from unmix_plugin.captures.checks.seen_view import SeenView

_WIDTH = 110


@dataclass(frozen=True)
class Checked:
    """What the checks say, one sentence each."""

    findings: tuple[str, ...]
    """What looks wrong."""
    measured: tuple[str, ...]
    """What was looked at, with its numbers."""


def check_views(views: Sequence[SeenView], points: np.ndarray | None) -> Checked:
    """All checks.

    Args:
        views: Of one sensor, in order.
        points: Sparse points (P, 3), if there are any.
    """
    findings, measured = [*few_views(views), *pixels(views)], []
    for found, said in (
        ring(views),
        overlap(views, points),
        blur(views),
        exposure(views, points),
        moving_light(views, points),
    ):
        findings += found
        measured.append(said)
    return Checked(tuple(findings), tuple(measured))


def report_text(title: str, checked: Checked, done: Sequence[str]) -> str:
    """The page.

    Args:
        title: First line.
        checked: Of the checks.
        done: What was done, one sentence each.
    """
    wrong = checked.findings or ("nothing that these checks can see",)
    parts = [title, ""]
    for heading, lines in (
        ("What looks wrong", wrong),
        ("What was measured", checked.measured),
        ("What was done", done),
    ):
        parts += [heading, *(_bullet(line) for line in lines), ""]
    return "\n".join(parts)


def _bullet(line: str) -> str:
    return textwrap.fill(line, _WIDTH, initial_indent="- ", subsequent_indent="  ", break_long_words=False)
