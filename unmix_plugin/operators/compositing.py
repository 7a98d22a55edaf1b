"""Volume rendering of packed samples: from optical depths to weights, from weights to totals a ray.

Notation: `S` samples, `R` rays, `C` channels; `tau` the optical depth of a sample (density times length). Transmittance
before sample i is T_i = exp(-sum_{j<i} tau_j), its weight w_i = T_i (1 - exp(-tau_i)); a ray's weights and its final
transmittance sum to 1.

Source: Max 1995, Optical Models for Direct Volume Rendering, in the discrete form of Mildenhall et al. 2020, eq. 3.

Of the kernels a work item is a ray, so no two items share an address. Rows and stretches of arrays are taken out before
they are looped over: an index that counts up from 0 needs no code for negative ones.
"""

from functools import cache
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.operators.launching import declare, launch


def volume_weights(optical_depths: Float[Tensor, "S"], packed_info: Int[Tensor, "R 2"]) -> Float[Tensor, "S"]:
    """Share of its ray's light that each sample sends to the camera, in [0, 1]; differentiable once. `packed_info` has
    the first sample and the count of each ray; together the rays cover all samples."""
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


class _VolumeWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, optical_depths: Tensor, packed_info: Tensor) -> Tensor:
        _declare_kernels(optical_depths.dtype)
        weights, transmittances = torch.empty_like(optical_depths), torch.empty_like(optical_depths)
        arrays = [optical_depths, packed_info, weights, transmittances]
        launch(_weights_kernel, len(packed_info), arrays, packed_info.device)
        ctx.save_for_backward(weights, transmittances, packed_info)
        return weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        weights, transmittances, packed_info = ctx.saved_tensors
        incoming, depth_gradients = gradients[0].contiguous(), torch.empty_like(weights)
        arrays = [weights, transmittances, packed_info, incoming, depth_gradients]
        launch(_weights_gradient_kernel, len(packed_info), arrays, packed_info.device)
        return depth_gradients, None


class _Accumulate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, values: Tensor, packed_info: Tensor) -> Tensor:
        _declare_kernels(values.dtype)
        totals = values.new_empty(len(packed_info), values.shape[1])
        launch(_accumulate_kernel, len(packed_info), [weights, values, packed_info, totals], totals.device)
        ctx.save_for_backward(weights, values, packed_info)
        return totals

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        weights, values, packed_info = ctx.saved_tensors
        incoming = gradients[0].contiguous()
        weight_gradients, value_gradients = torch.empty_like(weights), torch.empty_like(values)
        arrays = [weights, values, packed_info, incoming, weight_gradients, value_gradients]
        launch(_accumulate_gradient_kernel, len(packed_info), arrays, packed_info.device)
        return weight_gradients, value_gradients, None


@cache
def _declare_kernels(dtype: torch.dtype) -> None:
    number = wp.dtype_from_torch(dtype)
    vector, matrix, info = (number, 1), (number, 2), (wp.int64, 2)
    declare(_weights_kernel, vector, info, vector, vector)
    declare(_weights_gradient_kernel, vector, vector, info, vector, vector)
    declare(_accumulate_kernel, vector, matrix, info, matrix)
    declare(_accumulate_gradient_kernel, vector, matrix, info, matrix, vector, matrix)


_OPAQUE = wp.constant(1e-20)
"""Transmittance that counts as 0: no sum has the digits for it, and on numbers too small for a normal exponent, which
would follow behind every surface, a CPU takes a hundred times as long."""


@wp.kernel(enable_backward=False)
@no_type_check
def _weights_kernel(
    first: int,
    end: int,
    stride: int,
    optical_depths: wp.array(dtype=Any),
    packed_info: wp.array2d(dtype=wp.int64),
    weights: wp.array(dtype=Any),
    transmittances: wp.array(dtype=Any),
):
    ray = first + wp.tid()
    while ray < end:
        sample = int(packed_info[ray, 0])
        stop = sample + int(packed_info[ray, 1])
        transmittance = weights.dtype(1.0)
        while sample < stop:
            passed = wp.exp(-optical_depths[sample])
            weights[sample] = transmittance * (weights.dtype(1.0) - passed)
            transmittance = transmittance * passed
            if transmittance < weights.dtype(_OPAQUE):
                transmittance = weights.dtype(0.0)
            transmittances[sample] = transmittance
            sample += 1
        ray += stride


@wp.kernel(enable_backward=False)
@no_type_check
def _weights_gradient_kernel(
    first: int,
    end: int,
    stride: int,
    weights: wp.array(dtype=Any),
    transmittances: wp.array(dtype=Any),
    packed_info: wp.array2d(dtype=wp.int64),
    weight_gradients: wp.array(dtype=Any),
    depth_gradients: wp.array(dtype=Any),
):
    # d w_i / d tau_i is what passes sample i; every later weight shrinks by itself: d w_j / d tau_i = -w_j for j > i.
    ray = first + wp.tid()
    while ray < end:
        start = int(packed_info[ray, 0])
        sample = start + int(packed_info[ray, 1]) - 1
        behind = weights.dtype(0.0)
        while sample >= start:
            gradient = weight_gradients[sample]
            depth_gradients[sample] = gradient * transmittances[sample] - behind
            behind = behind + gradient * weights[sample]
            sample -= 1
        ray += stride


@wp.kernel(enable_backward=False)
@no_type_check
def _accumulate_kernel(
    first: int,
    end: int,
    stride: int,
    weights: wp.array(dtype=Any),
    values: wp.array2d(dtype=Any),
    packed_info: wp.array2d(dtype=wp.int64),
    totals: wp.array2d(dtype=Any),
):
    ray = first + wp.tid()
    while ray < end:
        start = int(packed_info[ray, 0])
        count = int(packed_info[ray, 1])
        ray_weights = weights[start : start + count]
        ray_values = values[start : start + count]
        ray_totals = totals[ray]
        channel = int(0)  # noqa: RUF046, UP018 - Warp takes a bare literal for a constant
        while channel < values.shape[1]:
            total = weights.dtype(0.0)
            i = int(0)  # noqa: RUF046, UP018
            while i < count:
                total += ray_weights[i] * ray_values[i, channel]
                i += 1
            ray_totals[channel] = total
            channel += 1
        ray += stride


@wp.kernel(enable_backward=False)
@no_type_check
def _accumulate_gradient_kernel(
    first: int,
    end: int,
    stride: int,
    weights: wp.array(dtype=Any),
    values: wp.array2d(dtype=Any),
    packed_info: wp.array2d(dtype=wp.int64),
    total_gradients: wp.array2d(dtype=Any),
    weight_gradients: wp.array(dtype=Any),
    value_gradients: wp.array2d(dtype=Any),
):
    ray = first + wp.tid()
    while ray < end:
        sample = int(packed_info[ray, 0])
        stop = sample + int(packed_info[ray, 1])
        incoming = total_gradients[ray]
        while sample < stop:
            weight = weights[sample]
            sample_values = values[sample]
            sample_gradients = value_gradients[sample]
            total = weights.dtype(0.0)
            channel = int(0)  # noqa: RUF046, UP018
            while channel < values.shape[1]:
                gradient = incoming[channel]
                total += gradient * sample_values[channel]
                sample_gradients[channel] = weight * gradient
                channel += 1
            weight_gradients[sample] = total
            sample += 1
        ray += stride


def scale_gradient(values: Float[Tensor, "*S"], factors: Float[Tensor, "*#S"]) -> Float[Tensor, "*S"]:
    """The same values; gradients that reach them are multiplied with `factors`."""
    constant = values.detach()
    return constant + factors * (values - constant)
