"""Layers over a diffuse or metallic base: dust, sheen of cloth, clear coat, a glossy surface with haze.

From the top, each layer reflects its share and lets `1 - albedo` of each direction through to what is below, on the way
in and on the way out. So the stack is reciprocal and never reflects more than it gets. All of it is
`passed * base / pi + specular`, where only `passed` is the part that meets the diffuse base colour.

Albedos of the lobes are integrated once and looked up afterwards. A table's rows are perceptual roughness from 0 to 1,
its columns the square root of the cosine from 0 to 1: albedos change fastest near the horizon.

Notation as in `microfacet`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.tracing.microfacet import (
    SMALLEST_COSINE,
    LobeMixture,
    Lobes,
    Numbers,
    Vectors,
    alpha_of,
    distribution,
    dot,
    half_vectors,
    sample_reflections,
    schlick,
    visibility,
)

NUM_NUMBERS = 15
"""That name a stack: L."""
LARGEST_COVER = 0.7
DUST_COLOUR = (0.52, 0.46, 0.38)
"""Linear RGB, grey-brown."""
DUST_NODES = (0.03376524, 0.16939531, 0.38069041, 0.61930959, 0.83060469, 0.96623476)
DUST_WEIGHTS = (0.08566225, 0.18038079, 0.23395697, 0.23395697, 0.18038079, 0.08566225)
"""Of Gauss and Legendre on [0, 1]."""
SMALLEST_SHEEN_WIDTH = 0.22
"""Narrower sheen would reflect more than all light near the horizon."""
LARGEST_DIELECTRIC_F0 = 0.08
LARGEST_COAT_ROUGHNESS = 0.6
LARGEST_SHEEN = 0.6
LARGEST_HAZE = 0.7
_COAT_F0 = 0.04
_ROWS, _COLUMNS, _STRATA = 32, 48, 32


def _mean_held(cover: Numbers) -> Numbers:
    """Share of cosine-weighted light of the whole hemisphere that the dust holds back: with tau = -log(1 - cover) it is
    1 - 2 E3(tau), an exponential integral, summed at Gauss-Legendre nodes."""
    log_passed = torch.log1p(-cover)
    nodes = zip(DUST_NODES, DUST_WEIGHTS, strict=True)
    passed = [2.0 * weight * mu * torch.exp(log_passed * (1.0 / mu)) for mu, weight in nodes]
    return 1.0 - torch.stack(passed).sum(0)


def _sheen_reflection(roughness: Numbers, half: Vectors, n_i: Numbers, n_o: Numbers) -> Numbers:
    """White sheen, 1/sr, at a half vector; both directions above the surface.

    Source:
        Estevez and Kulla 2017, Production friendly microfacet sheen BRDF; visibility of Ashikhmin and Premoze.
    """
    exponent = 1.0 / (SMALLEST_SHEEN_WIDTH + (1.0 - SMALLEST_SHEEN_WIDTH) * roughness)
    log_sine2 = torch.log((half[0] * half[0] + half[1] * half[1]).clamp_min(1e-12))
    density = (2.0 + exponent) / (2.0 * math.pi) * torch.exp(exponent * (0.5 * log_sine2))
    n_i, n_o = n_i.clamp_min(SMALLEST_COSINE), n_o.clamp_min(SMALLEST_COSINE)
    return density / (4.0 * (n_i + n_o - n_i * n_o))


def ggx_albedo(roughness: Lobes, cosine: Numbers) -> Float[Tensor, "2 K N"]:
    """`(a, b)`: a GGX lobe of Schlick's Fresnel term reflects `f0 a + b` of what comes from this cosine."""
    return _look_up(_cells(ggx_table, roughness.device), roughness, cosine)


def mean_ggx_albedo(roughness: Lobes) -> Float[Tensor, "2 K N"]:
    """`(a, b)` of `ggx_albedo`, averaged over the hemisphere with the cosine as weight."""
    means = _ggx_means(roughness.device)
    row = (roughness.detach() * (_ROWS - 1)).floor().clamp(0, _ROWS - 2)
    index = row.long().reshape(-1)
    low, rise = (each.index_select(1, index).reshape(2, *roughness.shape) for each in means)
    return low + (roughness * (_ROWS - 1) - row) * rise


@lru_cache(maxsize=1)
def ggx_table() -> Float[Tensor, "R M 2"]:
    """Quasi Monte Carlo over visible normals, on a grid of strata."""
    steps = (torch.arange(_STRATA) + 0.5) / _STRATA
    uniforms = torch.cartesian_prod(steps, steps).T

    def reflected(width: Tensor, eye: Tensor) -> Tensor:
        wo, alpha = eye[:, None].expand(3, uniforms.shape[1]), width.expand(uniforms.shape[1])
        wi = sample_reflections(alpha, wo, uniforms)
        a2, n_i, n_o = alpha[0] ** 2, wi[2].clamp_min(0.0), wo[2]
        root_i, root_o = (torch.sqrt(a2 + (1.0 - a2) * n * n) for n in (n_i, n_o))
        # Reflectance times cosine over density: masking of both directions over masking of the eye's alone.
        passed = n_i * (n_o + root_o) / (n_o * root_i + n_i * root_o).clamp_min(1e-9)
        edge = schlick(dot(half_vectors(wi, wo), wo))
        return torch.stack([((1.0 - edge) * passed).mean(), (edge * passed).mean()])

    return _tabulated(alpha_of(torch.linspace(0.0, 1.0, _ROWS)), reflected)


@lru_cache(maxsize=1)
def sheen_table() -> Float[Tensor, "R M 1"]:
    """A product rule over the hemisphere."""
    steps = (torch.arange(2 * _STRATA) + 0.5) / (2 * _STRATA)
    u, v = torch.cartesian_prod(steps, steps).unbind(-1)
    # Squared steps crowd at the horizon; du of the cosine is 2 u.
    wi_z, weight = u * u, 2.0 * u
    sine = torch.sqrt(1.0 - wi_z * wi_z)
    wi = torch.stack([sine * torch.cos(math.pi * v), sine * torch.sin(math.pi * v), wi_z])

    def reflected(roughness: Tensor, eye: Tensor) -> Tensor:
        wo = eye[:, None].expand_as(wi)
        value = _sheen_reflection(roughness.expand_as(wi_z), half_vectors(wi, wo), wi_z, wo[2])
        return (value * wi_z * weight).mean()[None] * 2.0 * math.pi

    return _tabulated(torch.linspace(0.0, 1.0, _ROWS), reflected)


def _tabulated(rows: Tensor, reflected: Callable[[Tensor, Tensor], Tensor]) -> Float[Tensor, "R M channels"]:
    """What comes back to eyes at each column's cosine, by each row's number."""
    cosine = torch.linspace(0.0, 1.0, _COLUMNS).square().clamp_min(SMALLEST_COSINE)
    eyes = torch.stack([torch.sqrt(1.0 - cosine * cosine), torch.zeros_like(cosine), cosine], dim=1)
    return torch.stack([torch.stack([reflected(row, eye) for eye in eyes]) for row in rows])


@lru_cache(maxsize=4)
def _ggx_means(device: torch.device) -> tuple[Tensor, Tensor]:
    """Means of each row, (2, rows), and their rise to the next row."""
    # The integral of 2 mu E(mu), with mu the square of the column, exact for what is linear between columns as look-ups
    # are: a smooth white specular layer passes less light than a coarser rule is wrong by. Differences of the double
    # integral of 4 s^3 give the weights of columns.
    s = torch.linspace(0.0, 1.0, _COLUMNS, dtype=torch.float64)
    rises = (s**5 / 5).diff() / s.diff()
    weights = torch.cat([s[:1], rises, s[-1:]]).diff()
    means = (weights[:, None] * ggx_table()).sum(dim=1).float().T.contiguous().to(device)
    return means, means.diff(dim=1)


@lru_cache(maxsize=8)
def _cells(make: Callable[[], Tensor], device: torch.device) -> Tensor:
    """Of a table: four coefficients of each bilinear cell for each channel, (4 channels, cells)."""
    table = make()
    corner, right = table[:-1, :-1], table[:-1, 1:] - table[:-1, :-1]
    below, twist = table[1:, :-1] - table[:-1, :-1], table[1:, 1:] - table[1:, :-1] - right
    cells = torch.stack([corner, right, below, twist])
    return cells.permute(0, 3, 1, 2).reshape(4 * table.shape[2], -1).contiguous().to(device)


def _look_up(cells: Tensor, roughness: Tensor, cosine: Tensor) -> Tensor:
    """Bilinear, (channels K N); the gradient goes to the roughness."""
    row = (roughness.detach() * (_ROWS - 1)).floor().clamp(0, _ROWS - 2)
    at = torch.sqrt(cosine.clamp(0.0, 1.0)) * (_COLUMNS - 1)
    column = at.floor().clamp(0, _COLUMNS - 2)
    index = (row * (_COLUMNS - 1) + column).long().reshape(-1)
    corner, right, below, twist = cells.index_select(1, index).reshape(
        4, cells.shape[0] // 4, *roughness.shape
    )
    x = at - column
    return (corner + x * right) + (roughness * (_ROWS - 1) - row) * (below + x * twist)


@dataclass(frozen=True)
class LayerStack:
    """Materials at N points; every number in [0, 1]."""

    dust_cover: Numbers
    """How much of light at normal incidence meets dust."""
    sheen_colour: Vectors
    sheen_roughness: Numbers
    coat_weight: Numbers
    roughness: Vectors
    """Perceptual: of the coat, of the surface, of its haze."""
    haze_weight: Numbers
    """How much of the surface's reflection is spread into the haze."""
    metallicity: Numbers
    metal_colour: Vectors
    dielectric_f0: Numbers

    @staticmethod
    def of_numbers(numbers: Float[Tensor, "15 N"]) -> "LayerStack":
        """From parts of the most that each may be, [0, 1], in this order: dust, sheen's colour and roughness, coat,
        roughness of coat and surface, how much of what is left the haze is rougher, haze, metallicity, metal's colour,
        f0."""
        # Gradients of a split are joined once; each index into `numbers` would fill zeros for all of them.
        dust, sheen, sheen_roughness, coat, roughness, haze, metallicity, metal, level = numbers.split(
            [1, 3, 1, 1, 3, 1, 1, 3, 1]
        )
        of_coat, surface, beyond = roughness.unbind(0)
        hazy = surface + (1.0 - surface) * beyond
        return LayerStack(
            dust_cover=LARGEST_COVER * dust[0],
            sheen_colour=LARGEST_SHEEN * sheen,
            sheen_roughness=sheen_roughness[0],
            coat_weight=coat[0],
            roughness=torch.stack([LARGEST_COAT_ROUGHNESS * of_coat, surface, hazy]),
            haze_weight=LARGEST_HAZE * haze[0],
            metallicity=metallicity[0],
            metal_colour=metal,
            dielectric_f0=LARGEST_DIELECTRIC_F0 * level[0],
        )

    def reflectance(self, wi: Vectors, wo: Vectors) -> tuple[Numbers, Vectors]:
        """`(passed, specular)`: what passes down to the base and up again, and what the layers reflect, 1/sr; 0 where a
        direction is below the surface."""
        light, eye = self._passing(wi[2]), self._passing(wo[2])
        dust = light.dust * eye.dust
        sheen = dust * light.sheen * eye.sheen
        coat = sheen * light.coat * eye.coat
        half = half_vectors(wi, wo)
        edge = schlick(dot(wo, half))
        alpha = alpha_of(self.roughness)
        lobes = distribution(alpha, half) * visibility(alpha, wi[2], wo[2])
        coat_lobe, sharp, hazy = lobes.unbind(0)
        of_coat = self.coat_weight * (_COAT_F0 + (1.0 - _COAT_F0) * edge) * coat_lobe
        surface = coat * self._mixed(sharp, hazy)
        of_sheen = dust * _sheen_reflection(self.sheen_roughness, half, wi[2], wo[2])
        # f0 + (1 - f0) edge, of three colours, with what has none apart.
        specular = self._f0 * (surface * (1.0 - edge)) + (surface * edge + sheen * of_coat)
        specular = specular + of_sheen * self.sheen_colour + self._dust(light.dust, eye.dust)
        above = (wi[2] > 0) & (wo[2] > 0)
        passed = coat * (1.0 - self.metallicity) * light.surface * eye.surface / self._surface_mean()
        return passed * above, specular * above

    def mixture(self, wo: Vectors, base: Float[Tensor, "C N"]) -> LobeMixture:
        """A density about like the reflectance times the cosine; without gradient."""
        with torch.no_grad():
            eye = self._passing(wo[2])
            f0 = self._f0.mean(0)
            edge = schlick(wo[2]) * (1.0 - self.roughness[1])
            surface = eye.dust * eye.sheen * eye.coat * (f0 + (1.0 - f0) * edge)
            coat = eye.dust * eye.sheen * (1.0 - eye.coat)
            specular = torch.stack([coat, surface * (1.0 - self.haze_weight), surface * self.haze_weight])
            below = eye.dust * eye.sheen * eye.coat * eye.surface * (1.0 - self.metallicity) * base.mean(0)
            diffuse = below + 0.5 * (1.0 - eye.dust) + eye.dust * (1.0 - eye.sheen)
            return LobeMixture.of_albedos(alpha_of(self.roughness), diffuse, specular)

    @property
    def _f0(self) -> Vectors:
        """What the surface reflects at normal incidence."""
        return self.dielectric_f0 + self.metallicity * (self.metal_colour - self.dielectric_f0)

    def _dust(self, passed_light: Tensor, passed_eye: Tensor) -> Tensor:
        held = (1.0 - passed_light) * (1.0 - passed_eye) / _mean_held(self.dust_cover).clamp_min(1e-6)
        return held * (torch.tensor(DUST_COLOUR, device=held.device)[:, None] / math.pi)

    def _passing(self, cosine: Numbers) -> "_Passing":
        """What each layer lets through from one direction to what is below."""
        cosine = cosine.clamp_min(0.0)
        (coat_a, *surface_a), (coat_b, *surface_b) = (x.unbind(0) for x in ggx_albedo(self.roughness, cosine))
        coat = 1.0 - self.coat_weight * (_COAT_F0 * coat_a + coat_b)
        surface = 1.0 - (self.dielectric_f0 * self._mixed(*surface_a) + self._mixed(*surface_b))
        cells = _cells(sheen_table, cosine.device)
        white = _look_up(cells, self.sheen_roughness[None], cosine)[0, 0]
        sheen = 1.0 - self.sheen_colour.amax(0) * white
        dust = torch.exp(torch.log1p(-self.dust_cover) / cosine.clamp_min(SMALLEST_COSINE))
        return _Passing(dust, sheen, coat, surface)

    def _surface_mean(self) -> Tensor:
        """Mean of `surface` over directions, which makes a white base under it lose no light."""
        (_, *a), (_, *b) = (x.unbind(0) for x in mean_ggx_albedo(self.roughness))
        return 1.0 - (self.dielectric_f0 * self._mixed(*a) + self._mixed(*b))

    def _mixed(self, sharp: Tensor, hazy: Tensor) -> Tensor:
        return sharp + self.haze_weight * (hazy - sharp)


@dataclass(frozen=True)
class _Passing:
    """Shares of light along one direction that pass each layer, (N)."""

    dust: Tensor
    sheen: Tensor
    coat: Tensor
    surface: Tensor
