"""What rays sum to, without gradients: looked at from the front until hardly any light is left.

For pictures of a trained field. `VolumeRenderer.render` is the careful way, which training takes: it evaluates every
sample that carries weight, and goes on farther. Here neighbouring samples are merged where together they carry little
of their ray's light, and what lies behind the place where a ray ends is taken to look like what lies before it.

So many rays are under way at once as keep the processor busy: those that end make room for others.

Notation: `R` rays, `A` of them that are under way, `M` samples of each that are marched at once, `C` coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.field import CoefficientField
from unmix_plugin.light.shading import Lamplight
from unmix_plugin.operators.compositing import accumulate
from unmix_plugin.operators.marching import FirstSamples
from unmix_plugin.operators.merging import MergedSamples, MergeLimits, merge_samples
from unmix_plugin.spectral.materials import Coefficients

_ENDING_LIGHT = 3.0
"""Share of its light at which a ray ends, in multiples of the smallest weight of a sample."""
_MERGED_WEIGHT = 125.0
"""Most of a ray's light that merged samples carry together, in the same unit."""
FEWEST_SAMPLES = 4
"""Of each ray, that are looked at before it is known whether light gets farther; later at most as many as so far, since
light that gets through those gets through more."""
SAMPLES_MARCHED = 16
"""Of each ray, before it is known whether light gets behind them."""
_DENSER = 2.0
"""How many times denser what follows is taken to be than what was looked at: most rays have just entered a surface."""

_March = Callable[[Float[Tensor, "A 3"], Float[Tensor, "A 3"], Float[Tensor, "A"], int], FirstSamples]
_LightAt = Callable[[Float[Tensor, "S 3"], Float[Tensor, "S 3"]], Lamplight | None]


@dataclass(frozen=True)
class FrontToBack:
    """How rays are looked at."""

    march: _March
    """From origins, directions, distances and a number: the first so many samples behind the distances, at first 0."""
    step: float
    """Distance of samples, for which each counts."""
    smallest_weight: float
    """Samples that contribute no more of their ray's light are left out."""
    light_at: _LightAt
    """From origins of rays and positions on them to what of a moving lamp's light reaches them, as
    `CoefficientField.get_outputs` takes it."""
    residual_on_last_sample: bool = False
    """Whether the last sample of a ray takes all the light that is left."""
    rays_at_once: int = 32_768
    """Rays under way."""
    samples_at_once: int = FEWEST_SAMPLES
    """Samples of each ray that are looked at together at first; with as many as are marched always that many, since a
    GPU computes more of them in less time than the processor takes to ask again."""


@dataclass(frozen=True)
class _Front:
    """How far rays under way were looked at."""

    rays: Int[Tensor, "A"]
    left: Float[Tensor, "A"]
    """Share of its light that each still has."""
    wanted: Int[Tensor, "A"]
    """Samples of each to look at next, if it has as many."""
    num_seen: Int[Tensor, "A"]
    """Samples of each that were looked at."""
    ends: Float[Tensor, "A"]
    """From where to march on."""
    t: Float[Tensor, "A M"]
    """The samples that were marched."""
    counts: Int[Tensor, "A"]
    """How many there are."""
    at: Int[Tensor, "A"]
    """The next of them."""

    @classmethod
    def before(cls, rays: Int[Tensor, "A"], like: Float[Tensor, "_ _"], samples_at_once: int) -> _Front:
        """Rays before they are marched."""
        none, numbers = torch.zeros_like(rays), like.new_zeros(len(rays))
        t = like.new_zeros(len(rays), SAMPLES_MARCHED)
        return cls(rays, numbers + 1, none + samples_at_once, none, numbers, t, none, none)

    def __len__(self) -> int:
        return len(self.rays)

    def select(self, chosen: Int[Tensor, "N"]) -> _Front:
        """Some of the rays."""
        return _Front(*(getattr(self, each.name).index_select(0, chosen) for each in fields(self)))

    def join(self, more: _Front) -> _Front:
        """With other rays."""
        pairs = ((getattr(self, each.name), getattr(more, each.name)) for each in fields(self))
        return _Front(*map(torch.cat, pairs))

    def marched(self, ray_bundle: RayBundle, march: _March) -> _Front:
        """With the next samples of each ray that has some."""
        found = march(*_lines(ray_bundle, self.rays), self.ends, SAMPLES_MARCHED)
        marched = replace(self, t=found.t, counts=found.counts, ends=found.ends, at=torch.zeros_like(self.at))
        return marched.select(found.counts.nonzero()[:, 0])

    def next_counts(self) -> Int[Tensor, "A"]:
        """How many samples of each are looked at next."""
        return torch.minimum(self.wanted, self.counts - self.at)

    def after(self, left: Float[Tensor, "A"], how: FrontToBack, ending_light: float) -> tuple[_Front, _Front]:
        """Behind these samples: rays with enough light of which there are more, and those to be marched on."""
        looked = self.next_counts()
        at, num_seen = self.at + looked, self.num_seen + looked
        enough = looked / _DENSER * (left / ending_light).log() / (self.left / left).log()
        enough = enough.ceil().nan_to_num(nan=torch.inf)  # no number if both logarithms are infinite
        fewest = 1 if how.samples_at_once < SAMPLES_MARCHED else SAMPLES_MARCHED
        wanted = torch.minimum(enough, num_seen.clamp(min=how.samples_at_once)).clamp(min=fewest).long()
        front = replace(self, left=left, wanted=wanted, num_seen=num_seen, at=at)
        is_lit, has_more = left > ending_light, at < self.counts
        may_have_more = ~has_more & (self.counts == SAMPLES_MARCHED)
        chosen = ((is_lit & which).nonzero()[:, 0] for which in (has_more, may_have_more))
        going, waiting = (front.select(rays) for rays in chosen)
        return going, waiting


@torch.no_grad()
def composite_front_to_back(field: CoefficientField, ray_bundle: RayBundle, how: FrontToBack) -> Coefficients:
    """Coefficients (R, ...) of each ray of a field."""
    origins, ending_light = ray_bundle.origins, _ENDING_LIGHT * how.smallest_weight
    limits = MergeLimits(how.step, how.smallest_weight, _MERGED_WEIGHT * how.smallest_weight)
    left = torch.ones_like(origins[:, 0])
    all_rays = torch.arange(len(left), device=left.device)
    going = waiting = _Front.before(all_rays[:0], origins, how.samples_at_once)
    num_begun, totals, last = 0, None, None
    while True:
        new = all_rays[num_begun : num_begun + max(how.rays_at_once - len(going) - len(waiting), 0)]
        num_begun += len(new)
        begun = _Front.before(new, origins, how.samples_at_once)
        marched = waiting.join(begun).marched(ray_bundle, how.march)
        front = going.join(marched)
        merged = _look(field, ray_bundle, front, limits)
        values = _values(field, ray_bundle, front.rays, merged, how.light_at)
        if totals is None or last is None:
            totals = values.packed.new_zeros(len(left), values.packed.shape[1])
            last = torch.zeros_like(totals) if how.residual_on_last_sample else totals[:0]
        totals.index_add_(0, front.rays, accumulate(merged.weights, values.packed, merged.packed_info))
        if how.residual_on_last_sample:
            found = merged.packed_info[:, 1].nonzero()[:, 0]
            last[front.rays[found]] = values.packed[merged.packed_info[found].sum(dim=1) - 1]
        left[front.rays] = merged.left
        going, waiting = front.after(merged.left, how, ending_light)
        if num_begun == len(left) and len(going) == len(waiting) == 0:
            break
    if how.residual_on_last_sample:
        totals = totals + (1 - totals[:, :1]) * last
    else:
        totals *= torch.where(left > ending_light, 1.0, 1 / (1 - left))[:, None]
    return Coefficients(totals, values.num_endmembers)


def _look(
    field: CoefficientField, ray_bundle: RayBundle, front: _Front, limits: MergeLimits
) -> MergedSamples:
    """The next samples of rays, merged."""
    counts = front.next_counts()
    ends = counts.cumsum(0)
    size = int(ends[-1]) if len(ends) else 0
    starts = ends - counts
    owners = torch.repeat_interleave(counts, output_size=size)
    firsts = torch.arange(len(front), device=ends.device) * SAMPLES_MARCHED + front.at
    chosen = (firsts - starts).index_select(0, owners).add_(torch.arange(size, device=ends.device))
    t = front.t.view(-1).index_select(0, chosen)
    origins, along = _lines(ray_bundle, front.rays.index_select(0, owners))
    densities, features = field.density_of(field.encode(torch.addcmul(origins, along, t[:, None])))
    info = torch.stack([starts, counts], dim=-1)
    return merge_samples(densities * limits.step, t, features, info, front.left, limits)


def _values(
    field: CoefficientField,
    ray_bundle: RayBundle,
    rays: Int[Tensor, "A"],
    merged: MergedSamples,
    light_at: _LightAt,
) -> Coefficients:
    """What groups of samples look like."""
    origins, along = _lines(ray_bundle, rays.index_select(0, merged.ray_indices))
    positions = torch.addcmul(origins, along, merged.t[:, None])
    outputs = field.get_outputs(positions, along, merged.features, light_at(origins, positions))
    return Coefficients.of(
        torch.ones_like(merged.t),
        merged.t,
        outputs["abundances"],
        outputs["scaled_abundances"],
        outputs["specular_coefficients"],
    )


def _lines(
    ray_bundle: RayBundle, rays: Int[Tensor, "S"]
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Origins and directions of some rays."""
    return ray_bundle.origins.index_select(0, rays), ray_bundle.directions.index_select(0, rays)
