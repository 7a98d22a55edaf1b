"""Synthetic linear mixtures for the tests of endmember extraction."""

from itertools import combinations

import torch
from torch import Tensor

from unmix_plugin.spectral.metrics import spectral_angle


def smooth_endmembers(num_endmembers: int, num_bands: int = 24) -> Tensor:
    """Bumps at different places over a pedestal: well apart, in (0, 1), (K, B) in float64."""
    position = torch.linspace(0, 1, num_bands, dtype=torch.float64)
    centres = (torch.arange(num_endmembers, dtype=torch.float64)[:, None] + 0.5) / num_endmembers
    return 0.1 + 0.7 * torch.exp(-(((position - centres) * num_endmembers / 1.2) ** 2))


def mixed_pixels(endmembers: Tensor, num_pixels: int, seed: int, max_abundance: float = 0.8) -> Tensor:
    """Mixtures none of which is purer than `max_abundance` (of a lone endmember: copies)."""
    if len(endmembers) == 1:
        return endmembers.repeat(num_pixels, 1)
    generator = torch.Generator().manual_seed(seed)
    weights = -torch.log(torch.rand(num_pixels, len(endmembers), dtype=torch.float64, generator=generator))
    weights = weights / weights.sum(1, keepdim=True)
    excess = (weights.amax(1, keepdim=True) - max_abundance).clamp(min=0) / (1 - 1 / len(endmembers))
    return (weights * (1 - excess) + excess / len(endmembers)) @ endmembers


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def surface_pixels(materials: Tensor, seed=0, per_material=60, per_pair=30, noise=0.0) -> Tensor:
    """Pixels of surfaces: pure ones of each material and mixtures of every two, under random shading."""
    generator = seeded(seed)
    parts = [materials.repeat(per_material, 1)]
    for first, second in combinations(range(len(materials)), 2):
        share = torch.rand(per_pair, 1, dtype=torch.float64, generator=generator)
        parts.append(share * materials[first] + (1 - share) * materials[second])
    pixels = torch.cat(parts)
    shading = 0.1 + 0.9 * torch.rand(len(pixels), 1, dtype=torch.float64, generator=generator)
    spread = noise * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    return (shading * pixels + spread).clamp(min=1e-4)


def worst_angle(found: Tensor, materials: Tensor) -> float:
    """Largest angle of a material to the nearest found spectrum."""
    return float(spectral_angle(materials[:, None].double(), found[None].double()).amin(1).max())
