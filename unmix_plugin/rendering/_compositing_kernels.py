"""Warp kernels of volume rendering on packed samples: one work item is one ray, so no two items share an address."""

from typing import Any, no_type_check

import warp as wp


@wp.kernel(enable_backward=False)
@no_type_check
def weights_kernel(
    first: int,
    optical_depths: wp.array(dtype=Any),
    packed_info: wp.array2d(dtype=wp.int64),
    weights: wp.array(dtype=Any),
    transmittances: wp.array(dtype=Any),
):
    ray = first + wp.tid()
    start = int(packed_info[ray, 0])
    count = int(packed_info[ray, 1])
    transmittance = weights.dtype(1.0)
    for i in range(count):
        sample = start + i
        passed = wp.exp(-optical_depths[sample])
        weights[sample] = transmittance * (weights.dtype(1.0) - passed)
        transmittance = transmittance * passed
        transmittances[sample] = transmittance


@wp.kernel(enable_backward=False)
@no_type_check
def weights_gradient_kernel(
    first: int,
    weights: wp.array(dtype=Any),
    transmittances: wp.array(dtype=Any),
    packed_info: wp.array2d(dtype=wp.int64),
    weight_gradients: wp.array(dtype=Any),
    depth_gradients: wp.array(dtype=Any),
):
    # d w_i / d tau_i is what passes sample i; every later weight shrinks by itself: d w_j / d tau_i = -w_j for j > i.
    ray = first + wp.tid()
    start = int(packed_info[ray, 0])
    count = int(packed_info[ray, 1])
    behind = weights.dtype(0.0)
    for i in range(count):
        sample = start + count - 1 - i
        depth_gradients[sample] = weight_gradients[sample] * transmittances[sample] - behind
        behind = behind + weight_gradients[sample] * weights[sample]


@wp.kernel(enable_backward=False)
@no_type_check
def accumulate_kernel(
    first: int,
    weights: wp.array(dtype=Any),
    values: wp.array2d(dtype=Any),
    packed_info: wp.array2d(dtype=wp.int64),
    totals: wp.array2d(dtype=Any),
):
    ray = first + wp.tid()
    start = int(packed_info[ray, 0])
    for i in range(int(packed_info[ray, 1])):
        sample = start + i
        weight = weights[sample]
        for channel in range(values.shape[1]):
            totals[ray, channel] += weight * values[sample, channel]


@wp.kernel(enable_backward=False)
@no_type_check
def accumulate_gradient_kernel(
    first: int,
    weights: wp.array(dtype=Any),
    values: wp.array2d(dtype=Any),
    packed_info: wp.array2d(dtype=wp.int64),
    total_gradients: wp.array2d(dtype=Any),
    weight_gradients: wp.array(dtype=Any),
    value_gradients: wp.array2d(dtype=Any),
):
    ray = first + wp.tid()
    start = int(packed_info[ray, 0])
    for i in range(int(packed_info[ray, 1])):
        sample = start + i
        weight = weights[sample]
        total = weights.dtype(0.0)
        for channel in range(values.shape[1]):
            gradient = total_gradients[ray, channel]
            total += gradient * values[sample, channel]
            value_gradients[sample, channel] = weight * gradient
        weight_gradients[sample] = total
