"""Pieces of a surface that changed, and what changed there by how much.

Notation: `P` vertices, `B` bands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Shaped
from scipy import stats

from unmix_plugin.comparing.captured import Surface
from unmix_plugin.comparing.significance import Difference, adjusted, is_significant
from unmix_plugin.spectral.metrics import spectral_angle

_GROWING_P = 0.05
"""p of a neighbour up to which a place goes on."""
_SMALLEST_PX, _SMALLEST_BY_DISTANCE_PX = 4.0, 100.0
"""Area in pixels below which a place is not told from noise at an edge; and of one that is known by distance alone, as
errors of distances reach about so far, unless the distance is clear: a hundredth of the level."""
_LARGEST_HOLE_PX = 30.0
"""Area of what lies within a place and belongs to it."""
_EDGE, _EDGE_RINGS = 0.5, 2
"""Part of the strongest change of spectra nearby, below which a vertex is beside a place: pixels blur its edge, and an
edge is where half of the change is there; and how many neighbours away pixels reach."""
_CLOSED_RINGS = 2
"""Neighbours that a gap in a place is wide at most, as differences of distances are no finer."""
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class Amount:
    """By how much something changed over a place: mean and interval that holds it with 95 %."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class ChangedPlace:
    """A connected piece of the first surface that changed."""

    number: int
    """From 1, by area."""
    vertices: Int64[np.ndarray, " n"]
    area: float
    """Square units of the first world."""
    center: tuple[float, float, float]
    """Of its area, in the first world."""
    what: str
    """Which of distance, spectrum and brightness stands out most."""
    p: float
    """Least of its vertices, after correction for all of the surface."""
    angle: float
    """Spectral angle between the means of the place, rad."""
    amounts: Mapping[str, Amount]
    """By quantity, as `Comparison.differences` names them: brightness as a factor, others as differences."""

    def in_words(self) -> str:
        """What changed most, for people."""
        largest = max(
            (name for name in self.amounts if name.startswith("abundance ")),
            key=lambda name: abs(np.nan_to_num(self.amounts[name].mean)),
        )
        if self.what == "distance":
            return f"surface by {self.amounts['distance'].mean:+.3g} units"
        amount = self.amounts[largest]
        text = f"{largest.removeprefix('abundance ')} by {amount.mean:+.2f}"
        return f"{text}, {self.angle:.2f} rad, {self.amounts['brightness'].mean:.2f} times as bright"


def find_places(
    surface: Surface,
    p: Float64[np.ndarray, " P"],
    differences: Mapping[str, Difference],
    means: Sequence[Float64[np.ndarray, "P B"]],
    level: float,
    pixel: float,
) -> tuple[tuple[ChangedPlace, ...], Bool[np.ndarray, " P"]]:
    """Pieces that hold a vertex whose corrected p is at most `level`, with all neighbours of small p; and their
    vertices."""
    q = adjusted(p)
    seeds = is_significant(q, level)
    edges = surface.faces[:, [0, 1, 1, 2, 2, 0, 1, 0, 2, 1, 0, 2]].reshape(-1, 2)
    relative = np.linalg.norm(means[1] - means[0], axis=1) / np.linalg.norm(means[0], axis=1).clip(min=1e-12)
    relative = np.nan_to_num(relative)
    within = relative >= _EDGE * _most_nearby(relative, edges, _EDGE_RINGS)
    within |= is_significant(differences["distance"].p, _GROWING_P)
    grown = (seeds | is_significant(p, _GROWING_P)) & within
    by_spectra = is_significant(
        adjusted(any_of([differences["spectrum"].p, differences["brightness"].p])), level
    )
    by_clear_distance = is_significant(differences["distance"].q, level / 100)
    changed = np.zeros(len(p), bool)
    for vertices in _pieces(surface, grown):
        areas = surface.areas[vertices] / pixel**2
        is_seen = areas[(by_spectra | by_clear_distance)[vertices]].sum() >= _SMALLEST_PX
        if seeds[vertices].any() and (is_seen or areas.sum() >= _SMALLEST_BY_DISTANCE_PX):
            changed[vertices] = True
    changed = ~_most_nearby(~_most_nearby(changed, edges, _CLOSED_RINGS), edges, _CLOSED_RINGS)
    changed &= np.isfinite(p)
    for hole in _pieces(surface, ~changed):
        if surface.areas[hole].sum() <= _LARGEST_HOLE_PX * pixel**2:
            changed[hole] = np.isfinite(p[hole])
    found = _pieces(surface, changed)
    found.sort(key=lambda vertices: -surface.areas[vertices].sum())
    places = [
        _place(number, vertices, surface, q, differences, means)
        for number, vertices in enumerate(found, start=1)
    ]
    return tuple(places), changed


def _most_nearby(
    values: Shaped[np.ndarray, " P"], edges: Int64[np.ndarray, "E 2"], rings: int
) -> Shaped[np.ndarray, " P"]:
    """The largest of each vertex and its neighbours, and of theirs, so many times."""
    for _ in range(rings):
        largest = values.copy()
        np.maximum.at(largest, edges[:, 0], values[edges[:, 1]])
        values = largest
    return values


def _pieces(surface: Surface, chosen: Bool[np.ndarray, " P"]) -> list[Int64[np.ndarray, " n"]]:
    """The chosen vertices in pieces that edges connect."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    inside = edges[chosen[edges].all(axis=1)]
    count = len(chosen)
    links = coo_matrix((np.ones(len(inside)), (inside[:, 0], inside[:, 1])), shape=(count, count))
    _, numbers = connected_components(links, directed=False)
    vertices = np.flatnonzero(chosen)
    order = np.argsort(numbers[vertices], kind="stable")
    starts = np.flatnonzero(np.diff(numbers[vertices][order])) + 1
    return [piece for piece in np.split(vertices[order], starts) if len(piece)]


def any_of(several: Sequence[Float64[np.ndarray, " P"]]) -> Float64[np.ndarray, " P"]:
    """Bonferroni's p of several tests at each place; NaN where none is known."""
    stacked = np.stack(several)
    known = np.isfinite(stacked)
    least = np.where(known, stacked, 1.0).min(axis=0)
    found = (least * known.sum(axis=0)).clip(max=1.0)
    return np.where(known.any(axis=0), found, np.nan)


def _place(
    number: int,
    vertices: Int64[np.ndarray, " n"],
    surface: Surface,
    q: Float64[np.ndarray, " P"],
    differences: Mapping[str, Difference],
    means: Sequence[Float64[np.ndarray, "P B"]],
) -> ChangedPlace:
    areas = surface.areas[vertices]
    center = areas @ surface.positions[vertices] / max(areas.sum(), 1e-30)
    what = max(
        ("distance", "spectrum", "brightness"),
        key=lambda name: _standing_out(differences[name], vertices, surface.areas),
    )
    amounts = {
        name: amount_over(name, one, vertices, surface.areas)
        for name, one in differences.items()
        if one.mean.shape[1] == 1
    }
    return ChangedPlace(
        number,
        vertices,
        float(areas.sum()),
        (float(center[0]), float(center[1]), float(center[2])),
        what,
        float(np.nanmin(q[vertices])),
        angle_over(means, vertices),
        amounts,
    )


def _standing_out(
    found: Difference, vertices: Int64[np.ndarray, " n"], areas: Float64[np.ndarray, " P"]
) -> float:
    """How many errors of one vertex the mean over a place is from nothing; 0 where nothing is known."""
    means, errors = found.mean[vertices], found.error[vertices]
    known = np.isfinite(means).all(axis=1) & np.isfinite(errors).all(axis=1)
    if not known.any():
        return 0.0
    weights = areas[vertices][known] + 1e-30
    mean = np.linalg.norm(weights @ means[known] / weights.sum())
    return float(mean / max(np.sqrt((weights @ errors[known] ** 2 / weights.sum()).sum()), 1e-30))


def angle_over(means: Sequence[Float64[np.ndarray, "P B"]], vertices: Int64[np.ndarray, " n"]) -> float:
    """Spectral angle (rad) between the mean spectra of some vertices; NaN where none is known."""
    chosen = [one[vertices] for one in means]
    known = np.isfinite(chosen[0]).all(axis=1) & np.isfinite(chosen[1]).all(axis=1)
    if not known.any():
        return float("nan")
    spectra = [torch.from_numpy(one[known].mean(axis=0)) for one in chosen]
    return float(spectral_angle(*spectra))


def amount_over(
    name: str,
    found: Difference,
    vertices: Int64[np.ndarray, " n"],
    areas: Float64[np.ndarray, " P"],
) -> Amount:
    """Mean over some vertices; its error is that of one of them, as errors of neighbours are one error. Brightness is a
    factor."""
    values, errors = found.mean[vertices, 0], found.error[vertices, 0]
    known = np.isfinite(values) & np.isfinite(errors)
    if not known.any():
        return Amount(np.nan, np.nan, np.nan)
    weights = areas[vertices][known] + 1e-30
    mean = float(weights @ values[known] / weights.sum())
    error = float(np.sqrt(weights @ errors[known] ** 2 / weights.sum()))
    reach = float(stats.norm.ppf((1 + _CONFIDENCE) / 2)) * error
    amounts = (mean, mean - reach, mean + reach)
    return Amount(*(float(np.exp(value)) for value in amounts)) if name == "brightness" else Amount(*amounts)
