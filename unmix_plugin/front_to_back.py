"""What rays sum to, without gradients: looked at from the front until hardly any light is left.

For pictures of a trained field. `VolumeRenderer.render` is the careful way, which training takes: it evaluates every
sample that carries weight, and goes on farther. Here neighbouring samples are merged where together they carry little
of their ray's light, and what lies behind the place where a ray ends is taken to look like what lies before it.

Notation: `R` rays, `M` of them that are marched, `A` that still have light, `C` coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.field import CoefficientField
from unmix_plugin.rendering.compositing import accumulate
from unmix_plugin.rendering.marching import PackedSamples
from unmix_plugin.rendering.merging import MergedSamples, MergeLimits, merge_samples
from unmix_plugin.spectral.coefficients import Coefficients

_ENDING_LIGHT = 3.0
"""Share of its light at which a ray ends, in multiples of the smallest weight of a sample."""
_MERGED_WEIGHT = 125.0
"""Most of a ray's light that merged samples carry together, in the same unit."""
_SAMPLES_AT_ONCE = 4
"""Of each ray, that are looked at before it is known whether light gets farther; later at most as many as so far, since
light that gets through those gets through more."""
_DENSER = 2.0
"""How many times denser what follows is taken to be than what was looked at: most rays have just entered a surface."""

FIRST_SAMPLES = 16
"""Of each ray, that are marched before it is known whether light gets behind them."""

_MarchOn = Callable[[RayBundle, Float[Tensor, "R"]], PackedSamples]
_Visible = Callable[[Float[Tensor, "S 3"], Float[Tensor, "S 3"]], Float[Tensor, "S"] | None]


@dataclass(frozen=True)
class _Front:
    """How far rays that still have light were looked at."""

    rays: Int[Tensor, "A"]
    at: Int[Tensor, "A"]
    """Next sample of each."""
    todo: Int[Tensor, "A"]
    """Samples of each from there."""
    left: Float[Tensor, "A"]
    """Share of its light that each still has."""
    wanted: Int[Tensor, "A"]
    """Samples of each that are looked at next, at most `todo`."""
    num_seen: int = 0
    """Most samples of one that were looked at."""

    @classmethod
    def before(
        cls, samples: PackedSamples, rays: Int[Tensor, "M"], left: Float[Tensor, "R"], num_seen: int
    ) -> _Front:
        """Before the samples of M marched rays, of which each is one of R and had some before."""
        starts, counts = samples.packed_info.unbind(-1)
        found = counts.nonzero()[:, 0]
        rays, at, todo = (value.index_select(0, found) for value in (rays, starts, counts))
        wanted = todo.clamp(max=_SAMPLES_AT_ONCE)
        return cls(rays, at, todo, left.index_select(0, rays), wanted, num_seen)

    def after(self, left: Float[Tensor, "A"], ending_light: float) -> _Front:
        """Behind these samples, where there are more and enough light is left."""
        at_once = max(_SAMPLES_AT_ONCE, self.num_seen)
        todo = self.todo - self.wanted
        alive = ((left > ending_light) & (todo > 0)).nonzero()[:, 0]
        values = (self.rays, self.at + self.wanted, todo, left, self.wanted, self.left)
        rays, at, todo, left, wanted, before = (value.index_select(0, alive) for value in values)
        enough = wanted / _DENSER * (left / ending_light).log() / (before / left).log()
        enough = (
            enough.ceil().nan_to_num(nan=at_once).clamp(1, at_once)
        )  # no number if both logarithms are infinite
        wanted = torch.minimum(enough.long(), todo)
        return _Front(rays, at, todo, left, wanted, self.num_seen + at_once)


@torch.no_grad()
def composite_front_to_back(
    field: CoefficientField,
    samples: PackedSamples,
    ray_bundle: RayBundle,
    smallest_weight: float,
    visible: _Visible,
    residual_on_last_sample: bool = False,
    march_on: _MarchOn | None = None,
) -> Coefficients:
    """Coefficients (R, ...) of each ray.

    Args:
        field: What is rendered.
        samples: Of the rays of the bundle, each `samples.step` long.
        ray_bundle: R rays.
        smallest_weight: Samples that contribute no more of their ray's light are left out.
        visible: From origins of rays and positions on them to the part of a moving lamp's light that reaches them, as
            `CoefficientField.get_outputs` takes it.
        residual_on_last_sample: Whether the last sample of a ray takes all the light that is left.
        march_on: From rays and distances along them to the samples behind, where `samples` are the first
            `FIRST_SAMPLES` of each ray; None where they are all.
    """
    starts, counts = samples.packed_info.unbind(-1)
    left = torch.ones_like(counts, dtype=samples.t.dtype)
    ending_light = _ENDING_LIGHT * smallest_weight
    limits = MergeLimits(samples.step, smallest_weight, _MERGED_WEIGHT * smallest_weight)
    front = _Front.before(samples, torch.arange(len(counts), device=counts.device), left, 0)
    totals = last = torch.zeros(0)
    while True:
        merged = _look(field, samples, ray_bundle, front, limits)
        values = _values(field, ray_bundle, front.rays, merged, visible)
        if totals.dim() == 1:
            totals = values.packed.new_zeros(len(counts), values.packed.shape[1])
            last = torch.zeros_like(totals)
        totals.index_add_(0, front.rays, accumulate(merged.weights, values.packed, merged.packed_info))
        if residual_on_last_sample:
            found = merged.packed_info[:, 1].nonzero()[:, 0]
            last[front.rays[found]] = values.packed[merged.packed_info[found].sum(dim=1) - 1]
        left[front.rays] = merged.left
        front = front.after(merged.left, ending_light)
        if len(front.rays) == 0 and march_on is not None:
            lit = ((left > ending_light) & (counts == FIRST_SAMPLES)).nonzero()[:, 0]
            samples = march_on(ray_bundle[lit], samples.t[starts[lit] + FIRST_SAMPLES - 1])
            front, march_on = _Front.before(samples, lit, left, FIRST_SAMPLES), None
        if len(front.rays) == 0:
            break
    if residual_on_last_sample:
        totals = totals + (1 - totals[:, :1]) * last
    else:
        totals *= torch.where(left > ending_light, 1.0, 1 / (1 - left))[:, None]
    return Coefficients(totals, values.num_endmembers)


def _look(
    field: CoefficientField,
    samples: PackedSamples,
    ray_bundle: RayBundle,
    front: _Front,
    limits: MergeLimits,
) -> MergedSamples:
    """The next samples of rays, merged."""
    wanted = front.wanted
    ends = wanted.cumsum(0)
    size = int(ends[-1]) if len(ends) else 0
    packed_info = torch.stack([ends - wanted, wanted], dim=-1)
    owners = torch.repeat_interleave(wanted, output_size=size)
    chosen = (front.at - packed_info[:, 0]).index_select(0, owners)
    t = samples.t.index_select(0, chosen.add_(torch.arange(size, device=chosen.device)))
    origins, along = _lines(ray_bundle, front.rays.index_select(0, owners))
    densities, features = field.density_of(field.encode(torch.addcmul(origins, along, t[:, None])))
    return merge_samples(densities * limits.step, t, features, packed_info, front.left, limits)


def _values(
    field: CoefficientField,
    ray_bundle: RayBundle,
    rays: Int[Tensor, "A"],
    merged: MergedSamples,
    visible: _Visible,
) -> Coefficients:
    """What groups of samples look like."""
    origins, along = _lines(ray_bundle, rays.index_select(0, merged.ray_indices))
    positions = torch.addcmul(origins, along, merged.t[:, None])
    lit = visible(origins, positions)
    outputs = field.get_outputs(positions, along, merged.features, *(() if lit is None else (lit,)))
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
