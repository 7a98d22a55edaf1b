"""Views that differ from the others: blurred ones, and jumps of exposure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.checks.seen_view import SeenView, angles_between, log_ratio
from unmix_plugin.errors import counted

BLURRED = 0.6
"""Detail of a view against the median of all, below which it is blurred."""
LEAST_VIEWS = 4
JUMP = 0.15
"""Logarithm of a gain against the others that counts as a jump."""
JUMP_DEVIATIONS = 4.0
LEAST_POINTS = 50
NEIGHBOURS = 6
"""Views that one is compared with: the nearest."""
SATURATED_SHARE = 0.01
MISSING_SHARE = 0.05


def blur(views: Sequence[SeenView]) -> tuple[list[str], str]:
    """Views with less fine detail than the others."""
    details = np.array([view.record.detail for view in views])
    middle = float(np.median(details))
    if len(views) < LEAST_VIEWS or middle <= 0:
        return [], "blur is not judged"
    blurred = [
        f"{view.name} ({detail / middle:.0%} of the usual detail)"
        for view, detail in zip(views, details, strict=True)
        if detail < BLURRED * middle
    ]
    findings = (
        [f"{counted(len(blurred), 'view')} less sharp than the others: {_some(blurred)}"] if blurred else []
    )
    return (
        findings,
        f"finest structures have {middle:.2f} times the contrast of those twice as large (median of views)",
    )


def exposure(views: Sequence[SeenView], points: Float64[np.ndarray, "P 3"] | None) -> tuple[list[str], str]:
    """Views whose sparse points are brighter or darker than the same points in the views nearest to them."""
    if points is None or len(points) < LEAST_POINTS or len(views) < LEAST_VIEWS:
        return (
            [],
            "exposure is not compared: it takes sparse points, which come with estimated poses and COLMAP",
        )
    gains = _gains(views, points)
    if np.isnan(gains).any():
        return [], "exposure is not compared: too few sparse points are seen in every view"
    usual = 1.4826 * float(np.median(np.abs(gains - np.median(gains))))
    limit = max(JUMP, JUMP_DEVIATIONS * usual)
    jumps = [
        f"{view.name} ({np.exp(gain):.2f} times as bright)"
        for view, gain in zip(views, gains, strict=True)
        if abs(gain) > limit
    ]
    findings = (
        [f"exposure jumps in {counted(len(jumps), 'view')}, judged by sparse points: {_some(jumps)}"]
        if jumps
        else []
    )
    return (
        findings,
        f"sparse points vary by {np.expm1(usual):.0%} in brightness from view to view (robust deviation)",
    )


def _gains(views: Sequence[SeenView], points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, " N"]:
    """Logarithm of how much brighter a view is than the views around it; NaN where too few points tell."""
    angles = angles_between(views) + 360.0 * np.eye(len(views))
    before = [view.has_before_it(points) for view in views]
    gains = np.full(len(views), np.nan)
    for index, view in enumerate(views):
        ratios = []
        for other in np.argsort(angles[index])[:NEIGHBOURS]:
            shared = points[before[index] & before[other]]
            found = log_ratio(views[other], view, shared)
            found = found[np.isfinite(found)]
            if len(found) >= LEAST_POINTS // 2:
                ratios.append(float(np.median(found)))
        if len(ratios) >= 2:
            gains[index] = np.median(ratios)
    return gains


def pixels(views: Sequence[SeenView]) -> list[str]:
    """Views with many saturated or missing pixels."""
    findings = []
    for what, share, limit in (
        ("saturated", "saturated_pixels", SATURATED_SHARE),
        ("missing", "missing_pixels", MISSING_SHARE),
    ):
        shares = {view.name: getattr(view.record, share) / view.record.num_pixels for view in views}
        many = [f"{name} ({part:.0%})" for name, part in shares.items() if part > limit]
        if many:
            findings.append(
                f"{counted(len(many), 'view')} with more than {limit:.0%} {what} pixels: {_some(many)}"
            )
    empty = [view.name for view in views if view.record.matter_share == 0.0]
    if empty:
        findings.append(f"{counted(len(empty), 'view')} without any matter, by the mask: {_some(empty)}")
    return findings


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
