"""Gaussians on a picture, blended front to back: what viewers of splats draw, differentiable.

Notation: `P` Gaussians, `C` channels, `E` entries: a Gaussian in one of the `T` tiles that it touches. A Gaussian of
mean m, opacity o and inverse covariance (a b; b c), pixels, has at the centre x of a pixel, d = x - m, the opacity

    alpha = min(0.99, o exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2)),    0 where that is below 1/255,

and adds its colour by T alpha, T the product of 1 - alpha of all Gaussians before it; none where T is 1e-4 or less.

Source: Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering, with the limits of its code.

Of the kernels a work item is a tile, which walks its Gaussians and the pixels that each of them touches; so no two of
them share an address. The gradients that entries get from their tiles are added up afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float, Int64
from torch import Tensor

from unmix_plugin.operators.launching import declare, launch

_TILE = 16
"""Edge of a tile, pixels."""
_PART = 4
"""Tiles of a part of a launch on CPUs."""
_LEAST, _MOST, _OPAQUE = wp.constant(1 / 255), wp.constant(0.99), wp.constant(1e-4)
_NUM_SHAPE = 6
"""Numbers of a Gaussian but its colour: mean, inverse covariance, opacity."""


@dataclass(frozen=True)
class TileLists:
    """Which Gaussians each tile of a picture shows, front to back, tiles row after row."""

    order: Int64[Tensor, "E"]
    """Gaussians."""
    packed_info: Int64[Tensor, "T 2"]
    """First entry and count of each tile."""
    reaches: Float[Tensor, "P 2"]
    """How far from its mean along x and y a Gaussian may be seen, pixels."""
    size: Int64[Tensor, "2"]
    """Width and height of the picture."""


@torch.no_grad()
def tile_lists(
    means: Float[Tensor, "P 2"],
    conics: Float[Tensor, "P 3"],
    opacities: Float[Tensor, "P"],
    depths: Float[Tensor, "P"],
    width: int,
    height: int,
) -> TileLists:
    """Sort Gaussians, arguments as those of `splat`, into the tiles of a picture by their depths; what has no positive
    depth is left out."""
    a, b, c = conics.unbind(-1)
    squared = 2 * torch.log(opacities / _LEAST).clamp(min=0) / (a * c - b * b).clamp(min=1e-12)
    reaches = (squared[:, None] * torch.stack([c, a], dim=-1)).sqrt()
    columns, rows = -(-width // _TILE), -(-height // _TILE)
    counts = torch.tensor([columns, rows], device=means.device)
    low = ((means - reaches) / _TILE).floor().long().clamp(min=0)
    high = ((means + reaches) / _TILE).floor().long() + 1
    spans = (torch.minimum(high, counts) - low).clamp(min=0)
    spans = spans * ((depths > 0) & (opacities > _LEAST))[:, None]
    sorted_by_depth = depths.argsort()
    spans = spans[sorted_by_depth]
    touched = spans.prod(dim=-1)
    rank = torch.arange(len(means), device=means.device).repeat_interleave(touched)
    within = torch.arange(len(rank), device=means.device) - (touched.cumsum(0) - touched)[rank]
    order, across = sorted_by_depth[rank], spans[rank, 0]
    tiles = (low[order, 1] + within // across) * columns + low[order, 0] + within % across
    tiles, by_tile = tiles.sort(stable=True)
    num = torch.bincount(tiles, minlength=columns * rows)
    packed_info = torch.stack([num.cumsum(0) - num, num], dim=-1)
    return TileLists(order[by_tile], packed_info, reaches, counts.new_tensor([width, height]))


def splat(
    means: Float[Tensor, "P 2"],
    conics: Float[Tensor, "P 3"],
    opacities: Float[Tensor, "P"],
    colours: Float[Tensor, "P C"],
    lists: TileLists,
) -> Float[Tensor, "H W C"]:
    """Blend Gaussians on black; a channel that is 1 everywhere becomes the opacity of the picture. Differentiable once.

    Args:
        means: Pixels, x to the right and y down, the centre of column c, row r at (c + 0.5, r + 0.5).
        conics: a, b, c of the inverse covariances, per square pixel.
        opacities: At the means, (0, 1).
        colours: Any numbers.
        lists: Of the same Gaussians.
    """
    shapes = torch.cat([means, conics, opacities[:, None]], dim=-1)
    return _Splat.apply(shapes, colours.contiguous(), lists)  # type: ignore[no-any-return]


def splat_twin(
    means: Float[Tensor, "P 2"],
    conics: Float[Tensor, "P 3"],
    opacities: Float[Tensor, "P"],
    colours: Float[Tensor, "P C"],
    depths: Float[Tensor, "P"],
    width: int,
    height: int,
) -> Float[Tensor, "H W C"]:
    """The same in plain PyTorch, every Gaussian at every pixel."""
    order = depths.argsort()
    order = order[depths[order] > 0]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).to(means) + 0.5
    offsets = pixels.view(1, -1, 2) - means[order, None]
    dx, dy = offsets.unbind(-1)
    a, b, c = conics[order, :, None].unbind(1)
    alphas = opacities[order, None] * torch.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)
    alphas = torch.where(alphas < _LEAST, torch.zeros_like(alphas), alphas.clamp(max=_MOST))
    passed = (1 - alphas).cumprod(dim=0)
    before = torch.cat([torch.ones_like(passed[:1]), passed])[: len(passed)]
    weights = torch.where(before > _OPAQUE, before * alphas, torch.zeros_like(alphas))
    return (weights.T @ colours[order]).view(height, width, colours.shape[1])


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, shapes: Tensor, colours: Tensor, lists: TileLists) -> Tensor:
        _declare_kernels(shapes.dtype)
        width, height = lists.size.tolist()
        picture = colours.new_zeros(height * width, colours.shape[1])
        transmittances = colours.new_ones(len(picture))
        arrays = [lists.size, lists.order, lists.packed_info, lists.reaches]
        arrays += [shapes, colours, transmittances, picture]
        launch(_blend_kernel, len(lists.packed_info), arrays, shapes.device, _PART)
        ctx.save_for_backward(shapes, colours, picture)
        ctx.lists = lists
        return picture.view(height, width, colours.shape[1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        shapes, colours, picture = ctx.saved_tensors
        lists: TileLists = ctx.lists
        incoming = gradients[0].reshape(picture.shape).contiguous()
        behind = (incoming * picture).sum(dim=-1)
        transmittances = torch.ones_like(behind)
        entries = shapes.new_zeros(len(lists.order), _NUM_SHAPE + colours.shape[1])
        arrays = [lists.size, lists.order, lists.packed_info, lists.reaches]
        arrays += [shapes, colours, incoming, transmittances, behind, entries]
        launch(_blend_gradient_kernel, len(lists.packed_info), arrays, shapes.device, _PART)
        found = shapes.new_zeros(len(shapes), entries.shape[1]).index_add_(0, lists.order, entries)
        return found[:, :_NUM_SHAPE], found[:, _NUM_SHAPE:].contiguous(), None


@cache
def _declare_kernels(dtype: torch.dtype) -> None:
    number = wp.dtype_from_torch(dtype)
    vector, matrix = (number, 1), (number, 2)
    lists = ((wp.int64, 1), (wp.int64, 1), (wp.int64, 2), matrix)
    declare(_blend_kernel, *lists, matrix, matrix, vector, matrix)
    declare(_blend_gradient_kernel, *lists, matrix, matrix, matrix, vector, vector, matrix)


@wp.kernel(enable_backward=False)
@no_type_check
def _blend_kernel(
    first: int,
    end: int,
    stride: int,
    size: wp.array(dtype=wp.int64),
    order: wp.array(dtype=wp.int64),
    packed_info: wp.array2d(dtype=wp.int64),
    reaches: wp.array2d(dtype=Any),
    shapes: wp.array2d(dtype=Any),
    colours: wp.array2d(dtype=Any),
    transmittances: wp.array(dtype=Any),
    picture: wp.array2d(dtype=Any),
):
    tile = first + wp.tid()
    width = int(size[0])
    height = int(size[1])
    columns = (width + 15) // 16
    half = shapes.dtype(0.5)
    one = shapes.dtype(1.0)
    while tile < end:
        tile_left = (tile % columns) * 16
        tile_top = (tile // columns) * 16
        entry = int(packed_info[tile, 0])
        stop = entry + int(packed_info[tile, 1])
        while entry < stop:
            which = int(order[entry])
            shape = shapes[which]
            colour = colours[which]
            a = shape[2]
            b = shape[3]
            c = shape[4]
            opacity = shape[5]
            left = wp.max(tile_left, int(wp.floor(shape[0] - reaches[which, 0])))
            right = wp.min(wp.min(tile_left + 16, width), int(wp.ceil(shape[0] + reaches[which, 0])))
            y = wp.max(tile_top, int(wp.floor(shape[1] - reaches[which, 1])))
            bottom = wp.min(wp.min(tile_top + 16, height), int(wp.ceil(shape[1] + reaches[which, 1])))
            while y < bottom:
                dy = shapes.dtype(y) + half - shape[1]
                x = int(left)
                while x < right:
                    pixel = y * width + x
                    before = transmittances[pixel]
                    if before > shapes.dtype(_OPAQUE):
                        dx = shapes.dtype(x) + half - shape[0]
                        alpha = opacity * wp.exp(-half * (a * dx * dx + c * dy * dy) - b * dx * dy)
                        if alpha >= shapes.dtype(_LEAST):
                            alpha = wp.min(alpha, shapes.dtype(_MOST))
                            weight = before * alpha
                            seen = picture[pixel]
                            channel = int(0)  # noqa: RUF046, UP018 - Warp takes a bare literal for a constant
                            while channel < colours.shape[1]:
                                seen[channel] = seen[channel] + weight * colour[channel]
                                channel += 1
                            transmittances[pixel] = before * (one - alpha)
                    x += 1
                y += 1
            entry += 1
        tile += stride


@wp.kernel(enable_backward=False)
@no_type_check
def _blend_gradient_kernel(
    first: int,
    end: int,
    stride: int,
    size: wp.array(dtype=wp.int64),
    order: wp.array(dtype=wp.int64),
    packed_info: wp.array2d(dtype=wp.int64),
    reaches: wp.array2d(dtype=Any),
    shapes: wp.array2d(dtype=Any),
    colours: wp.array2d(dtype=Any),
    incoming: wp.array2d(dtype=Any),
    transmittances: wp.array(dtype=Any),
    behind: wp.array(dtype=Any),
    entries: wp.array2d(dtype=Any),
):
    # Front to back again: `behind` starts as all that a pixel's loss sees and keeps what comes after each Gaussian,
    # which shrinks as 1 - alpha does.
    tile = first + wp.tid()
    width = int(size[0])
    height = int(size[1])
    columns = (width + 15) // 16
    half = shapes.dtype(0.5)
    one = shapes.dtype(1.0)
    while tile < end:
        tile_left = (tile % columns) * 16
        tile_top = (tile // columns) * 16
        entry = int(packed_info[tile, 0])
        stop = entry + int(packed_info[tile, 1])
        while entry < stop:
            which = int(order[entry])
            shape = shapes[which]
            colour = colours[which]
            a = shape[2]
            b = shape[3]
            c = shape[4]
            opacity = shape[5]
            of_x = shapes.dtype(0.0)
            of_y = shapes.dtype(0.0)
            of_a = shapes.dtype(0.0)
            of_b = shapes.dtype(0.0)
            of_c = shapes.dtype(0.0)
            of_opacity = shapes.dtype(0.0)
            gradients = entries[entry]
            left = wp.max(tile_left, int(wp.floor(shape[0] - reaches[which, 0])))
            right = wp.min(wp.min(tile_left + 16, width), int(wp.ceil(shape[0] + reaches[which, 0])))
            y = wp.max(tile_top, int(wp.floor(shape[1] - reaches[which, 1])))
            bottom = wp.min(wp.min(tile_top + 16, height), int(wp.ceil(shape[1] + reaches[which, 1])))
            while y < bottom:
                dy = shapes.dtype(y) + half - shape[1]
                x = int(left)
                while x < right:
                    pixel = y * width + x
                    before = transmittances[pixel]
                    if before > shapes.dtype(_OPAQUE):
                        dx = shapes.dtype(x) + half - shape[0]
                        alpha = opacity * wp.exp(-half * (a * dx * dx + c * dy * dy) - b * dx * dy)
                        if alpha >= shapes.dtype(_LEAST):
                            unclamped = alpha
                            alpha = wp.min(alpha, shapes.dtype(_MOST))
                            weight = before * alpha
                            of_pixel = incoming[pixel]
                            own = shapes.dtype(0.0)
                            channel = int(0)  # noqa: RUF046, UP018
                            while channel < colours.shape[1]:
                                gradient = of_pixel[channel]
                                own += gradient * colour[channel]
                                gradients[channel + 6] = gradients[channel + 6] + weight * gradient
                                channel += 1
                            after = behind[pixel] - weight * own
                            behind[pixel] = after
                            transmittances[pixel] = before * (one - alpha)
                            if unclamped <= shapes.dtype(_MOST):
                                of_alpha = before * own - after / (one - alpha)
                                of_opacity += of_alpha * alpha / opacity
                                of_power = -of_alpha * alpha
                                of_x -= of_power * (a * dx + b * dy)
                                of_y -= of_power * (b * dx + c * dy)
                                of_a += of_power * half * dx * dx
                                of_b += of_power * dx * dy
                                of_c += of_power * half * dy * dy
                    x += 1
                y += 1
            gradients[0] = of_x
            gradients[1] = of_y
            gradients[2] = of_a
            gradients[3] = of_b
            gradients[4] = of_c
            gradients[5] = of_opacity
            entry += 1
        tile += stride
