"""Where the second capture of an object lies in the world of the first: by its surface and by what that is made of.

Coarse: turns spread over all rotations, with the centres and sizes of both surfaces put on each other,
scored by how near points of one colour are; the worlds as they are is one more guess. Fine: iterated closest points,
where a point is pulled to the plane of its partner and, along the surface, to where the spectrum is its own. Points
without a near partner of about the same normal don't count, so that what changed or is seen once only pulls nothing.
No markers are needed. Where both captures have some they give the first guess, pull a little so that a surface that is
round or plain does not slide, and say at the end whether they agree; where they don't, the surface decides.

Source: iterated closest points (Besl and McKay 1992) point to plane (Chen and Medioni 1992), with colour as Park, Zhou
and Koltun 2017 (coloured point cloud registration) have it, here for a few principal axes of spectra; weights of Tukey.

Notation: `P`, `Q` points of the moving and of the fixed surface, `C` axes of spectra, `B` bands, `M` points of markers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from unmix_plugin.comparing.captured import Surface
from unmix_plugin.errors import ConfigError, name_some

ScaleChoice = Literal["free", "fixed", "auto"]
"""Whether a unit of the second world may have any length in the first's."""

_AXES = 3
"""Of spectra, by which points are told apart."""
_TURNS, _COARSE_POINTS, _COARSE_TARGETS, _STARTS = 1200, 250, 2500, 8
_FIRST_STEPS, _STEPS, _FIRST_POINTS, _MOST_POINTS = 25, 40, 1200, 12_000
_COLOUR_WEIGHT = 8.0
"""Pixels that count as much as a difference of spectra by 1, unit spectra."""
_NORMAL_WEIGHT = 3.0
_NEAR_PX = 3.0
"""How far from the other surface a point may be and still lie on both."""
_ALIKE = 0.15
"""Difference of unit spectra, light taken out, below which places are of one material; about radians."""
_LEAST_OVERLAP, _LEAST_AGREEMENT, _LARGEST_RMS_PX = 0.35, 0.6, 1.5
_NEIGHBOURS = 12
_MARKER_WEIGHT = 0.05
"""What all markers together count, of what the surface does."""
_LEAST_ACROSS = 0.05
"""Extent of markers across the line that fits them best, over that along it, from which they tell a turn."""

Markers = Mapping[str, Float64[np.ndarray, "n 3"]]
"""World points by name."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """From points x of one world to s R x + t of another."""

    scale: float
    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, "3"]

    def apply(self, points: Float64[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        """Points of the first world in the second."""
        return self.scale * points @ self.rotation.T + self.translation

    def turn(self, directions: Float64[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        """Directions of the first world in the second."""
        return directions @ self.rotation.T

    @property
    def inverse(self) -> Similarity:
        """The way back."""
        back = self.rotation.T
        return Similarity(1 / self.scale, back, -(back @ self.translation) / self.scale)

    @staticmethod
    def identity() -> Similarity:
        """Which moves nothing."""
        return Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Registration:
    """How the second capture lies in the first, and how well that is known."""

    to_before: Similarity
    """From the second capture's world to the first's."""
    rms_px: float
    """Root mean square of the distances between the surfaces where both are, pixels of the first capture."""
    overlap: float
    """Part of the first surface that lies within three pixels of the second."""
    agreement: float
    """Part of that where the spectra are alike, light taken out."""
    light: Float64[np.ndarray, " B"]
    """The second capture's radiance over the first's, of places that did not change; one number for each band."""
    markers_px: float | None = None
    """Root mean square distance between the markers of both that were used, pixels; None without any."""
    notes: tuple[str, ...] = ()
    """Which markers were not used, and why."""

    def in_words(self) -> str:
        """How well they fit, for people."""
        markers = (
            "" if self.markers_px is None else f"; markers of both are {self.markers_px:.2f} pixels apart"
        )
        return (
            f"registered: rms {self.rms_px:.2f} pixels where both surfaces are, which is {self.overlap:.0%} of the "
            f"first; {self.agreement:.0%} of that has the same spectra; 1 unit of the second world is "
            f"{self.to_before.scale:.5g} of the first{markers}"
        )


def register(
    before: Surface,
    after: Surface,
    pixel: float,
    scale: ScaleChoice = "free",
    ratio: float | None = None,
    markers: tuple[Markers, Markers] = ({}, {}),
) -> Registration:
    """Lay the second surface onto the first; both have the same bands.

    Args:
        pixel: Edge of a pixel, units of the first world.
        scale: `fixed` takes `ratio` for how long a unit of the second world is in the first.
        ratio: None: worlds of unknown size, which have to be of the same size where the scale is fixed.
        markers: Of each capture, in its world; those of one name and as many points are the same ones.
    Raises:
        ConfigError: the surfaces don't fit each other.
    """
    fixed_ratio = (1.0 if ratio is None else ratio) if scale == "fixed" else None
    marked = _common_markers(markers, pixel, fixed_ratio)
    notes: tuple[str, ...] = ()
    if marked is not None:
        try:
            found = _laid(before, after, pixel, fixed_ratio, marked)
            if found.markers_px is not None and found.markers_px <= _NEAR_PX:
                return replace(found, notes=marked.notes)
            apart = f"they are {found.markers_px:.3g} pixels apart where the surfaces lie on each other"
        except ConfigError:
            apart = "the surfaces don't lie on each other where they do"
        contradiction = (
            f"the markers of both captures ({name_some(marked.names)}) contradict the surface: {apart}. The surface "
            "decides; were they moved, or are others of the same numbers?"
        )
        notes = (contradiction,)
    return replace(_laid(before, after, pixel, fixed_ratio, None), notes=notes)


@dataclass(frozen=True, eq=False)
class _CommonMarkers:
    """Points of markers that keep their places, in pixels of the first capture, each in its world."""

    names: tuple[str, ...]
    fixed: Float64[np.ndarray, "M 3"]
    moving: Float64[np.ndarray, "M 3"]
    way: Similarity
    """From the second to the first."""
    notes: tuple[str, ...]
    """Which ones moved."""


def _common_markers(
    markers: tuple[Markers, Markers], pixel: float, ratio: float | None
) -> _CommonMarkers | None:
    """Markers of both captures, without those that most others contradict; None where they tell no turn."""
    both = [
        name
        for name, points in markers[0].items()
        if name in markers[1] and markers[1][name].shape == points.shape
    ]
    moved: list[str] = []

    def points_of(names: list[str]) -> list[Float64[np.ndarray, "M 3"]]:
        return [np.concatenate([np.zeros((0, 3)), *(one[name] for name in names)]) / pixel for one in markers]

    def tell_turn(names: list[str]) -> bool:
        extents = [
            np.linalg.svd(points - points.mean(axis=0), compute_uv=False) for points in points_of(names)
        ]
        return all(bool(one[1] > _LEAST_ACROSS * one[0]) for one in extents)

    if sum(len(markers[0][name]) for name in both) < 3 or not tell_turn(both):
        return None
    while True:
        fixed, moving = points_of(both)
        way = _similarity_between(moving, fixed, ratio)
        misses = np.linalg.norm(way.apply(moving) - fixed, axis=1)
        owners = np.repeat(both, [len(markers[0][name]) for name in both])
        rest = [name for name in both if name != owners[misses.argmax()]]
        if misses.max() <= _NEAR_PX or len(moved) + 1 >= len(rest) or not tell_turn(rest):
            notes = (f"markers that moved against the others are not used: {name_some(moved)}",)
            return _CommonMarkers(tuple(both), fixed, moving, way, notes if moved else ())
        moved += [name for name in both if name not in rest]
        both = rest


def _similarity_between(
    points: Float64[np.ndarray, "M 3"], targets: Float64[np.ndarray, "M 3"], ratio: float | None
) -> Similarity:
    """The similarity with the least squares from points to targets; its scale is `ratio` where that is given."""
    middle, goal = points.mean(axis=0), targets.mean(axis=0)
    turn = Rotation.align_vectors(targets - goal, points - middle)[0]
    turned = turn.apply(points - middle)
    scale = float((turned * (targets - goal)).sum() / (turned**2).sum()) if ratio is None else ratio
    return Similarity(scale, turn.as_matrix(), goal - scale * turn.apply(middle))


def _laid(
    before: Surface, after: Surface, pixel: float, ratio: float | None, marked: _CommonMarkers | None
) -> Registration:
    """Coarse, fine, and judged; from where markers are if there are some."""
    light = (after.areas @ after.spectra / after.areas.sum()) / (
        before.areas @ before.spectra / before.areas.sum()
    ).clip(min=1e-9)
    clouds = _clouds(before, after, light, pixel, marked)
    found = _best_start(*clouds, ratio) if marked is None else marked.way
    for _ in range(2):
        found = _refine(*clouds, found, ratio is None, _STEPS)
        light = _light(before, after, found, pixel, light)
        clouds = _clouds(before, after, light, pixel, marked)
    return _judged(*clouds, found, light)


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Points in pixels of the first capture, with normals, colours (axes of unit spectra) and areas."""

    positions: Float64[np.ndarray, "P 3"]
    normals: Float64[np.ndarray, "P 3"]
    colours: Float64[np.ndarray, "P C"]
    areas: Float64[np.ndarray, " P"]
    markers: Float64[np.ndarray, "M 3"]
    """Row by row those of the other cloud."""
    pixel: float

    def some(self, most: int, seed: int = 0) -> _Cloud:
        """At most so many of the points, drawn by area."""
        if len(self.positions) <= most:
            return self
        chances = self.areas / self.areas.sum()
        chosen = np.random.default_rng(seed).choice(len(chances), most, replace=False, p=chances)
        return replace(
            self,
            positions=self.positions[chosen],
            normals=self.normals[chosen],
            colours=self.colours[chosen],
            areas=self.areas[chosen],
        )

    @cached_property
    def middle(self) -> Float64[np.ndarray, "3"]:
        """Centre of the area."""
        return self.areas @ self.positions / self.areas.sum()

    @cached_property
    def radius(self) -> float:
        """Root mean square distance from there."""
        away = ((self.positions - self.middle) ** 2).sum(axis=1)
        return float(np.sqrt(self.areas @ away / self.areas.sum()))

    def joint(self, position_weight: float = 1.0) -> Float64[np.ndarray, "P x"]:
        """Positions, colours and normals in one space of pixels, in which partners are looked for."""
        return np.concatenate(
            [position_weight * self.positions, _COLOUR_WEIGHT * self.colours, _NORMAL_WEIGHT * self.normals],
            axis=1,
        )

    def moved(self, transform: Similarity) -> _Cloud:
        """In another world."""
        return replace(
            self,
            positions=transform.apply(self.positions),
            normals=transform.turn(self.normals),
            markers=transform.apply(self.markers),
        )

    @cached_property
    def tree(self) -> KDTree:
        """For partners of points."""
        return KDTree(self.joint())

    @cached_property
    def gradients(self) -> Float64[np.ndarray, "P C 3"]:
        """How colours change along the surface, a pixel: planes through neighbours, in the tangent plane."""
        count = min(_NEIGHBOURS, len(self.positions))
        _, near = KDTree(self.positions).query(self.positions, k=count)
        offsets = self.positions[near] - self.positions[:, None]
        offsets -= (offsets * self.normals[:, None]).sum(axis=-1, keepdims=True) * self.normals[:, None]
        changes = self.colours[near] - self.colours[:, None]
        square = np.einsum("pka,pkb->pab", offsets, offsets)
        square += 0.1 * np.eye(3) + np.einsum("pa,pb->pab", self.normals, self.normals)
        both = np.einsum("pka,pkc->pac", offsets, changes)
        return np.linalg.solve(square, both).swapaxes(1, 2)


def unit(spectra: Float[np.ndarray, "*places B"]) -> Float[np.ndarray, "*places B"]:
    """Spectra of length 1."""
    return spectra / np.linalg.norm(spectra, axis=-1, keepdims=True).clip(min=1e-12)


def _clouds(
    before: Surface,
    after: Surface,
    light: Float64[np.ndarray, " B"],
    pixel: float,
    marked: _CommonMarkers | None,
) -> tuple[_Cloud, _Cloud]:
    """The fixed and the moving points, colours on common axes and positions in pixels of the first world."""
    first, second = unit(before.spectra), unit(after.spectra / light.clip(min=1e-9))
    both = np.concatenate([first, second])
    middle = both.mean(axis=0)
    _, _, axes = np.linalg.svd((both - middle)[:: max(1, len(both) // 4000)], full_matrices=False)
    axes = axes[:_AXES].T
    markers = (np.zeros((0, 3)),) * 2 if marked is None else (marked.fixed, marked.moving)
    return (
        _Cloud(
            before.positions / pixel, before.normals, (first - middle) @ axes, before.areas, markers[0], pixel
        ),
        _Cloud(
            after.positions / pixel, after.normals, (second - middle) @ axes, after.areas, markers[1], pixel
        ),
    )


def _best_start(fixed: _Cloud, moving: _Cloud, ratio: float | None) -> Similarity:
    """The best of many turns, each refined a little; in pixels."""
    scale = fixed.radius / moving.radius if ratio is None else ratio
    near = fixed.some(_COARSE_TARGETS)
    tree = KDTree(np.concatenate([near.positions, _COLOUR_WEIGHT * 3 * near.colours], axis=1))
    some = moving.some(_COARSE_POINTS, seed=1)
    most = (0.3 * fixed.radius) ** 2

    def cost(turn: Float64[np.ndarray, "3 3"]) -> float:
        placed = scale * (some.positions - moving.middle) @ turn.T + fixed.middle
        away, _ = tree.query(np.concatenate([placed, _COLOUR_WEIGHT * 3 * some.colours], axis=1))
        return float(np.minimum(away**2, most).mean())

    quaternions = np.random.default_rng(0).normal(size=(_TURNS, 4))  # of all rotations alike
    turns = Rotation.from_quat(quaternions).as_matrix()
    order = np.argsort([cost(turn) for turn in turns])[:_STARTS]
    starts = [Similarity(scale, turn, fixed.middle - scale * turn @ moving.middle) for turn in turns[order]]
    as_is = Similarity(1.0 if ratio is None else ratio, np.eye(3), np.zeros(3))
    few_fixed, few_moving = fixed.some(4 * _FIRST_POINTS), moving.some(_FIRST_POINTS, seed=2)
    tried = [_refine(few_fixed, few_moving, start, ratio is None, _FIRST_STEPS) for start in (as_is, *starts)]
    costs = [_cost(few_fixed, few_moving, one) for one in tried]
    return tried[int(np.argmin(costs))]


def _cost(fixed: _Cloud, moving: _Cloud, transform: Similarity) -> float:
    """Mean of squared joint distances, each at most that of a point without a partner; both ways."""
    placed = moving.moved(transform)
    there, _ = fixed.tree.query(placed.joint())
    back, _ = placed.tree.query(fixed.joint())
    most = (3 * _NEAR_PX) ** 2
    return float(np.minimum(there**2, most).mean() + np.minimum(back**2, most).mean())


def _refine(fixed: _Cloud, moving: _Cloud, start: Similarity, is_free: bool, steps: int) -> Similarity:
    """Steps of least squares from partners to partners, until they no longer move."""
    moving, found = moving.some(_MOST_POINTS, seed=3), start
    reach = 0.2 * fixed.radius
    for _ in range(steps):
        placed = moving.moved(found)
        away, partners = fixed.tree.query(placed.joint())
        reach = max(_NEAR_PX, min(0.8 * reach, 3.0 * float(np.median(away))))
        step, moved = _step(fixed, placed, np.asarray(partners), reach, is_free)
        found = Similarity(
            step.scale * found.scale,
            step.rotation @ found.rotation,
            step.apply(found.translation),
        )
        if moved < 1e-3 and reach <= _NEAR_PX:
            break
    return found


def _step(
    fixed: _Cloud, placed: _Cloud, partners: Int64[np.ndarray, " P"], reach: float, is_free: bool
) -> tuple[Similarity, float]:
    """One step about the middle of the points, and by how many pixels it moves them at most."""
    normals, gradients = fixed.normals[partners], fixed.gradients[partners]
    offsets = placed.positions - fixed.positions[partners]
    across = (offsets * normals).sum(axis=1)
    colours = placed.colours - fixed.colours[partners] - np.einsum("pca,pa->pc", gradients, offsets)
    middle, size = fixed.middle, max(fixed.radius, 1.0)
    arms = (placed.positions - middle) / size
    faces = (placed.normals * normals).sum(axis=1) > 0.5

    def rows(directions: Float64[np.ndarray, "n 3"], arms: Float64[np.ndarray, "n 3"]) -> np.ndarray:
        scales = (directions * arms).sum(axis=1, keepdims=True)
        return np.concatenate([np.cross(arms, directions), directions, scales[:, : int(is_free)]], axis=1)

    weights = _tukey(across, reach) * faces * (np.linalg.norm(offsets, axis=1) < 2 * reach)
    system, values, counts = [rows(normals, arms)], [-across], [weights]
    for axis in range(colours.shape[1]):
        spread = max(1.5 * float(np.median(np.abs(colours[:, axis]))), 1e-3)
        system.append(_COLOUR_WEIGHT * rows(gradients[:, axis], arms))
        values.append(_COLOUR_WEIGHT * colours[:, axis])
        counts.append(_tukey(colours[:, axis], 4 * spread) * weights)
    if len(placed.markers):
        apart = (fixed.markers - placed.markers).ravel()
        share = _MARKER_WEIGHT * max(weights.sum(), 1.0) / len(apart)
        system.append(rows(np.tile(np.eye(3), (len(placed.markers), 1)),
                           np.repeat((placed.markers - middle) / size, 3, axis=0)))  # fmt: skip
        values.append(apart)
        counts.append(np.full(len(apart), share))
    matrix, wanted, counted = np.concatenate(system), np.concatenate(values), np.concatenate(counts)
    # A little pull towards partners keeps plain surfaces from sliding where neither shape nor colour holds them.
    normal = matrix.T @ (counted[:, None] * matrix) + 1e-6 * max(counted.sum(), 1.0) * np.eye(matrix.shape[1])
    change = np.linalg.solve(normal, matrix.T @ (counted * wanted))
    turn = Rotation.from_rotvec(change[:3] / size).as_matrix()
    scale = float(np.exp(change[6] / size)) if is_free else 1.0
    shift = middle + change[3:6] - scale * turn @ middle
    return Similarity(scale, turn, shift), float(np.abs(change).max())


def _tukey(values: Float64[np.ndarray, " n"], reach: float) -> Float64[np.ndarray, " n"]:
    return (1 - (values / reach) ** 2).clip(min=0) ** 2


def _light(
    before: Surface,
    after: Surface,
    found: Similarity,
    pixel: float,
    guess: Float64[np.ndarray, " B"],
) -> Float64[np.ndarray, " B"]:
    """Median ratio of spectra over places that lie on both surfaces and look alike but for the guess."""
    placed = Similarity(found.scale, found.rotation, found.translation * pixel).apply(after.positions)
    away, partners = KDTree(placed).query(before.positions)
    first, second = before.spectra, after.spectra[partners]
    alike = np.linalg.norm(unit(first) - unit(second / guess.clip(min=1e-9)), axis=1) < _ALIKE
    both = (away < _NEAR_PX * pixel) & alike
    return light_between(first[both], second[both], before.areas[both], guess)


_DARK = 0.1
"""Part of the brightest place, below which one tells nothing of the light."""


def light_between(
    first: Float64[np.ndarray, "P B"],
    second: Float64[np.ndarray, "P B"],
    areas: Float64[np.ndarray, " P"],
    otherwise: Float64[np.ndarray, " B"],
) -> Float64[np.ndarray, " B"]:
    """The second spectra over the first, band by band: medians over places, by area, of those that are bright there;
    what was known before in a band where none is."""
    found = otherwise.copy()
    for band in range(first.shape[1]):
        bright = (
            first[:, band] > _DARK * np.quantile(first[:, band], 0.99) if len(first) else np.zeros(0, bool)
        )
        if bright.sum() < 10:
            continue
        ratios, weights = second[bright, band] / first[bright, band], areas[bright]
        order = np.argsort(ratios)
        total = np.cumsum(weights[order])
        found[band] = ratios[order][np.searchsorted(total, total[-1] / 2)]
    return found.clip(min=1e-6)


def _judged(fixed: _Cloud, moving: _Cloud, found: Similarity, light: np.ndarray) -> Registration:
    """How well the surfaces fit; a ConfigError where they don't."""
    placed = moving.moved(found)
    away, partners = KDTree(placed.positions).query(fixed.positions)
    offsets = fixed.positions - placed.positions[partners]
    across = (offsets * placed.normals[partners]).sum(axis=1)
    both = (away < _NEAR_PX) & ((fixed.normals * placed.normals[partners]).sum(axis=1) > 0.5)
    overlap = float(fixed.areas[both].sum() / fixed.areas.sum())
    same = np.linalg.norm(fixed.colours - placed.colours[partners], axis=1) < _ALIKE
    shared = max(float(fixed.areas[both].sum()), 1e-12)
    agreement = float(fixed.areas[both & same].sum()) / shared
    rms = float(np.sqrt((fixed.areas[both] * across[both] ** 2).sum() / shared))
    in_world = Similarity(found.scale, found.rotation, found.translation * fixed.pixel)
    if overlap < _LEAST_OVERLAP or agreement < _LEAST_AGREEMENT or rms > _LARGEST_RMS_PX:
        raise ConfigError(
            f"the two captures can't be laid on each other: at best {overlap:.0%} of the first surface lies on the "
            f"second (needed: {_LEAST_OVERLAP:.0%}), of which {agreement:.0%} is of the same materials (needed: "
            f"{_LEAST_AGREEMENT:.0%}), at {rms:.2f} pixels rms; are they of one object, seen from the same sides?"
        )
    apart = np.linalg.norm(fixed.markers - placed.markers, axis=1)
    markers_px = float(np.sqrt((apart**2).mean())) if len(apart) else None
    return Registration(in_world, rms, overlap, agreement, light, markers_px)
