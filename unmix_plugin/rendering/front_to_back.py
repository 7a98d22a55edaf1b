"""What rays sum to, without gradients: samples are evaluated from the front until no more light gets through.

For pictures of a trained field. `VolumeRenderer.render` is what training takes: it first evaluates the density of every
sample that light may reach. Both end a ray where its transmittance is no more than the smallest weight of a sample,
behind which no sample can count; so opacities are the same. Here neighbouring samples are merged where together they
carry little light.

As many rays are active at once as keep the processor busy: those that end make room for others.

Notation: `R` rays, `A` active ones, `M` samples of each that are marched at once, `C` coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.engine.machine import can_work_beside, working_beside
from unmix_plugin.field import CoefficientField
from unmix_plugin.operators.compositing import accumulate
from unmix_plugin.operators.marching import packed_rows
from unmix_plugin.operators.merging import MergeLimits, merge_samples
from unmix_plugin.rendering.renderer import VolumeRenderer, coefficients_of
from unmix_plugin.spectral.materials import Coefficients

_MERGED_WEIGHT = 125.0
"""Most of a ray's light that merged samples carry together, in multiples of the smallest weight of a sample."""
FEWEST_SAMPLES = 4
"""Of each ray, that are evaluated before it is known whether light gets farther; later at most as many as so far, since
light that gets through those gets through more."""
SAMPLES_MARCHED = 16
"""Of each ray, before it is known whether light gets behind them."""
_FEWEST_SHARED = 4096
"""Rays that two threads share; of fewer each would wait for the other."""
_DENSER = 2.0
"""How many times denser what follows is taken to be than what was evaluated: most rays have just entered a surface."""


@dataclass(frozen=True)
class _ActiveRays:
    """Rays that go on, and their samples up to some distance."""

    rays: Int[Tensor, "A"]
    transmittance: Float[Tensor, "A"]
    """Of all that was evaluated."""
    wanted: Int[Tensor, "A"]
    """Samples of each to evaluate next, if it has as many."""
    num_evaluated: Int[Tensor, "A"]
    t: Float[Tensor, "A M"]
    """Distances of the samples that were marched last."""
    count: Int[Tensor, "A"]
    """How many these are."""
    next: Int[Tensor, "A"]
    """Which of them is evaluated next."""
    t_end: Float[Tensor, "A"]
    """From where to march on."""

    def select(self, chosen: Int[Tensor, "N"]) -> _ActiveRays:
        """Some of the rays."""
        return _ActiveRays(*(getattr(self, each.name).index_select(0, chosen) for each in fields(self)))

    def join(self, rays: Int[Tensor, "N"], wanted: int) -> _ActiveRays:
        """With further rays of which nothing was marched yet; of each so many samples are evaluated first."""
        none, start = torch.zeros_like(rays), self.t_end.new_zeros(len(rays))
        t = self.t.new_zeros(len(rays), SAMPLES_MARCHED)
        further = (rays, start + 1, none + wanted, none, t, none, none, start)
        own = (getattr(self, each.name) for each in fields(self))
        return _ActiveRays(*map(torch.cat, zip(own, further, strict=True)))


DIAGONAL = ((0.25, 0.25), (0.75, 0.75))
"""Places in a pixel, x and y: the least that softens edges of all directions."""


def evenly_in_pixel(subpixels: int) -> tuple[tuple[float, float], ...]:
    """Places in a pixel: middles of so many parts along each of its edges."""
    middles = [(i + 0.5) / subpixels for i in range(subpixels)]
    return tuple((x, y) for y in middles for x in middles)


@torch.no_grad()
def composite_view(
    renderer: VolumeRenderer,
    field: CoefficientField,
    camera: Cameras,
    places: Sequence[tuple[float, float]] = ((0.5, 0.5),),
) -> Coefficients:
    """Coefficients (H, W, ...) of a whole view of one camera: every picture of it follows from them. Rays through these
    places of each pixel are averaged: all outputs but ratios are linear."""
    camera = camera.to(renderer.skips.device)
    total: Coefficients | None = None
    for place in places:
        found = composite(renderer, field, camera.image_rays(0, place))
        total = found if total is None else found.map(total.packed.add_)
    assert total is not None
    return total.map(lambda packed: packed / len(places)).unflatten(camera.height, camera.width)


@torch.no_grad()
def composite(renderer: VolumeRenderer, field: CoefficientField, ray_bundle: RayBundle) -> Coefficients:
    """Coefficients (R, ...) of each ray, few rays at a time in memory: those of `VolumeRenderer.render` but for what
    this module says, in less time."""
    if len(ray_bundle) < _FEWEST_SHARED or not can_work_beside(ray_bundle.origins.device):
        return _composite(renderer, field, ray_bundle)
    half = replace(renderer, rays_per_chunk=max(renderer.rays_per_chunk // 2, 1))
    with working_beside(partial(_composite, half, field, ray_bundle[::2])) as other:
        odd = _composite(half, field, ray_bundle[1::2])
    even = other.result()
    packed = even.packed.new_empty(len(ray_bundle), even.packed.shape[1])
    packed[::2], packed[1::2] = even.packed, odd.packed
    return Coefficients(packed, even.num_endmembers)


@torch.no_grad()
def _composite(renderer: VolumeRenderer, field: CoefficientField, ray_bundle: RayBundle) -> Coefficients:
    found, chunk = _composite_field(renderer, field, ray_bundle), renderer.rays_per_chunk
    parts = [field.sky(ray_bundle[first : first + chunk]) for first in range(0, len(ray_bundle), chunk)]
    skies = [sky for sky in parts if sky is not None]
    return found.before(torch.cat(skies))[0] if skies else found


def _composite_field(
    renderer: VolumeRenderer, field: CoefficientField, ray_bundle: RayBundle
) -> Coefficients:
    """Coefficients (R, ...) of what rays meet in the field."""
    origins, directions, smallest = ray_bundle.origins, ray_bundle.directions, renderer.smallest_weight
    limits = MergeLimits(renderer.step, smallest, _MERGED_WEIGHT * smallest)
    # On a GPU always as many as are marched: it computes more in less time than the processor takes to ask again.
    at_first = FEWEST_SAMPLES if origins.device.type == "cpu" else SAMPLES_MARCHED
    fewest = 1 if at_first < SAMPLES_MARCHED else SAMPLES_MARCHED
    pending = torch.arange(len(origins), device=origins.device)
    none, numbers = pending[:0], origins[:0, 0]
    t = origins.new_zeros(0, SAMPLES_MARCHED)
    active = _ActiveRays(none, numbers, none, none, t, none, none, numbers)
    totals = last = origins.new_zeros(len(origins), 0)
    num_endmembers = 0
    while True:
        # Pending rays take the room of those that ended.
        room = max(renderer.rays_per_chunk - len(active.rays), 0)
        active, pending = active.join(pending[:room], at_first), pending[room:]

        # Rays whose samples are evaluated are marched on; those that meet nothing more end.
        is_used_up = active.next == active.count
        rows = is_used_up.nonzero()[:, 0]
        rays = active.rays.index_select(0, rows)
        lines = origins.index_select(0, rays), directions.index_select(0, rays)
        found = renderer.march(*lines, active.t_end.index_select(0, rows)).first_samples(SAMPLES_MARCHED)
        active = replace(
            active,
            t=active.t.index_copy(0, rows, found.t),
            count=active.count.index_copy(0, rows, found.counts),
            next=active.next.masked_fill(is_used_up, 0),
            t_end=active.t_end.index_copy(0, rows, found.ends),
        )
        active = active.select(active.count.nonzero()[:, 0])

        # The next samples of each ray are evaluated, and neighbours merged.
        evaluated = torch.minimum(active.wanted, active.count - active.next)
        firsts = torch.arange(len(active.rays), device=none.device) * SAMPLES_MARCHED + active.next
        owners, rows, info = packed_rows(firsts, evaluated)
        t, rays = active.t.view(-1).index_select(0, rows), active.rays.index_select(0, owners)
        positions = torch.addcmul(origins.index_select(0, rays), directions.index_select(0, rays), t[:, None])
        densities, features = field.density_of(field.encode(positions))
        merged = merge_samples(densities * limits.step, t, features, info, active.transmittance, limits)

        # What they look like is added to their rays.
        rays = active.rays.index_select(0, merged.ray_indices)
        starts, along = origins.index_select(0, rays), directions.index_select(0, rays)
        positions = torch.addcmul(starts, along, merged.t[:, None])
        light = None if renderer.opaque_skips is None else renderer.lamplight(field, starts, positions)
        values = coefficients_of(merged.t, field.get_outputs(positions, along, merged.features, light))
        if num_endmembers == 0:
            num_endmembers = values.num_endmembers
            totals = values.packed.new_zeros(len(origins), values.packed.shape[1])
            last = torch.zeros_like(totals) if renderer.residual_on_last_sample else last
        totals.index_add_(0, active.rays, accumulate(merged.weights, values.packed, merged.packed_info))
        if renderer.residual_on_last_sample:
            rows = merged.packed_info[:, 1].nonzero()[:, 0]
            last[active.rays[rows]] = values.packed[merged.packed_info[rows].sum(dim=1) - 1]

        # Rays end that have no light left, or no samples. Of others so many more are wanted as would take their light.
        enough = evaluated / _DENSER * (merged.transmittance / smallest).log()
        enough /= (active.transmittance / merged.transmittance).log()
        enough = enough.ceil().nan_to_num(nan=torch.inf)  # no number if both logarithms are infinite
        num_evaluated = active.num_evaluated + evaluated
        wanted = torch.minimum(enough, num_evaluated.clamp(min=at_first)).clamp(min=fewest).long()
        position = active.next + evaluated
        may_have_more = (position < active.count) | (active.count == SAMPLES_MARCHED)
        goes_on = (merged.transmittance > smallest) & may_have_more
        active = replace(
            active,
            transmittance=merged.transmittance,
            wanted=wanted,
            num_evaluated=num_evaluated,
            next=position,
        ).select(goes_on.nonzero()[:, 0])
        if len(pending) == 0 and len(active.rays) == 0:
            break
    if renderer.residual_on_last_sample:
        totals = totals + (1 - totals[:, :1]) * last
    return Coefficients(totals, num_endmembers)
