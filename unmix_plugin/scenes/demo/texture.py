"""Speckled surfaces for the demo scene: two materials mixed at random in space, as in terrazzo or printed paper.

Structure from motion finds nothing on plain surfaces. Speckles change abundances only: light, forms and gloss stay,
and every point is still a mixture of two of the scene's materials.

Notation: `P` points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32

from unmix_plugin.scenes.demo.materials import Blend, smooth_step
from unmix_plugin.scenes.demo.shading import THINGS, Thing

_LATTICE = 96
"""Cells along each side of the random block, after which it repeats."""

_OCTAVES = ((6.0, 0.25), (17.0, 0.3), (45.0, 0.45))
"""Cells per scene unit, and share of the sum. The smallest cells are 3 pixels of a view of 400."""

_CONTRAST = (0.35, 0.65)
"""Sums below the first are one material alone, above the second the other."""


def speckled_things() -> Sequence[Thing]:
    """The demo scene's objects with speckles on every surface."""
    return tuple(
        replace(thing, surface=replace(thing.surface, second=second, blend=_speckled(thing, strength, seed)))
        for seed, (thing, second, strength) in enumerate(zip(THINGS, _SECOND, _STRENGTH, strict=True))
    )


_SECOND = ("red", "yellow", "white", "yellow", "green")
"""The second material of each of `THINGS`: its own, but for the last, which is of one material."""

_STRENGTH = (1.0, 0.8, 0.8, 0.8, 0.9)
"""How far speckles replace the pattern of each thing, in [0, 1]."""


def solid_noise(points: Float[np.ndarray, "P 3"], seed: int) -> Float32[np.ndarray, " P"]:
    """Smooth random values in [0, 1], the same for the same place.

    Args:
        points: In units of the scene.
        seed: Another one gives another pattern.
    """
    from scipy.ndimage import map_coordinates

    total = np.zeros(len(points), np.float32)
    for octave, (cells, share) in enumerate(_OCTAVES):
        # An irrational offset keeps the lattices of the octaves from meeting.
        places = points.T * cells + np.sqrt(2) * (1 + octave + 7 * seed)
        total += share * map_coordinates(
            _random_block(), places, order=1, mode="grid-wrap", output=np.float32
        )
    return total


def _speckled(thing: Thing, strength: float, seed: int) -> Blend:
    """The thing's blend with speckles over it."""
    sizes = np.asarray(thing.placement.half_sizes, np.float32)

    def blend(local_points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
        speckles = smooth_step(solid_noise(local_points * sizes, seed), *_CONTRAST)
        return (1 - strength) * thing.surface.blend(local_points) + strength * speckles

    return blend


@lru_cache(maxsize=1)
def _random_block() -> Float32[np.ndarray, "X Y Z"]:
    return np.random.default_rng(20).random((_LATTICE,) * 3, dtype=np.float32)
