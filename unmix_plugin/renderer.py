"""From rays to composited coefficients: which samples are taken, which carry weight, and what they sum to.

Notation: `R` rays, `S` samples, `K` endmembers, `J` specular coefficients; w_i = T_i (1 - exp(-sigma_i delta)). Rays
are marched through the occupied cells of a grid; a first pass without gradient finds the samples that carry weight, and
only those go through the heads and the backward pass. The cost of a sample doesn't depend on the number of bands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.field import CoefficientField
from unmix_plugin.rendering.compositing import accumulate, volume_weights
from unmix_plugin.rendering.marching import PackedSamples, march
from unmix_plugin.rendering.occupancy import OccupancyGrid
from unmix_plugin.spectral.composition import Coefficients

_HAZE_DEPTH = 0.03
"""Optical depth of a sample from which on haze grows slower than matter does."""


@dataclass(frozen=True)
class RendererConfig:
    """How finely rays are sampled and what is left out."""

    samples_per_pixel: float = 1.5
    """Samples of a ray along the length of a pixel's edge where it meets the middle of the scene box."""
    smallest_weight: float = 4e-3
    """Samples that send less than this part of their ray's light to the camera are left out."""
    open_smallest_weight: float = 1e-3
    """The same in scenes without alpha, where matter has to be found far behind fog: a sample left out can't grow."""
    grid_update_interval: int = 16
    """Steps between updates of the occupancy grid."""
    grid_probed_cells: int = 32_768
    """Cells of the grid that an update probes."""
    grid_decay: float = 0.5
    """Factor on the remembered density of a probed cell: lower forgets emptied space sooner."""
    grid_smallest_opacity: float = 0.03
    """Opacity of one sample's interval from which a cell counts as occupied."""
    seen_weight: float = 0.05
    """Part of its ray's light from which on a sample is seen. In scenes with alpha, cells that no two training views
    have lately seen are left out; 1 leaves none out."""


@dataclass(frozen=True)
class RenderedRays:
    """What rendering a bundle of rays gives."""

    coefficients: Coefficients
    num_samples: int
    """Samples marched for all rays."""
    haze: Float[Tensor, ""]
    """Sum of log(1 + tau / 0.03) over the samples of a ray that carry weight, tau their optical depth; mean over rays.
    The same light stopped by few samples gives less of it than by many: surfaces little, fog much."""


class CoefficientRenderer(nn.Module):
    """Volume renderer of a field's coefficients, with the occupancy grid that it keeps."""

    aabb: Tensor

    def __init__(
        self,
        config: RendererConfig,
        scene_box: SceneBox,
        pixel_size: float,
        grid_resolution: int,
        is_open: bool,
        close_rays: bool,
    ) -> None:
        """
        Args:
            config: Sampling.
            scene_box: What is rendered, model space.
            pixel_size: Edge of a pixel in the middle of the scene, scene units.
            grid_resolution: Cells along an edge of the occupancy grid.
            is_open: No hull of the objects is known.
            close_rays: The last sample of a ray takes all the light that is left.
        """
        super().__init__()
        self.config = config
        self.is_open, self.close_rays = is_open, close_rays
        self.step = pixel_size / config.samples_per_pixel
        self.grid = OccupancyGrid(torch.ones((grid_resolution,) * 3, dtype=torch.bool))
        self.register_buffer("aabb", scene_box.aabb.clone(), persistent=False)
        self._scene_box = scene_box

    def carve(self, reachable: Bool[Tensor, "X Y Z"]) -> None:
        """Start from a grid of which only some cells may ever hold matter."""
        self.grid = OccupancyGrid(reachable).to(self.aabb.device)

    def forward(self, field: CoefficientField, ray_bundle: RayBundle) -> RenderedRays:
        """Composited coefficients of each ray.

        In training mode the samples of each ray are shifted at random, drawn from torch's global generator.
        """
        samples = self._march(ray_bundle)
        kept, encoded = self._carrying_weight(field, samples, ray_bundle)
        positions, along = _points(kept, ray_bundle)
        densities, features = field.density_of(field.encode(positions, encoded))
        depths = densities * self.step
        weights = volume_weights(depths, kept.packed_info)
        self._note_what_is_seen(kept, positions, weights, ray_bundle)
        outputs = field.get_outputs(positions, along, features)
        names = ("abundances", "scaled_abundances", "specular_coefficients")
        columns = [torch.ones_like(kept.t)[:, None], kept.t[:, None], *(outputs[name] for name in names)]
        values = torch.cat(columns, dim=-1)
        totals = accumulate(weights, values, kept.packed_info)
        if self.close_rays:
            totals = totals + _rest_on_last_sample(totals[:, 0], values, kept)
        parts = totals.split([column.shape[1] for column in columns], dim=-1)
        haze = torch.log1p(depths / _HAZE_DEPTH).sum() / max(len(ray_bundle), 1)
        return RenderedRays(Coefficients(parts[0][:, 0], parts[1][:, 0], *parts[2:]), len(samples), haze)

    def in_chunks(self, field: CoefficientField, ray_bundle: RayBundle, chunk: int) -> Coefficients:
        """Composited coefficients of each ray, with `chunk` rays at a time in memory."""
        bundles = (ray_bundle[i : i + chunk] for i in range(0, len(ray_bundle), chunk))
        return Coefficients.concatenate([self(field, bundle).coefficients for bundle in bundles])

    def update_grid(self, field: CoefficientField, step: int) -> None:
        """Probe the field where the grid's turn has come."""
        interval = self.config.grid_update_interval
        if step % interval:
            return
        self.grid.update(
            lambda points: field.get_density(points * self._size + self.aabb[0])[0],
            threshold=-math.log1p(-self.config.grid_smallest_opacity) / self.step,
            decay=self.config.grid_decay,
            num_cells=self.config.grid_probed_cells,
            generator=torch.Generator().manual_seed(int(torch.randint(2**62, (1,)))),
        )

    @torch.no_grad()
    def normals(
        self, field: CoefficientField, ray_bundle: RayBundle, ray_distance: Float[Tensor, "R"]
    ) -> Float[Tensor, "R 3"]:
        """Unit normals in model space where the rays end: against the gradient of the log density."""
        with torch.enable_grad():
            ends = ray_bundle.origins + ray_distance[:, None] * ray_bundle.directions
            positions = ends.detach().requires_grad_()
            log_density = field.get_density(positions)[0].clamp(min=1e-20).log().sum()
            (gradient,) = torch.autograd.grad(log_density, positions)
        return torch.nn.functional.normalize(-gradient, dim=-1)

    @property
    def _box(self) -> SceneBox:
        """The scene box where the model is; made once a device, since a box looks at its corners on the host."""
        if self._scene_box.aabb is not self.aabb:
            self._scene_box = SceneBox(self.aabb)
        return self._scene_box

    @property
    def _size(self) -> Float[Tensor, "3"]:
        return self.aabb[1] - self.aabb[0]

    def _unit(self, positions: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3"]:
        """Positions with the box as the unit cube."""
        return (positions - self.aabb[0]) / self._size

    def _march(self, ray_bundle: RayBundle) -> PackedSamples:
        origins, directions = ray_bundle.origins, ray_bundle.directions
        t_near, t_far = self._box.intersect(origins, directions)
        jitter = torch.rand_like(t_near) if self.training else torch.full_like(t_near, 0.5)
        unit_origins, unit_directions = self._unit(origins), directions / self._size
        return march(unit_origins, unit_directions, t_near, t_far, jitter, self.grid.occupied, self.step)

    def _note_what_is_seen(
        self,
        samples: PackedSamples,
        positions: Float[Tensor, "S 3"],
        weights: Float[Tensor, "S"],
        ray_bundle: RayBundle,
    ) -> None:
        """While training, where a hull of the objects is known: in a room, walls must be found far behind fog."""
        if self.training and not self.is_open and self.config.seen_weight < 1:
            views = ray_bundle.camera_indices.index_select(0, samples.ray_indices)
            seen = weights.detach() > self.config.seen_weight
            self.grid.sight.record(self._unit(positions), views, seen, len(ray_bundle))

    @torch.no_grad()
    def _carrying_weight(
        self, field: CoefficientField, samples: PackedSamples, ray_bundle: RayBundle
    ) -> tuple[PackedSamples, Float[Tensor, "kept LF"]]:
        """The samples that send enough of their ray's light to the camera, and their encodings."""
        encoded = field.encode(_points(samples, ray_bundle)[0])
        densities, _ = field.density_of(encoded)
        smallest = self.config.open_smallest_weight if self.is_open else self.config.smallest_weight
        keep = volume_weights(densities * self.step, samples.packed_info) > smallest
        return samples.select(keep), encoded.index_select(0, keep.nonzero()[:, 0])


def _points(
    samples: PackedSamples, ray_bundle: RayBundle
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Positions of samples and the directions they are seen along."""
    # index_select: a third of the time of indexing by a tensor, and this is done for every sample.
    origins, along = (
        x.index_select(0, samples.ray_indices) for x in (ray_bundle.origins, ray_bundle.directions)
    )
    return origins + samples.t[:, None] * along, along


def _rest_on_last_sample(
    accumulation: Float[Tensor, "R"], values: Float[Tensor, "S C"], samples: PackedSamples
) -> Float[Tensor, "R C"]:
    """What the last sample of each ray adds if it takes all the light left; 0 for rays without samples."""
    starts, counts = samples.packed_info.unbind(-1)
    if len(values) == 0:
        return values.new_zeros(len(starts), values.shape[1])
    last = values.index_select(0, (starts + counts - 1).clamp(min=0))
    return torch.where(counts > 0, 1 - accumulation, 0.0)[:, None] * last
