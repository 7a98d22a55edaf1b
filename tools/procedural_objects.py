"""Objects of seeds: shapes and layered materials like those of the built-in object, which is the first of them.

For the training of the prior, and for benchmarks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from unmix_plugin.neumatex.demo.surfaces import (
    DEMO_KINDS,
    Field,
    LayeredSurface,
    Noise,
    Pattern,
    blob,
    layered_parameters,
    meshed,
    noise_at,
    random_colour,
)
from unmix_plugin.neumatex.tracing.built_in_lights import NAMES
from unmix_plugin.neumatex.tracing.mesh import Mesh

_TRAINING_LIGHTS = ("studio", "softbox-strips", "clear-sky", "window-room", "overcast")
"""Lights that show all colours of a material; an object in colours is captured under one of them."""


def seeded_mesh(seed: int, resolution: int = 96) -> Mesh:
    """A shape of one of `SHAPES`, chosen and varied by the seed, in model space."""
    return meshed(_SHAPE_MAKERS[SHAPES[seed % len(SHAPES)]](np.random.default_rng([1, seed])), resolution)


def seeded_surface(seed: int) -> LayeredSurface:
    """Three of seven kinds of material, chosen and varied by the seed."""
    rng = np.random.default_rng([2, seed])
    chosen = rng.choice(list(_KINDS), size=3, replace=False)
    return LayeredSurface({str(kind): _KINDS[kind] for kind in chosen}, rng)


def seeded_lights(seed: int) -> list[str]:
    """A light of training, one of `_TRAINING_LIGHTS`, and all others after it."""
    rng = np.random.default_rng([3, seed])
    chosen = str(rng.choice(_TRAINING_LIGHTS))
    return [chosen, *(str(name) for name in rng.permutation(NAMES) if name != chosen)]


def _turned(field: Field, rng: np.random.Generator) -> Field:
    """The same shape in a random orientation."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return lambda p: field(p @ rotation)


def _sphere(rng: np.random.Generator) -> Field:
    noise, depth = Noise.draw(rng, 14.0), rng.uniform(0.0, 0.012)
    return lambda p: np.linalg.norm(p, axis=-1) - 1.0 - depth * noise_at(noise, p)


def _torus(rng: np.random.Generator) -> Field:
    thickness = rng.uniform(0.22, 0.4)
    flat = rng.uniform(0.8, 1.2)

    def _field(p: np.ndarray) -> np.ndarray:
        ring = np.hypot(p[:, 0], p[:, 1]) - (1.0 - thickness)
        return np.hypot(ring, p[:, 2] * flat) - thickness

    return _turned(_field, rng)


def _superquadric(rng: np.random.Generator) -> Field:
    around, along = rng.uniform(1.4, 5.0, 2)
    axes = rng.uniform(0.6, 1.0, 3)

    def _field(p: np.ndarray) -> np.ndarray:
        x, y, z = np.abs(p / axes).T + 1e-9
        flat = (x**around + y**around) ** (1 / around)
        return ((flat**along + z**along) ** (1 / along) - 1.0) * axes.min()

    return _turned(_field, rng)


def _vase(rng: np.random.Generator) -> Field:
    """Turned on a lathe, hollow and open at the top."""
    from scipy.interpolate import CubicSpline

    heights = np.linspace(-1.3, 1.3, 7)
    profile = CubicSpline(heights, rng.uniform(0.38, 0.72, 7))
    wall = rng.uniform(0.10, 0.14)

    def _field(p: np.ndarray) -> np.ndarray:
        radius, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
        outside = np.maximum(0.8 * (radius - profile(z)), np.abs(z) - 1.0)
        cavity = np.maximum(0.8 * (radius - profile(z) + wall / 0.8), -0.75 - z)
        return _smooth_max(outside, -cavity, 0.04)

    return _field


def _parts(rng: np.random.Generator) -> Field:
    """Three to five primitives that melt into each other where they touch."""
    parts = [_part(rng) for _ in range(rng.integers(3, 6))]

    def _field(p: np.ndarray) -> np.ndarray:
        values = parts[0](p)
        for part in parts[1:]:
            values = -_smooth_max(-values, -part(p), 0.08)
        # All parts reach a ball in the middle, which joins them.
        return -_smooth_max(-values, 0.38 - np.linalg.norm(p, axis=-1), 0.08)

    return _field


def _part(rng: np.random.Generator) -> Field:
    centre = rng.normal(size=3)
    centre *= rng.uniform(0.25, 0.5) / np.linalg.norm(centre)
    size = rng.uniform(0.25, 0.45)
    kind = rng.integers(3)
    if kind == 0:
        return lambda p: np.linalg.norm(p - centre, axis=-1) - size
    if kind == 1:
        box = size * rng.uniform(0.6, 1.1, 3)
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        return lambda p: _box(np.abs((p - centre) @ rotation), box)
    return _bar(centre, rng.normal(size=3), size)


def _box(p: np.ndarray, half_edges: np.ndarray) -> np.ndarray:
    """A box with rounded edges, for points of one octant."""
    beyond = p - (half_edges - 0.06)
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0) - 0.06


def _bar(centre: np.ndarray, direction: np.ndarray, size: float) -> Field:
    """A rod with round ends through the middle of the shape."""
    direction = direction / np.linalg.norm(direction)

    def _field(p: np.ndarray) -> np.ndarray:
        along = np.clip((p - centre) @ direction, -0.6, 0.6)
        return np.linalg.norm(p - centre - along[:, None] * direction, axis=-1) - 0.45 * size

    return _field


def _smooth_max(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The greater of two numbers, rounded where they differ by less than about `width`."""
    return (a + b + np.sqrt((a - b) ** 2 + width**2)) / 2


_SHAPE_MAKERS: dict[str, Callable[[np.random.Generator], Field]] = {
    "blob": blob,
    "vase": _vase,
    "parts": _parts,
    "torus": _torus,
    "superquadric": _superquadric,
    "sphere": _sphere,
}

SHAPES = tuple(_SHAPE_MAKERS)
"""In the order of seeds."""


def _metallic_tone(rng: np.random.Generator) -> np.ndarray:
    tones = ((0.95, 0.64, 0.37), (1.0, 0.78, 0.34), (0.91, 0.92, 0.92), (0.56, 0.57, 0.58), (0.8, 0.62, 0.5))
    return np.array(tones[rng.integers(len(tones))]) * rng.uniform(0.8, 1.0)


def _hazy_plastic(rng: np.random.Generator) -> Pattern:
    first, second = random_colour(rng, (0.3, 0.9), (0.4, 0.8)), random_colour(rng, (0.0, 0.5), (0.3, 0.8))
    haze = {"haze weight": rng.uniform(0.5, 1.0), "haze spread": rng.uniform(0.3, 0.8), "specular level": 0.7}
    return Pattern(
        Noise.draw(rng, rng.uniform(3, 6)),
        layered_parameters(haze | {"roughness": rng.uniform(0.12, 0.25)}, first),
        layered_parameters(haze | {"roughness": rng.uniform(0.25, 0.4)}, second),
        sharpness=14.0,
        stripes=rng.choice([0.0, 4.0]),
    )


def _dusty_gloss(rng: np.random.Generator) -> Pattern:
    colour = random_colour(rng, (0.3, 0.9), (0.1, 0.45))
    gloss = {
        "roughness": rng.uniform(0.12, 0.25),
        "specular level": 0.6,
        "coat weight": rng.choice([0.0, 0.8]),
    }
    return Pattern(
        Noise.draw(rng, rng.uniform(4, 7)),
        layered_parameters(gloss | {"dust": rng.uniform(0.0, 0.1)}, colour),
        layered_parameters(gloss | {"dust": rng.uniform(0.6, 1.0)}, colour),
        sharpness=2.5,
        stripes=0.0,
    )


def _worn_metal(rng: np.random.Generator) -> Pattern:
    tone = _metallic_tone(rng)
    return Pattern(
        Noise.draw(rng, rng.uniform(5, 9)),
        layered_parameters({"metallicity": 1.0, "roughness": rng.uniform(0.15, 0.3)}, tone),
        layered_parameters(
            {"metallicity": 1.0, "roughness": rng.uniform(0.45, 0.65)}, tone * rng.uniform(0.6, 0.9)
        ),
        sharpness=4.0,
        stripes=0.0,
    )


def _glazed_clay(rng: np.random.Generator) -> Pattern:
    clay, glaze = (
        np.array([0.55, 0.27, 0.16]) * rng.uniform(0.7, 1.2),
        random_colour(rng, (0.2, 0.8), (0.2, 0.7)),
    )
    return Pattern(
        Noise.draw(rng, rng.uniform(2.5, 5)),
        layered_parameters({"roughness": 0.9, "specular level": 0.3, "dust": 0.2}, clay),
        layered_parameters(
            {"roughness": 0.6, "coat weight": 1.0, "coat roughness": rng.uniform(0.1, 0.3)}, glaze
        ),
        sharpness=25.0,
        stripes=0.0,
    )


_KINDS: dict[str, Callable[[np.random.Generator], Pattern]] = {
    "car paint": DEMO_KINDS["car paint"],
    "velvet": DEMO_KINDS["velvet"],
    "hazy plastic": _hazy_plastic,
    "dusty gloss": _dusty_gloss,
    "coated wood": DEMO_KINDS["coated wood"],
    "worn metal": _worn_metal,
    "glazed clay": _glazed_clay,
}
