"""Where the cameras are: how many there are, from which sides they look, and whether neighbours see the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.checks.seen_view import SeenView, angles_between
from unmix_plugin.engine.geometry.camera_paths import meeting_point
from unmix_plugin.errors import counted

FEW_VIEWS = 15
NARROW_DEG = 12.0
"""Cameras that are all within this range of elevation see the object from one height only."""
WIDE_RING_DEG = 180.0
"""Part of a circle from which a ring counts as one."""
GAP_DEG = 75.0
LEAST_OVERLAP = 0.4
"""Share of a view that another one should see too."""
FAR_NEIGHBOUR_DEG = 35.0
_SAMPLES = 8


def few_views(views: Sequence[SeenView]) -> list[str]:
    """Whether there are enough views."""
    if len(views) >= FEW_VIEWS:
        return []
    return [f"only {len(views)} views: expect holes and fog; {FEW_VIEWS} or more all around serve better"]


def ring(views: Sequence[SeenView]) -> tuple[list[str], str]:
    """From which sides the cameras look, and what is missing."""
    poses = np.stack([view.camera.camera_to_world for view in views])
    focus = meeting_point(poses)
    if focus is None:
        return [], "the cameras look at no one place: sides are not judged"
    directions = poses[:, :, 3] - focus
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    elevation = np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    azimuth = np.sort(np.degrees(np.arctan2(directions[:, 1], directions[:, 0])))
    gap = float(np.diff(azimuth, append=azimuth[0] + 360.0).max())
    around, height = 360.0 - gap, float(np.ptp(elevation))
    said = (
        f"cameras span {around:.0f} degrees around the middle, at elevations of {elevation.min():.0f} to "
        f"{elevation.max():.0f} degrees"
    )
    findings = []
    if height < NARROW_DEG and around > WIDE_RING_DEG:
        findings.append(
            f"a narrow ring: all cameras are within {height:.0f} degrees of elevation, so that what is seen from "
            "above or below is a guess; add a second ring 25 degrees higher"
        )
    if around > WIDE_RING_DEG and gap > GAP_DEG:
        findings.append(f"no camera looks from {gap:.0f} degrees of the circle around the object")
    return findings, said


def overlap(
    views: Sequence[SeenView], points: Float64[np.ndarray, "P 3"] | None = None
) -> tuple[list[str], str]:
    """Whether each view shows something that another view shows from a similar side.

    A grid of rays of each view is followed to the depth of the middle of the scene: where the cameras look, or that of
    the sparse points if they look at no one place. What other cameras see of these places is the overlap, if they look
    from within 35 degrees.
    """
    poses = np.stack([view.camera.camera_to_world for view in views])
    focus = meeting_point(poses)
    if focus is None and points is not None and len(points):
        focus = np.median(points, axis=0)
    if focus is None or len(views) < 2:
        return [], "overlap is not judged: the cameras look at no one place, and there are no sparse points"
    between = angles_between(views)
    shares = np.zeros(len(views))
    nearest = np.zeros(len(views))
    for index, view in enumerate(views):
        points = _points_seen(view, focus)
        angles = np.where(np.arange(len(views)) == index, np.inf, between[index])
        nearest[index] = angles.min()
        near = np.argsort(angles)[: min(6, len(views) - 1)]
        near = near[angles[near] <= FAR_NEIGHBOUR_DEG]
        seen = [np.isfinite(views[other].pixels_of(points)).all(axis=1).mean() for other in near]
        shares[index] = max(seen, default=0.0)
    alone = [index for index in range(len(views)) if shares[index] < LEAST_OVERLAP]
    findings = []
    if alone:
        worst = min(alone, key=lambda index: shares[index])
        names = ", ".join(views[index].name for index in alone[:5]) + (" and more" if len(alone) > 5 else "")
        findings.append(
            f"{counted(len(alone), 'view')} with hardly any overlap with another one ({names}): of "
            f"{views[worst].name} at most {shares[worst]:.0%} is seen by a neighbour, the nearest looks from "
            f"{nearest[worst]:.0f} degrees away; take views in smaller steps"
        )
    return findings, (
        f"views share {np.median(shares):.0%} with a neighbour (median; least {shares.min():.0%}); the nearest one "
        f"looks from {np.median(nearest):.0f} degrees away (median; most {nearest.max():.0f})"
    )


def _points_seen(view: SeenView, focus: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "P 3"]:
    """Points on a grid of the view's rays, at the depth of the middle; lenses are taken without distortion."""
    lens = view.camera.lens
    assert lens is not None
    x, y = np.meshgrid(
        (np.arange(_SAMPLES) + 0.5) / _SAMPLES * lens.width,
        (np.arange(_SAMPLES) + 0.5) / _SAMPLES * lens.height,
    )
    across = (x.ravel() - lens.center_px[0]) / lens.focal_px[0]
    down = (y.ravel() - lens.center_px[1]) / lens.focal_px[1]
    rays = np.column_stack([across, -down, -np.ones_like(across)]) @ view.camera.camera_to_world[:, :3].T
    depth = max(float((focus - view.position) @ view.axis), 1e-9)
    return view.position + depth * rays
