"""Neighbouring samples of a ray as one, where together they carry little weight.

What is looked up once for a group of samples needn't be looked up for each of them: of a soft surface many samples
carry a few hundredths of the light each, and differ little. A sample that carries much stays alone.

Notation: `S` samples, `R` rays, `G` groups, `F` features; weights as in compositing.py.

Of the kernel a work item is a ray, whose groups it writes where the ray's samples are: there are no more of them.
"""

from dataclasses import dataclass
from typing import no_type_check

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.operators.launching import launch
from unmix_plugin.operators.marching import packed_rows

_GAP = 1.5
"""Distance of neighbouring samples in steps from which they don't belong together: there is empty space between."""


@dataclass(frozen=True)
class MergedSamples:
    """Groups of neighbouring samples, ray after ray."""

    weights: Float[Tensor, "G"]
    """Sums of the weights."""
    t: Float[Tensor, "G"]
    """Means, by weight."""
    features: Float[Tensor, "G F"]
    """Means, by weight."""
    ray_indices: Int[Tensor, "G"]
    packed_info: Int[Tensor, "R 2"]
    """First group and number of groups of each ray."""
    transmittance: Float[Tensor, "R"]
    """Of each ray, behind its samples."""


@dataclass(frozen=True)
class MergeLimits:
    """Which samples are merged."""

    step: float
    """Distance of samples."""
    smallest_weight: float
    """Samples that carry no more are left out, as if nothing were there."""
    most_weight: float
    """That a group of more than one sample carries."""


def merge_samples(
    optical_depths: Float[Tensor, "S"],
    t: Float[Tensor, "S"],
    features: Float[Tensor, "S F"],
    packed_info: Int[Tensor, "R 2"],
    transmittance: Float[Tensor, "R"],
    limits: MergeLimits,
) -> MergedSamples:
    """Merge the samples of each ray from the front, given its `transmittance` before them;
    without gradients."""
    num_rays, behind = len(packed_info), transmittance.clone()
    weights, places = torch.empty_like(t), torch.empty_like(t)
    means = torch.empty_like(features, memory_format=torch.contiguous_format)
    counts = torch.empty(num_rays, dtype=torch.int64, device=t.device)
    inputs = [optical_depths.contiguous(), t, features.contiguous(), packed_info]
    numbers = [limits.smallest_weight, limits.most_weight, _GAP * limits.step]
    launch(_merge_kernel, num_rays, [*inputs, *numbers, behind, counts, weights, places, means], t.device)
    rays, rows, group_info = packed_rows(packed_info[:, 0], counts)
    weights, places, means = (values.index_select(0, rows) for values in (weights, places, means))
    return MergedSamples(weights, places, means, rays, group_info, behind)


def merge_samples_twin(
    optical_depths: Float[Tensor, "S"],
    t: Float[Tensor, "S"],
    features: Float[Tensor, "S F"],
    packed_info: Int[Tensor, "R 2"],
    transmittance: Float[Tensor, "R"],
    limits: MergeLimits,
) -> MergedSamples:
    """The same as `merge_samples` in plain Python, sample by sample."""
    groups: list[tuple[int, list[int]]] = []
    weights, behind, counts = torch.zeros_like(t), transmittance.clone(), []
    for ray, (start, count) in enumerate(packed_info.tolist()):
        before = len(groups)
        for sample in range(start, start + count):
            passed = behind[ray] * torch.exp(-optical_depths[sample])
            weights[sample] = behind[ray] - passed
            if weights[sample] <= limits.smallest_weight:
                continue
            behind[ray] = passed
            open_group = groups[-1][1] if len(groups) > before else []
            together = weights[[*open_group, sample]].sum()
            is_near = bool(open_group) and t[sample] - t[open_group[-1]] <= _GAP * limits.step
            if is_near and together <= limits.most_weight:
                open_group.append(sample)
            else:
                groups.append((ray, [sample]))
        counts.append(len(groups) - before)
    shares = torch.zeros(len(groups), len(t))
    for row, (_, members) in enumerate(groups):
        shares[row, members] = weights[members]
    sums = shares.sum(dim=1)
    means = shares / sums[:, None]
    number = torch.tensor(counts, dtype=torch.int64)
    info = torch.stack([number.cumsum(0) - number, number], dim=-1)
    rays = torch.tensor([ray for ray, _ in groups], dtype=torch.int64)
    return MergedSamples(sums, means @ t, means @ features, rays, info, behind)


@wp.kernel(enable_backward=False)
@no_type_check
def _merge_kernel(
    first: int,
    end: int,
    stride: int,
    depths: wp.array(dtype=float),
    t_samples: wp.array(dtype=float),
    features: wp.array2d(dtype=float),
    packed_info: wp.array2d(dtype=wp.int64),
    smallest: float,
    most: float,
    gap: float,
    transmittances: wp.array(dtype=float),
    counts: wp.array(dtype=wp.int64),
    group_weights: wp.array(dtype=float),
    group_t: wp.array(dtype=float),
    group_features: wp.array2d(dtype=float),
):
    ray = first + wp.tid()
    width = features.shape[1]
    while ray < end:
        start = int(packed_info[ray, 0])
        sample = start
        stop = start + int(packed_info[ray, 1])
        group = start - 1
        transmittance = transmittances[ray]
        total = float(0.0)  # noqa: UP018 - Warp takes a bare literal for a constant
        last = float(0.0)  # noqa: UP018
        while sample < stop:
            passed = transmittance * wp.exp(-depths[sample])
            weight = transmittance - passed
            if weight > smallest:
                transmittance = passed
                t = t_samples[sample]
                own = features[sample]
                channel = int(0)  # noqa: RUF046, UP018
                if total == 0.0 or total + weight > most or t - last > gap:
                    group += 1
                    total = weight
                    group_t[group] = t
                    mean = group_features[group]
                    while channel < width:
                        mean[channel] = own[channel]
                        channel += 1
                else:
                    total += weight
                    share = weight / total
                    group_t[group] = group_t[group] + share * (t - group_t[group])
                    mean = group_features[group]
                    while channel < width:
                        mean[channel] = mean[channel] + share * (own[channel] - mean[channel])
                        channel += 1
                group_weights[group] = total
                last = t
            sample += 1
        transmittances[ray] = transmittance
        counts[ray] = wp.int64(group + 1 - start)
        ray += stride
