"""Families of materials: reflectances with a common set of parameters, and the sampling of their directions.

Notation: `N` points, `P` parameters of a material, `C` colours or bands `B`, `K` endmembers. Directions are unit
vectors in the local frame of a point, whose z axis is the shading normal; `wi` points to the light, `wo` to the eye.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.neumatex.tracing.layers import LayerStack, ggx_albedo, mean_ggx_albedo
from unmix_plugin.neumatex.tracing.microfacet import (
    LobeMixture,
    alpha_of,
    distribution,
    dot,
    half_vectors,
    schlick,
    visibility,
)

_DIELECTRIC_F0 = 0.04
Parameters: TypeAlias = Float[Tensor, "N P"]
Directions: TypeAlias = Float[Tensor, "N 3"]
Colours: TypeAlias = Float[Tensor, "N C"]


class MaterialFamily(ABC):
    """Reflectances with a common set of parameters, each in [0, 1]; differentiable by them."""

    PARAMETERS: tuple[str, ...]
    """Their names."""
    num_parameters: int
    """P."""
    num_colours: int
    """C."""

    @abstractmethod
    def evaluate(self, parameters: Parameters, wi: Directions, wo: Directions) -> Colours:
        """Reflectance, 1/sr, without the cosine; 0 where a direction is below the surface."""

    @abstractmethod
    def base_colour(self, parameters: Parameters) -> Colours:
        """Base colour, linear, [0, 1]: what a metal reflects, and the diffuse albedo of everything else."""

    def _mixture(self, parameters: Parameters, wo: Float[Tensor, "3 N"]) -> LobeMixture:
        """The lobes of each point, seen along a direction; a family that draws in a way of its own has none."""
        raise NotImplementedError

    @torch.no_grad()
    def sample(self, parameters: Parameters, wo: Directions, uniforms: Directions) -> Directions:
        """Directions to the light, drawn about as the reflectance times the cosine is distributed, by independent
        numbers in [0, 1); no gradient."""
        wo = wo.T.contiguous()
        return self._mixture(parameters, wo).sample(wo, uniforms.T.contiguous()).T.contiguous()

    @torch.no_grad()
    def density(self, parameters: Parameters, wi: Directions, wo: Directions) -> Float[Tensor, " N"]:
        """Probability density of `sample`, 1/sr; no gradient."""
        wo = wo.T.contiguous()
        return self._mixture(parameters, wo).density(wi.T.contiguous(), wo)

    def decoded(self, parameters: Parameters) -> tuple[MaterialFamily, Float[Tensor, "N D"]]:
        """The same reflectances by parameters of another family, if need be, without a network for each direction."""
        return self, parameters


class StackFamily(MaterialFamily):
    """Layers over a diffuse base: the first three parameters are its linear colour, which says nothing of a metal, and
    all of them give the layers."""

    num_colours = 3

    @abstractmethod
    def stack(self, parameters: Parameters) -> LayerStack:
        """The layers that the parameters stand for."""

    def evaluate(self, parameters: Parameters, wi: Directions, wo: Directions) -> Colours:
        passed, specular = self.stack(parameters).reflectance(wi.T.contiguous(), wo.T.contiguous())
        return ((passed / math.pi) * parameters[:, :3].T + specular).T

    def base_colour(self, parameters: Parameters) -> Colours:
        layers = self.stack(parameters)
        return torch.lerp(parameters[:, :3], layers.metal_colour.T, layers.metallicity[:, None])

    def _mixture(self, parameters: Tensor, wo: Tensor) -> LobeMixture:
        return self.stack(parameters).mixture(wo, parameters[:, :3].T)


class LayeredFamily(StackFamily):
    """Analytic layered materials: the truth that the neural decoder learns, and procedural objects are made of.

    Dust over sheen over clear coat over a surface with haze over a base that is diffuse or metal. Parameters in [0, 1]:

    | index | name | meaning |
    | --- | --- | --- |
    | 0 to 2 | base colour | linear RGB; what a metal reflects, and the diffuse albedo of everything else |
    | 3 | metallicity | 0 dielectric, 1 metal |
    | 4 | roughness | perceptual; the GGX width is about its square |
    | 5 | specular level | `f0` of the dielectric, 0 to 0.08; 0.5 is a refractive index of 1.5 |
    | 6 | coat weight | of a clear coat of index 1.5 |
    | 7 | coat roughness | perceptual, 0 to 0.6 |
    | 8 | sheen weight | 0 to 0.6 |
    | 9 | sheen roughness | 0 hugs the silhouette, 1 is all over |
    | 10 | sheen tint | from white to the hue of the base colour |
    | 11 | haze weight | share of the surface's reflection that is spread, 0 to 0.7 |
    | 12 | haze spread | the haze's roughness is `roughness + (1 - roughness) (0.15 + 0.6 spread)` |
    | 13 | dust | cover at normal incidence, 0 to 0.7 |
    """

    PARAMETERS = (
        "base colour R", "base colour G", "base colour B", "metallicity", "roughness", "specular level", "coat weight",
        "coat roughness", "sheen weight", "sheen roughness", "sheen tint", "haze weight", "haze spread", "dust",
    )  # fmt: skip
    num_parameters = len(PARAMETERS)

    def stack(self, parameters: Parameters) -> LayerStack:
        base, *scalars = parameters.T.contiguous().split([3, *[1] * (parameters.shape[1] - 3)])
        metallicity, roughness, level, coat, coat_roughness, *others = scalars
        sheen, sheen_roughness, tint, haze, spread, dust = others
        hue = base / base.amax(0).clamp_min(1e-3)
        of_sheen = [sheen * (1.0 + tint * (hue - 1.0)), sheen_roughness]
        rough = [coat_roughness, roughness, 0.15 + 0.6 * spread]
        return LayerStack.of_numbers(
            torch.cat([dust, *of_sheen, coat, *rough, haze, metallicity, base, level])
        )


class PbrFamily(MaterialFamily):
    """Metallic-roughness materials. Parameters: base colour (0 to 2, linear), roughness (3), metallicity (4).

    As published they may reflect up to twice the light at grazing angles, where the diffuse part does not know how much
    the surface reflects. That is kept: files of this kind mean just this.

    Source:
        glTF 2.0 specification, appendix B.
    """

    PARAMETERS = ("base colour R", "base colour G", "base colour B", "roughness", "metallicity")
    num_parameters = len(PARAMETERS)
    num_colours = 3

    def evaluate(self, parameters: Parameters, wi: Directions, wo: Directions) -> Colours:
        base, roughness, metallicity = parameters.T.contiguous().split([3, 1, 1])
        f0 = _DIELECTRIC_F0 + metallicity * (base - _DIELECTRIC_F0)
        fresnel, facets, masking, above = _specular(roughness, f0, wi.T.contiguous(), wo.T.contiguous())
        diffuse = (1.0 - fresnel) * ((1.0 - metallicity) / math.pi) * base
        return ((diffuse + fresnel * (facets * masking)) * above).T

    def base_colour(self, parameters: Parameters) -> Colours:
        return parameters[:, :3]

    def _mixture(self, parameters: Tensor, wo: Tensor) -> LobeMixture:
        base, roughness, metallicity = parameters.T.contiguous().split([3, 1, 1])
        f0 = _DIELECTRIC_F0 + metallicity * (base.mean(0) - _DIELECTRIC_F0)
        specular = f0 + (1.0 - f0) * schlick(wo[2])
        diffuse = (1.0 - metallicity) * base.mean(0) * (1.0 - f0)
        return LobeMixture.of_albedos(alpha_of(roughness), diffuse[0], specular)


class SpectralFamily(MaterialFamily):
    """A diffuse base that is a mixture of endmember reflectances, and a grey specular layer above it.

    Parameters: abundances (0 to K - 1, at least 0, sum 1), roughness (K), specular level (K + 1). With abundances a,
    endmembers E and the albedo A of the layer for light from one direction,

        f = (1 - A(wi)) (1 - A(wo)) / (1 - mean A) (a E) / pi + specular(wi, wo)

    The layer is one GGX lobe, the same in all bands. It reflects the square of the specular level at normal incidence:
    0.2 is a common dielectric's 4 %. What it reflects does not reach the base, so a white base under it reflects all
    light, and no material more than it gets.
    """

    def __init__(self, endmembers: Float[Tensor, "K B"], gains: Float[Tensor, " K"] | None = None) -> None:
        """Keep tensors as they are given, so that their gradients arrive there.

        Args:
            endmembers: Reflectances, [0, 1].
            gains: Factors of the endmembers, 1 except within a step of training.
        """
        self.endmembers = endmembers
        self.gains = endmembers.new_ones(len(endmembers)) if gains is None else gains
        self.num_endmembers, self.num_colours = endmembers.shape
        shares = (f"abundance {index}" for index in range(self.num_endmembers))
        self.PARAMETERS = (*shares, "roughness", "specular level")
        self.num_parameters = len(self.PARAMETERS)

    def abundances(self, parameters: Parameters) -> Float[Tensor, "N K"]:
        """Share of each endmember."""
        return parameters[:, : self.num_endmembers]

    def evaluate(self, parameters: Parameters, wi: Directions, wo: Directions) -> Colours:
        roughness, f0 = self._roughness_and_f0(parameters)
        wi, wo = wi.T.contiguous(), wo.T.contiguous()
        fresnel, facets, masking, above = _specular(roughness, f0, wi, wo)
        a, b = mean_ggx_albedo(roughness)
        passed = _passing(roughness, f0, wi[2]) * _passing(roughness, f0, wo[2]) / (1.0 - (f0 * a + b))
        return (passed * above / math.pi).T * self.base_colour(parameters) + (
            fresnel * facets * masking * above
        ).T

    def base_colour(self, parameters: Parameters) -> Colours:
        """Diffuse reflectance of each band, [0, 1]."""
        return self.abundances(parameters) @ (self.gains[:, None] * self.endmembers)

    @torch.no_grad()
    def settle_gains(self) -> None:
        """Make endmembers as bright as their gains say, as far as reflectances can be, and the gains 1; in place."""
        bright = self.endmembers.clamp(0, 1) * self.gains.clamp(min=0)[:, None]
        self.endmembers.copy_(bright / bright.amax(dim=1, keepdim=True).clamp(min=1))
        self.gains.fill_(1)

    def _roughness_and_f0(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Each (1 N); f0 is what the specular layer reflects at normal incidence."""
        roughness, level = parameters[:, self.num_endmembers :].T.contiguous().split([1, 1])
        return roughness, level * level

    def _mixture(self, parameters: Tensor, wo: Tensor) -> LobeMixture:
        roughness, f0 = self._roughness_and_f0(parameters)
        passed = _passing(roughness, f0, wo[2])
        diffuse = passed[0] * self.base_colour(parameters).mean(dim=1)
        return LobeMixture.of_albedos(alpha_of(roughness), diffuse, 1.0 - passed)


def _specular(
    roughness: Float[Tensor, "1 N"],
    f0: Float[Tensor, "C N"],
    wi: Float[Tensor, "3 N"],
    wo: Float[Tensor, "3 N"],
) -> tuple[Float[Tensor, "C N"], Float[Tensor, "1 N"], Float[Tensor, "1 N"], Bool[Tensor, " N"]]:
    """Factors of a GGX lobe: Schlick's Fresnel term, distribution, visibility; and whether both directions are above
    the surface."""
    half, alpha = half_vectors(wi, wo), alpha_of(roughness)
    fresnel = f0 + (1.0 - f0) * schlick(dot(wo, half))
    above = (wi[2] > 0) & (wo[2] > 0)
    return fresnel, distribution(alpha, half), visibility(alpha, wi[2], wo[2]), above


def _passing(roughness: Tensor, f0: Tensor, cosine: Float[Tensor, " N"]) -> Float[Tensor, "1 N"]:
    """Share of light from a direction that the specular layer does not reflect."""
    a, b = ggx_albedo(roughness, cosine.clamp_min(0.0))
    return 1.0 - (f0 * a + b)
