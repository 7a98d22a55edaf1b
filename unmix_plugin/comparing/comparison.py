"""What has changed between two captures of one object: `compare_runs(before, after) -> Comparison`.

Both runs are laid on each other, the light is taken out, and at every vertex of the first surface what the views of
both measured is compared. Places are pieces of the surface that changed: they start where a change is sure after
correction for all vertices, and grow as long as neighbours differ too.

Notation: `P` vertices of the first surface, `V` views, `B` common bands, `K` materials of both captures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64

from unmix_plugin.comparing.captured import Capture, Observed, Surface, open_capture
from unmix_plugin.comparing.materials import JoinedMaterials, join_materials
from unmix_plugin.comparing.places import ChangedPlace, any_of, find_places
from unmix_plugin.comparing.registration import (
    Registration,
    ScaleChoice,
    light_between,
    register,
    unit,
)
from unmix_plugin.comparing.significance import (
    LEAST_SEEN,
    Difference,
    Moments,
    difference,
    difference_of_heights,
)
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import parse_index
from unmix_plugin.spectral.materials import seen_reflectance
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.trained.surface import Follow
from unmix_plugin.trained.surface_mesh import TriangleMesh, Working

_AXES = 4
"""Of unit spectra, in which their shapes are compared."""
_FEWEST_BANDS = 3
_RINGS, _HEIGHT_RINGS = 1, 4
"""Neighbours over which what a view shows, and where surfaces lie, is averaged."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two captures laid on each other, and what differs."""

    before: Capture
    after: Capture
    registration: Registration
    surface: Surface
    """Of the first capture, in its world."""
    bands: Bands
    """Those of the first capture that both have."""
    materials: JoinedMaterials
    spectra: tuple[Float64[np.ndarray, "P B"], Float64[np.ndarray, "P B"]]
    """Mean of what each capture's views measured, in the light of the first; NaN where none sees a vertex."""
    angle: Float64[np.ndarray, " P"]
    """Spectral angle between them, rad."""
    differences: Mapping[str, Difference]
    """`distance` along the normal (units of the first world, positive where matter was added), `spectrum` (its shape),
    `brightness` (logarithm), `abundance NAME` of each material, and `index NAME` of those asked for."""
    changed: Bool[np.ndarray, " P"]
    """Vertices of the places."""
    places: tuple[ChangedPlace, ...]
    """Largest first."""
    level: float
    """Part of the places that may be false."""
    notes: tuple[str, ...]
    """What a user has to be told."""

    @property
    def known(self) -> Bool[np.ndarray, " P"]:
        """Vertices that enough views of both captures see."""
        return np.isfinite(self.differences["spectrum"].p)

    @property
    def changed_area(self) -> float:
        """Part of the known surface that changed."""
        areas = self.surface.areas
        return float(areas[self.changed].sum() / max(areas[self.known].sum(), 1e-30))

    @cached_property
    def p(self) -> Float64[np.ndarray, " P"]:
        """Of any change at each vertex: the least of distance, spectrum and brightness, times their number."""
        return any_of([self.differences[name].p for name in TESTED])


TESTED = ("distance", "spectrum", "brightness")
"""What is changed if one of them is; abundances and indices follow from spectra."""


def compare_runs(
    before: str | Path,
    after: str | Path,
    *,
    before_data: str | Path | None = None,
    after_data: str | Path | None = None,
    scale: ScaleChoice = "auto",
    level: float = 0.05,
    indices: Sequence[str] = (),
    device: str = "auto",
) -> Comparison:
    """What has changed on an object between two runs of it.

    Args:
        before, after: Run folders of unmix-nerf.
        before_data, after_data: Their scenes, where these are no longer where the runs were trained.
        scale: `fixed` takes both worlds to be of known or of the same size; `free` finds how large the second is;
            `auto` is fixed where both runs have a scale.
        level: Part of the changed vertices that may be false.
        indices: Names or formulas of spectral indices to compare too.
        device: `auto`, `cpu` or `cuda`.
    Raises:
        RunError, SceneError: a run or its scene is missing or damaged.
        ConfigError: they can't be compared: not one object, no overlap, no common bands, another method.
    """
    first = open_capture(before, before_data, device, asked_by="before_data")
    second = open_capture(after, after_data, device, asked_by="after_data")
    return compare(first, second, scale=scale, level=level, indices=indices)


def compare(
    before: Capture,
    after: Capture,
    *,
    scale: ScaleChoice = "auto",
    level: float = 0.05,
    indices: Sequence[str] = (),
    follow: Follow = lambda _doing, items: items,
    working: Working = lambda _doing: nullcontext(),
) -> Comparison:
    """The same of opened captures; errors as those of `compare_runs`."""
    if not 0 < level < 1:
        raise ConfigError(f"the level is {level:g}; give a probability above 0 and below 1, such as 0.05")
    bands, to_common, notes = _common_bands(before, after)
    maps = {name: parse_index(name, bands) for name in indices}  # refused before anything is rendered
    choice, ratio, scale_notes = _scale_choice(before, after, scale)
    surfaces = []
    for capture, matrix in zip((before, after), to_common, strict=True):
        found = capture.surface(follow, working)
        surfaces.append(found if matrix is None else replace(found, spectra=found.spectra @ matrix))
    with working("laying the second surface on the first"):
        markers = (before.markers, after.markers)
        registration = register(surfaces[0], surfaces[1], before.pixel, choice, ratio, markers)
    surface = surfaces[0]
    back = registration.to_before.inverse
    seen = [
        before.observe(surface.positions, surface.normals, follow),
        after.observe(back.apply(surface.positions), back.turn(surface.normals), follow),
    ]
    seen = [
        one if matrix is None else replace(one, spectra=(one.spectra @ matrix).astype(np.float32))
        for one, matrix in zip(seen, to_common, strict=True)
    ]
    with working("comparing"):
        found = _compared(before, after, surfaces, registration, seen, bands, maps, level)
    unseen = 1 - float(surface.areas[found.known].sum() / surface.areas.sum())
    if unseen > _MUCH_UNSEEN:
        notes += (f"{unseen:.0%} of the first surface is not seen by enough views of both captures",)
    return replace(found, notes=(*notes, *scale_notes, *registration.notes, *found.notes))


_MUCH_UNSEEN = 0.3


def _common_bands(
    before: Capture, after: Capture
) -> tuple[
    Bands, tuple[Float64[np.ndarray, "B b"] | None, Float64[np.ndarray, "C b"] | None], tuple[str, ...]
]:
    """The bands of the first that lie within those of the second, and what spectra of each are multiplied with."""
    if before.bands == after.bands:
        return before.bands, (None, None), ()
    own, others = before.bands.centers_nm, after.bands.centers_nm
    chosen = np.array([after.bands.contains(nm) and others[0] <= nm <= others[-1] for nm in own])
    if chosen.sum() < _FEWEST_BANDS:
        raise ConfigError(
            f"the captures have {int(chosen.sum())} common bands ({before.bands} and {after.bands}); at least "
            f"{_FEWEST_BANDS} are needed: compare runs with more bands in one range"
        )
    bands = Bands.of(own[chosen])
    from_others = np.stack([np.interp(bands.centers_nm, others, row) for row in np.eye(len(others))])
    note = f"other bands: compared in the {bands} that both have, the second capture's interpolated between its own"
    return bands, (np.eye(len(own))[:, chosen], from_others), (note,)


def _scale_choice(
    before: Capture, after: Capture, asked: ScaleChoice
) -> tuple[ScaleChoice, float | None, tuple[str, ...]]:
    """Whether the scale is free, how long a unit of the second world is in the first's, and what to say of it."""
    known = [capture.scale for capture in (before, after)]
    ratio = None
    if known[0] is not None and known[1] is not None:
        ratio = known[1].metres_per_unit / known[0].metres_per_unit
    if asked == "free" or (asked == "auto" and ratio is None):
        one = sum(scale is not None for scale in known) == 1
        missing = "the second" if known[0] is not None else "the first"
        note = f"one run has a scale and {missing} has none: the ratio of both is found by laying them on each other"
        return "free", None, ((note,) if one and asked == "auto" else ())
    note = "both worlds are taken to have units of one length, since not both runs have a scale"
    return "fixed", ratio, (() if ratio is not None else (note,))


def _compared(
    before: Capture,
    after: Capture,
    surfaces: Sequence[Surface],
    registration: Registration,
    seen: Sequence[Observed],
    bands: Bands,
    maps: Mapping[str, Any],
    level: float,
) -> Comparison:
    """Everything that follows from what the views say of the first surface."""
    surface, smooth = surfaces[0], _Smoothing(surfaces[0])
    values = [smooth.views(one.spectra, _RINGS) for one in seen]
    means = [Moments.of(one).mean for one in values]
    counts = [np.isfinite(one[..., 0]).sum(axis=0) for one in values]
    both = (counts[0] > 0) & (counts[1] > 0)
    if not (np.minimum(*counts) >= LEAST_SEEN).any():
        raise ConfigError(
            f"no place of the first surface is seen by at least {LEAST_SEEN} views of both captures; take more views"
        )
    light = light_between(means[0][both], means[1][both], surface.areas[both], registration.light)
    registration = replace(registration, light=light)
    values[1] = (values[1] / light).astype(np.float32)
    means = [
        np.where((count > 0)[:, None], mean, np.nan)
        for count, mean in zip(counts, (means[0], means[1] / light), strict=True)
    ]
    materials = _joined(before, after, surfaces, bands, light)

    def of_both(function: Any) -> Difference:
        return difference(function(values[0]), function(values[1]))

    shape = _shape_axes(means, both)
    power = before.scene.light if before.bands == bands else None
    differences = {
        "distance": _distances(surface, smooth, seen, before, after, registration),
        "spectrum": of_both(lambda one: (unit(one) - shape[0]) @ shape[1]),
        "brightness": of_both(lambda one: np.log(one.sum(axis=-1, keepdims=True).clip(min=1e-4))),
    }
    abundances = [materials.abundances(one) for one in values]
    for index, name in enumerate(materials.names):
        differences[f"abundance {name}"] = _difference_of_abundances(
            *(one[..., index : index + 1] for one in abundances)
        )
    for name, formula in maps.items():
        differences[f"index {name}"] = of_both(lambda one, formula=formula: _index_of(one, formula, power))
    tested = [differences[name].p for name in TESTED]
    angle = spectral_angle(*(torch.from_numpy(one) for one in means)).numpy()
    places, changed = find_places(surface, any_of(tested), differences, means, level, before.pixel)
    return Comparison(
        before, after, registration, surface, bands, materials, (means[0], means[1]),
        angle, differences, changed, places, level, (),
    )  # fmt: skip


_PRESENT = 0.02
"""Mean abundance in one of the captures, below which a material is not there."""


def _difference_of_abundances(
    before: Float32[np.ndarray, "V P 1"], after: Float32[np.ndarray, "W P 1"]
) -> Difference:
    """Of one material; where neither capture has it, nothing changed."""
    means = [Moments.of(one) for one in (before, after)]
    absent = np.maximum(means[0].mean, means[1].mean)[:, 0] < _PRESENT
    given = [np.where(absent[None, :, None], np.nan, one) for one in (before, after)]
    found = difference(given[0], given[1])
    nothing = absent & (np.minimum(means[0].count, means[1].count) >= LEAST_SEEN)
    error = np.sqrt(means[0].error_squared + means[1].error_squared)
    return replace(
        found,
        mean=np.where(nothing[:, None], means[1].mean - means[0].mean, found.mean),
        error=np.where(nothing[:, None], error, found.error),
        p=np.where(nothing, 1.0, found.p),
    )


def _index_of(
    spectra: Float32[np.ndarray, "V P B"], formula: Any, power: torch.Tensor | None
) -> Float32[np.ndarray, "V P 1"]:
    """A spectral index of what was measured, of reflectance where the light is known."""
    given = torch.from_numpy(spectra)
    reflectance = seen_reflectance(
        given, torch.ones(given.shape[:-1]), None if power is None else power.cpu()
    )
    return formula(reflectance).numpy()[..., None].astype(np.float32)


def _shape_axes(
    means: Sequence[Float64[np.ndarray, "P B"]], both: Bool[np.ndarray, " P"]
) -> tuple[Float64[np.ndarray, " B"], Float64[np.ndarray, "B C"]]:
    """Mean and main axes of unit spectra of both captures."""
    units = np.concatenate([unit(one[both]) for one in means])
    middle = units.mean(axis=0)
    _, _, axes = np.linalg.svd((units - middle)[:: max(1, len(units) // 6000)], full_matrices=False)
    return middle, axes[:_AXES].T


def _joined(
    before: Capture,
    after: Capture,
    surfaces: Sequence[Surface],
    bands: Bands,
    light: Float64[np.ndarray, " B"],
) -> JoinedMaterials:
    """The materials of both in the common bands and the light of the first."""
    given = []
    _, matrices, _ = _common_bands(before, after)
    factors = (np.ones(len(bands)), light)
    for capture, surface, matrix, factor in zip((before, after), surfaces, matrices, factors, strict=True):
        own = capture.scene.materials
        spectra = own.endmembers.detach().cpu().double().numpy()
        spectra = (spectra if matrix is None else spectra @ matrix) / factor
        given.append((own.names, spectra, surface.areas @ surface.abundances / surface.areas.sum()))
    return join_materials(given[0], given[1])


def _distances(
    surface: Surface,
    smooth: _Smoothing,
    seen: Sequence[Observed],
    before: Capture,
    after: Capture,
    registration: Registration,
) -> Difference:
    """How far the second surface lies above the first along its normal, units of the first world."""
    ratio = registration.to_before.scale * after.pixel / before.pixel
    heights = [seen[0].heights[..., None], seen[1].heights[..., None] * np.float32(ratio)]
    moments = [Moments.of(one) for one in heights]
    enough = (moments[0].count >= _LEAST_HEIGHTS) & (moments[1].count >= _LEAST_HEIGHTS)
    change = np.where(enough, (moments[1].mean - moments[0].mean)[:, 0], np.nan)
    spreads = [smooth.places(np.where(enough, one.variance[:, 0], np.nan) ** 0.5, 2) for one in moments]
    roughness = []
    for one in moments:
        own = np.where(enough, one.mean[:, 0], np.nan)
        roughness.append(smooth.places(np.abs(smooth.places(own, 1) - own), 3))
    normals = np.stack([smooth.places(axis, 6) for axis in surface.normals.T], axis=1)
    curvature = 1 - np.linalg.norm(normals, axis=1)
    off = smooth.places(np.abs(np.where(enough, moments[0].mean[:, 0], np.nan)), 3)
    few = np.minimum(moments[0].count, moments[1].count)
    features = [np.log(one + 0.02) for one in spreads] + [np.log(one + 0.03) for one in (*roughness, off)]
    features += [np.log(curvature.clip(min=0) + 1e-3), np.log(few + 1.0)]
    found = difference_of_heights(smooth.places(change, _HEIGHT_RINGS), np.stack(features, axis=1))
    return replace(found, mean=found.mean * before.pixel, error=found.error * before.pixel)


_LEAST_HEIGHTS = 4


class _Smoothing:
    """Means over neighbours of a surface, of what is known there."""

    def __init__(self, surface: Surface) -> None:
        """With links along the edges of its triangles."""
        from scipy.sparse import identity

        links = TriangleMesh(surface.positions, surface.faces).links
        self._links = (links + identity(len(surface.positions))).tocsr()

    def places(self, values: Float[np.ndarray, " P"], rings: int) -> Float64[np.ndarray, " P"]:
        """One number a place; NaN stays."""
        return self._smooth(np.asarray(values, np.float64)[:, None], rings)[:, 0]

    def _smooth(self, values: Float64[np.ndarray, "P x"], rings: int) -> Float64[np.ndarray, "P x"]:
        known = np.isfinite(values[:, 0])
        counts = (self._links @ known.astype(np.float64)).clip(min=1.0)[:, None]
        for _ in range(rings):
            values = (self._links @ np.where(known[:, None], values, 0.0)) / counts
        return np.where(known[:, None], values, np.nan)

    def views(self, values: Float32[np.ndarray, "V P x"], rings: int) -> Float32[np.ndarray, "V P x"]:
        """Numbers of each view."""
        return np.stack([self._smooth(one.astype(np.float64), rings).astype(np.float32) for one in values])
