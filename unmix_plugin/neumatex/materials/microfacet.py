"""GGX microfacets: distribution, masking, reflection at the half vector, sampling of visible normals.

Notation: `N` points, `K` lobes of a point. `alpha` is the width of a lobe, about the square of its roughness.
Directions are local, z along the normal; `n_i` and `n_o` are the cosines of `wi` (light) and `wo` (eye).
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


def half_vectors(wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Unit vectors halfway; short ones where the directions are opposite."""
    sums = wi + wo
    return sums / sums.norm(dim=-1, keepdim=True).clamp_min(1e-6)


def schlick(cosine: Tensor) -> Tensor:
    """(1 - cosine)^5: how far reflection at this angle is from `f0` to 1."""
    x = (1.0 - cosine).clamp(0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


def distribution(alpha: Float[Tensor, "N K"], half: Float[Tensor, "N 3"]) -> Float[Tensor, "N K"]:
    """GGX density of microfacet normals, 1/sr; 0 below the surface."""
    # The sine comes from x and y: one minus the squared cosine would lose the digits of a sharp lobe.
    sine2 = half[:, :1].square() + half[:, 1:2].square()
    cosine = half[:, 2:].clamp_min(0.0)
    a2 = alpha * alpha
    spread = (a2 * cosine * cosine + sine2).clamp_min(1e-9)  # 0 where directions are opposite
    return (cosine > 0) * a2 / (math.pi * spread * spread)


def visibility(
    alpha: Float[Tensor, "N K"], n_i: Float[Tensor, "N 1"], n_o: Float[Tensor, "N 1"]
) -> Float[Tensor, "N K"]:
    """Smith's height-correlated masking and shadowing over 4 n_i n_o."""
    a2 = alpha * alpha
    n_i, n_o = n_i.clamp_min(SMALLEST_COSINE), n_o.clamp_min(SMALLEST_COSINE)
    of_eye = n_i * torch.sqrt(a2 + (1.0 - a2) * n_o * n_o)
    of_light = n_o * torch.sqrt(a2 + (1.0 - a2) * n_i * n_i)
    return 0.5 / (of_eye + of_light)


def sample_reflections(
    alpha: Float[Tensor, " N"], wo: Float[Tensor, "N 3"], uniforms: Float[Tensor, "N 2"]
) -> Float[Tensor, "N 3"]:
    """Directions to the light by reflection of `wo` at visible normals; some point below the surface.

    Source:
        Dupuy and Benyoub 2023, Sampling visible GGX normals with spherical caps.
    """
    scale = torch.stack([alpha, alpha, torch.ones_like(alpha)], -1)
    stretched = torch.nn.functional.normalize(wo * scale, dim=-1)
    z = (1.0 - uniforms[:, 1]) * (1.0 + stretched[:, 2]) - stretched[:, 2]
    sine = torch.sqrt((1.0 - z * z).clamp(0.0, 1.0))
    angle = 2.0 * math.pi * uniforms[:, 0]
    cap = torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z], -1)
    normals = torch.nn.functional.normalize((cap + stretched) * scale, dim=-1)
    return 2.0 * (wo * normals).sum(-1, keepdim=True) * normals - wo


def reflection_density(
    alpha: Float[Tensor, "N K"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
) -> Float[Tensor, "N K"]:
    """Density of `sample_reflections` on the whole sphere, 1/sr; `wo` must be above the surface."""
    n_o = wo[:, 2:].clamp_min(SMALLEST_COSINE)
    a2 = alpha * alpha
    return distribution(alpha, half_vectors(wi, wo)) * 0.5 / (n_o + torch.sqrt(a2 + (1.0 - a2) * n_o * n_o))
