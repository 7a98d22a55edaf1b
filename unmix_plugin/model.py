"""UnMix-NeRF: rays to composited coefficients to spectra, its losses, metrics and pictures.

Notation: `R` rays, `S` samples, `B` bands, `K` endmembers, `J` specular coefficients. A first pass without gradient
finds the samples that carry weight; only those go through the heads and the backward pass. Their abundances, scaled
abundances and specular coefficients are composited, and endmembers E and specular spectra D applied once a ray:

    C = E^T sum_i w_i S_i a_i + D^T sum_i w_i h_i u_i,   w_i = T_i (1 - exp(-sigma_i delta_i))

which equals the paper's sum of spectra, since both parts are linear in E and D.

Source: Perez et al. 2025, UnMix-NeRF, eqs. 4 to 9.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.engine.cameras import Cameras
from unmix_plugin.engine.instantiate import Target
from unmix_plugin.engine.model import Model, ModelConfig
from unmix_plugin.engine.rays import RayBundle
from unmix_plugin.errors import ConfigError
from unmix_plugin.field import UnmixField, UnmixFieldConfig
from unmix_plugin.rendering.compositing import accumulate, volume_weights
from unmix_plugin.rendering.marching import PackedSamples, march
from unmix_plugin.rendering.occupancy import OccupancyGrid
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.composition import Coefficients, Materials, SegmentationMethod, compose, spectral
from unmix_plugin.spectral.endmembers import EndmemberMethod, initialise_endmembers
from unmix_plugin.spectral.metrics import psnr
from unmix_plugin.spectral.spectra_csv import read_spectra_csv


@dataclass(frozen=True)
class UnmixModelConfig(ModelConfig):
    """Settings of the model of UnMix-NeRF."""

    _target: Target = field(default_factory=lambda: UnmixModel)
    num_endmembers: int = 6
    """K, the number of materials to unmix into."""
    endmember_init: EndmemberMethod | Literal["file"] = "kmeans"
    """First guess of the endmembers from the pixels of all training views, or spectra from `endmember_file`."""
    endmember_file: Path | None = None
    """CSV of reflectances (wavelength,name,...) for `endmember_init` file; multiplied by the scene's light if known."""
    specular: Literal["none", "dictionary", "full"] = "dictionary"
    """View-dependent part: none, multiples of a few spectra, or one value a band as published."""
    num_specular_spectra: int = 1
    """Spectra of the specular dictionary. The first is the light's, a highlight's colour on anything but metal."""
    segmentation: SegmentationMethod = "abundances"
    """Material of a ray: its largest abundance, or the endmember of smallest angle to its spectrum as published."""
    background: Literal["random", "black", "white", "last"] = "random"
    """What lies behind the scene in training: a random grey a ray, black, white, or the colour of the last sample."""
    spectral_loss_weight: float = 1.0
    """Weight of the mean squared error of spectra."""
    rgb_loss_weight: float = 0.0
    """Weight of the mean squared error of their sRGB colours."""
    samples_per_step: int = 20_000
    """Samples marched in a training step; the number of rays adapts to it."""
    samples_across: int = 384
    """Samples along the diagonal of the scene box: what sets their distance."""
    smallest_weight: float = 1e-3
    """Samples that send less than this part of their ray's light to the camera are left out."""
    initial_opacity: float = 0.05
    """Opacity of one sample's interval in the untrained field where a hull of the objects is known."""
    initial_opacity_unknown: float = 0.01
    """The same in scenes without alpha, where space between cameras and walls must stay clear."""
    grid_update_interval: int = 16
    """Steps between updates of the occupancy grid."""
    field: UnmixFieldConfig = UnmixFieldConfig()
    """Sizes of the field."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range or settings that contradict each other.
        """
        rules = {
            "num-endmembers of 1 to 255": 1 <= self.num_endmembers <= 255,
            "num-specular-spectra of at least 1": self.num_specular_spectra >= 1,
            "samples-per-step of at least 1": self.samples_per_step >= 1,
            "samples-across of at least 2": self.samples_across >= 2,
            "smallest-weight in [0, 0.5)": 0 <= self.smallest_weight < 0.5,
            "grid-update-interval of at least 1": self.grid_update_interval >= 1,
            "initial opacities in (0, 1)": 0 < self.initial_opacity < 1 and 0 < self.initial_opacity_unknown < 1,
            "endmember-file exactly when endmember-init is file": (self.endmember_init == "file")
            == (self.endmember_file is not None),
        }
        broken = [rule for rule, holds in rules.items() if not holds]
        if broken:
            raise ConfigError(f"the model needs {' and '.join(broken)}")


class UnmixModel(Model):
    """A mixture of materials at every point of a scene box."""

    config: UnmixModelConfig

    def populate_modules(self) -> None:
        """Field, endmembers (K, B), specular spectra (J, B) and occupancy grid, shaped by config and metadata."""
        config, metadata = self.config, self.metadata
        self.bands = Bands.of(metadata["wavelengths_nm"])
        num_bands = len(self.bands)
        if config.num_endmembers > num_bands:
            raise ConfigError(
                f"num-endmembers is {config.num_endmembers} but the scene has {num_bands} bands; "
                f"choose at most {num_bands}"
            )
        self.endmembers = nn.Parameter(torch.zeros(config.num_endmembers, num_bands))
        num_dictionary = config.num_specular_spectra if config.specular == "dictionary" else 0
        self.specular_spectra = nn.Parameter(torch.zeros(num_dictionary, num_bands))
        box_size = self.scene_box.aabb[1] - self.scene_box.aabb[0]
        self.step = float(box_size.norm()) / config.samples_across
        opacity = config.initial_opacity if metadata["has_alpha"] else config.initial_opacity_unknown
        self.field = UnmixField(
            config.field,
            self.scene_box,
            config.num_endmembers,
            {"none": 0, "dictionary": num_dictionary, "full": num_bands}[config.specular],
            initial_density=-float(np.log1p(-opacity)) / self.step,
        )
        resolution = metadata["grid_resolution"]
        self.grid = OccupancyGrid(torch.ones(resolution, resolution, resolution, dtype=torch.bool))
        self.register_buffer("aabb", self.scene_box.aabb.clone(), persistent=False)
        self.register_buffer("rgb_weights", rgb_matrix(self.bands), persistent=False)
        self.register_buffer("identity", torch.eye(num_bands), persistent=False)

    def initialise(self, initial_data: Mapping[str, np.ndarray]) -> None:
        """Endmembers from the training pixels or a file, the light in the dictionary, and the carved grid.

        Raises:
            SpectrumError: more endmembers than distinct pixels, or spectra that don't cover the bands.
            ConfigError: the file has another number of spectra than `num_endmembers`.
        """
        light = self.metadata["illuminant"]
        lamp = torch.ones(len(self.bands)) if light is None else torch.tensor(light, dtype=torch.float32)
        self.endmembers.copy_(self._first_endmembers(torch.from_numpy(initial_data["pixels"]), lamp))
        if len(self.specular_spectra):
            self.specular_spectra[0] = lamp
            for row in range(1, len(self.specular_spectra)):
                self.specular_spectra[row] = self.endmembers[(row - 1) % len(self.endmembers)]
        self.grid = OccupancyGrid(torch.from_numpy(initial_data["reachable"])).to(self.device)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """The hash table, the networks and the spectra."""
        networks = [value for name, value in self.field.named_parameters() if name != "table"]
        spectra = [self.endmembers, self.specular_spectra]
        return {
            "grid": [self.field.table],
            "networks": networks,
            "spectra": [value for value in spectra if value.numel()],
        }

    @property
    def materials(self) -> Materials:
        """The spectra that coefficients are multiplied with."""
        spectra = self.identity if self.config.specular == "full" else self.specular_spectra
        return Materials(self.bands, self.endmembers, spectra, self.config.segmentation)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        """`spectral` (R, B) on black, `accumulation` (R) and, as one number, `num_samples` marched."""
        coefficients, num_samples = self.render_coefficients(ray_bundle)
        return {
            "spectral": spectral(coefficients, self.materials),
            "accumulation": coefficients.accumulation,
            "num_samples": torch.tensor(num_samples),
        }

    def render_coefficients(self, ray_bundle: RayBundle) -> tuple[Coefficients, int]:
        """Composited coefficients along rays, and how many samples were marched for them."""
        origins, directions = ray_bundle.origins, ray_bundle.directions
        samples = self._march(origins, directions)
        kept = samples.select(self._carries_weight(samples, origins, directions))
        positions, seen_along = _points(kept, origins, directions)
        densities, features = self.field.get_density(positions)
        weights = volume_weights(densities * self.step, kept.packed_info)
        outputs = self.field.get_outputs(positions, seen_along, features)
        num_endmembers, num_rays = self.config.num_endmembers, len(ray_bundle)
        specular = outputs.get("specular_coefficients", positions.new_zeros(len(positions), 0))
        columns = [
            torch.stack([torch.ones_like(kept.t), kept.t], dim=-1),
            outputs["abundances"],
            outputs["scaled_abundances"],
            specular,
        ]
        values = torch.cat(columns, dim=-1)
        totals = accumulate(weights, values, kept.packed_info)
        if self.config.background == "last":
            totals = totals + _rest_on_last_sample(totals[:, 0], values, kept)
        split = [1, 1, num_endmembers, num_endmembers, specular.shape[1]]
        accumulation, distance, abundances, scaled, glossy = totals.view(num_rays, -1).split(split, dim=-1)
        coefficients = Coefficients(accumulation[:, 0], distance[:, 0], abundances, scaled, glossy)
        return coefficients, len(samples)

    def get_loss_dict(
        self,
        outputs: dict[str, Tensor],
        batch: dict[str, Tensor],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """Weighted errors of spectra and, if asked, of their sRGB colours, over a common background.

        Where the sensor is saturated (a measured value of 1) a brighter prediction is no error.
        """
        background = self._background(batch["spectra"])
        target = batch["spectra"] + (1 - batch["alpha"])[:, None] * background
        predicted = outputs["spectral"] + (1 - outputs["accumulation"])[:, None] * background
        saturated = (batch["spectra"] >= 1) & (predicted > target)
        predicted = torch.where(saturated, target, predicted)
        losses = {"spectral": self.config.spectral_loss_weight * (predicted - target).square().mean()}
        if self.config.rgb_loss_weight > 0:
            colours = linear_to_srgb(torch.stack([predicted, target]) @ self.rgb_weights)
            losses["rgb"] = self.config.rgb_loss_weight * (colours[0] - colours[1]).square().mean()
        return losses

    def get_metrics_dict(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """`psnr` of the batch in dB, on black."""
        error = (outputs["spectral"].detach().clamp(0, 1) - batch["spectra"]).square().mean()
        return {"psnr": -10 * torch.log10(error.clamp(min=1e-12))}

    @torch.no_grad()
    def get_image_coefficients(self, camera: Cameras) -> Coefficients:
        """Coefficients (H, W, ...) of a whole view, rendered chunk by chunk: all else follows from them."""
        bundle = camera.to(self.device).image_rays(0)
        chunk = self.config.eval_num_rays_per_chunk
        parts = [self.render_coefficients(bundle[i : i + chunk])[0] for i in range(0, len(bundle), chunk)]
        return Coefficients.concatenate(parts).unflatten(camera.height, camera.width)

    @torch.no_grad()
    def get_outputs_for_camera(
        self, camera: Cameras, outputs: Collection[str] | None = None
    ) -> dict[str, Tensor]:
        """Outputs of a whole view by name, (H, W, ...); see `spectral.composition.compose` for the names.

        Raises:
            ConfigError: an unknown name.
        """
        coefficients = self.get_image_coefficients(camera)
        names = ("spectral", "rgb", "abundances", "segmentation", "accumulation") if outputs is None else outputs
        return {name: compose(name, coefficients, self.materials) for name in names}

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR of the view in dB, and its predicted sRGB picture."""
        return {"psnr": float(psnr(outputs["spectral"], batch["spectra"]))}, {"rgb": outputs["rgb"]}

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Update the occupancy grid every few steps; keep spectra in [0, 1] after each."""
        return [
            TrainingCallback(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, self._update_grid),
            TrainingCallback(TrainingCallbackLocation.AFTER_TRAIN_ITERATION, self._keep_spectra_physical),
        ]

    def num_samples(self, outputs: dict[str, Tensor]) -> int:
        """Samples marched for `outputs`."""
        return int(outputs["num_samples"])

    def next_num_rays(self, outputs: dict[str, Tensor], current: int) -> int | None:
        """Rays with which a step would march `samples_per_step`, approached smoothly."""
        samples_a_ray = max(self.num_samples(outputs) / current, 1.0)
        wanted = self.config.samples_per_step / samples_a_ray
        return int(min(max((current + wanted) / 2, 64), 8192))

    def warm_up(self) -> None:
        """Compile the kernels by one render and its backward pass."""
        low, high = self.aabb[0], self.aabb[1]
        direction = torch.nn.functional.normalize(high - low, dim=0)
        bundle = RayBundle(
            origins=(low - direction)[None],
            directions=direction[None],
            camera_indices=torch.zeros(1, dtype=torch.int64, device=low.device),
        )
        with torch.enable_grad():
            outputs = self.get_outputs(bundle)
            parameters = [value for group in self.get_param_groups().values() for value in group]
            torch.autograd.grad(outputs["spectral"].sum(), parameters, allow_unused=True)

    def _first_endmembers(self, pixels: Float[Tensor, "N B"], lamp: Float[Tensor, "B"]) -> Float[Tensor, "K B"]:
        config = self.config
        if config.endmember_file is None:
            assert config.endmember_init != "file"
            generator = torch.Generator().manual_seed(torch.initial_seed() % 2**63)
            return initialise_endmembers(pixels, config.num_endmembers, config.endmember_init, generator)
        table = read_spectra_csv(config.endmember_file).resampled(self.bands)
        if len(table.names) != config.num_endmembers:
            raise ConfigError(
                f"{config.endmember_file} has {len(table.names)} spectra but num-endmembers is "
                f"{config.num_endmembers}; give both the same number"
            )
        return (torch.as_tensor(table.spectra, dtype=torch.float32) * lamp).clamp(0, 1)

    def _march(self, origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]) -> PackedSamples:
        size = self.aabb[1] - self.aabb[0]
        t_near, t_far = self.scene_box.to(origins.device).intersect(origins, directions)
        jitter = torch.rand(len(origins), device=origins.device) if self.training else None
        return march(
            (origins - self.aabb[0]) / size,
            directions / size,
            t_near,
            t_far,
            torch.full_like(t_near, 0.5) if jitter is None else jitter,
            self.grid.occupied,
            self.step,
        )

    @torch.no_grad()
    def _carries_weight(self, samples: PackedSamples, origins: Tensor, directions: Tensor) -> Tensor:
        densities, _ = self.field.get_density(_points(samples, origins, directions)[0])
        return volume_weights(densities * self.step, samples.packed_info) > self.config.smallest_weight

    def _background(self, spectra: Float[Tensor, "R B"]) -> Float[Tensor, "R 1"]:
        shade = spectra.new_zeros(len(spectra), 1)
        if self.config.background == "random":
            return torch.rand_like(shade)
        return shade + 1 if self.config.background == "white" else shade

    def _update_grid(self, step: int, progress: float) -> None:
        interval = self.config.grid_update_interval
        if step % interval:
            return
        early = step < 4 * interval
        size = self.aabb[1] - self.aabb[0]
        generator = torch.Generator().manual_seed(int(torch.randint(2**62, (1,))))
        self.grid.update(
            lambda points: self.field.get_density(points * size + self.aabb[0])[0],
            threshold=0.01 / self.step,
            decay=0.95,
            num_cells=None if early else self.grid.occupied.numel() // 16,
            generator=generator,
        )

    @torch.no_grad()
    def _keep_spectra_physical(self, step: int, progress: float) -> None:
        self.endmembers.clamp_(0, 1)
        self.specular_spectra.clamp_(0, 1)


def _points(samples: PackedSamples, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Positions of samples and the directions they are seen along."""
    along = directions[samples.ray_indices]
    return origins[samples.ray_indices] + samples.t[:, None] * along, along


def _rest_on_last_sample(accumulation: Tensor, values: Tensor, samples: PackedSamples) -> Tensor:
    """What the last sample of each ray adds if it takes all the light that is left; 0 for rays without samples."""
    starts, counts = samples.packed_info.unbind(-1)
    if len(values) == 0:
        return values.new_zeros(len(starts), values.shape[1])
    last = values[(starts + counts - 1).clamp(min=0)]
    return torch.where(counts > 0, 1 - accumulation, 0.0)[:, None] * last
