"""From rays to composited coefficients: which samples are taken, which are visible, and what they sum to.

Rays are marched through the occupied cells of a grid. A first pass without gradient, from the front until no light is
left, finds the visible samples: those that contribute enough of their ray's light. Only these go through the heads and
the backward pass. The cost of a sample doesn't depend on the number of bands. Pictures of a trained field are
composited in front_to_back.py.

Notation: `R` rays, `N` samples that light may reach, `S` visible ones, `K` endmembers, `J` specular coefficients;
w_i = T_i (1 - exp(-sigma_i delta)).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from unmix_plugin.engine.geometry.space import RayBundle, SceneBox, UnitSpace
from unmix_plugin.field import CoefficientField
from unmix_plugin.light.shading import FINEST, Lamplight, ShadowDetail, lamplight
from unmix_plugin.operators.compositing import accumulate, scale_gradient, volume_weights
from unmix_plugin.operators.marching import GridRays, PackedSamples, packed_rows, rays_in_box, rays_in_world
from unmix_plugin.operators.occupancy import cells_at
from unmix_plugin.spectral.materials import Coefficients

_SMALLEST_SHARE = 1e-30
"""Of an abundance whose logarithm is taken: 0 has none."""
_FIRST_SAMPLES, _FIRST_ON_GPU = 8, 32
"""Of each ray, that are evaluated before it is known whether light gets farther; asking a GPU again costs more."""


@dataclass(frozen=True)
class EvaluatedSamples:
    """What was found at samples in model space, without gradients."""

    positions: Float[Tensor, "N 3"]
    encoded: Float[Tensor, "N LF"]
    densities: Float[Tensor, "N"]
    features: Float[Tensor, "N G"]


@dataclass(frozen=True)
class VisibleSamples:
    """Samples that contribute enough of their ray's light, among all that light may reach."""

    samples: PackedSamples
    rows: Int[Tensor, "S"]
    """Of each, among the samples evaluated."""
    evaluated: Sequence[EvaluatedSamples]
    """All samples that light may reach, in the parts in which they were evaluated."""

    def of(self, parts: Sequence[Float[Tensor, "_ *values"]]) -> Float[Tensor, "S *values"]:
        """The values of the visible samples, from those of each part of the evaluated ones."""
        return torch.cat(list(parts)).index_select(0, self.rows)


@torch.no_grad()
def visible_samples(
    field: CoefficientField,
    samples: PackedSamples,
    ray_bundle: RayBundle,
    *,
    step: float,
    smallest_weight: float,
    at_first: int | None = None,
) -> VisibleSamples:
    """Of samples of the rays that lie `step` apart those that contribute more than `smallest_weight` of their ray's
    light.

    The first samples of all rays are evaluated first, so many as `at_first` says, or as suit the device, then twice as
    many of the rays that still let light through, and so on: what lies behind can't contribute enough, whatever it is.
    """
    starts, counts = samples.packed_info.unbind(-1)
    depths, rows = torch.zeros_like(samples.t), torch.zeros_like(samples.ray_indices)
    evaluated: list[EvaluatedSamples] = []
    first, num_evaluated, transmittance = 0, 0, torch.ones_like(counts, dtype=samples.t.dtype)
    at_first = at_first or (_FIRST_SAMPLES if depths.device.type == "cpu" else _FIRST_ON_GPU)
    while True:
        wanted = (counts - first).clamp(0, max(first, at_first)) * (transmittance > smallest_weight)
        rays, chosen, _ = packed_rows(starts + first, wanted)
        if len(chosen) == 0 and evaluated:
            break
        positions, _ = points_of(ray_bundle, rays, samples.t.index_select(0, chosen))
        encoded = field.encode(positions)
        densities, features = field.density_of(encoded)
        evaluated.append(EvaluatedSamples(positions, encoded, densities, features))
        depths[chosen] = densities * step
        rows[chosen] = torch.arange(num_evaluated, num_evaluated + len(chosen), device=rows.device)
        depth = torch.zeros_like(transmittance).index_add_(0, rays, densities * step)
        transmittance = transmittance * torch.exp(-depth)
        first, num_evaluated = first + max(first, at_first), num_evaluated + len(chosen)
    keep = volume_weights(depths, samples.packed_info) > smallest_weight
    return VisibleSamples(samples.select(keep), rows[keep], evaluated)


def points_of(
    ray_bundle: RayBundle, ray_indices: Int[Tensor, "S"], t: Float[Tensor, "S"]
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Positions of samples and the directions they are seen along."""
    # index_select: a third of the time of indexing by a tensor, and this is done for every sample.
    origins, along = (x.index_select(0, ray_indices) for x in (ray_bundle.origins, ray_bundle.directions))
    return origins + t[:, None] * along, along


_SPARSE_DEPTH = 0.03
"""Optical depth of a sample from which on its part of the sparsity loss grows slower than the depth."""


@dataclass(frozen=True)
class RenderedRays:
    """What rendering a bundle of rays gives."""

    coefficients: Coefficients
    mixtures: Float[Tensor, "R K"]
    """Abundances of all that a ray sees, the sky included."""
    sparsity: Float[Tensor, ""]
    """Sum of log(1 + tau / 0.03) over the samples of a ray that are visible, tau their optical depth; mean over rays.
    The same light stopped by few samples gives less of it than by many: surfaces little, floaters much."""
    certainty: Float[Tensor, ""]
    """Weighted sum over the samples of a ray of the cross entropy of their abundances with even ones, at least log K;
    mean over rays. Weights have no gradient."""
    positions: Float[Tensor, "S 3"]
    """Visible samples, in the unit cube."""
    weights: Float[Tensor, "S"]
    """Share of its ray's light that each contributes."""
    ray_indices: Int[Tensor, "S"]
    """Ray of each."""
    evaluated: Sequence[EvaluatedSamples]
    """All samples that light may reach."""

    @property
    def num_samples(self) -> int:
        """Samples evaluated of all rays."""
        return sum(len(part.densities) for part in self.evaluated)


@dataclass(frozen=True)
class VolumeRenderer:
    """Volume renderer of a field's coefficients: pure functions of its values, the field and the rays."""

    space: UnitSpace
    """What is rendered, and where the cells of the grid lie: a box, or a world in which rays go on outside of it,
    through contracted space, and end on the sky."""
    skips: UInt8[Tensor, "X Y Z"]
    """0 in the cells of the box that rays are sampled in; others are empty, and have what `skip_distances` says."""
    step: float
    """Distance of samples, model units; larger outside the box of a world without end."""
    smallest_weight: float
    """Samples that contribute less are left out."""
    residual_on_last_sample: bool = False
    """Whether the last sample of a ray takes all the light that is left."""
    rays_per_chunk: int = 32_768
    """Rays under way at once for a whole image; fewer take less memory."""
    opaque_skips: UInt8[Tensor, "X Y Z"] | None = None
    """0 in the cells that cast shadows in the light of a lamp that moves with the camera, in others what
    `skip_distances` says; None without such a lamp."""
    shadow_detail: ShadowDetail = FINEST
    """How sharp those shadows are."""

    def render(
        self, field: CoefficientField, ray_bundle: RayBundle, generator: torch.Generator | None = None
    ) -> RenderedRays:
        """Composited coefficients of each ray; a generator shifts the samples of each at random, as in training."""
        origins, directions = ray_bundle.origins.detach(), ray_bundle.directions.detach()
        samples = self.march(origins, directions, torch.zeros_like(origins[:, 0]), generator).samples()
        seen = visible_samples(
            field, samples, ray_bundle, step=self.step, smallest_weight=self.smallest_weight
        )
        kept = seen.samples
        positions, along = points_of(ray_bundle, kept.ray_indices, kept.t)
        if torch.is_grad_enabled():
            encoded = seen.of([part.encoded for part in seen.evaluated])
            densities, features = field.density_of(field.encode(positions, encoded))
        else:
            densities = seen.of([part.densities for part in seen.evaluated])
            features = seen.of([part.features for part in seen.evaluated])

        light = None
        if self.opaque_skips is not None:
            origins = ray_bundle.origins.index_select(0, kept.ray_indices)
            light = self.lamplight(field, origins, positions, generator)
        outputs = field.get_outputs(positions, along, features, light)
        if self.space.is_unbounded:
            # What is near a camera fills more of its pixels than what is far, so it would learn faster, and from one
            # view alone. Source: Philip and Deschaintre 2023, Floaters No More.
            near = (kept.t / self.space.half_edge).square().clamp(max=1.0)
            densities = scale_gradient(densities, near)
            outputs = {name: scale_gradient(values, near[:, None]) for name, values in outputs.items()}

        depths = densities * self.step
        weights = volume_weights(depths, kept.packed_info)
        values = coefficients_of(kept.t, outputs)
        totals = accumulate(weights, values.packed, kept.packed_info)
        if self.residual_on_last_sample and len(values.packed):
            starts, counts = kept.packed_info.unbind(-1)
            last = values.packed.index_select(0, (starts + counts - 1).clamp(min=0))
            totals = totals + torch.where(counts > 0, 1 - totals[:, 0], 0.0)[:, None] * last
        coefficients, sky = Coefficients(totals, values.num_endmembers), field.sky(ray_bundle)
        coefficients, mixtures = (
            (coefficients, coefficients.abundances) if sky is None else coefficients.before(sky)
        )

        num_rays = max(len(ray_bundle), 1)
        mean_log = outputs["abundances"].clamp(min=_SMALLEST_SHARE).log().mean(dim=1)
        return RenderedRays(
            coefficients,
            mixtures,
            sparsity=torch.log1p(depths / _SPARSE_DEPTH).sum() / num_rays,
            certainty=(weights.detach() * -mean_log).sum() / num_rays,
            positions=self.space.to_unit(positions).detach(),
            weights=weights,
            ray_indices=kept.ray_indices,
            evaluated=seen.evaluated,
        )

    @torch.no_grad()
    def normals(
        self, field: CoefficientField, ray_bundle: RayBundle, ray_distance: Float[Tensor, "R"]
    ) -> Float[Tensor, "R 3"]:
        """Unit normals in model space where the rays end: against the gradient of the log density."""
        chunk, parts = self.rays_per_chunk, []
        for i in range(0, len(ray_bundle), chunk):
            rays, distance = ray_bundle[i : i + chunk], ray_distance[i : i + chunk]
            with torch.enable_grad():
                positions = rays.at(distance).detach().requires_grad_()
                log_density = field.get_density(positions)[0].clamp(min=1e-20).log().sum()
                (gradient,) = torch.autograd.grad(log_density, positions)
            parts.append(torch.nn.functional.normalize(-gradient, dim=-1))
        return torch.cat(parts)

    def is_occupied(self, positions: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
        """Points in the box, in cells that rays are sampled in."""
        cells = self.skips == 0
        unit = self.space.to_unit(positions)
        return self.space.contains(positions) & cells[cells_at(unit, cells.shape).unbind(-1)]

    @property
    def box(self) -> SceneBox:
        """That of the scene, model space."""
        return self.space.box

    def lamplight(
        self,
        field: CoefficientField,
        origins: Float[Tensor, "S 3"],
        positions: Float[Tensor, "S 3"],
        generator: torch.Generator | None = None,
    ) -> Lamplight | None:
        """What of a moving lamp's light reaches positions on rays, as `CoefficientField.get_outputs` takes it."""
        if field.moving_lamp is None or self.opaque_skips is None:
            return None
        lamp, skips = field.moving_lamp, self.opaque_skips
        return lamplight(lamp, origins, positions, self.box, skips, self.shadow_detail, generator)

    def march(
        self,
        origins: Float[Tensor, "R 3"],
        directions: Float[Tensor, "R 3"],
        behind: Float[Tensor, "R"],
        generator: torch.Generator | None = None,
    ) -> GridRays:
        """Rays through the grid, which give their samples behind these distances, at first 0; a generator shifts the
        samples of each at random, else they lie in the middles of intervals."""
        jitter = torch.full_like(behind, 0.5)
        if generator is not None:
            jitter = torch.rand(jitter.shape, generator=generator, device=generator.device).to(jitter)
        if self.space.is_unbounded:
            starts, along = self.space.centred(origins), directions / self.space.half_edge
            return rays_in_world(starts, along, behind, jitter, self.skips, self.step)
        t_near, t_far = self.box.intersect(origins, directions)
        starts, along = self.box.normalise(origins), directions / self.box.size
        return rays_in_box(starts, along, torch.maximum(t_near, behind), t_far, jitter, self.skips, self.step)


def coefficients_of(t: Float[Tensor, "S"], outputs: Mapping[str, Tensor]) -> Coefficients:
    """Those of opaque samples at these distances, of which a field says this."""
    values = [outputs[name] for name in ("abundances", "scaled_abundances", "specular_coefficients")]
    packed = torch.cat([torch.ones_like(t)[:, None], t[:, None], *values], dim=-1)
    return Coefficients(packed, values[0].shape[-1])
