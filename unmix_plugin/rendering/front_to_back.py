"""What rays sum to, without gradients: samples are evaluated from the front until no more light gets through.

For pictures of a trained field. `VolumeRenderer.render` is what training takes: it first evaluates the density of every
sample that light may reach. Both end a ray where its transmittance is no more than the smallest weight of a sample,
behind which no sample can count; so opacities are the same. Here neighbouring samples are merged where together they
carry little light.

As many rays are active at once as keep the processor busy: those that end make room for others.

Notation: `R` rays, `A` active ones, `M` samples of each that are marched at once, `C` coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.field import CoefficientField
from unmix_plugin.operators.compositing import accumulate
from unmix_plugin.operators.marching import packed_rows
from unmix_plugin.operators.merging import MergedSamples, MergeLimits, merge_samples
from unmix_plugin.rendering.renderer import VolumeRenderer, before_sky, coefficients_of
from unmix_plugin.spectral.materials import Coefficients

_MERGED_WEIGHT = 125.0
"""Most of a ray's light that merged samples carry together, in multiples of the smallest weight of a sample."""
FEWEST_SAMPLES = 4
"""Of each ray, that are evaluated before it is known whether light gets farther; later at most as many as so far, since
light that gets through those gets through more."""
SAMPLES_MARCHED = 16
"""Of each ray, before it is known whether light gets behind them."""
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

    @staticmethod
    def at_camera(rays: Int[Tensor, "A"], like: Float[Tensor, "_ _"]) -> _ActiveRays:
        """Rays of which nothing was marched yet."""
        zeros, numbers = torch.zeros_like(rays), like.new_zeros(len(rays))
        t = like.new_zeros(len(rays), SAMPLES_MARCHED)
        wanted = zeros + _samples_at_once(like)
        return _ActiveRays(rays, numbers + 1, wanted, zeros, t, zeros, zeros, numbers)

    def __len__(self) -> int:
        return len(self.rays)

    def select(self, chosen: Int[Tensor, "N"]) -> _ActiveRays:
        """Some of the rays."""
        return _ActiveRays(*(getattr(self, each.name).index_select(0, chosen) for each in fields(self)))

    def join(self, more: _ActiveRays) -> _ActiveRays:
        """With other rays."""
        pairs = ((getattr(self, each.name), getattr(more, each.name)) for each in fields(self))
        return _ActiveRays(*map(torch.cat, pairs))

    def march(self, ray_bundle: RayBundle, renderer: VolumeRenderer) -> _ActiveRays:
        """With further samples of the rays whose samples are evaluated; without rays that have none."""
        is_used_up = self.next == self.count
        rows = is_used_up.nonzero()[:, 0]
        lines = _lines(ray_bundle, self.rays.index_select(0, rows))
        found = renderer.march(*lines, self.t_end.index_select(0, rows)).first_samples(SAMPLES_MARCHED)
        marched = replace(
            self,
            t=self.t.index_copy(0, rows, found.t),
            count=self.count.index_copy(0, rows, found.counts),
            next=self.next.masked_fill(is_used_up, 0),
            t_end=self.t_end.index_copy(0, rows, found.ends),
        )
        return marched.select(marched.count.nonzero()[:, 0])

    def next_counts(self) -> Int[Tensor, "A"]:
        """How many samples of each are evaluated next."""
        return torch.minimum(self.wanted, self.count - self.next)

    def behind(self, transmittance: Float[Tensor, "A"], smallest: float) -> _ActiveRays:
        """Behind these samples, the rays that have light left and may meet more."""
        evaluated = self.next_counts()
        position, num_evaluated = self.next + evaluated, self.num_evaluated + evaluated
        enough = evaluated / _DENSER * (transmittance / smallest).log()
        enough /= (self.transmittance / transmittance).log()
        enough = enough.ceil().nan_to_num(nan=torch.inf)  # no number if both logarithms are infinite
        at_first = _samples_at_once(transmittance)
        fewest = 1 if at_first < SAMPLES_MARCHED else SAMPLES_MARCHED
        wanted = torch.minimum(enough, num_evaluated.clamp(min=at_first)).clamp(min=fewest).long()
        passed = replace(
            self, transmittance=transmittance, wanted=wanted, num_evaluated=num_evaluated, next=position
        )
        may_have_more = (position < self.count) | (self.count == SAMPLES_MARCHED)
        return passed.select(((transmittance > smallest) & may_have_more).nonzero()[:, 0])


def _samples_at_once(like: Tensor) -> int:
    """Samples of each ray to evaluate together at first; on a GPU always as many as are marched, since it computes more
    of them in less time than the processor takes to ask again."""
    return FEWEST_SAMPLES if like.device.type == "cpu" else SAMPLES_MARCHED


@torch.no_grad()
def composite_view(
    renderer: VolumeRenderer, field: CoefficientField, camera: Cameras, subpixels: int = 1
) -> Coefficients:
    """Coefficients (H, W, ...) of a whole view of one camera: every picture of it follows from them. So many rays
    pass a pixel along each of its edges and are averaged: all outputs but ratios are linear."""
    camera = camera.to(renderer.skips.device)
    centres = [(i + 0.5) / subpixels for i in range(subpixels)]
    total: Coefficients | None = None
    for offset in [(x, y) for y in centres for x in centres]:
        found = composite(renderer, field, camera.image_rays(0, offset))
        total = found if total is None else found.map(total.packed.add_)
    assert total is not None
    return total.map(lambda packed: packed / subpixels**2).unflatten(camera.height, camera.width)


@torch.no_grad()
def composite(renderer: VolumeRenderer, field: CoefficientField, ray_bundle: RayBundle) -> Coefficients:
    """Coefficients (R, ...) of each ray, few rays at a time in memory: those of `VolumeRenderer.render` but for what
    this module says, in less time."""
    found, chunk = _composite_foreground(renderer, field, ray_bundle), renderer.rays_per_chunk
    parts = [field.sky(ray_bundle[first : first + chunk]) for first in range(0, len(ray_bundle), chunk)]
    skies = [sky for sky in parts if sky is not None]
    return before_sky(found, torch.cat(skies) if skies else None)[0]


def _composite_foreground(
    renderer: VolumeRenderer, field: CoefficientField, ray_bundle: RayBundle
) -> Coefficients:
    """Coefficients (R, ...) of each ray of a field, before any sky."""
    origins, smallest = ray_bundle.origins, renderer.smallest_weight
    limits = MergeLimits(renderer.step, smallest, _MERGED_WEIGHT * smallest)
    pending = torch.arange(len(origins), device=origins.device)
    active = _ActiveRays.at_camera(pending[:0], origins)
    features = field.density_of(field.encode(origins[:0]))[1]
    nothing = _coefficients(renderer, field, (origins[:0], origins[:0]), origins[:0, 0], features)
    totals = nothing.packed.new_zeros(len(origins), nothing.packed.shape[1])
    last = torch.zeros_like(totals) if renderer.residual_on_last_sample else None
    while len(pending) or len(active):
        room = max(renderer.rays_per_chunk - len(active), 0)
        active = active.join(_ActiveRays.at_camera(pending[:room], origins)).march(ray_bundle, renderer)
        pending = pending[room:]
        merged = _evaluate(field, ray_bundle, active, limits)
        lines = _lines(ray_bundle, active.rays.index_select(0, merged.ray_indices))
        values = _coefficients(renderer, field, lines, merged.t, merged.features).packed
        totals.index_add_(0, active.rays, accumulate(merged.weights, values, merged.packed_info))
        if last is not None:
            rows = merged.packed_info[:, 1].nonzero()[:, 0]
            last[active.rays[rows]] = values[merged.packed_info[rows].sum(dim=1) - 1]
        active = active.behind(merged.transmittance, smallest)
    if last is not None:
        totals = totals + (1 - totals[:, :1]) * last
    return Coefficients(totals, nothing.num_endmembers)


def _evaluate(
    field: CoefficientField, ray_bundle: RayBundle, active: _ActiveRays, limits: MergeLimits
) -> MergedSamples:
    """The next samples of rays, merged."""
    firsts = torch.arange(len(active), device=active.next.device) * SAMPLES_MARCHED + active.next
    owners, rows, info = packed_rows(firsts, active.next_counts())
    t = active.t.view(-1).index_select(0, rows)
    origins, along = _lines(ray_bundle, active.rays.index_select(0, owners))
    densities, features = field.density_of(field.encode(torch.addcmul(origins, along, t[:, None])))
    return merge_samples(densities * limits.step, t, features, info, active.transmittance, limits)


def _coefficients(
    renderer: VolumeRenderer,
    field: CoefficientField,
    lines: tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]],
    t: Float[Tensor, "S"],
    features: Float[Tensor, "S G"],
) -> Coefficients:
    """What opaque samples on these lines look like."""
    origins, along = lines
    positions = torch.addcmul(origins, along, t[:, None])
    light = renderer.lamplight(field, origins, positions)
    return coefficients_of(t, field.get_outputs(positions, along, features, light))


def _lines(
    ray_bundle: RayBundle, rays: Int[Tensor, "S"]
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Origins and directions of some rays."""
    return ray_bundle.origins.index_select(0, rays), ray_bundle.directions.index_select(0, rays)
