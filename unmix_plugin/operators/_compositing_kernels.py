"""Warp kernels of volume rendering on packed samples: one work item is one ray, so no two items share an address.

Rows and stretches of arrays are taken out before they are looped over: an index that counts up from 0 needs no code for
negative ones.
"""

from typing import Any, no_type_check

import warp as wp

_OPAQUE = wp.constant(1e-20)
"""Transmittance that counts as 0: no sum has the digits for it, and on numbers too small for a normal exponent, which
would follow behind every surface, a CPU takes a hundred times as long."""


@wp.kernel(enable_backward=False)
@no_type_check
def weights_kernel(
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
def weights_gradient_kernel(
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
def accumulate_kernel(
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
def accumulate_gradient_kernel(
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
