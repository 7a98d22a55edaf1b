"""Warp kernels that merge neighbouring samples of a ray: one work item is one ray.

Counting and writing walk the same samples with the same arithmetic, so that the second pass fills what the first one
counted.
"""

from typing import no_type_check

import warp as wp


@wp.func
@no_type_check
def starts_group(weight: float, t: float, total: float, last: float, most: float, gap: float):
    """1 where a sample doesn't belong to the group that is open, whose weight is `total` and whose end is `last`."""
    return int(total == 0.0 or total + weight > most or t - last > gap)


@wp.kernel(enable_backward=False)
@no_type_check
def count_kernel(
    first: int,
    end: int,
    stride: int,
    depths: wp.array(dtype=float),
    t_samples: wp.array(dtype=float),
    packed_info: wp.array2d(dtype=wp.int64),
    smallest: float,
    most: float,
    gap: float,
    left: wp.array(dtype=float),
    weights: wp.array(dtype=float),
    counts: wp.array(dtype=wp.int64),
):
    ray = first + wp.tid()
    while ray < end:
        sample = int(packed_info[ray, 0])
        stop = sample + int(packed_info[ray, 1])
        transmittance = left[ray]
        total = float(0.0)  # noqa: UP018 - Warp takes a bare literal for a constant
        last = float(0.0)  # noqa: UP018
        count = int(0)  # noqa: RUF046, UP018
        while sample < stop:
            passed = transmittance * wp.exp(-depths[sample])
            weight = transmittance - passed
            weights[sample] = weight
            if weight > smallest:
                transmittance = passed
                t = t_samples[sample]
                if starts_group(weight, t, total, last, most, gap) == 1:
                    count += 1
                    total = float(0.0)  # noqa: UP018
                total += weight
                last = t
            sample += 1
        left[ray] = transmittance
        counts[ray] = wp.int64(count)
        ray += stride


@wp.kernel(enable_backward=False)
@no_type_check
def write_kernel(
    first: int,
    end: int,
    stride: int,
    weights: wp.array(dtype=float),
    t_samples: wp.array(dtype=float),
    features: wp.array2d(dtype=float),
    packed_info: wp.array2d(dtype=wp.int64),
    smallest: float,
    most: float,
    gap: float,
    group_info: wp.array2d(dtype=wp.int64),
    group_rays: wp.array(dtype=wp.int64),
    group_weights: wp.array(dtype=float),
    group_t: wp.array(dtype=float),
    group_features: wp.array2d(dtype=float),
):
    ray = first + wp.tid()
    width = features.shape[1]
    while ray < end:
        sample = int(packed_info[ray, 0])
        stop = sample + int(packed_info[ray, 1])
        group = int(group_info[ray, 0]) - 1
        total = float(0.0)  # noqa: UP018
        last = float(0.0)  # noqa: UP018
        while sample < stop:
            weight = weights[sample]
            if weight > smallest:
                t = t_samples[sample]
                own = features[sample]
                if starts_group(weight, t, total, last, most, gap) == 1:
                    group += 1
                    total = weight
                    group_rays[group] = wp.int64(ray)
                    group_t[group] = t
                    mean = group_features[group]
                    channel = int(0)  # noqa: RUF046, UP018
                    while channel < width:
                        mean[channel] = own[channel]
                        channel += 1
                else:
                    total += weight
                    share = weight / total
                    group_t[group] = group_t[group] + share * (t - group_t[group])
                    mean = group_features[group]
                    channel = int(0)  # noqa: RUF046, UP018
                    while channel < width:
                        mean[channel] = mean[channel] + share * (own[channel] - mean[channel])
                        channel += 1
                group_weights[group] = total
                last = t
            sample += 1
        ray += stride
