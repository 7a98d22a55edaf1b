"""The light of an object, found from how bright its surface is: a lamp, and a sky of few parameters.

Mesh and abundances are known from a run. A diffuse point p that no light but the first reaches sends

    y_b(p) = lamp_b  rho_b(p)  (L_s V_p(s) n.s + sum_m L_m A_m(p)),   rho = sum_k a_k(p) g_k E_k / lamp

to the eye: V_p is what the tracer says of what stands in the way, s the direction of the lamp, sharp or soft, and A_m
what one of seven wide patches of sky would give (even light, and light from each side along three axes). All are at
least 0. For each of many directions s the brightnesses that fit best are found (non-negative least squares), and those
around the best one are tried again, more finely. The gains g of the endmembers are fitted in turn with the light: a
radiance field knows spectra, but not how bright a material is beside the shading.

What is told by shading alone is the product of light and reflectance: one factor stays unknown. It is the one with
which a white surface that the lamp lights best reads 1, as in captures that were divided by a white reference, unless
some surface would be brighter than white.

Notation: `N` points, `D` directions, `B` bands, `K` endmembers, `M` patches of sky.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.engine import UNDECIDED, Decision
from unmix_plugin.neumatex.tracing.lamp_and_sky import (
    NUM_PATCHES,
    SHARP_DEG,
    SOFT_DEG,
    LampAndSky,
    sky_patches,
)
from unmix_plugin.neumatex.tracing.microfacet import to_local, to_world
from unmix_plugin.neumatex.tracing.rays import RayMesh, SurfacePoints

_NUM_DIRECTIONS = 384
"""Of the first search: 10 degrees apart."""
_FINER = ((8.0, 48), (2.5, 48))
"""Half angles of the cones of the next searches, degrees, and how many directions they have."""
_ROUNDS = 8
"""In which light and gains are fitted in turn: with 3, a low sun left materials on its far side 20 % too bright."""
_HIGHLIGHTS = 2.5
"""Robust standard deviations from which a point counts less: highlights and errors of the mesh are no diffuse light."""
_LEAST_GAIN = 0.2
"""Part by which a lamp has to lower the squared error of a sky alone, or it is not believed."""
_LEAST_SHARE = 0.12
"""Of a lamp in all light that falls on a surface which faces it: less is what interreflections look like."""
_CLEARLY_WORSE = 1.02
"""Squared error of lamps more than `_ELSEWHERE_DEG` away over that of the best, from which they are ruled out."""
_ELSEWHERE_DEG = 40.0
_WHITE = 0.95
"""Reflectance of what is as bright as surfaces get."""


@dataclass(frozen=True)
class LitPoints:
    """Points of a surface, what is seen of them, and what they are made of."""

    points: SurfacePoints
    """In the space of the mesh, whose axes are the world's."""
    spectra: Float[Tensor, "N B"]
    """Radiance towards the eye."""
    abundances: Float[Tensor, "N K"]
    """Summing to 1."""
    light_axes: Float[Tensor, "N 3 3"] | None = None
    """Rows are the axes in which the light stands still, as seen from each point's camera; None: those of the world."""


@dataclass(frozen=True)
class FoundLight:
    """The light of an object, and how it was decided."""

    light: LampAndSky
    """World directions; relative to the lamp's spectrum."""
    direction: Float64[np.ndarray, "3"] | None
    """Unit vector to the lamp in the axes of the light; None where no direction is believed."""
    gains: Float64[np.ndarray, " K"]
    """By which each endmember's reflectance is brighter than it was given."""
    error: float
    """Mean squared error of the shading that is left."""
    decision: Decision


@torch.no_grad()
def find_light(
    ray_mesh: RayMesh,
    lit: LitPoints,
    reflectances: Float[Tensor, "K B"],
    lamp: Float[Tensor, " B"],
    white: float | None,
) -> FoundLight:
    """The light that fits best.

    Args:
        ray_mesh: Which casts shadows.
        lit: Enough points, some thousands, with normals on all sides.
        reflectances: Endmembers over the lamp, of any brightness each.
        lamp: Its spectrum, greatest band 1.
        white: What a white surface that is lit best reads, where a reference says so; None: 1 is assumed.
    """
    seen = lit.spectra / lamp
    search = _Search(ray_mesh, lit)
    gains = torch.ones(len(reflectances), dtype=torch.float64)
    weights = torch.ones(len(seen), dtype=torch.float64)
    for _ in range(_ROUNDS - 1):
        best = search.best(_Shading.of(lit, reflectances, seen, gains, weights))
        gains, weights = _refitted(best, lit, reflectances, seen)
    best = search.best(_Shading.of(lit, reflectances, seen, gains, weights))
    fit = best.fit
    share = float(fit.values[NUM_PATCHES:].sum() / max(fit.values.sum(), 1e-12))
    is_better = (
        fit.error < (1 - _LEAST_GAIN) * best.sky_alone.error and best.elsewhere > _CLEARLY_WORSE * fit.error
    )
    is_believed = is_better and share > _LEAST_SHARE
    if not is_believed:
        fit = _Fit(np.append(best.sky_alone.values, [0.0, 0.0]), best.sky_alone.error)
    scale = _scale(fit, search, best, white)
    lobes, patches = (
        torch.from_numpy(scale * part).float()
        for part in (fit.values[NUM_PATCHES:], fit.values[:NUM_PATCHES])
    )
    light = LampAndSky(best.towards.float(), torch.tensor([SHARP_DEG, SOFT_DEG]), lobes, patches)
    towards = best.towards.double().numpy()
    decision = Decision(
        "light",
        f"a lamp at {_place(towards, lit.light_axes is not None)}, and sky" if is_believed else UNDECIDED,
        {
            "squared error over that of a sky alone": best.fit.error / best.sky_alone.error,
            "best lamp elsewhere over the best": best.elsewhere / best.fit.error,
            "lamp over all light": share,
            "brightness of white": "assumed" if white is None else "by the white reference",
        },
        "a sky alone that explains shading and shadows nearly as well, or a lamp elsewhere that does",
        "--environment",
    )
    return FoundLight(light, towards if is_believed else None, (gains / scale).numpy(), fit.error, decision)


@dataclass(frozen=True)
class _Shading:
    """How much light each point seems to receive, when endmembers are as bright as `gains` says."""

    mixed: Float[Tensor, "N B"]
    """Reflectances of the points."""
    shade: Float[Tensor, " N"]
    """Light on each that explains its spectrum best."""
    trust: Float[Tensor, " N"]
    """Weights of the points: dark materials, highlights and errors of the mesh say little."""

    @staticmethod
    def of(
        lit: LitPoints,
        reflectances: Float[Tensor, "K B"],
        seen: Float[Tensor, "N B"],
        gains: Float[Tensor, " K"],
        weights: Float[Tensor, " N"],
    ) -> _Shading:
        mixed = lit.abundances.double() @ (gains[:, None] * reflectances.double())
        albedo = mixed.norm(dim=1)
        shade = (seen.double() * mixed).sum(dim=1) / (albedo * albedo).clamp(min=1e-12)
        return _Shading(mixed, shade, weights * albedo)


@dataclass(frozen=True)
class _BestLamp:
    """The lamp and sky that explain a shading best, beside what else explains it."""

    shading: _Shading
    towards: Float[Tensor, "3"]
    """Unit vector to the lamp."""
    fit: _Fit
    light: Float[Tensor, " N"]
    """What falls on each point by the fit."""
    sky_alone: _Fit
    elsewhere: float
    """Least error with a lamp more than `_ELSEWHERE_DEG` away."""


class _Search:
    """Lamps of every direction, tried from coarse to fine."""

    def __init__(self, ray_mesh: RayMesh, lit: LitPoints) -> None:
        self.ray_mesh, self.lit = ray_mesh, lit
        self.directions = _fibonacci(_NUM_DIRECTIONS)
        self.patches = sky_patches(self.directions)
        self.arriving = _arriving(ray_mesh, lit, self.directions)
        self.softened = self.arriving @ _soft(self.directions, self.directions)
        self.sky = self.arriving @ self.patches * (4 / _NUM_DIRECTIONS)  # solid angle of a direction over pi

    def best(self, shading: _Shading) -> _BestLamp:
        """First over the whole sphere, then in narrowing cones about the best."""
        sky, shade, trust = self.sky, shading.shade, shading.trust
        sky_alone = _fitted(sky, [], shade, trust)[0]
        sharp, soft, directions = self.arriving, self.softened, self.directions
        fits = _fitted(sky, [sharp, soft], shade, trust)
        errors = np.array([each.error for each in fits])
        chosen = int(errors.argmin())
        far = (directions @ directions[chosen]).numpy() < math.cos(math.radians(_ELSEWHERE_DEG))
        for half_angle, count in _FINER:
            directions = _cone(directions[chosen], half_angle, count)
            sharp = _arriving(self.ray_mesh, self.lit, directions)
            soft = self.arriving @ _soft(self.directions, directions)
            fits = _fitted(sky, [sharp, soft], shade, trust)
            chosen = min(range(count), key=lambda index: fits[index].error)
        columns = torch.cat([sky, sharp[:, [chosen]], soft[:, [chosen]]], dim=1).double()
        light = columns @ torch.from_numpy(fits[chosen].values)
        return _BestLamp(
            shading, directions[chosen], fits[chosen], light, sky_alone, float(errors[far].min())
        )


@dataclass(frozen=True)
class _Fit:
    """Brightness of each part of the light, and what is left unexplained."""

    values: Float64[np.ndarray, " n"]
    """What a white surface reads that faces it: patches, the sharp lamp, the soft one."""
    error: float
    """Mean squared error of the shading, weighted."""


def _fitted(
    sky: Float[Tensor, "N M"],
    lamps: list[Float[Tensor, "N D"]],
    shade: Float[Tensor, " N"],
    trust: Float[Tensor, " N"],
) -> list[_Fit]:
    """The best brightnesses, at least 0, of the sky with one column of each of the lamps, for each of their columns; of
    the sky alone without lamps."""
    from scipy.optimize import nnls

    wide, wanted = sky.double() * trust[:, None], shade * trust
    own = [lamp.double() * trust[:, None] for lamp in lamps]
    total, power = float((trust * trust).sum()), float(wanted @ wanted)
    size = sky.shape[1] + len(lamps)
    grams = torch.zeros(own[0].shape[1] if own else 1, size, size, dtype=torch.float64)
    rights = torch.zeros(len(grams), size, dtype=torch.float64)
    first = sky.shape[1]
    grams[:, :first, :first], rights[:, :first] = wide.T @ wide, wide.T @ wanted
    for row, lamp in enumerate(own, start=first):
        grams[:, row, :first] = lamp.T @ wide
        grams[:, :first, row] = grams[:, row, :first]
        rights[:, row] = lamp.T @ wanted
        for column, other in enumerate(own, start=first):
            grams[:, row, column] = (lamp * other).sum(dim=0)
    # |A x - y|^2 by the normal equations, of which a Cholesky factor is a small system with the same answer.
    ridge = 1e-9 * grams.diagonal(dim1=1, dim2=2).mean() * torch.eye(size, dtype=torch.float64)
    factors = torch.linalg.cholesky(grams + ridge)
    sides = torch.linalg.solve_triangular(factors, rights[..., None], upper=False)[..., 0]
    found = []
    for gram, right, factor, side in zip(
        *(part.numpy() for part in (grams, rights, factors, sides)), strict=True
    ):
        values, _ = nnls(factor.T, side)
        found.append(_Fit(values, float(power - 2 * right @ values + values @ gram @ values) / total))
    return found


def _refitted(
    best: _BestLamp, lit: LitPoints, reflectances: Float[Tensor, "K B"], seen: Float[Tensor, "N B"]
) -> tuple[Float[Tensor, " K"], Float[Tensor, " N"]]:
    """How bright each endmember is, 1 in the mean, when so much light falls on each point; and weights of the points,
    less for those that the light explains badly."""
    from scipy.optimize import nnls

    off = (best.shading.shade - best.light).abs() / best.light.clamp(min=1e-6)
    usual = off.median().clamp(min=1e-6) / 0.6745
    weights = (_HIGHLIGHTS * usual / off.clamp(min=1e-9)).clamp(max=1)
    shaded = lit.abundances.double() * (best.light * weights)[:, None]
    alike = reflectances.double() @ reflectances.double().T
    gram = (shaded.T @ shaded) * alike
    right = (shaded * ((seen.double() * weights[:, None]) @ reflectances.double().T)).sum(dim=0)
    # Endmembers that hardly any point shows stay as bright as the others.
    ridge = 1e-3 * gram.diagonal().mean()
    found, _ = nnls((gram + ridge * torch.eye(len(gram))).numpy(), (right + ridge).numpy())
    return torch.from_numpy(found / max(found.mean(), 1e-12)).clamp(min=1e-2), weights


def _arriving(ray_mesh: RayMesh, lit: LitPoints, directions: Float[Tensor, "D 3"]) -> Float[Tensor, "N D"]:
    """Cosines of directions of the light at points, 0 where the mesh is in the way."""
    points, axes = lit.points, lit.light_axes
    normals, geometric = points.normals, points.geometric_normals
    if axes is not None:
        normals, geometric = to_local(axes, normals), to_local(axes, geometric)
    cosines = (normals @ directions.T).clamp(min=0) * (geometric @ directions.T > 0)
    rows, columns = (cosines > 0).nonzero(as_tuple=True)
    towards = directions[columns] if axes is None else to_world(axes[rows], directions[columns])
    cosines[rows, columns] *= ~ray_mesh.blocked(points.positions[rows], towards)
    return cosines


def _fibonacci(count: int) -> Float[Tensor, "D 3"]:
    """Directions evenly spread over the sphere."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z, azimuth = 1 - 2 * index / count, index * math.pi * (3 - math.sqrt(5))
    flat = (1 - z * z).sqrt()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), z], dim=1).float()


def _cone(axis: Float[Tensor, "3"], half_angle_deg: float, count: int) -> Float[Tensor, "D 3"]:
    """Directions evenly spread about an axis, which is the first."""
    index = torch.arange(count, dtype=torch.float64)
    radius = math.tan(math.radians(half_angle_deg)) * (index / max(count - 1, 1)).sqrt()
    azimuth = index * math.pi * (3 - math.sqrt(5))
    first = normalize(torch.linalg.cross(axis, torch.eye(3)[int(axis.abs().argmin())]), dim=0)
    beside = torch.stack([first, torch.linalg.cross(axis, first)]).double()
    offsets = torch.stack([radius * azimuth.cos(), radius * azimuth.sin()], dim=1) @ beside
    return normalize(axis.double() + offsets, dim=1).float()


def _soft(directions: Float[Tensor, "D 3"], towards: Float[Tensor, "n 3"]) -> Float[Tensor, "D n"]:
    """Parts of soft lamps' light from each direction, summing to 1 for each lamp."""
    sharpness = 1 / math.radians(SOFT_DEG) ** 2
    lobes = (sharpness * (directions @ towards.T - 1)).exp()
    return lobes / lobes.sum(dim=0)


def _scale(fit: _Fit, search: _Search, best: _BestLamp, white: float | None) -> float:
    """Factor of the light, by which reflectances are divided: white reads as its reference says, or as 1."""
    facing = (search.directions @ search.directions.T).clamp(min=0)
    reads = (facing @ search.patches).double() @ torch.from_numpy(fit.values[:NUM_PATCHES])
    reads = reads * (4 / len(search.directions))
    lamps = float(fit.values[NUM_PATCHES:].sum())
    reads = reads + lamps * (search.directions @ best.towards).clamp(min=0)
    if white is not None:
        return white / float(reads.max())
    brightest = float(best.shading.mixed.mean(dim=1).quantile(0.99))
    return max(1 / float(reads.max()), brightest / _WHITE)


def _place(towards: Float64[np.ndarray, "3"], moves: bool) -> str:
    azimuth, elevation = math.degrees(math.atan2(towards[1], towards[0])), math.degrees(math.asin(towards[2]))
    if moves:
        side = "right" if azimuth > 0 else "left"
        return f"{abs(azimuth):.0f} degrees to the camera's {side}, elevation {elevation:.0f} degrees"
    return f"azimuth {azimuth:.0f} degrees, elevation {elevation:.0f} degrees"
