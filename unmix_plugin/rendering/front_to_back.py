"""What rays sum to, without gradients: looked at from the front until hardly any light is left.

For pictures of a trained field. `VolumeRenderer.render` is the careful way, which training takes: it evaluates every
sample that carries weight, and goes on farther. Here neighbouring samples are merged where together they carry little
of their ray's light, and what lies behind the place where a ray ends is taken to look like what lies before it.

So many rays are under way at once as keep the processor busy: those that end make room for others.

Notation: `R` rays, `A` of them that are under way, `M` samples of each that are marched at once, `C` coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.field import CoefficientField
from unmix_plugin.operators.compositing import accumulate
from unmix_plugin.operators.marching import packed_rows
from unmix_plugin.operators.merging import MergedSamples, MergeLimits, merge_samples
from unmix_plugin.spectral.materials import Coefficients

if TYPE_CHECKING:
    from unmix_plugin.rendering.renderer import VolumeRenderer

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
    def before(cls, rays: Int[Tensor, "A"], like: Float[Tensor, "_ _"]) -> _Front:
        """Rays before they are marched."""
        none, numbers = torch.zeros_like(rays), like.new_zeros(len(rays))
        t = like.new_zeros(len(rays), SAMPLES_MARCHED)
        return cls(rays, numbers + 1, none + _samples_at_once(like), none, numbers, t, none, none)

    def __len__(self) -> int:
        return len(self.rays)

    def select(self, chosen: Int[Tensor, "N"]) -> _Front:
        """Some of the rays."""
        return _Front(*(getattr(self, each.name).index_select(0, chosen) for each in fields(self)))

    def join(self, more: _Front) -> _Front:
        """With other rays."""
        pairs = ((getattr(self, each.name), getattr(more, each.name)) for each in fields(self))
        return _Front(*map(torch.cat, pairs))

    def marched(self, ray_bundle: RayBundle, renderer: VolumeRenderer) -> _Front:
        """With the next samples of each ray that has some."""
        lines = _lines(ray_bundle, self.rays)
        found = renderer.march(*lines, self.ends).first_samples(SAMPLES_MARCHED)
        marched = replace(self, t=found.t, counts=found.counts, ends=found.ends, at=torch.zeros_like(self.at))
        return marched.select(found.counts.nonzero()[:, 0])

    def next_counts(self) -> Int[Tensor, "A"]:
        """How many samples of each are looked at next."""
        return torch.minimum(self.wanted, self.counts - self.at)

    def after(self, left: Float[Tensor, "A"], ending_light: float) -> tuple[_Front, _Front]:
        """Behind these samples: rays with enough light of which there are more, and those to be marched on."""
        looked = self.next_counts()
        at, num_seen = self.at + looked, self.num_seen + looked
        enough = looked / _DENSER * (left / ending_light).log() / (self.left / left).log()
        enough = enough.ceil().nan_to_num(nan=torch.inf)  # no number if both logarithms are infinite
        at_first = _samples_at_once(left)
        fewest = 1 if at_first < SAMPLES_MARCHED else SAMPLES_MARCHED
        wanted = torch.minimum(enough, num_seen.clamp(min=at_first)).clamp(min=fewest).long()
        front = replace(self, left=left, wanted=wanted, num_seen=num_seen, at=at)
        is_lit, has_more = left > ending_light, at < self.counts
        may_have_more = ~has_more & (self.counts == SAMPLES_MARCHED)
        chosen = ((is_lit & which).nonzero()[:, 0] for which in (has_more, may_have_more))
        going, waiting = (front.select(rays) for rays in chosen)
        return going, waiting


def _samples_at_once(like: Tensor) -> int:
    """Samples of each ray to look at together at first; on a GPU always as many as are marched, since it computes more
    of them in less time than the processor takes to ask again."""
    return FEWEST_SAMPLES if like.device.type == "cpu" else SAMPLES_MARCHED


@torch.no_grad()
def composite_front_to_back(
    renderer: VolumeRenderer, field: CoefficientField, ray_bundle: RayBundle
) -> Coefficients:
    """Coefficients (R, ...) of each ray of a field, before any sky."""
    origins, smallest = ray_bundle.origins, renderer.smallest_weight
    ending_light = _ENDING_LIGHT * smallest
    limits = MergeLimits(renderer.step, smallest, _MERGED_WEIGHT * smallest)
    left = torch.ones_like(origins[:, 0])
    all_rays = torch.arange(len(left), device=left.device)
    going = waiting = _Front.before(all_rays[:0], origins)
    num_begun, totals, last = 0, None, None
    while True:
        room = max(renderer.rays_per_chunk - len(going) - len(waiting), 0)
        begun = _Front.before(all_rays[num_begun : num_begun + room], origins)
        num_begun += len(begun)
        marched = waiting.join(begun).marched(ray_bundle, renderer)
        front = going.join(marched)
        merged = _look(field, ray_bundle, front, limits)
        values = _values(renderer, field, ray_bundle, front.rays, merged)
        if totals is None or last is None:
            totals = values.packed.new_zeros(len(left), values.packed.shape[1])
            last = torch.zeros_like(totals) if renderer.residual_on_last_sample else totals[:0]
        totals.index_add_(0, front.rays, accumulate(merged.weights, values.packed, merged.packed_info))
        if renderer.residual_on_last_sample:
            found = merged.packed_info[:, 1].nonzero()[:, 0]
            last[front.rays[found]] = values.packed[merged.packed_info[found].sum(dim=1) - 1]
        left[front.rays] = merged.left
        going, waiting = front.after(merged.left, ending_light)
        if num_begun == len(left) and len(going) == len(waiting) == 0:
            break
    if renderer.residual_on_last_sample:
        totals = totals + (1 - totals[:, :1]) * last
    else:
        totals *= torch.where(left > ending_light, 1.0, 1 / (1 - left))[:, None]
    return Coefficients(totals, values.num_endmembers)


def _look(
    field: CoefficientField, ray_bundle: RayBundle, front: _Front, limits: MergeLimits
) -> MergedSamples:
    """The next samples of rays, merged."""
    firsts = torch.arange(len(front), device=front.at.device) * SAMPLES_MARCHED + front.at
    owners, rows, info = packed_rows(firsts, front.next_counts())
    t = front.t.view(-1).index_select(0, rows)
    origins, along = _lines(ray_bundle, front.rays.index_select(0, owners))
    densities, features = field.density_of(field.encode(torch.addcmul(origins, along, t[:, None])))
    return merge_samples(densities * limits.step, t, features, info, front.left, limits)


def _values(
    renderer: VolumeRenderer,
    field: CoefficientField,
    ray_bundle: RayBundle,
    rays: Int[Tensor, "A"],
    merged: MergedSamples,
) -> Coefficients:
    """What groups of samples look like."""
    origins, along = _lines(ray_bundle, rays.index_select(0, merged.ray_indices))
    positions = torch.addcmul(origins, along, merged.t[:, None])
    light = renderer.lamplight(field, origins, positions)
    return coefficients_of(merged.t, field.get_outputs(positions, along, merged.features, light))


def coefficients_of(t: Float[Tensor, "S"], outputs: Mapping[str, Tensor]) -> Coefficients:
    """Those of opaque samples at these distances, of which a field says this."""
    names = ("abundances", "scaled_abundances", "specular_coefficients")
    return Coefficients.of(torch.ones_like(t), t, *(outputs[name] for name in names))


def _lines(
    ray_bundle: RayBundle, rays: Int[Tensor, "S"]
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Origins and directions of some rays."""
    return ray_bundle.origins.index_select(0, rays), ray_bundle.directions.index_select(0, rays)
