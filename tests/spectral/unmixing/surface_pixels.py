"""Pixels of surfaces: most show one material, some two."""

from itertools import combinations

import torch

from tests.spectral.mixtures import seeded


def surface_pixels(materials, seed=0, per_material=60, per_pair=30, noise=0.0):
    """Pure pixels of each material and mixtures of every two, under random shading."""
    generator = seeded(seed)
    parts = [materials.repeat(per_material, 1)]
    for first, second in combinations(range(len(materials)), 2):
        share = torch.rand(per_pair, 1, dtype=torch.float64, generator=generator)
        parts.append(share * materials[first] + (1 - share) * materials[second])
    pixels = torch.cat(parts)
    shading = 0.1 + 0.9 * torch.rand(len(pixels), 1, dtype=torch.float64, generator=generator)
    spread = noise * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    return (shading * pixels + spread).clamp(min=1e-4)
