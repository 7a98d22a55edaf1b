"""The demo scene's materials, objects and light: what a camera ray gathers, as coefficients that no band enters.

Notation: `R` rays, `P` points, `B` bands, `K` materials, `H`, `W` rows and columns. Reflectances are in [0, 1], the
lamp's power is relative, largest band 1. Abundances of a point are fractions of its area, >= 0, summing to 1. The
radiance of a point is lamp * (diffuse @ reflectances + specular): `diffuse` (K) is abundance times irradiance,
`specular` a number, since a clear coat mirrors the lamp in the lamp's own colour. Both are linear, so pixels average
coefficients and the spectrum is applied once a pixel. Nothing is random: every subpixel sees the lamp's disc at a fixed
point of it, and the sky's occlusion has a closed form. Surfaces may be speckled with a second material, as in terrazzo
or printed paper: structure from motion finds nothing on plain ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.scenes.demo.shapes import PerRay, PlacedPrimitive, Points, Rays, dot, first_hits
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power

PerPoint = Float[np.ndarray, " P"]
_Place = tuple[float, float, float]
MATERIALS = ("white", "red", "yellow", "green", "cyan", "purple")
"""Six patches of the ColorChecker chart; the spectral angle between any two under the lamp is at least 0.45 rad."""
_PATCHES = ("white 9.5 (.05 D)", *MATERIALS[1:])
_RANGE_NM = (400.0, 700.0)
LAMP = "D50"
"""CIE illuminant of the lamp and of the sky."""
Blend = Callable[[Points], PerPoint]
"""Share of the second material at points in a shape's own coordinates."""


def band_centers_nm(bands: int) -> Float[np.ndarray, " B"]:
    """Evenly spaced band centres over 400-700 nm, ends included."""
    return np.linspace(*_RANGE_NM, bands)


def reflectances(wavelengths_nm: Float[np.ndarray, " B"]) -> Float[np.ndarray, "K B"]:
    """Reflectance of every material, in the order of `MATERIALS`.

    Source:
        The average of 30 ColorChecker charts measured by BabelColor, 380-730 nm in steps of 10 nm.
    """
    # Imported here because colour-science takes more than a second.
    from colour.characterisation import SDS_COLOURCHECKERS

    chart = SDS_COLOURCHECKERS["BabelColor Average"]
    return np.stack(
        [np.interp(wavelengths_nm, chart[name].wavelengths, chart[name].values) for name in _PATCHES]
    )


def lamp_power(
    wavelengths_nm: Float[np.ndarray, " B"], illuminant: str | Path = LAMP
) -> Float[np.ndarray, " B"]:
    """Relative power of the lamp and of the sky, which share one spectrum: largest value 1; see `illuminant_power`."""
    return illuminant_power(illuminant, Bands.of(wavelengths_nm))


@dataclass(frozen=True)
class Surface:
    """Two materials and where on a shape which of them shows."""

    first: str
    second: str
    blend: Blend
    roughness: float | None = None
    """GGX alpha of the clear coat; None is matt."""

    def abundances(self, local_points: Points) -> Float[np.ndarray, "P K"]:
        """Abundances at points in the shape's own coordinates."""
        share = self.blend(local_points)
        result = np.zeros((len(local_points), len(MATERIALS)), dtype=local_points.dtype)
        result[:, MATERIALS.index(self.first)] += 1 - share
        result[:, MATERIALS.index(self.second)] += share
        return result


def smooth_step(values: PerPoint, low: float, high: float) -> PerPoint:
    """0 below `low`, 1 above `high`, a cubic with level ends between."""
    t = ((values - low) / (high - low)).clip(0, 1)
    return t * t * (3 - 2 * t)


def _gingham(points: Points) -> PerPoint:
    """Woven squares: warp and weft each carry half of the second material; a plain rim below the top."""
    stripes = [smooth_step(np.sin(points[:, axis] * 10.5 + 0.8), -0.25, 0.25) for axis in (0, 1)]
    on_top = points[:, 2] > 0.999
    return np.where(on_top, (stripes[0] + stripes[1]) / 2, 1)


def _blush(points: Points) -> PerPoint:
    """A slow gradient over one side."""
    return smooth_step(points @ np.array([0.75, 0.5, 0.43], dtype=points.dtype), -0.15, 1.1)


def _ribbon(points: Points) -> PerPoint:
    """A parcel's crossed ribbons, with slightly soft borders."""
    across = np.minimum(np.abs(points[:, 0]), np.abs(points[:, 1]))
    return 1 - smooth_step(across, 0.2, 0.27)


def _candy_stripes(points: Points) -> PerPoint:
    """A soft helix around the side; a plain top."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    share = smooth_step(np.sin(2 * angle + points[:, 2] * 4.5), -0.45, 0.45)
    return np.where(np.abs(points[:, 2]) > 0.999, 0, share)


def plain(points: Points) -> PerPoint:
    """The first material alone."""
    return np.zeros(len(points), dtype=points.dtype)


LAMP_POSITION = (2.6, -2.2, 4.2)
_LAMP_RADIUS = 0.55
LAMP_IRRADIANCE = 0.7
"""On a surface that faces the lamp; with the sky it keeps a white wall just below 1."""
_SKY_IRRADIANCE = 0.34
_BOUNCE_SHARE = 0.35
"""What a surface that faces down receives, as a share of the open sky."""
COAT_REFLECTANCE = 0.05
"""Fresnel reflectance of the clear coats at normal incidence."""
_SUBPIXELS = 3
"""Rays along each side of a pixel."""
_RAYS_AT_ONCE = 2**14
"""So many, where an image has fewer pixels: numpy takes as long for a few as for thousands."""


@dataclass(frozen=True)
class Thing:
    """One object: its form, its surface, and the balls that stand for it where it hides the sky."""

    placement: PlacedPrimitive
    surface: Surface
    sky_blockers: tuple[tuple[float, float, float, float], ...] = ()
    """Balls as (x, y, z, radius) in the world."""


THINGS = (
    Thing(
        PlacedPrimitive("cylinder", (0.0, 0.0, -0.06), (1.3, 1.3, 0.06)), Surface("white", "red", _gingham)
    ),
    Thing(
        PlacedPrimitive("sphere", (-0.5, -0.42, 0.4), (0.44, 0.44, 0.4)),
        Surface("green", "yellow", _blush, roughness=0.1),
        ((-0.5, -0.42, 0.4, 0.42),),
    ),
    Thing(
        PlacedPrimitive("box", (0.5, 0.42, 0.3), (0.34, 0.34, 0.3), turn_deg=28.0),
        Surface("cyan", "white", _ribbon),
        ((0.5, 0.42, 0.3, 0.36),),
    ),
    Thing(
        PlacedPrimitive("cylinder", (-0.42, 0.56, 0.42), (0.24, 0.24, 0.42)),
        Surface("purple", "yellow", _candy_stripes),
        ((-0.42, 0.56, 0.22, 0.26), (-0.42, 0.56, 0.62, 0.26)),
    ),
    Thing(
        PlacedPrimitive("sphere", (0.42, -0.52, 0.25), (0.36, 0.25, 0.25), turn_deg=-35.0),
        Surface("yellow", "yellow", plain, roughness=0.15),
        ((0.42, -0.52, 0.25, 0.28),),
    ),
)

Sky = Callable[[Rays], Float[np.ndarray, "R K"]]
"""From directions to what the sky there sends, in multiples of the materials as the lamp shows them."""


@dataclass(frozen=True)
class ViewCoefficients:
    """One view, averaged over each pixel's rays; rays that hit nothing count as black and transparent."""

    alpha: Float[np.ndarray, "H W"]
    abundances: Float[np.ndarray, "H W K"]
    """Fractions of what is covered: they sum to 1 where alpha > 0, and are 0 elsewhere; the sky covers nothing."""
    diffuse: Float[np.ndarray, "H W K"]
    specular: Float[np.ndarray, "H W"]


@dataclass(frozen=True)
class _Hits:
    """What rays see; rows of rays that hit nothing are 0."""

    is_hit: Bool[np.ndarray, " R"]
    abundances: Float[np.ndarray, "R K"]
    diffuse: Float[np.ndarray, "R K"]
    specular: PerRay


def render_view(
    cameras: Cameras,
    index: int,
    subpixels: int = _SUBPIXELS,
    things: Sequence[Thing] = THINGS,
    lamp: _Place = LAMP_POSITION,
    sky: Sky | None = None,
) -> ViewCoefficients:
    """Look at things through one camera with `subpixels`^2 rays per pixel; `lamp` is the middle of its disc."""
    count = subpixels**2
    pixels = cameras.height * cameras.width
    coverage = np.zeros(pixels, dtype=np.float32)
    abundances = np.zeros((pixels, len(MATERIALS)), dtype=np.float32)
    diffuse, specular = np.zeros_like(abundances), np.zeros_like(coverage)
    at_once = max(1, _RAYS_AT_ONCE // pixels)
    for first in range(0, count, at_once):
        numbers = range(first, min(first + at_once, count))
        offsets = [((i % subpixels + 0.5) / subpixels, (i // subpixels + 0.5) / subpixels) for i in numbers]
        rays = [cameras.image_rays(index, offset) for offset in offsets]
        origins, directions = (
            np.concatenate([getattr(one, name).numpy() for one in rays]) for name in ("origins", "directions")
        )
        lamps = np.stack([_lamp_point(i, count, lamp) for i in numbers]).repeat(pixels, axis=0)
        hits = trace(origins, directions, lamps, things, lamp)
        if sky is not None:
            hits.diffuse[~hits.is_hit] = sky(directions[~hits.is_hit])
        seen = (hits.is_hit, hits.abundances, hits.diffuse, hits.specular)
        for total, values in zip((coverage, abundances, diffuse, specular), seen, strict=True):
            total += values.reshape(len(numbers), *total.shape).sum(axis=0)
    shape = (cameras.height, cameras.width)
    return ViewCoefficients(
        (coverage / count).reshape(shape),
        (abundances / np.maximum(coverage, 1)[:, None]).reshape(*shape, -1),
        (diffuse / count).reshape(*shape, -1),
        (specular / count).reshape(shape),
    )


def trace(
    origins: Rays,
    directions: Rays,
    lamps: Float[np.ndarray, "#R 3"],
    things: Sequence[Thing] = THINGS,
    lamp_middle: _Place = LAMP_POSITION,
) -> _Hits:
    """What each ray sees first, lit by one point of the lamp and by the sky; highlights come from the lamp's middle.
    Directions have length 1."""
    placements = [thing.placement for thing in things]
    distances, nearest = first_hits(placements, origins, directions)
    is_hit = np.isfinite(distances)
    shape = (len(origins), len(MATERIALS))
    abundances, diffuse = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    specular = np.zeros(len(origins), dtype=np.float32)
    lamps = np.broadcast_to(lamps, origins.shape)
    for i, thing in enumerate(things):
        rows = np.flatnonzero(is_hit & (nearest == i))
        points = origins[rows] + distances[rows, None] * directions[rows]
        local_points = thing.placement.to_local(points)
        normals = thing.placement.normals_at(local_points)
        lamplight = direct_light(points, normals, lamps[rows], placements)
        abundances[rows] = thing.surface.abundances(local_points)
        diffuse[rows] = abundances[rows] * (lamplight + _sky_light(points, normals, thing, things))[:, None]
        if thing.surface.roughness is not None:
            highlight = coat_highlight(
                points, normals, -directions[rows], thing.surface.roughness, lamp_middle
            )
            specular[rows] = lamplight * highlight
    return _Hits(is_hit, abundances, diffuse, specular)


def _lamp_point(i: int, count: int, middle: _Place) -> Float[np.ndarray, "3"]:
    """The i-th of `count` points that are spread evenly over the lamp's horizontal disc.

    Source:
        Vogel 1979, the sunflower spiral. The order strides through the spiral, so that neighbouring rays of a pixel
        see far apart points.
    """
    rank = i * 7 % count if count % 7 else i
    angle, radius = rank * np.pi * (3 - np.sqrt(5)), _LAMP_RADIUS * np.sqrt((rank + 0.5) / count)
    offset = np.array([radius * np.cos(angle), radius * np.sin(angle), 0])
    return (np.array(middle) + offset).astype(np.float32)


def direct_light(
    points: Points, normals: Points, lamps: Float[np.ndarray, "#P 3"], placements: Sequence[PlacedPrimitive]
) -> PerPoint:
    """Irradiance of each point from one of the lamp's: 0 in the shadow of `placements`, no fall-off with distance."""
    towards_lamp = lamps - points
    cosines = (dot(towards_lamp, normals) / np.sqrt(dot(towards_lamp, towards_lamp))).clip(0)
    # The segment to the lamp has length 1: a ceiling lies farther away.
    blocked, _ = first_hits(placements, points + 1e-3 * normals, towards_lamp)
    return np.where(blocked < 1, 0, LAMP_IRRADIANCE * cosines).astype(np.float32)


def _sky_light(points: Points, normals: Points, thing: Thing, things: Sequence[Thing]) -> PerPoint:
    """Irradiance from a sky of one brightness and from the ground, less what other things hide of it.

    Source:
        A ball of radius r at distance d, all of it above the horizon, hides (r / d)^2 cos of a cosine-weighted
        hemisphere; the power 1.5 for one that the horizon cuts is the fit of I. Quilez, "sphere ambient occlusion".
    """
    open_share = np.ones(len(points), dtype=np.float32)
    for other in things:
        for *center, radius in other.sky_blockers if other.placement is not thing.placement else ():
            offsets = np.asarray(center, dtype=np.float32) - points
            lengths = np.sqrt(dot(offsets, offsets))
            cosines = dot(offsets, normals) / lengths
            ratio = np.maximum(lengths / radius, 1)
            is_cut = np.abs(cosines) * ratio < 1
            whole = cosines.clip(0) / ratio**2
            cut = ((cosines * ratio + 1) / (2 * ratio**2)).clip(0, 1) ** 1.5
            open_share *= 1 - np.where(is_cut, cut, whole)
    facing_up = (1 + normals[:, 2]) / 2
    return _SKY_IRRADIANCE * (_BOUNCE_SHARE + (1 - _BOUNCE_SHARE) * facing_up) * open_share


def coat_highlight(
    points: Points, normals: Points, towards_eye: Points, roughness: float, lamp_middle: _Place
) -> PerPoint:
    """Mirrored radiance for irradiance 1 from the lamp's centre, in units of a white matt surface's.

    Source:
        Walter et al. 2007 (GGX; separable Smith term), Schlick 1994 (Fresnel); times pi, for a matt white surface has
        a reflectance distribution of 1 / pi.
    """
    towards_lamp = np.asarray(lamp_middle, dtype=np.float32) - points
    towards_lamp /= np.sqrt(dot(towards_lamp, towards_lamp))[:, None]
    halfway = towards_lamp + towards_eye
    halfway /= np.sqrt(dot(halfway, halfway))[:, None]
    cos_half = dot(halfway, normals).clip(0)
    cos_eye = dot(towards_eye, normals).clip(1e-3)
    cos_lamp = dot(towards_lamp, normals).clip(1e-3)
    a2 = roughness**2
    distribution = a2 / (np.pi * (1 + cos_half**2 * (a2 - 1)) ** 2)
    # The Smith term over 4 cos_eye cos_lamp, simplified.
    shadowing = 1.0
    for cosine in (cos_eye, cos_lamp):
        shadowing = shadowing / (cosine + np.sqrt(a2 + (1 - a2) * cosine**2))
    fresnel = COAT_REFLECTANCE + (1 - COAT_REFLECTANCE) * (1 - dot(halfway, towards_eye).clip(0, 1)) ** 5
    return np.pi * distribution * shadowing * fresnel


_LATTICE = 96
"""Cells along each side of the random block, after which it repeats."""
_OCTAVES = ((6.0, 0.25), (17.0, 0.3), (45.0, 0.45))
"""Cells per scene unit, and share of the sum. The smallest cells are 3 pixels of a view of 400."""
_CONTRAST = (0.35, 0.65)
"""Sums below the first are one material alone, above the second the other."""
_SECOND = ("red", "yellow", "white", "yellow", "green")
"""The second material of each of `THINGS`: its own, but for the last, which is of one material."""
_STRENGTH = (1.0, 0.8, 0.8, 0.8, 0.9)
"""How far speckles replace the pattern of each thing, in [0, 1]."""


def speckled_things() -> Sequence[Thing]:
    """The demo scene's objects with speckles on every surface."""
    return tuple(
        replace(thing, surface=replace(thing.surface, second=second, blend=_speckled(thing, strength, seed)))
        for seed, (thing, second, strength) in enumerate(zip(THINGS, _SECOND, _STRENGTH, strict=True))
    )


def _solid_noise(points: Points, seed: int) -> Float32[np.ndarray, " P"]:
    """Smooth random values in [0, 1], the same for the same place, in units of the scene, and seed."""
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

    def blend(local_points: Points) -> PerPoint:
        speckles = smooth_step(_solid_noise(local_points * sizes, seed), *_CONTRAST)
        return (1 - strength) * thing.surface.blend(local_points) + strength * speckles

    return blend


@lru_cache(maxsize=1)
def _random_block() -> Float32[np.ndarray, "X Y Z"]:
    return np.random.default_rng(20).random((_LATTICE,) * 3, dtype=np.float32)
