"""Materials, directions and uniform numbers for the laws of reflectances."""

import math

import torch
from torch import Tensor


def wide_parameters(number: int, num_parameters: int, seed: int = 0) -> Tensor:
    """Random parameters, a quarter of them at 0 or 1."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(number, num_parameters, generator=generator)
    ends = torch.rand(number, num_parameters, generator=generator)
    return torch.where(ends < 0.125, 0.0, torch.where(ends > 0.875, 1.0, drawn))


def eye_directions(number: int, seed: int = 1, lowest: float = 0.05) -> Tensor:
    """Above the surface, cosines from `lowest` to 1."""
    generator = torch.Generator().manual_seed(seed)
    z = lowest + (1 - lowest) * torch.rand(number, generator=generator)
    angle = 2 * math.pi * torch.rand(number, generator=generator)
    sine = torch.sqrt(1 - z * z)
    return torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z], -1)


def numbers(rows: int, columns: int, seed: int = 2) -> Tensor:
    """Uniform random numbers."""
    return torch.rand(rows, columns, generator=torch.Generator().manual_seed(seed))


def spherical_grid(rings: int, spokes: int) -> tuple[Tensor, Tensor]:
    """Directions over the whole sphere and their solid angles."""
    z = 1 - 2 * (torch.arange(rings, dtype=torch.float64) + 0.5) / rings
    angle = 2 * math.pi * (torch.arange(spokes, dtype=torch.float64) + 0.5) / spokes
    z, angle = torch.cartesian_prod(z, angle).unbind(-1)
    sine = torch.sqrt(1 - z * z)
    directions = torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z], -1).float()
    return directions, torch.full((len(directions),), 4 * math.pi / len(directions))
