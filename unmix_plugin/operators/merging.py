"""Neighbouring samples of a ray as one, where together they carry little weight.

What is looked up once for a group of samples needn't be looked up for each of them: of a soft surface many samples
carry a few hundredths of the light each, and differ little. A sample that carries much stays alone.

Notation: `S` samples, `R` rays, `G` groups, `F` features; weights as in compositing.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.operators.launching import as_warp, launch

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
    left: Float[Tensor, "R"]
    """Share of its light that each ray still has behind its samples."""


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
    left: Float[Tensor, "R"],
    limits: MergeLimits,
) -> MergedSamples:
    """Merge the samples of each ray from the front; without gradients.

    Args:
        optical_depths: Density times length of each sample, >= 0.
        t: Distances along the ray, growing.
        features: Of each sample.
        packed_info: First sample and count of each ray.
        left: Share of its light that each ray has before its samples.
        limits: Which samples are left out and which are merged.
    """
    from unmix_plugin.operators._merging_kernels import count_kernel, write_kernel

    device, num_rays = t.device, len(packed_info)
    behind, weights = left.clone(), torch.empty_like(t)
    counts = torch.empty(num_rays, dtype=torch.int64, device=device)
    info, places = as_warp(packed_info), as_warp(t)
    numbers = [limits.smallest_weight, limits.most_weight, _GAP * limits.step]
    depths = as_warp(optical_depths.contiguous())
    outputs = [as_warp(values) for values in (behind, weights, counts)]
    launch(count_kernel, num_rays, [depths, places, info, *numbers, *outputs], device)
    ends = counts.cumsum(0)
    group_info = torch.stack([ends - counts, counts], dim=-1)
    total = int(ends[-1]) if num_rays else 0
    merged = MergedSamples(
        t.new_empty(total),
        t.new_empty(total),
        t.new_empty(total, features.shape[1]),
        counts.new_empty(total),
        group_info,
        behind,
    )
    found = (merged.packed_info, merged.ray_indices, merged.weights, merged.t, merged.features)
    if total:
        samples = [as_warp(weights), places, as_warp(features.contiguous()), info]
        launch(write_kernel, num_rays, [*samples, *numbers, *map(as_warp, found)], device)
    return merged


def merge_samples_twin(
    optical_depths: Float[Tensor, "S"],
    t: Float[Tensor, "S"],
    features: Float[Tensor, "S F"],
    packed_info: Int[Tensor, "R 2"],
    left: Float[Tensor, "R"],
    limits: MergeLimits,
) -> MergedSamples:
    """The same as `merge_samples` in plain Python, sample by sample."""
    groups: list[tuple[int, list[int]]] = []
    weights, behind, counts = torch.zeros_like(t), left.clone(), []
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
