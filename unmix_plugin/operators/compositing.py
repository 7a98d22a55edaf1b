"""Volume rendering of packed samples: from optical depths to weights, from weights to totals a ray.

Notation: `S` samples, `R` rays, `C` channels; `tau` the optical depth of a sample (density times length). Transmittance
before sample i is T_i = exp(-sum_{j<i} tau_j), its weight w_i = T_i (1 - exp(-tau_i)); a ray's weights and its final
transmittance sum to 1.

Source: Max 1995, Optical Models for Direct Volume Rendering, in the discrete form of Mildenhall et al. 2020, eq. 3.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.operators.launching import as_warp, launch


def volume_weights(optical_depths: Float[Tensor, "S"], packed_info: Int[Tensor, "R 2"]) -> Float[Tensor, "S"]:
    """Share of its ray's light that each sample sends to the camera, in [0, 1]; differentiable once.

    Args:
        optical_depths: Density times length of each sample, >= 0.
        packed_info: First sample and count of each ray; together the rays cover all samples.
    """
    return _VolumeWeights.apply(optical_depths.contiguous(), packed_info)  # type: ignore[no-any-return]


def volume_weights_twin(
    optical_depths: Float[Tensor, "S"], packed_info: Int[Tensor, "R 2"]
) -> Float[Tensor, "S"]:
    """The same as `volume_weights` in plain PyTorch."""
    exclusive = optical_depths.cumsum(0) - optical_depths
    counts = packed_info[:, 1]
    at_start = torch.cat([exclusive, exclusive.new_zeros(1)])[packed_info[:, 0].clamp(max=len(exclusive))]
    in_front = exclusive - torch.repeat_interleave(at_start, counts)
    return torch.exp(-in_front) * -torch.expm1(-optical_depths)


def accumulate(
    weights: Float[Tensor, "S"], values: Float[Tensor, "S C"], packed_info: Int[Tensor, "R 2"]
) -> Float[Tensor, "R C"]:
    """Weighted sum of the samples of each ray; zero for a ray without samples; differentiable once."""
    return _Accumulate.apply(weights.contiguous(), values.contiguous(), packed_info)  # type: ignore[no-any-return]


def accumulate_twin(
    weights: Float[Tensor, "S"], values: Float[Tensor, "S C"], packed_info: Int[Tensor, "R 2"]
) -> Float[Tensor, "R C"]:
    """The same as `accumulate` in plain PyTorch."""
    rays = torch.arange(len(packed_info), device=weights.device)
    ray_indices = torch.repeat_interleave(rays, packed_info[:, 1])
    totals = values.new_zeros(len(packed_info), values.shape[1])
    return totals.index_add(0, ray_indices, weights[:, None] * values)


def _launch(kernel: Any, packed_info: Int[Tensor, "R 2"], *arrays: Tensor) -> None:
    launch(kernel, len(packed_info), [as_warp(array) for array in arrays], packed_info.device)


class _VolumeWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, optical_depths: Tensor, packed_info: Tensor) -> Tensor:
        from unmix_plugin.operators._compositing_kernels import weights_kernel

        weights, transmittances = torch.empty_like(optical_depths), torch.empty_like(optical_depths)
        _launch(weights_kernel, packed_info, optical_depths, packed_info, weights, transmittances)
        ctx.save_for_backward(weights, transmittances, packed_info)
        return weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        from unmix_plugin.operators._compositing_kernels import weights_gradient_kernel

        weights, transmittances, packed_info = ctx.saved_tensors
        incoming, depth_gradients = gradients[0].contiguous(), torch.empty_like(weights)
        arrays = (weights, transmittances, packed_info, incoming, depth_gradients)
        _launch(weights_gradient_kernel, packed_info, *arrays)
        return depth_gradients, None


class _Accumulate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, values: Tensor, packed_info: Tensor) -> Tensor:
        from unmix_plugin.operators._compositing_kernels import accumulate_kernel

        totals = values.new_empty(len(packed_info), values.shape[1])
        _launch(accumulate_kernel, packed_info, weights, values, packed_info, totals)
        ctx.save_for_backward(weights, values, packed_info)
        return totals

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        from unmix_plugin.operators._compositing_kernels import accumulate_gradient_kernel

        weights, values, packed_info = ctx.saved_tensors
        incoming = gradients[0].contiguous()
        weight_gradients, value_gradients = torch.empty_like(weights), torch.empty_like(values)
        arrays = (weights, values, packed_info, incoming, weight_gradients, value_gradients)
        _launch(accumulate_gradient_kernel, packed_info, *arrays)
        return weight_gradients, value_gradients, None
