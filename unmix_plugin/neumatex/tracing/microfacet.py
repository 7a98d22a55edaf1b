"""GGX microfacets: shading frames, distribution, masking, sampling of visible normals, and mixtures of such lobes.

Notation: `N` points, `K` lobes of a point. `alpha` is the width of a lobe, about the square of its roughness.
Directions are local, z along the normal; `n_i` and `n_o` are the cosines of `wi` (light) and `wo` (eye). Components and
lobes come first, `3 N` and `K N`: numbers that meet are then side by side in memory, which is several times faster.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

Numbers: TypeAlias = Float[Tensor, " N"]
Vectors: TypeAlias = Float[Tensor, "3 N"]
Lobes: TypeAlias = Float[Tensor, "K N"]
SMALLEST_ALPHA = 0.002
"""Width of the sharpest lobe; a perfect mirror has no reflectance that could be evaluated."""
SMALLEST_COSINE = 1e-4
"""Grazing directions count as this steep in denominators."""


def frames(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """Right-handed orthonormal frames; the rows are tangent, bitangent and normal.

    Args:
        normals: Unit length.
    Source:
        Duff et al. 2017, Building an orthonormal basis, revisited.

    >>> frames(torch.tensor([[0.0, 0.0, 1.0]]))[0].diagonal()
    tensor([1., 1., 1.])
    """
    x, y, z = normals.unbind(-1)
    sign = torch.copysign(torch.ones_like(z), z)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangents = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], -1)
    bitangents = torch.stack([b, sign + y * y * a, -y], -1)
    return torch.stack([tangents, bitangents, normals], -2)


def to_local(frames: Float[Tensor, "N 3 3"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """World directions as seen in their frames."""
    return (frames * directions[:, None, :]).sum(-1)


def to_world(frames: Float[Tensor, "N 3 3"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Directions of local frames as seen in the world."""
    return (frames * directions[:, :, None]).sum(-2)


def alpha_of(roughness: Tensor) -> Tensor:
    """Width of the lobe of a perceptual roughness, [0, 1].

    >>> alpha_of(torch.tensor([0.0, 1.0]))
    tensor([0.0020, 1.0000])
    """
    return SMALLEST_ALPHA + (1.0 - SMALLEST_ALPHA) * roughness * roughness


def half_vectors(wi: Vectors, wo: Vectors) -> Vectors:
    """Unit vectors halfway; short ones where the directions are opposite."""
    return _unit(wi + wo)


def dot(a: Vectors, b: Vectors) -> Numbers:
    """Inner products."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def schlick(cosine: Tensor) -> Tensor:
    """(1 - cosine)^5: how far reflection at this angle is from `f0` to 1."""
    x = (1.0 - cosine).clamp(0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


def distribution(alpha: Lobes, half: Vectors) -> Lobes:
    """GGX density of microfacet normals, 1/sr; 0 below the surface."""
    # The sine comes from x and y: one minus the squared cosine would lose the digits of a sharp lobe.
    sine2 = half[0] * half[0] + half[1] * half[1]
    cosine = half[2].clamp_min(0.0)
    a2 = alpha * alpha
    spread = (a2 * (cosine * cosine) + sine2).clamp_min(1e-9)  # 0 where directions are opposite
    return ((cosine > 0) / math.pi) * a2 / (spread * spread)


def visibility(alpha: Lobes, n_i: Numbers, n_o: Numbers) -> Lobes:
    """Smith's height-correlated masking and shadowing over 4 n_i n_o."""
    a2 = alpha * alpha
    n_i, n_o = n_i.clamp_min(SMALLEST_COSINE), n_o.clamp_min(SMALLEST_COSINE)
    of_eye = n_i * torch.sqrt(n_o * n_o + a2 * (1.0 - n_o * n_o))
    of_light = n_o * torch.sqrt(n_i * n_i + a2 * (1.0 - n_i * n_i))
    return 0.5 / (of_eye + of_light)


def sample_reflections(alpha: Numbers, wo: Vectors, uniforms: Float[Tensor, "2 N"]) -> Vectors:
    """Directions to the light by reflection of `wo` at visible normals; some point below the surface.

    Source:
        Dupuy and Benyoub 2023, Sampling visible GGX normals with spherical caps.
    """
    scale = torch.stack([alpha, alpha, torch.ones_like(alpha)])
    stretched = _unit(wo * scale)
    z = (1.0 - uniforms[1]) * (1.0 + stretched[2]) - stretched[2]
    sine = torch.sqrt((1.0 - z * z).clamp(0.0, 1.0))
    angle = 2.0 * math.pi * uniforms[0]
    cap = torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z])
    normals = _unit((cap + stretched) * scale)
    return 2.0 * dot(wo, normals) * normals - wo


def reflection_density(alpha: Lobes, wi: Vectors, wo: Vectors) -> Lobes:
    """Density of `sample_reflections` on the whole sphere, 1/sr; `wo` must be above the surface."""
    n_o = wo[2].clamp_min(SMALLEST_COSINE)
    root = torch.sqrt(n_o * n_o + alpha * alpha * (1.0 - n_o * n_o))
    return distribution(alpha, half_vectors(wi, wo)) * 0.5 / (n_o + root)


def _unit(vectors: Vectors) -> Vectors:
    return vectors * torch.rsqrt(dot(vectors, vectors).clamp_min(1e-12))


@dataclass(frozen=True)
class LobeMixture:
    """A density of directions to the light for one `wo` per point."""

    alphas: Lobes
    """Widths of the GGX lobes."""
    shares: Float[Tensor, "K1 N"]
    """Of the cosine lobe, then of each GGX lobe; they sum to 1."""

    @staticmethod
    def of_albedos(alphas: Lobes, diffuse: Numbers, specular: Lobes) -> "LobeMixture":
        """Shares in proportion to what each lobe reflects; every lobe keeps a small one, which bounds estimates."""
        albedos = torch.cat([diffuse[None] + 0.05, specular + 0.005])
        return LobeMixture(alphas, albedos / albedos.sum(0))

    def sample(self, wo: Vectors, uniforms: Vectors) -> Vectors:
        """Directions to the light; those of GGX lobes can point below the surface."""
        lobe = (uniforms[2] >= self.shares.cumsum(0)).sum(0).clamp_max(len(self.alphas))
        alpha = self.alphas.gather(0, (lobe - 1).clamp_min(0)[None])[0]
        reflected = sample_reflections(alpha, wo, uniforms[:2])
        return torch.where(lobe == 0, cosine_directions(uniforms[:2]), reflected)

    def density(self, wi: Vectors, wo: Vectors) -> Numbers:
        """Of `sample`, 1/sr, on the whole sphere."""
        lobes = (self.shares[1:] * reflection_density(self.alphas, wi, wo)).sum(0)
        return self.shares[0] * (wi[2].clamp_min(0.0) / math.pi) + lobes


def cosine_directions(uniforms: Float[Tensor, "2 N"]) -> Vectors:
    """Directions above the surface whose density is their cosine over pi."""
    radius, angle = torch.sqrt(uniforms[1]), 2.0 * math.pi * uniforms[0]
    z = torch.sqrt((1.0 - uniforms[1]).clamp_min(0.0))
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z])
