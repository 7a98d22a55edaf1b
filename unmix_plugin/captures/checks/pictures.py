"""Views that differ from the others: blurred ones, and jumps of exposure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.checks.seen_view import SeenView

BLURRED = 0.6
"""Detail of a view against the median of all, below which it is blurred."""
LEAST_VIEWS = 4
JUMP = 0.15
"""Logarithm of a gain against the others that counts as a jump."""
JUMP_DEVIATIONS = 4.0
LEAST_POINTS = 50
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
    findings = [f"{len(blurred)} views are less sharp than the others: {_some(blurred)}"] if blurred else []
    return (
        findings,
        f"finest structures have {middle:.2f} times the contrast of those twice as large (median of views)",
    )


def exposure(views: Sequence[SeenView], points: Float64[np.ndarray, "P 3"] | None) -> tuple[list[str], str]:
    """Views whose sparse points are brighter or darker than the same points in the other views."""
    if points is None or len(points) < LEAST_POINTS or len(views) < LEAST_VIEWS:
        return (
            [],
            "exposure is not compared: it takes sparse points, which come with estimated poses and COLMAP",
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        light = np.log(np.stack([view.brightness_at(view.pixels_of(points)) for view in views]))
    light[~np.isfinite(light)] = np.nan
    enough = np.isfinite(light).sum(axis=0) >= LEAST_VIEWS
    relative = light[:, enough] - np.nanmedian(light[:, enough], axis=0)
    counted = np.isfinite(relative).sum(axis=1)
    if (counted < LEAST_POINTS).any():
        return [], "exposure is not compared: too few sparse points are seen in every view"
    gains = np.nanmedian(relative, axis=1)
    gains -= np.median(gains)
    usual = 1.4826 * float(np.median(np.abs(gains)))
    limit = max(JUMP, JUMP_DEVIATIONS * usual)
    jumps = [
        f"{view.name} ({np.exp(gain):.2f} times as bright)"
        for view, gain in zip(views, gains, strict=True)
        if abs(gain) > limit
    ]
    findings = (
        [f"exposure jumps in {len(jumps)} views, judged by sparse points: {_some(jumps)}"] if jumps else []
    )
    return (
        findings,
        f"sparse points vary by {np.expm1(usual):.0%} in brightness from view to view (robust deviation)",
    )


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
            findings.append(f"{len(many)} views have more than {limit:.0%} {what} pixels: {_some(many)}")
    empty = [view.name for view in views if view.record.matter_share == 0.0]
    if empty:
        findings.append(f"{len(empty)} views show no matter at all by their mask: {_some(empty)}")
    return findings


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
