"""Layers over a diffuse or metallic base: dust, sheen, clear coat, a glossy surface with haze.

Notation as in `microfacet`. From the top, each layer reflects its share and lets `1 - albedo` of each direction through
to what is below, on the way in and on the way out. So the stack is reciprocal and never reflects more than it gets.
All of it is `passed * base / pi + specular`, where only `passed` is the part that meets the diffuse base colour.
"""

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.albedos import ggx_albedo, mean_ggx_albedo, sheen_albedo
from unmix_plugin.neumatex.materials.dust import DUST_COLOUR, dust_passed, mean_held
from unmix_plugin.neumatex.materials.lobe_mixture import LobeMixture
from unmix_plugin.neumatex.materials.microfacet import (
    alpha_of,
    distribution,
    dot,
    half_vectors,
    schlick,
    visibility,
)
from unmix_plugin.neumatex.materials.sheen import sheen_reflection

_COAT_F0 = 0.04
LARGEST_DIELECTRIC_F0 = 0.08
LARGEST_COAT_ROUGHNESS = 0.6
LARGEST_SHEEN = 0.6
LARGEST_HAZE = 0.7


@dataclass(frozen=True)
class LayerStack:
    """Materials at N points; every number in [0, 1]."""

    dust_cover: Float[Tensor, " N"]
    """How much of light at normal incidence meets dust."""
    sheen_colour: Float[Tensor, "3 N"]
    sheen_roughness: Float[Tensor, " N"]
    coat_weight: Float[Tensor, " N"]
    roughness: Float[Tensor, "3 N"]
    """Perceptual: of the coat, of the surface, of its haze."""
    haze_weight: Float[Tensor, " N"]
    """How much of the surface's reflection is spread into the haze."""
    metallicity: Float[Tensor, " N"]
    metal_colour: Float[Tensor, "3 N"]
    dielectric_f0: Float[Tensor, " N"]

    def repeat(self, times: int) -> "LayerStack":
        """Each material `times` times in a row."""
        return LayerStack(
            **{each.name: getattr(self, each.name).repeat_interleave(times, -1) for each in fields(self)}
        )

    def reflectance(
        self, wi: Float[Tensor, "3 N"], wo: Float[Tensor, "3 N"]
    ) -> tuple[Float[Tensor, " N"], Float[Tensor, "3 N"]]:
        """`(passed, specular)`: what passes down to the base and up again, and what the layers reflect, 1/sr.

        Both are 0 where a direction is below the surface.
        """
        light, eye = self.passing(wi[2]), self.passing(wo[2])
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
        of_sheen = dust * sheen_reflection(self.sheen_roughness, half, wi[2], wo[2])
        # f0 + (1 - f0) edge, of three colours, with what has none apart.
        specular = self.f0 * (surface * (1.0 - edge)) + (surface * edge + sheen * of_coat)
        specular = specular + of_sheen * self.sheen_colour + self._dust(light.dust, eye.dust)
        above = (wi[2] > 0) & (wo[2] > 0)
        passed = coat * (1.0 - self.metallicity) * light.surface * eye.surface / self._surface_mean()
        return passed * above, specular * above

    def mixture(self, wo: Float[Tensor, "3 N"], base: Float[Tensor, "C N"]) -> LobeMixture:
        """A density about like the reflectance times the cosine; without gradient."""
        with torch.no_grad():
            eye = self.passing(wo[2])
            f0 = self.f0.mean(0)
            edge = schlick(wo[2]) * (1.0 - self.roughness[1])
            surface = eye.dust * eye.sheen * eye.coat * (f0 + (1.0 - f0) * edge)
            coat = eye.dust * eye.sheen * (1.0 - eye.coat)
            specular = torch.stack([coat, surface * (1.0 - self.haze_weight), surface * self.haze_weight])
            below = eye.dust * eye.sheen * eye.coat * eye.surface * (1.0 - self.metallicity) * base.mean(0)
            diffuse = below + 0.5 * (1.0 - eye.dust) + eye.dust * (1.0 - eye.sheen)
            return LobeMixture.of_albedos(alpha_of(self.roughness), diffuse, specular)

    @property
    def f0(self) -> Float[Tensor, "3 N"]:
        """What the surface reflects at normal incidence."""
        return self.dielectric_f0 + self.metallicity * (self.metal_colour - self.dielectric_f0)

    def _dust(self, passed_light: Tensor, passed_eye: Tensor) -> Tensor:
        held = (1.0 - passed_light) * (1.0 - passed_eye) / mean_held(self.dust_cover).clamp_min(1e-6)
        return held * (torch.tensor(DUST_COLOUR, device=held.device)[:, None] / math.pi)

    def passing(self, cosine: Float[Tensor, " N"]) -> "Passing":
        """What each layer lets through from one direction to what is below."""
        cosine = cosine.clamp_min(0.0)
        (coat_a, *surface_a), (coat_b, *surface_b) = (x.unbind(0) for x in ggx_albedo(self.roughness, cosine))
        coat = 1.0 - self.coat_weight * (_COAT_F0 * coat_a + coat_b)
        surface = 1.0 - (self.dielectric_f0 * self._mixed(*surface_a) + self._mixed(*surface_b))
        sheen = 1.0 - self.sheen_colour.amax(0) * sheen_albedo(self.sheen_roughness, cosine)
        return Passing(dust_passed(self.dust_cover, cosine), sheen, coat, surface)

    def _surface_mean(self) -> Tensor:
        """Mean of `surface` over directions, which makes a white base under it lose no light."""
        (_, *a), (_, *b) = (x.unbind(0) for x in mean_ggx_albedo(self.roughness))
        return 1.0 - (self.dielectric_f0 * self._mixed(*a) + self._mixed(*b))

    def _mixed(self, sharp: Tensor, hazy: Tensor) -> Tensor:
        return sharp + self.haze_weight * (hazy - sharp)


@dataclass(frozen=True)
class Passing:
    """Shares of light along one direction that pass each layer, (N)."""

    dust: Tensor
    sheen: Tensor
    coat: Tensor
    surface: Tensor
