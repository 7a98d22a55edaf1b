"""Directional albedos of the lobes, integrated once and looked up afterwards.

A table's rows are perceptual roughness from 0 to 1, its columns the square root of the cosine from 0 to 1: albedos
change fastest near the horizon.
"""

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.microfacet import (
    SMALLEST_COSINE,
    alpha_of,
    dot,
    half_vectors,
    sample_reflections,
    schlick,
)
from unmix_plugin.neumatex.materials.sheen import sheen_reflection

_ROWS, _COLUMNS, _STRATA = 32, 48, 32


def ggx_albedo(
    roughness: Float[Tensor, "K N"], cosine: Float[Tensor, " N"]
) -> tuple[Float[Tensor, "K N"], Float[Tensor, "K N"]]:
    """`(a, b)`: a GGX lobe of Schlick's Fresnel term reflects `f0 a + b` of what comes from this cosine."""
    a, b = _look_up(_ggx_cells(roughness.device), roughness, cosine).unbind(0)
    return a, b


def sheen_albedo(roughness: Float[Tensor, " N"], cosine: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Directional albedo of white sheen, [0, 1]."""
    return _look_up(_sheen_cells(roughness.device), roughness[None], cosine)[0, 0]


def mean_ggx_albedo(roughness: Float[Tensor, "K N"]) -> tuple[Float[Tensor, "K N"], Float[Tensor, "K N"]]:
    """`(a, b)` of `ggx_albedo`, averaged over the hemisphere with the cosine as weight."""
    means = _ggx_means(roughness.device)
    row = (roughness.detach() * (_ROWS - 1)).floor().clamp(0, _ROWS - 2)
    index = row.long().reshape(-1)
    low, rise = (each.index_select(1, index).reshape(2, *roughness.shape) for each in means)
    a, b = (low + (roughness * (_ROWS - 1) - row) * rise).unbind(0)
    return a, b


@lru_cache(maxsize=1)
def ggx_table() -> Float[Tensor, "R M 2"]:
    """Quasi Monte Carlo over visible normals, on a grid of strata."""
    roughness, cosine = _nodes(_COLUMNS, alpha_of(torch.linspace(0.0, 1.0, _ROWS)))
    table = torch.empty(_ROWS * _COLUMNS, 2)
    steps = (torch.arange(_STRATA) + 0.5) / _STRATA
    uniforms = torch.cartesian_prod(steps, steps).T
    for node in range(_ROWS * _COLUMNS):
        wo = _direction(cosine[node])[:, None].expand(3, uniforms.shape[1])
        alpha = roughness[node].expand(uniforms.shape[1])
        wi = sample_reflections(alpha, wo, uniforms)
        a2, n_i, n_o = alpha[0] ** 2, wi[2].clamp_min(0.0), wo[2]
        root_i, root_o = (torch.sqrt(a2 + (1.0 - a2) * n * n) for n in (n_i, n_o))
        # Reflectance times cosine over density: masking of both directions over masking of the eye's alone.
        passed = n_i * (n_o + root_o) / (n_o * root_i + n_i * root_o).clamp_min(1e-9)
        edge = schlick(dot(half_vectors(wi, wo), wo))
        table[node] = torch.stack([((1.0 - edge) * passed).mean(), (edge * passed).mean()])
    return table.reshape(_ROWS, _COLUMNS, 2)


@lru_cache(maxsize=1)
def sheen_table() -> Float[Tensor, "R M 1"]:
    """A product rule over the hemisphere."""
    roughness, cosine = _nodes(_COLUMNS, torch.linspace(0.0, 1.0, _ROWS))
    steps = (torch.arange(2 * _STRATA) + 0.5) / (2 * _STRATA)
    u, v = torch.cartesian_prod(steps, steps).unbind(-1)
    # Squared steps crowd at the horizon; du of the cosine is 2 u.
    wi_z, weight = u * u, 2.0 * u
    sine = torch.sqrt(1.0 - wi_z * wi_z)
    wi = torch.stack([sine * torch.cos(math.pi * v), sine * torch.sin(math.pi * v), wi_z])
    table = torch.empty(_ROWS * _COLUMNS, 1)
    for node in range(_ROWS * _COLUMNS):
        wo = _direction(cosine[node])[:, None].expand_as(wi)
        value = sheen_reflection(roughness[node].expand_as(wi_z), half_vectors(wi, wo), wi_z, wo[2])
        table[node] = (value * wi_z * weight).mean() * 2.0 * math.pi
    return table.reshape(_ROWS, _COLUMNS, 1)


def _nodes(columns: int, rows: Tensor) -> tuple[Tensor, Tensor]:
    cosine = torch.linspace(0.0, 1.0, columns).square().clamp_min(SMALLEST_COSINE)
    return rows.repeat_interleave(columns), cosine.repeat(len(rows))


def _direction(cosine: Tensor) -> Tensor:
    return torch.stack([torch.sqrt(1.0 - cosine * cosine), torch.zeros_like(cosine), cosine])


def _mean(table: Tensor) -> Tensor:
    """Average over directions, row by row: the integral of 2 mu E(mu), with mu the square of the column."""
    s = torch.linspace(0.0, 1.0, table.shape[1])
    return torch.trapezoid(4.0 * s[:, None] ** 3 * table, s, dim=1)


@lru_cache(maxsize=4)
def _ggx_cells(device: torch.device) -> Tensor:
    return _cells(ggx_table()).to(device)


@lru_cache(maxsize=4)
def _ggx_means(device: torch.device) -> tuple[Tensor, Tensor]:
    """Means of each row, (2, rows), and their rise to the next row."""
    means = _mean(ggx_table()).T.contiguous().to(device)
    return means, means.diff(dim=1)


@lru_cache(maxsize=4)
def _sheen_cells(device: torch.device) -> Tensor:
    return _cells(sheen_table()).to(device)


def _cells(table: Tensor) -> Tensor:
    """Four coefficients of each bilinear cell for each channel, (4 channels, cells)."""
    corner, right = table[:-1, :-1], table[:-1, 1:] - table[:-1, :-1]
    below, twist = table[1:, :-1] - table[:-1, :-1], table[1:, 1:] - table[1:, :-1] - right
    cells = torch.stack([corner, right, below, twist])
    return cells.permute(0, 3, 1, 2).reshape(4 * table.shape[2], -1).contiguous()


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
