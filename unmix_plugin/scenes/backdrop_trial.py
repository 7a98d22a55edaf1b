"""A backdrop that was found by its looks is tried, before it decides anything: do masks from it agree between views,
and does it stand behind the scene rather than around it, as the walls of a room do?

A backdrop looks alike in all views along one direction, where it is far away, or in one pixel, where it stands still
before the camera while the object turns. Plain walls do neither: each has a shade of its own, and where two of them
meet moves from view to view as near surfaces do. So background that looks alike on a sphere around the cameras, but
along directions and in pixels differs, is a surface of the scene.

Notation: `P` background pixels of all views, `k` features of a spectrum, `C` cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64

from unmix_plugin.engine.decisions import UNDECIDED, Decision
from unmix_plugin.engine.geometry.camera_paths import meeting_point
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.scenes.backdrops import BeforeBackdrop, find_before_backdrop
from unmix_plugin.scenes.doctor import check_masks, contradicted_share
from unmix_plugin.scenes.geometry.carving import MOST_CONTRADICTED
from unmix_plugin.scenes.geometry.views import Views
from unmix_plugin.scenes.messages import Message

_MOST_PIXELS = 2_000
"""Of a view, that are compared."""
_CELLS = 8
"""From the middle of a picture, or of the sphere of directions, to its end; pixels of a cell are compared."""
_RADII = (1.1, 1.5, 2.0, 3.0)
"""Of spheres around the cameras, in distances of the farthest from the point that all look at, or from their middle."""
_TOLERANCE = 0.02
"""Of the brightest background, by which a view may differ from the mean of all in a cell."""
_LEAST_OF_BRIGHTEST = 0.25
"""Of the brightest pixels, what background counts as at least: what is black differs by noise alone."""
MOST_DIFFERENT = 0.1
"""Share of cells in which views differ, of a backdrop: skies have 0 to 0.002, plain rooms 0.3 and more."""
_NEARER = 0.8
"""Of that share, what a sphere at a finite distance leaves where a surface is: 0.25 to 0.76 in plain rooms, but 1 where
views differ for another reason, such as their exposures."""


@dataclass(frozen=True)
class TriedBackdrop:
    """Whether views stand before a backdrop."""

    before: BeforeBackdrop | None = None
    box: SceneBox | None = None
    """Of what stands before it."""
    decision: Decision | None = None
    is_refuted: bool = False
    """Whether there is what looks like one, but is none or may be none."""
    warnings: tuple[str, ...] = ()
    """Where it may be one."""


NO_BACKDROP = TriedBackdrop()
_TRIED = (
    f"masks from it contradict each other behind more than {MOST_CONTRADICTED:.0%} of what they show; views agree on "
    "it at a finite distance, or neither along directions nor in pixels"
)


def try_backdrop(views: Views) -> TriedBackdrop:
    """Look for a backdrop that the views share, and try it.

    Plain walls share much with a backdrop, but each keeps its shade where it is, and what one view sees as background
    is a wall among the things in another. They are learnt as part of the scene, also where they stand behind all that
    cameras look at: a wall cut out costs 2 dB. Where views agree on no place of the background, that is undecided, and
    all is kept, too.
    """
    before = find_before_backdrop(views)
    if before is None:
        return TriedBackdrop(decision=Decision("backdrop", "none", {}, "", "--world"))
    box, contradicted = None, 0.0
    if before.shows_foreground:
        box, contradicted = contradicted_share(views.cameras, before.masks())
    distance = measure_distance(views, before)
    outcome = "found"
    if check_masks(contradicted) is not None or distance.is_near:
        outcome = "none"
    elif distance.far > MOST_DIFFERENT:
        outcome = UNDECIDED
    evidence = {
        "looks": before.in_words,
        "contradicted": contradicted,
        "differs along directions and in pixels": distance.far,
        "differs at a finite distance": distance.near,
    }
    decision = Decision("backdrop", outcome, evidence, _TRIED, "--world")
    if outcome == "found":
        return TriedBackdrop(before, box, decision)
    doubt = Message.BACKDROP_IN_DOUBT.sentence(looks=before.in_words, share=distance.far)
    warnings = (doubt,) if outcome == UNDECIDED else ()
    return TriedBackdrop(decision=decision, is_refuted=True, warnings=warnings)


@dataclass(frozen=True)
class BackgroundDistance:
    """How often views differ in what they show of the background at one place."""

    far: float
    """Where it is infinitely far away, or stands still before the camera: the smaller share."""
    near: float
    """On the best of spheres at finite distances."""

    @property
    def is_near(self) -> bool:
        """Whether it is a surface at a finite distance."""
        return self.far > MOST_DIFFERENT and self.near < _NEARER * self.far


def measure_distance(views: Views, before: BeforeBackdrop) -> BackgroundDistance:
    """Compare the background between views."""
    pixels = list(_background(views, before))
    if not pixels:
        return BackgroundDistance(0.0, 0.0)
    poses = views.cameras.camera_to_world.double().numpy()
    found = meeting_point(poses)
    centre = poses[:, :, 3].mean(axis=0) if found is None else found
    owners = np.repeat(np.arange(len(pixels)), [len(one.spectra) for one in pixels])
    spectra, origins, directions, places = (
        np.concatenate([getattr(one, name) for one in pixels])
        for name in ("spectra", "origins", "directions", "places")
    )
    background = float(np.percentile(np.linalg.norm(spectra, axis=1), 99))
    scale = max(background, _LEAST_OF_BRIGHTEST * float(np.median([one.brightest for one in pixels])))
    if not scale > 0:
        return BackgroundDistance(0.0, 0.0)

    def differing(points: Float64[np.ndarray, "P d"]) -> float:
        cells = np.unique(np.rint(points * _CELLS).astype(int), axis=0, return_inverse=True)[1].ravel()
        return _share_that_differs(cells, owners, spectra / scale)

    from_centre = origins - centre
    radius = float(np.linalg.norm(from_centre, axis=1).max())
    far = min(differing(directions), differing(places))
    if not radius > 0:  # cameras at one place see no distance
        return BackgroundDistance(far, far)
    # Where rays, which start within each sphere around the centre, meet it; in its radii.
    along, squared = (from_centre * directions).sum(axis=1), (from_centre**2).sum(axis=1)
    spheres = []
    for reach in (factor * radius for factor in _RADII):
        ahead = np.sqrt(np.maximum(along**2 - squared + reach**2, 0.0)) - along
        spheres.append((from_centre + ahead[:, None] * directions) / reach)
    return BackgroundDistance(far, min(map(differing, spheres)))


@dataclass(frozen=True)
class _Background:
    """Pixels of one view."""

    spectra: Float64[np.ndarray, "P B"]
    origins: Float64[np.ndarray, "P 3"]
    directions: Float64[np.ndarray, "P 3"]
    """Unit vectors."""
    places: Float64[np.ndarray, "P 2"]
    """In the picture, [-1, 1]."""
    brightest: float
    """Length of the spectra of the brightest pixels of the view, matter too."""


def _background(views: Views, before: BeforeBackdrop) -> Iterator[_Background]:
    for view, matter in enumerate(before.thinned):
        flat = np.flatnonzero(~matter)
        rows, columns = np.divmod(flat[:: max(1, -(-len(flat) // _MOST_PIXELS))], matter.shape[1])
        if len(rows) == 0:
            continue
        every = slice(None, None, before.stride)
        image = views.read(view, (every, every, slice(None))).astype(np.float64)
        seen, brightest = image[rows, columns], float(np.percentile(np.linalg.norm(image, axis=2), 99))
        coords = torch.from_numpy(np.stack([columns, rows], axis=1) * before.stride).float() + 0.5
        rays = views.cameras.generate_rays(torch.full((len(coords),), view), coords)
        directions = torch.nn.functional.normalize(rays.directions.double(), dim=-1).numpy()
        places = 2 * coords.double().numpy() / np.array(before.size) - 1
        yield _Background(seen, rays.origins.double().numpy(), directions, places, brightest)


def _share_that_differs(
    cells: Int64[np.ndarray, " P"], owners: Int64[np.ndarray, " P"], spectra: Float64[np.ndarray, "P B"]
) -> float:
    """Share of what views show in cells that others see too in which they differ from the mean of all."""
    pairs, numbers = np.unique(np.stack([cells, owners]), axis=1, return_inverse=True)
    shown = _means(numbers.ravel(), spectra)
    owned = np.unique(pairs[0], return_inverse=True)[1].ravel()
    counts = np.bincount(owned)[owned].astype(float)
    if not (counts > 1).any():
        return 0.0
    # The mean holds the view itself, so that it is nearer to it than the truth is.
    away = np.linalg.norm(shown - _means(owned, shown)[owned], axis=1)[counts > 1]
    corrected = away * np.sqrt(counts[counts > 1] / (counts[counts > 1] - 1))
    return float((corrected > _TOLERANCE).mean())


def _means(groups: Int64[np.ndarray, " P"], values: Float64[np.ndarray, "P B"]) -> Float64[np.ndarray, "C B"]:
    counts = np.bincount(groups)
    return np.stack([np.bincount(groups, column) / counts for column in values.T], axis=1)
