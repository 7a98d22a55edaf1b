"""The demo scene's objects and light: what a camera ray gathers, as coefficients that no band enters.

Notation: `R` rays, `P` points, `K` materials, `H`, `W` rows and columns. The radiance of a point is
lamp * (diffuse @ reflectances + specular): `diffuse` (K) is abundance times irradiance, `specular` a number, since a
clear coat mirrors the lamp in the lamp's own colour. Both are linear, so pixels average coefficients and the spectrum
is applied once a pixel. Nothing is random: every subpixel sees the lamp's disc at a fixed point of it, and the sky's
occlusion has a closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.scenes.demo.materials import (
    MATERIALS,
    Surface,
    blush,
    candy_stripes,
    gingham,
    plain,
    ribbon,
)
from unmix_plugin.scenes.demo.shapes import Placement, dot, first_hits

LAMP_POSITION = (2.6, -2.2, 4.2)
LAMP_RADIUS = 0.55
LAMP_IRRADIANCE = 0.7
"""On a surface that faces the lamp; with the sky it keeps a white wall just below 1."""
SKY_IRRADIANCE = 0.34
BOUNCE_SHARE = 0.35
"""What a surface that faces down receives, as a share of the open sky."""
COAT_REFLECTANCE = 0.05
"""Fresnel reflectance of the clear coats at normal incidence."""

SUBPIXELS = 3
"""Rays along each side of a pixel."""

_RAYS_AT_ONCE = 2**14
"""So many, where an image has fewer pixels: numpy takes as long for a few as for thousands."""


@dataclass(frozen=True)
class Thing:
    """One object: its form, its surface, and the balls that stand for it where it hides the sky."""

    placement: Placement
    surface: Surface
    sky_blockers: tuple[tuple[float, float, float, float], ...] = ()
    """Balls as (x, y, z, radius) in the world."""


THINGS = (
    Thing(Placement("cylinder", (0.0, 0.0, -0.06), (1.3, 1.3, 0.06)), Surface("white", "red", gingham)),
    Thing(
        Placement("sphere", (-0.5, -0.42, 0.4), (0.44, 0.44, 0.4)),
        Surface("green", "yellow", blush, roughness=0.1),
        ((-0.5, -0.42, 0.4, 0.42),),
    ),
    Thing(
        Placement("box", (0.5, 0.42, 0.3), (0.34, 0.34, 0.3), turn_deg=28.0),
        Surface("cyan", "white", ribbon),
        ((0.5, 0.42, 0.3, 0.36),),
    ),
    Thing(
        Placement("cylinder", (-0.42, 0.56, 0.42), (0.24, 0.24, 0.42)),
        Surface("purple", "yellow", candy_stripes),
        ((-0.42, 0.56, 0.22, 0.26), (-0.42, 0.56, 0.62, 0.26)),
    ),
    Thing(
        Placement("sphere", (0.42, -0.52, 0.25), (0.36, 0.25, 0.25), turn_deg=-35.0),
        Surface("yellow", "yellow", plain, roughness=0.15),
        ((0.42, -0.52, 0.25, 0.28),),
    ),
)

PLACEMENTS = tuple(thing.placement for thing in THINGS)

Sky = Callable[[Float[np.ndarray, "R 3"]], Float[np.ndarray, "R K"]]
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
class Hits:
    """What rays see; rows of rays that hit nothing are 0."""

    is_hit: Bool[np.ndarray, " R"]
    abundances: Float[np.ndarray, "R K"]
    diffuse: Float[np.ndarray, "R K"]
    specular: Float[np.ndarray, " R"]


def render_view(
    cameras: Cameras,
    index: int,
    subpixels: int = SUBPIXELS,
    things: Sequence[Thing] = THINGS,
    lamp: tuple[float, float, float] = LAMP_POSITION,
    sky: Sky | None = None,
) -> ViewCoefficients:
    """Look at the scene through one camera with `subpixels`^2 rays a pixel.

    Args:
        things: What there is.
        lamp: Middle of the lamp's disc.
        sky: What shows behind it; None is black.
    """
    count = subpixels**2
    pixels = cameras.height * cameras.width
    coverage = np.zeros(pixels, dtype=np.float32)
    abundances = np.zeros((pixels, len(MATERIALS)), dtype=np.float32)
    diffuse, specular = np.zeros_like(abundances), np.zeros_like(coverage)
    at_once = max(1, _RAYS_AT_ONCE // pixels)
    for first in range(0, count, at_once):
        numbers = range(first, min(first + at_once, count))
        rays = [cameras.image_rays(index, _offset(i, subpixels)) for i in numbers]
        origins, directions = (
            np.concatenate([getattr(one, name).numpy() for one in rays]) for name in ("origins", "directions")
        )
        lamps = np.stack([lamp_point(i, count, lamp) for i in numbers]).repeat(pixels, axis=0)
        hits = trace(origins, directions, lamps, things, lamp)
        if sky is not None:
            hits.diffuse[~hits.is_hit] = sky(directions[~hits.is_hit])
        for total, values in (
            (coverage, hits.is_hit),
            (abundances, hits.abundances),
            (diffuse, hits.diffuse),
            (specular, hits.specular),
        ):
            total += values.reshape(len(numbers), *total.shape).sum(axis=0)
    shape = (cameras.height, cameras.width)
    return ViewCoefficients(
        (coverage / count).reshape(shape),
        (abundances / np.maximum(coverage, 1)[:, None]).reshape(*shape, -1),
        (diffuse / count).reshape(*shape, -1),
        (specular / count).reshape(shape),
    )


def _offset(i: int, subpixels: int) -> tuple[float, float]:
    """Where in its pixel the i-th ray goes through, (x, y) in [0, 1]."""
    return (i % subpixels + 0.5) / subpixels, (i // subpixels + 0.5) / subpixels


def trace(
    origins: Float[np.ndarray, "R 3"],
    directions: Float[np.ndarray, "R 3"],
    lamps: Float[np.ndarray, "#R 3"],
    things: Sequence[Thing] = THINGS,
    lamp_middle: tuple[float, float, float] = LAMP_POSITION,
) -> Hits:
    """What each ray sees first, lit by one point of the lamp and by the sky. Directions have length 1.

    Args:
        lamps: These points.
        lamp_middle: Of the lamp's disc, where highlights come from.
    """
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
        diffuse[rows] = abundances[rows] * (lamplight + sky_light(points, normals, thing, things))[:, None]
        if thing.surface.roughness is not None:
            highlight = coat_highlight(
                points, normals, -directions[rows], thing.surface.roughness, lamp_middle
            )
            specular[rows] = lamplight * highlight
    return Hits(is_hit, abundances, diffuse, specular)


def lamp_point(
    i: int, count: int, middle: tuple[float, float, float] = LAMP_POSITION
) -> Float[np.ndarray, "3"]:
    """The i-th of `count` points that are spread evenly over the lamp's horizontal disc.

    Source:
        Vogel 1979, the sunflower spiral. The order strides through the spiral, so that neighbouring rays of a pixel
        see far apart points.
    """
    rank = i * 7 % count if count % 7 else i
    angle, radius = rank * np.pi * (3 - np.sqrt(5)), LAMP_RADIUS * np.sqrt((rank + 0.5) / count)
    offset = np.array([radius * np.cos(angle), radius * np.sin(angle), 0])
    return (np.array(middle) + offset).astype(np.float32)


def direct_light(
    points: Float[np.ndarray, "P 3"],
    normals: Float[np.ndarray, "P 3"],
    lamps: Float[np.ndarray, "#P 3"],
    placements: Sequence[Placement] = PLACEMENTS,
) -> Float[np.ndarray, " P"]:
    """Irradiance of each point from one of the lamp's: 0 in the shadow of `placements`, no fall-off with distance."""
    towards_lamp = lamps - points
    cosines = (dot(towards_lamp, normals) / np.sqrt(dot(towards_lamp, towards_lamp))).clip(0)
    # The segment to the lamp has length 1 here: nothing of the scene lies beyond the lamp.
    blocked, _ = first_hits(placements, points + 1e-3 * normals, towards_lamp)
    return np.where(np.isfinite(blocked), 0, LAMP_IRRADIANCE * cosines).astype(np.float32)


def sky_light(
    points: Float[np.ndarray, "P 3"],
    normals: Float[np.ndarray, "P 3"],
    thing: Thing,
    things: Sequence[Thing] = THINGS,
) -> Float[np.ndarray, " P"]:
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
    return SKY_IRRADIANCE * (BOUNCE_SHARE + (1 - BOUNCE_SHARE) * facing_up) * open_share


def coat_highlight(
    points: Float[np.ndarray, "P 3"],
    normals: Float[np.ndarray, "P 3"],
    towards_eye: Float[np.ndarray, "P 3"],
    roughness: float,
    lamp_middle: tuple[float, float, float] = LAMP_POSITION,
) -> Float[np.ndarray, " P"]:
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
