"""UnMix-NeRF: rays to coefficients to spectra, losses and metrics.

Notation: `R` rays, `B` bands, `K` endmembers, `J` specular coefficients. The renderer composites abundances, scaled
abundances and specular coefficients; endmembers E and specular spectra D are applied once a ray:

    C = E^T sum_i w_i S_i a_i + D^T sum_i w_i h_i u_i

which equals the paper's sum of a spectrum a sample, since both parts are linear in E and D.

Source: Perez et al. 2025, UnMix-NeRF, eqs. 4 to 9.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor, nn

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, UnitSpace
from unmix_plugin.engine.model import (
    DataManager,
    Model,
    TrainingCallback,
    TrainingCallbackLocation,
    TrainOutputs,
)
from unmix_plugin.engine.runs.replacing import foreign, move_aside
from unmix_plugin.field import FieldSpace, GridField, PublishedField, UnmixField
from unmix_plugin.light.lamp import Lamp
from unmix_plugin.light.shading import FINEST, ShadowDetail
from unmix_plugin.losses.abundance_guide import AbundanceGuide, first_endmembers, first_specular_spectra
from unmix_plugin.losses.terms import (
    BatchComparison,
    ComparedPixels,
    light_near_cameras,
    loss_weights,
    normals_error,
    pose_errors,
    stray_light,
)
from unmix_plugin.operators.occupancy import OccupancyGrid
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.poses.training import CorrectedRays, PoseTraining
from unmix_plugin.presets import fill_auto, preset_for
from unmix_plugin.rendering.front_to_back import composite_view, evenly_in_pixel
from unmix_plugin.rendering.grid_upkeep import GRID_INTERVAL, update_grid
from unmix_plugin.rendering.renderer import RenderedRays, VolumeRenderer
from unmix_plugin.sensors.views import BandBalance, MeasuredPixels, SensorViews, ViewGains, from_batch
from unmix_plugin.settings import COARSEST_REFINED, UnmixModelConfig
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import write_spectra_csv
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.metrics import psnr

SAMPLES_ON_CPU, SAMPLES_ON_GPU = 25_000, 400_000
"""That a training step looks at; a GPU takes no longer for so many than the processor does to tell it what to do."""
_FEWEST_RAYS, _FEWEST_SAMPLES_A_RAY = 64, 3
_COARSE_PART = 0.5
"""Part of the training in which samples move together to the distance they have in the end."""
_FIRST_PART = 0.05
"""Part of the training in which lighter samples may have gradients than later."""


@dataclass(frozen=True)
class TrainingBatch:
    """What a training step compares, worked out once."""

    corrected: CorrectedRays
    """Rays as their cameras send them."""
    rendered: RenderedRays
    compared: list[ComparedPixels]
    """Pixels of each sensor, measured and rendered."""


class UnmixModel(Model):
    """A mixture of materials at every point of a scene box."""

    batches_at_once = 2
    config: UnmixModelConfig
    rgb_weights: Tensor
    every_band: Tensor
    endmember_bound: Tensor

    @classmethod
    def check_tensors(cls, metadata: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
        """Refuse another grid than the checkpoint's. Raises KeyError, ValueError."""
        shape, found = (metadata["grid_resolution"],) * 3, tuple(tensors["grid.occupied"].shape)
        if shape != found:
            raise ValueError(
                f"grid_resolution is {shape[0]} in scene.json, and the checkpoint has a grid of {found}"
            )

    def populate_modules(self) -> None:
        """Field, grid, endmembers (K, B) and specular spectra (J, B), shaped by config and metadata. Raises
        ConfigError: more endmembers than bands."""
        metadata, box = self.metadata, self.scene_box
        nm, fwhm_nm = metadata["wavelengths_nm"], metadata.get("fwhm_nm")
        self.bands = Bands(np.array(nm, float), None if fwhm_nm is None else np.array(fwhm_nm, float))
        self.is_unbounded = bool(metadata.get("is_unbounded"))
        has_backdrop = bool(metadata.get("has_backdrop"))
        self.is_carved = bool(metadata["has_alpha"]) or has_backdrop  # pictures tell where nothing is
        self.preset = preset_for(metadata["has_alpha"], self.is_unbounded, has_backdrop)
        self.longest_edge = float(box.size.max())
        config = self.config = self.config.settled(self.longest_edge, metadata)
        assert isinstance(config.num_endmembers, int)
        assert isinstance(config.num_specular_spectra, int)
        self.lamp = Lamp.of_numbers([float(number) for number in config.lamp]) if config.lamp else None
        """Where the lamp that moves with the camera is before training; None if there is none or that is not known."""

        num_bands, self.num_endmembers = len(self.bands), config.num_endmembers
        num_dictionary = config.num_specular_spectra if config.specular == "dictionary" else 0
        num_specular = num_bands if config.specular == "full" else num_dictionary
        spectra = torch.zeros(self.num_endmembers, num_bands)
        self.endmembers = nn.Parameter(spectra, requires_grad=config.train_endmembers)
        self.specular_spectra = nn.Parameter(torch.zeros(num_dictionary, num_bands))
        self.step = metadata["pixel_size"] / float(config.renderer.samples_per_pixel)
        self.grid = self._new_grid(torch.ones((metadata["grid_resolution"],) * 3, dtype=torch.bool))
        refines = config.poses == "refine"
        first_step = self.step * self._coarseness(0.0)
        space = FieldSpace(
            box,
            initial_density=-math.log1p(-float(config.initial_opacity)) / first_step,
            is_unbounded=self.is_unbounded,
            has_backdrop=has_backdrop,
            coarse_to_fine=refines,
        )
        sizes = config.field
        if refines:
            sizes = replace(sizes, coarsest_resolution=min(sizes.coarsest_resolution, COARSEST_REFINED))
        self.field: GridField
        if config.as_published:
            self.field = PublishedField(sizes, space, self.num_endmembers, num_specular)
        else:
            self.field = UnmixField(
                sizes,
                space,
                self.num_endmembers,
                num_specular,
                exposure=float(config.losses.exposure),
                lit_by_camera=config.light == "camera",
                lamp=self.lamp,
            )
        self.register_buffer("rgb_weights", rgb_matrix(self.bands), persistent=False)
        self.register_buffer("every_band", torch.eye(num_bands), persistent=False)
        self.register_buffer("endmember_bound", torch.ones(()))
        self.guide = AbundanceGuide(self.num_endmembers, num_bands)
        self.view_gains: ViewGains | None = None
        if config.light == "per-view":
            self.view_gains = ViewGains(metadata["num_train_views"], torch.tensor(metadata["wavelengths_nm"]))
        self.poses: PoseRefinement | None = None
        self._pose_training: PoseTraining | None = None
        if config.poses == "refine":
            rows = metadata.get("line_rows") or [0] * metadata["num_train_views"]
            self.poses = PoseRefinement(rows, config.pose_refinement.lens)
            self._pose_training = PoseTraining(config.pose_refinement, self.poses)
        self.seen_by = SensorViews(metadata.get("sensors", ()), self.rgb_weights)
        weights = tuple(float(weight) for weight in config.losses.band_weights)
        self.balance = BandBalance(weights, self.bands, self.seen_by)
        self.comparison = BatchComparison(
            config.losses,
            seen_by=self.seen_by,
            balance=self.balance,
            guide=self.guide,
            view_gains=self.view_gains,
            as_published=config.as_published,
            has_sky=self.field.has_sky,
        )
        self._renderer: VolumeRenderer | None = None
        self._progress = 0.0
        self._occupied_share = torch.ones(())

    def initialise(self, initial_data: Mapping[str, np.ndarray], generator: torch.Generator) -> None:
        """Samples a step of this machine, endmembers from the training pixels or a file, the light in the dictionary,
        and the carved grid.

        Raises:
            SpectrumError: more endmembers than distinct pixels, or spectra that don't cover the bands.
            ConfigError: the file has another number of spectra than `num_endmembers`.
        """
        usual = SAMPLES_ON_CPU if self.device.type == "cpu" else SAMPLES_ON_GPU
        self.config = fill_auto(self.config, samples_per_step=usual)
        light = self.metadata["illuminant"]
        lamp = torch.ones(len(self.bands)) if light is None else torch.tensor(light, dtype=torch.float32)
        endmembers = first_endmembers(
            self.config,
            initial_data,
            generator,
            count=self.num_endmembers,
            balance=self.balance,
            sensors=self.seen_by,
            lamp=lamp,
            bands=self.bands,
        )
        self.endmembers.copy_(endmembers)
        self.endmember_bound.fill_(max(1.0, float(endmembers.max())))
        sensor = initial_data.get("sensor")
        pixels = self.balance.scaled(torch.from_numpy(initial_data["pixels"]), sensor)
        seen = self.balance.scaled(self.seen_by.project(endmembers, sensor), sensor)
        self.guide.start(pixels, endmembers, seen)
        self.specular_spectra.copy_(first_specular_spectra(len(self.specular_spectra), lamp, endmembers))
        reachable = torch.from_numpy(initial_data["reachable"])
        if self.poses is not None:
            knots, pixel_size = torch.from_numpy(initial_data["knots"]), self.metadata["pixel_size"]
            self.poses.begin(knots, self.scene_box, pixel_size)
            reachable = torch.ones_like(reachable)  # poses that are off carve away what is there
        self.grid = self._new_grid(reachable).to(self.device)

    def _new_grid(self, reachable: Bool[torch.Tensor, "X Y Z"]) -> OccupancyGrid:
        """The grid before training. Where little was carved, cells are too many to wait until each was probed: what
        rays meet in them counts as well."""
        records_observed = not self.is_carved or self.config.poses == "refine"
        return OccupancyGrid(reachable, self.lamp is not None, records_observed)

    @torch.no_grad()
    def between_steps(self, step: int, progress: float, data: DataManager) -> Collection[str]:
        """Keep empty what the masks carve away as seen by the corrected cameras, once poses hardly change any more."""
        if self._pose_training is not None:
            reachable = self._pose_training.between_steps(data)
            if reachable is not None:
                self.grid.empty_beyond(reachable.to(self.device))
        return ()

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """The hash table, the networks and the spectra."""
        networks = dict(self.field.named_parameters())
        table = networks.pop("table")
        spectra = [x for x in (self.endmembers, self.specular_spectra) if x.requires_grad and x.numel()]
        spectra += [] if self.view_gains is None else [self.view_gains.log_gains]
        poses = [] if self.poses is None else [x for x in self.poses.parameters() if x.requires_grad]
        return {"grid": [table], "networks": [*networks.values()], "spectra": spectra, "poses": poses}

    @property
    def renderer(self) -> VolumeRenderer:
        """How rays are rendered at present; its grid follows the training."""
        if self._renderer is None or self._renderer.skips is not self.grid.skips:
            config = self.config
            self._renderer = VolumeRenderer(
                space=UnitSpace(self.scene_box.to(self.device), self.is_unbounded),
                skips=self.grid.skips,
                step=self.step,
                smallest_weight=float(config.renderer.smallest_weight),
                residual_on_last_sample=config.losses.background == "last",
                rays_per_chunk=self.rays_per_chunk,
                opaque_skips=self.grid.opaque_skips,
            )
        return self._renderer

    @property
    def materials(self) -> Materials:
        """The spectra that coefficients are multiplied with."""
        light = self.metadata["illuminant"]
        return Materials(
            self.bands,
            self.endmembers,
            self.every_band if self.config.specular == "full" else self.specular_spectra,
            self.config.segmentation,
            light=None if light is None else self.endmembers.new_tensor(light),
            margin_error=self.guide.margin_error if self.config.losses.abundances > 0 else None,
        )

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        """`spectral` (R, B) on black, `accumulation` (R) and `abundances` (R, K), those of the sky among them."""
        rendered = self._rendered(ray_bundle)
        return {
            "spectral": self.materials.spectra(rendered.coefficients),
            "accumulation": rendered.coefficients.accumulation,
            "abundances": rendered.mixtures,
        }

    def get_train_loss_dict(self, ray_bundle: RayBundle, batch: dict[str, Tensor]) -> TrainOutputs:
        """`batch` and `num_samples`; weighted losses by name, those of no weight left out; and `psnr` of the batch in
        dB, on black, samples per ray evaluated and visible, the share of the grid's cells that are occupied, how far
        poses were corrected, and in an unbounded world the part of light that does not come from the sky."""
        num_rays = max(len(ray_bundle), 1)
        measured = from_batch(batch, len(ray_bundle), self.seen_by.num_channels)
        step = self.training_batch(ray_bundle, measured)
        losses, rendered = self.losses(step), step.rendered
        metrics = {
            "psnr": self.comparison.psnr(step.compared),
            "samples_per_ray": torch.tensor(rendered.num_samples / num_rays),
            "visible_samples_per_ray": torch.tensor(len(rendered.weights) / num_rays),
            "occupied_share": self._occupied_share,
        }
        if self.poses is not None and step.corrected.steps is not None:
            metrics |= self.poses.figures(step.corrected.steps)
        if self.is_unbounded:
            metrics["matter_share"] = rendered.coefficients.accumulation.detach().mean()
        return {"batch": step, "num_samples": rendered.num_samples}, losses, metrics

    def training_batch(self, ray_bundle: RayBundle, measured: list[MeasuredPixels]) -> TrainingBatch:
        """Rays of training views, rendered and laid beside what was measured along them; changes nothing."""
        corrected = CorrectedRays(ray_bundle)
        if self._pose_training is not None:
            corrected = self._pose_training.corrected(ray_bundle)
        rendered = self._rendered(corrected.rays)
        views, materials = ray_bundle.camera_indices, self.materials
        compared = self.comparison.compare(measured, rendered, views, materials, corrected.weights)
        return TrainingBatch(corrected, rendered, compared)

    def losses(self, step: TrainingBatch) -> dict[str, Tensor]:
        """Weighted losses by name, and `poses`, what their corrections cost; changes nothing."""
        config, rendered = self.config, step.rendered
        weights = loss_weights(config.losses, self.preset, self._progress, config.as_published)
        losses = self.comparison.losses(step.compared, weights, self.generator)
        losses["sparsity"], losses["certainty"] = rendered.sparsity, rendered.certainty
        surfaces = [part.measured.surfaces_of_rays() for part in step.compared]
        if "surface" in weights and (known := [each for each in surfaces if each is not None]):
            light = (rendered.weights, rendered.positions, rendered.ray_indices)
            losses["surface"] = stray_light(*light, torch.cat(known), self.renderer.space)
        if "near" in weights:
            seen = (rendered.weights, rendered.positions, step.corrected.rays)
            losses["near"] = light_near_cameras(*seen, self.renderer.space)
        shading = self.field.lamp_shading if isinstance(self.field, UnmixField) else None
        if "normals" in weights and shading is not None:
            places = self.renderer.space.from_unit(rendered.positions)
            losses["normals"] = normals_error(
                self.field.get_density, shading, places, rendered.weights, self.generator
            )
        weighed = {name: weights[name] * losses[name] for name in weights if name in losses}
        if self.poses is not None and step.corrected.steps is not None:
            weighed["poses"] = self.poses.penalty(step.corrected.steps)
        return weighed

    def update(self, outputs: dict[str, Any]) -> None:
        """Note which cells the views see, and how far margins of abundances are from those of measured spectra."""
        step: TrainingBatch = outputs["batch"]
        rendered, views = step.rendered, step.corrected.rays.camera_indices
        visible_weight = float(self.config.renderer.visible_weight)
        if visible_weight < 1:
            own, is_seen = views.index_select(0, rendered.ray_indices), rendered.weights > visible_weight
            num_rays = len(views) * self.processes.count
            self.grid.visibility.record(rendered.positions, own, is_seen, num_rays)
        if self.grid.observed is not None:
            positions = torch.cat([part.positions for part in rendered.evaluated])
            densities = torch.cat([part.densities for part in rendered.evaluated])
            self.grid.record_observed(self.renderer.space.to_unit(positions.detach()), densities)
        self.comparison.update(step.compared)
        if self.poses is not None and step.corrected.knots is not None:
            self.poses.robust.update(*pose_errors(step.compared, step.corrected.knots))

    def _rendered(self, rays: RayBundle) -> RenderedRays:
        renderer = self._training_renderer if self.training else self.renderer
        return renderer.render(self.field, rays, self.generator if self.training else None)

    def warnings(self) -> list[str]:
        """Sensors whose pixels can't be unmixed into so many endmembers one by one."""
        return self.seen_by.warnings(self.num_endmembers)

    @torch.no_grad()
    def get_outputs_for_camera(
        self, camera: Cameras, outputs: Collection[str] | None = None
    ) -> dict[str, Tensor]:
        """`spectral` (H, W, B) on black, `rgb` sRGB (H, W, 3) and `accumulation` (H, W) of a whole view.

        For evaluation while training; `trained.TrainedScene` has all other outputs.
        """
        seen = composite_view(self.renderer, self.field, camera, evenly_in_pixel(self.metadata["subpixels"]))
        linear = self.materials.through(seen, self.rgb_weights).clamp(0, 1)
        found = {
            "spectral": self.materials.spectra(seen),
            "rgb": linear_to_srgb(linear),
            "accumulation": seen.accumulation,
        }
        return found if outputs is None else {name: found[name] for name in outputs}

    def get_evaluation_outputs(self, camera: Cameras, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """A view as the lens sees it that training corrected, if it did."""
        return self.get_outputs_for_camera(
            camera if self.poses is None else self.poses.corrected_lens(camera)
        )

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR of the view's valid pixels in dB as its sensor sees them, and its predicted sRGB picture."""
        sensor = int(batch["sensor"]) if "sensor" in batch else None
        seen = self.seen_by.project(outputs["spectral"], sensor)
        return {"psnr": psnr(seen, batch["spectra"], batch.get("valid"))}, {"rgb": outputs["rgb"]}

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Keep the occupancy grid up to date, and spectra within their bounds."""
        before, after = TrainingCallbackLocation
        return [TrainingCallback(before, self._begin_step), TrainingCallback(after, self._bound_spectra)]

    def num_samples(self, outputs: dict[str, Any]) -> int:
        """Samples that light may reach, of the batch with these outputs."""
        return outputs["num_samples"]

    def next_num_rays(self, num_samples: int, current: int) -> int | None:
        """Half of the way to the rays with which a step would have `samples_per_step`."""
        samples = self.config.samples_per_step
        if samples == "auto":  # of a run from before it was settled
            samples = SAMPLES_ON_CPU if self.device.type == "cpu" else SAMPLES_ON_GPU
        samples = samples / self.processes.count
        samples_a_ray = max(num_samples / current, _FEWEST_SAMPLES_A_RAY)
        return max(int(current + samples / samples_a_ray) // 2, _FEWEST_RAYS)

    def warm_up(self) -> None:
        """Compile the kernels by one render along the box's diagonal and its backward pass."""
        low, high = self.renderer.box.aabb
        direction = torch.nn.functional.normalize(high - low, dim=0)
        bundle = RayBundle((low - direction)[None], direction[None], low.new_zeros(1, dtype=torch.int64))
        with torch.enable_grad():
            spectra = self.materials.spectra(self.renderer.render(self.field, bundle).coefficients)
            parameters = [value for group in self.get_param_groups().values() for value in group]
            torch.autograd.grad(spectra.sum(), parameters, allow_unused=True)

    def write_results(self, folder: Path) -> None:
        """Write the endmembers that evaluation and exports will use: `endmembers.csv`."""
        path = folder / "endmembers.csv"
        for changed in foreign([path]):  # by its user, who goes on with the run: both are kept
            move_aside(changed, "changed")
        write_spectra_csv(path, self.materials.called_by_colour().table())

    @property
    def _training_renderer(self) -> VolumeRenderer:
        """That of the present training step: samples may be farther apart, and shadows softer, than in the end."""
        config, progress, renderer = self.config.renderer, self._progress, self.renderer
        smallest = config.first_smallest_weight if progress < _FIRST_PART else config.smallest_weight
        return replace(
            renderer,
            step=self.step * self._coarseness(progress),
            smallest_weight=float(smallest),
            shadow_detail=FINEST if renderer.opaque_skips is None else ShadowDetail.at(progress),
        )

    def _coarseness(self, progress: float) -> float:
        """How many times farther apart samples are in training than in the end: large images begin coarsely."""
        samples_along_box = self.longest_edge / self.step
        to_go = max(1.0 - progress / _COARSE_PART, 0.0)
        return max(samples_along_box / float(self.config.renderer.coarse_samples), 1.0) ** to_go

    def _begin_step(self, step: int, progress: float) -> None:
        self._progress = progress
        if self._pose_training is not None:
            self._pose_training.begin_step(step, progress, self.field)
        if step % GRID_INTERVAL == 0:
            update_grid(
                self.grid,
                self.field,
                self._training_renderer,
                self.processes,
                self.generator,
                progress=progress,
                num_pixels=self.metadata.get("num_train_pixels", 0),
            )
            self._occupied_share = self.grid.occupied.float().mean()
            self.processes.reduce(self.guide.margin_variance, "mean")
            if self._pose_training is not None:
                self._pose_training.update_weights(self.processes)

    @torch.no_grad()
    def _bound_spectra(self, step: int, progress: float) -> None:
        self.endmembers.clamp_(min=0.0).clamp_(max=self.endmember_bound)
        self.specular_spectra.clamp_(0, 1)
        if self._pose_training is not None:
            self._pose_training.end_step()
