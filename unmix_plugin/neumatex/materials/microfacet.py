"""GGX microfacets: distribution, masking, reflection at the half vector, sampling of visible normals.

Notation: `N` points, `K` lobes of a point. `alpha` is the width of a lobe, about the square of its roughness.
Directions are local, z along the normal; `n_i` and `n_o` are the cosines of `wi` (light) and `wo` (eye). Components and
lobes come first, `3 N` and `K N`: numbers that meet are then side by side in memory, which is several times faster.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

SMALLEST_ALPHA = 0.002
"""Width of the sharpest lobe; a perfect mirror has no reflectance that could be evaluated."""
SMALLEST_COSINE = 1e-4
"""Grazing directions count as this steep in denominators."""


def alpha_of(roughness: Tensor) -> Tensor:
    """Width of the lobe of a perceptual roughness, [0, 1].

    >>> alpha_of(torch.tensor([0.0, 1.0]))
    tensor([0.0020, 1.0000])
    """
    return SMALLEST_ALPHA + (1.0 - SMALLEST_ALPHA) * roughness * roughness


def roughness_of(alpha: Tensor) -> Tensor:
    """Perceptual roughness of a lobe's width: the inverse of `alpha_of`."""
    return torch.sqrt(((alpha - SMALLEST_ALPHA) / (1.0 - SMALLEST_ALPHA)).clamp(1e-8, 1.0))


def half_vectors(wi: Float[Tensor, "3 N"], wo: Float[Tensor, "3 N"]) -> Float[Tensor, "3 N"]:
    """Unit vectors halfway; short ones where the directions are opposite."""
    return _unit(wi + wo)


def dot(a: Float[Tensor, "3 N"], b: Float[Tensor, "3 N"]) -> Float[Tensor, " N"]:
    """Inner products."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def schlick(cosine: Tensor) -> Tensor:
    """(1 - cosine)^5: how far reflection at this angle is from `f0` to 1."""
    x = (1.0 - cosine).clamp(0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


def distribution(alpha: Float[Tensor, "K N"], half: Float[Tensor, "3 N"]) -> Float[Tensor, "K N"]:
    """GGX density of microfacet normals, 1/sr; 0 below the surface."""
    # The sine comes from x and y: one minus the squared cosine would lose the digits of a sharp lobe.
    sine2 = half[0] * half[0] + half[1] * half[1]
    cosine = half[2].clamp_min(0.0)
    a2 = alpha * alpha
    spread = (a2 * (cosine * cosine) + sine2).clamp_min(1e-9)  # 0 where directions are opposite
    return ((cosine > 0) / math.pi) * a2 / (spread * spread)


def visibility(
    alpha: Float[Tensor, "K N"], n_i: Float[Tensor, " N"], n_o: Float[Tensor, " N"]
) -> Float[Tensor, "K N"]:
    """Smith's height-correlated masking and shadowing over 4 n_i n_o."""
    a2 = alpha * alpha
    n_i, n_o = n_i.clamp_min(SMALLEST_COSINE), n_o.clamp_min(SMALLEST_COSINE)
    of_eye = n_i * torch.sqrt(n_o * n_o + a2 * (1.0 - n_o * n_o))
    of_light = n_o * torch.sqrt(n_i * n_i + a2 * (1.0 - n_i * n_i))
    return 0.5 / (of_eye + of_light)


def sample_reflections(
    alpha: Float[Tensor, " N"], wo: Float[Tensor, "3 N"], uniforms: Float[Tensor, "2 N"]
) -> Float[Tensor, "3 N"]:
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


def reflection_density(
    alpha: Float[Tensor, "K N"], wi: Float[Tensor, "3 N"], wo: Float[Tensor, "3 N"]
) -> Float[Tensor, "K N"]:
    """Density of `sample_reflections` on the whole sphere, 1/sr; `wo` must be above the surface."""
    n_o = wo[2].clamp_min(SMALLEST_COSINE)
    root = torch.sqrt(n_o * n_o + alpha * alpha * (1.0 - n_o * n_o))
    return distribution(alpha, half_vectors(wi, wo)) * 0.5 / (n_o + root)


def _unit(vectors: Float[Tensor, "3 N"]) -> Float[Tensor, "3 N"]:
    return vectors * torch.rsqrt(dot(vectors, vectors).clamp_min(1e-12))
