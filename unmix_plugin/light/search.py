"""Where the lamp that moves with the camera is, by the brightness of places on the hull, before any training.

A place is as bright as a matt surface in the light of a lamp and of its surroundings:

    log y = a + b log(A + V max(0, c))

with a number a for each place, the cosine c between its normal and the direction to the lamp, and V = 0 where the hull
stands in the way. Lamps in all directions are tried in two frames, one that turns about the turntable's axis with the
camera and the camera's own; the one that explains most of the changes is moved until no other explains more. Both
halves of the places must find the same lamp, and together need its shadows to explain what they see.

Notation: `P` places, `N` views, `R` cells along an edge, `S` pairs of a place and a view that sees it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.engine.geometry.camera_paths import nearest_to_axes
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.light.lamp import Lamp, LampFrame, MovingLamp, Triple
from unmix_plugin.scenes.geometry.carving import Cells
from unmix_plugin.scenes.geometry.lighting import Pictures, Places, Seen, coarse_hull, seen_places

LEAST_SHARE = 0.15
"""Of the changes of brightness within places, that a lamp must explain to be accepted."""
LEAST_SHADOWS = 0.003
"""Part of the changes that its shadows must explain beside, in the mean over both halves of the places."""
NUM_DIRECTIONS, NUM_KEPT = 300, 6
"""Directions that are tried in each frame without shadows, and the best of each that are tried with shadows."""
FEWEST_VIEWS, FEWEST_PLACES = 4, 50
DARKEST_LOG = -1.5
"""Log brightness below which places of like colours are dark for other reasons than the lamp."""
AMBIENT = 0.5
"""A: light of the surroundings, in that of the lamp on a place that faces it."""
FIRST_DISTANCE, LEAST_DISTANCE, LARGEST_DISTANCE = 2.0, 1.0, 3.0
"""Of the lamp from the turntable's middle, in the box's longest edge."""
FIRST_MOVE, LEAST_MOVE = 0.15, 0.02
"""Of the lamp, in its distance."""
CLEAR_CELLS, DARK_CELLS = 3, 2.0
"""Way from a place to the lamp, in cells of the hull, that casts no shadow; and cells that leave 1 / e of its light."""
LEAST_AGREEMENT = 0.94
"""Cosine between the directions that either half of the places finds."""

Candidate = tuple[float, Lamp]
"""Share of the changes that a lamp explains, and the lamp."""


class _LampEvidence:
    """Places of a hull that enough views see, and how bright these show them."""

    def __init__(self, cameras: Cameras, places: Places, seen: Seen, hull: Cells, box: SceneBox) -> None:
        """Arguments as `seen_places` gives and takes them."""
        known = seen.isfinite() & (seen.isfinite().sum(dim=1, keepdim=True) >= FEWEST_VIEWS)
        self.place, view = known.nonzero().unbind(-1)
        """Of each pair of a place and a view that sees it."""
        self.positions, self.normals = places.positions[self.place], places.normals[self.place]
        self.origins = cameras.camera_to_world[view, :, 3]
        self.changes = _within(seen[known], self.place)
        """Of log brightness, from its mean over the views of the place."""
        self.hull, self.box = torch.from_numpy(coarse_hull(hull)), box

    def share(self, lamp: Lamp, with_shadows: bool = True) -> float:
        """Part of the squared changes that the light of a lamp explains."""
        with torch.no_grad():
            stands = MovingLamp(lamp).positions(self.origins)
        towards = normalize(stands - self.positions, dim=-1)
        light = (towards * self.normals).sum(dim=-1).clamp(min=0)
        if with_shadows:
            light = light * self._visible(towards)
        expected = _within(torch.log(AMBIENT + light), self.place)
        slope = (expected * self.changes).sum() / expected.square().sum().clamp(min=1e-12)
        residual = (self.changes - slope.clamp(min=0) * expected).square().sum()
        return float(1 - residual / self.changes.square().sum().clamp(min=1e-12))

    def _visible(self, towards: Float[Tensor, "S 3"]) -> Float[Tensor, " S"]:
        """Part of the light from these directions that the hull lets through to each place."""
        cells = len(self.hull)
        place, step = self.box.normalise(self.positions) * cells, normalize(towards / self.box.size, dim=-1)
        counts = torch.zeros(len(place))
        for i in range(CLEAR_CELLS, 2 * cells):
            at = place + i * step
            inside = ((at >= 0) & (at < cells)).all(dim=-1)
            if not bool(inside.any()):
                break
            x, y, z = at.long().clamp(0, cells - 1).unbind(-1)
            counts += inside & self.hull[x, y, z]
        return torch.exp(-(counts / DARK_CELLS).square())


def find_lamp(cameras: Cameras, log_shading: Pictures, hull: Cells, box: SceneBox) -> Lamp | None:
    """The lamp that explains most of the changes of brightness, given as of `seen_places` and as far as they are not
    those of a pixel's colour; None where none explains enough, its shadows explain nothing, or halves of the places
    find different lamps."""
    places, seen = seen_places(cameras, log_shading, hull, box)
    seen, is_even = seen.clamp(min=DARKEST_LOG), torch.arange(len(seen)) % 2 == 0
    found: list[Candidate] = []
    by_shadows = 0.0
    for half in (is_even, ~is_even):
        part = Places(places.positions[half], places.normals[half])
        evidence = _LampEvidence(cameras, part, seen[half], hull, box)
        if len(evidence.place.unique()) < FEWEST_PLACES:
            return None
        share, lamp = _best_lamp(evidence, cameras)
        if share < LEAST_SHARE:
            return None
        by_shadows += 0.5 * (share - evidence.share(lamp, with_shadows=False))
        found.append((share, lamp))
    if by_shadows < LEAST_SHADOWS:
        return None
    one, other = (normalize(torch.tensor(lamp.place), dim=0) for _, lamp in found)
    agree = found[0][1].frame == found[1][1].frame and float(one @ other) > LEAST_AGREEMENT
    return max(found, key=lambda candidate: candidate[0])[1] if agree else None


def _best_lamp(evidence: _LampEvidence, cameras: Cameras) -> Candidate:
    """The lamp whose light explains most."""
    middle, axis = turning_axis(cameras)
    distance = FIRST_DISTANCE * float(evidence.box.size.max())
    frames: tuple[LampFrame, ...] = ("turntable", "camera")
    kept: list[Lamp] = []
    for frame in frames:
        lamps = [Lamp(frame, middle, axis, _triple(distance * v)) for v in _sphere(NUM_DIRECTIONS)]
        kept += sorted(lamps, key=lambda lamp: -evidence.share(lamp, with_shadows=False))[:NUM_KEPT]
    best = max(((evidence.share(lamp), lamp) for lamp in kept), key=lambda found: found[0])
    move = FIRST_MOVE
    while move > LEAST_MOVE:
        tried = [(evidence.share(lamp), lamp) for lamp in _moved(best[1], move, evidence.box)]
        found = max([best, *tried], key=lambda found: found[0])
        move = move / 2 if found is best else move
        best = found
    return best


def turning_axis(cameras: Cameras) -> tuple[Triple, Triple]:
    """The point nearest to all lines of sight, and the unit vector upwards to which the cameras' right sides are
    perpendicular."""
    rotations = cameras.camera_to_world[:, :, :3]
    axis = torch.linalg.svd(rotations[:, :, 0]).Vh[-1]
    if float(rotations[:, :, 1].mean(dim=0) @ axis) < 0:
        axis = -axis
    middle = nearest_to_axes(cameras.camera_to_world.double().numpy())
    return _triple(torch.from_numpy(middle)), _triple(axis)


def _moved(lamp: Lamp, move: float, box: SceneBox) -> list[Lamp]:
    """The lamp a little to all sides, nearer and farther."""
    place = torch.tensor(lamp.place)
    towards, distance = normalize(place, dim=0), float(place.norm())
    aside = torch.linalg.svd(towards[None]).Vh[1:] * move * distance
    steps = [*aside, *-aside, 2 * move * place, -2 * move * place]
    longest = float(box.size.max())
    return [
        replace(lamp, place=_triple(place + step))
        for step in steps
        if LEAST_DISTANCE * longest <= float((place + step).norm()) <= LARGEST_DISTANCE * longest
    ]


def _within(values: Float[Tensor, " S"], place: Int[Tensor, " S"]) -> Float[Tensor, " S"]:
    """Values without the mean of their place."""
    count = int(place.max()) + 1 if len(place) else 0
    totals = values.new_zeros(count).index_add_(0, place, values)
    return values - (totals / place.bincount(minlength=count).clamp(min=1))[place]


def _sphere(count: int) -> Float[Tensor, "count 3"]:
    """Evenly spread unit vectors."""
    i = torch.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, i * np.pi * (3 - 5**0.5)
    flat = (1 - z * z).sqrt()
    return torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=-1)


def _triple(vector: Float[Tensor, "3"]) -> Triple:
    x, y, z = vector.tolist()
    return (x, y, z)
