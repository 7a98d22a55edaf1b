"""UnMix-NeRF: rays to coefficients to spectra, metrics and pictures.

Notation: `R` rays, `B` bands, `K` endmembers, `J` specular coefficients. The renderer composites abundances, scaled
abundances and specular coefficients; endmembers E and specular spectra D are applied once a ray:

    C = E^T sum_i w_i S_i a_i + D^T sum_i w_i h_i u_i

which equals the paper's sum of a spectrum a sample, since both parts are linear in E and D.

Source: Perez et al. 2025, UnMix-NeRF, eqs. 4 to 9.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.engine.instantiate import Common, Target, short
from unmix_plugin.engine.model import Model, ModelConfig
from unmix_plugin.engine.training.callbacks import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.errors import ConfigError
from unmix_plugin.field import UnmixField, UnmixFieldConfig
from unmix_plugin.renderer import CoefficientRenderer, RenderedRays, RendererConfig
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.composition import (
    OCCUPIED_ACCUMULATION,
    Coefficients,
    Materials,
    SegmentationMethod,
    compose,
    default_names,
    spectral,
)
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv
from unmix_plugin.spectral.metrics import psnr
from unmix_plugin.spectral.unmixing.endmembers import (
    EndmemberMethod,
    drop_uninformative_pixels,
    initialise_endmembers,
)
from unmix_plugin.spectral.unmixing.mixture_guide import MixtureGuide
from unmix_plugin.spectral.unmixing.num_materials import propose_num_materials
from unmix_plugin.training_losses import LossSettings, pixel_mean, training_losses

_FEWEST_RAYS, _MOST_RAYS = 64, 8192
_PIXELS_TO_COUNT_BY = 20_000
DEFAULT_OUTPUTS = ("spectral", "rgb", "abundances", "segmentation", "accumulation")


@dataclass(frozen=True)
class UnmixModelConfig(ModelConfig, LossSettings):
    """Settings of the model of UnMix-NeRF."""

    _target: Target = field(default_factory=lambda: UnmixModel)
    num_endmembers: Annotated[int | Literal["auto"], Common, short("endmembers")] = 6
    """K, the number of materials to unmix into; auto proposes it from the training pixels, with its evidence."""
    endmember_init: Annotated[EndmemberMethod | Literal["file"], Common, short("endmember-init")] = "pairs"
    """First guess of the endmembers from the pixels of all training views, or spectra from `endmember_file`."""
    endmember_file: Annotated[Path | None, Common, short("endmember-file")] = None
    """CSV of reflectances (wavelength,name,...) for `endmember_init` file; multiplied by the scene's light if known."""
    specular: Literal["none", "dictionary", "full"] = "dictionary"
    """View-dependent part: none, multiples of a few spectra, or one value a band as published."""
    num_specular_spectra: int | Literal["auto"] = "auto"
    """Spectra of the specular dictionary. The first is the light's, a highlight's colour on anything but metal; then
    come the endmembers', as light that they send on has. Auto is 1 where alpha is known, else all: in rooms, light is
    coloured by the walls."""
    train_endmembers: bool = True
    """Whether endmembers change while training; else they stay the first guess, or the spectra from a file."""
    segmentation: SegmentationMethod = "abundances"
    """Material of a ray: its largest abundance, or the endmember of smallest angle to its spectrum as published."""
    samples_per_step: int = 30_000
    """Samples marched in a training step; the number of rays adapts to it."""
    initial_opacity: float = 0.05
    """Opacity of one sample's interval in the untrained field where a hull of the objects is known."""
    initial_opacity_unknown: float = 0.01
    """The same in scenes without alpha, where space between cameras and walls must stay clear."""
    field: UnmixFieldConfig = UnmixFieldConfig()
    """Sizes of the field."""
    renderer: RendererConfig = RendererConfig()
    """How rays are sampled."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range or settings that contradict each other.
        """
        super().__post_init__()
        rules = {
            "num-endmembers of 1 to 255 or auto": self.num_endmembers == "auto"
            or 1 <= self.num_endmembers <= 255,
            "num-specular-spectra of at least 1 or auto": self.num_specular_spectra == "auto"
            or self.num_specular_spectra >= 1,
            "samples-per-step of at least 1": self.samples_per_step >= 1,
            **self.loss_rules(),
            "initial opacities in (0, 1)": 0 < self.initial_opacity < 1
            and 0 < self.initial_opacity_unknown < 1,
            "endmember-file exactly when endmember-init is file": (self.endmember_init == "file")
            == (self.endmember_file is not None),
        }
        broken = [rule for rule, holds in rules.items() if not holds]
        if broken:
            raise ConfigError(f"the model needs {' and '.join(broken)}")

    def resolve_auto(
        self, initial_data: Callable[[], Mapping[str, np.ndarray]], generator: torch.Generator
    ) -> tuple[UnmixModelConfig, str]:
        """With `num_endmembers` auto, the number that the training pixels propose, and the evidence for it.

        Raises:
            SpectrumError: no pixel is neither dark nor saturated.
        """
        if self.num_endmembers != "auto":
            return self, ""
        pixels = drop_uninformative_pixels(torch.from_numpy(initial_data()["pixels"]))
        kept = torch.randperm(len(pixels), generator=generator)[:_PIXELS_TO_COUNT_BY]
        count = propose_num_materials(pixels[kept], generator)
        return replace(self, num_endmembers=count.number), count.evidence()


class UnmixModel(Model):
    """A mixture of materials at every point of a scene box."""

    config: UnmixModelConfig
    rgb_weights: Tensor
    every_band: Tensor

    def populate_modules(self) -> None:
        """Field, renderer, endmembers (K, B) and specular spectra (J, B), shaped by config and metadata.

        Raises:
            ConfigError: more endmembers than bands.
        """
        config, metadata = self.config, self.metadata
        self.bands = Bands.of(metadata["wavelengths_nm"])
        num_bands = len(self.bands)
        if config.num_endmembers == "auto":
            raise ConfigError("num-endmembers is auto: call resolve_auto first")
        self.num_endmembers = config.num_endmembers
        if self.num_endmembers > num_bands:
            raise ConfigError(
                f"num-endmembers is {self.num_endmembers} but the scene has {num_bands} bands; "
                f"choose at most {num_bands}"
            )
        self.endmembers = nn.Parameter(
            torch.zeros(self.num_endmembers, num_bands), requires_grad=config.train_endmembers
        )
        self.endmember_names = default_names(self.num_endmembers)
        num_dictionary = self._num_dictionary_spectra()
        self.specular_spectra = nn.Parameter(torch.zeros(num_dictionary, num_bands))
        opacity = config.initial_opacity if metadata["has_alpha"] else config.initial_opacity_unknown
        self.renderer = CoefficientRenderer(
            config.renderer,
            self.scene_box,
            pixel_size=metadata["pixel_size"],
            grid_resolution=metadata["grid_resolution"],
            is_open=not metadata["has_alpha"],
            close_rays=config.background == "last",
        )
        self.field = UnmixField(
            config.field,
            self.scene_box,
            self.num_endmembers,
            num_bands if config.specular == "full" else num_dictionary,
            initial_density=-math.log1p(-opacity) / self.renderer.step,
            pixel_size=metadata["pixel_size"],
        )
        self.register_buffer("rgb_weights", rgb_matrix(self.bands), persistent=False)
        self.mixture_guide = MixtureGuide(self.num_endmembers, num_bands)
        self.register_buffer("every_band", torch.eye(num_bands), persistent=False)
        self._progress = 0.0

    def initialise(self, initial_data: Mapping[str, np.ndarray], generator: torch.Generator) -> None:
        """Endmembers from the training pixels or a file, the light in the dictionary, and the carved grid.

        Raises:
            SpectrumError: more endmembers than distinct pixels, or spectra that don't cover the bands.
            ConfigError: the file has another number of spectra than `num_endmembers`.
        """
        light = self.metadata["illuminant"]
        lamp = torch.ones(len(self.bands)) if light is None else torch.tensor(light, dtype=torch.float32)
        pixels = torch.from_numpy(initial_data["pixels"])
        self.endmembers.copy_(self._guess_endmembers(pixels, lamp, generator))
        self.mixture_guide.start(pixels, self.endmembers.detach(), self.config.mixing_penalty)
        for row in range(len(self.specular_spectra)):
            self.specular_spectra[row] = (
                lamp if row == 0 else self.endmembers[(row - 1) % len(self.endmembers)]
            )
        self.renderer.carve(torch.from_numpy(initial_data["reachable"]))

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """The hash table, the networks and the spectra."""
        networks = [value for name, value in self.field.named_parameters() if name != "table"]
        spectra = [self.endmembers] if self.endmembers.requires_grad else []
        spectra += [self.specular_spectra] if self.specular_spectra.numel() else []
        return {"grid": [self.field.table], "networks": networks, "spectra": spectra}

    @property
    def materials(self) -> Materials:
        """The spectra that coefficients are multiplied with."""
        specular_spectra = self.every_band if self.config.specular == "full" else self.specular_spectra
        light = self.metadata["illuminant"]
        return Materials(
            self.bands,
            self.endmembers,
            specular_spectra,
            self.config.segmentation,
            self.endmember_names,
            None if light is None else self.endmembers.new_tensor(light),
            self.mixture_guide.lead_error if self.config.abundance_loss_weight > 0 else None,
        )

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        """`spectral` (R, B) on black, `abundances` (R, K), `accumulation` (R), and `haze` and `num_samples`, one
        number each."""
        rendered: RenderedRays = self.renderer(self.field, ray_bundle)
        coefficients = rendered.coefficients
        return {
            "spectral": spectral(coefficients, self.materials),
            "accumulation": coefficients.accumulation,
            "abundances": coefficients.abundances,
            "haze": rendered.haze,
            "num_samples": torch.tensor(rendered.num_samples),
        }

    def get_loss_dict(
        self,
        outputs: dict[str, Tensor],
        batch: dict[str, Tensor],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """Weighted errors of spectra and what else training asks for, see training_losses.py."""
        return training_losses(
            self.config,
            outputs,
            batch,
            has_alpha=self.metadata["has_alpha"],
            progress=self._progress,
            rgb_weights=self.rgb_weights,
            guide=self.mixture_guide,
        )

    def get_metrics_dict(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """`psnr` of the batch in dB, on black."""
        spectra = pixel_mean(outputs["spectral"], len(batch["spectra"]))
        error = (spectra.detach().clamp(0, 1) - batch["spectra"]).square().mean()
        return {"psnr": -10 * torch.log10(error.clamp(min=1e-12))}

    @torch.no_grad()
    def get_image_coefficients(self, camera: Cameras, subpixels: int | None = None) -> Coefficients:
        """Coefficients (H, W, ...) of a whole view, rendered chunk by chunk: every picture of it follows from them.

        Args:
            camera: One camera.
            subpixels: Rays through a pixel along each of its edges, averaged; None for as many as in training.
        """
        count = self.metadata["subpixels"] if subpixels is None else subpixels
        centres = [(i + 0.5) / count for i in range(count)]
        passes = [self._coefficients_through(camera, (x, y)) for y in centres for x in centres]
        return Coefficients.mean(passes).unflatten(camera.height, camera.width)

    @torch.no_grad()
    def get_outputs_for_camera(
        self, camera: Cameras, outputs: Collection[str] | None = None
    ) -> dict[str, Tensor]:
        """Outputs of a whole view by name, (H, W, ...).

        Instead of the interface's way, which would carry B numbers a ray for each output, this composites a view
        once and derives every output from its coefficients. Besides the names of `spectral.composition.compose`:
        `depth` (H, W), distance along the viewing axis in scene units, and `normals` (H, W, 3), unit vectors in
        model space; both 0 where nothing is.

        Raises:
            ConfigError: an unknown name.
        """
        coefficients = self.get_image_coefficients(camera)
        geometric = {"depth": self._depth, "normals": self._normals}
        return {
            name: geometric[name](camera, coefficients)
            if name in geometric
            else compose(name, coefficients, self.materials)
            for name in (DEFAULT_OUTPUTS if outputs is None else outputs)
        }

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR of the view in dB, and its predicted sRGB picture."""
        return {"psnr": psnr(outputs["spectral"], batch["spectra"])}, {"rgb": outputs["rgb"]}

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Keep the occupancy grid up to date, and spectra in [0, 1]."""
        return [
            TrainingCallback(
                TrainingCallbackLocation.BEFORE_TRAIN_ITERATION,
                self._begin_step,
            ),
            TrainingCallback(TrainingCallbackLocation.AFTER_TRAIN_ITERATION, self._keep_spectra_physical),
        ]

    def _begin_step(self, step: int, progress: float) -> None:
        self._progress = progress
        self.renderer.update_grid(self.field, step)

    def num_samples(self, outputs: dict[str, Tensor]) -> int:
        """Samples marched for `outputs`."""
        return int(outputs["num_samples"])

    def next_num_rays(self, outputs: dict[str, Tensor], current: int) -> int | None:
        """Half of the way to the rays with which a step would march `samples_per_step`."""
        samples_a_ray = max(self.num_samples(outputs) / current, 1.0)
        wanted = self.config.samples_per_step / samples_a_ray
        return int(min(max((current + wanted) / 2, _FEWEST_RAYS), _MOST_RAYS))

    def warm_up(self) -> None:
        """Compile the kernels by one render along the box's diagonal and its backward pass."""
        low, high = self.renderer.aabb[0], self.renderer.aabb[1]
        direction = torch.nn.functional.normalize(high - low, dim=0)
        indices = torch.zeros(1, dtype=torch.int64, device=low.device)
        bundle = RayBundle((low - direction)[None], direction[None], indices)
        was_training = self.training
        self.eval()  # a ray of no view is nothing to be remembered
        with torch.enable_grad():
            parameters = [value for group in self.get_param_groups().values() for value in group]
            torch.autograd.grad(self.get_outputs(bundle)["spectral"].sum(), parameters, allow_unused=True)
        self.train(was_training)

    def _coefficients_through(self, camera: Cameras, offset: tuple[float, float]) -> Coefficients:
        bundle = camera.to(self.device).image_rays(0, offset)
        return self.renderer.in_chunks(self.field, bundle, self.config.eval_num_rays_per_chunk)

    def _num_dictionary_spectra(self) -> int:
        if self.config.specular != "dictionary":
            return 0
        if self.config.num_specular_spectra == "auto":
            return 1 if self.metadata["has_alpha"] else 1 + self.num_endmembers
        return self.config.num_specular_spectra

    def _guess_endmembers(
        self, pixels: Float[Tensor, "N B"], lamp: Float[Tensor, "B"], generator: torch.Generator
    ) -> Float[Tensor, "K B"]:
        config = self.config
        if config.endmember_file is None:
            assert config.endmember_init != "file"
            return initialise_endmembers(pixels, self.num_endmembers, config.endmember_init, generator)
        table = read_spectra_csv(config.endmember_file).resampled(self.bands)
        if len(table.names) != self.num_endmembers:
            raise ConfigError(
                f"{config.endmember_file} has {len(table.names)} spectra but num-endmembers is "
                f"{self.num_endmembers}; give both the same number"
            )
        return (torch.as_tensor(table.spectra, dtype=torch.float32) * lamp).clamp(0, 1)

    def _depth(self, camera: Cameras, coefficients: Coefficients) -> Float[Tensor, "H W"]:
        bundle = camera.to(self.device).image_rays(0)
        forward = -camera.camera_to_world[0, :, 2].to(self.device)
        along_axis = (bundle.directions @ forward).unflatten(0, (camera.height, camera.width))
        return compose("ray_distance", coefficients, self.materials) * along_axis

    def _normals(self, camera: Cameras, coefficients: Coefficients) -> Float[Tensor, "H W 3"]:
        bundle = camera.to(self.device).image_rays(0)
        distance = compose("ray_distance", coefficients, self.materials).flatten()
        chunk = self.config.eval_num_rays_per_chunk
        parts = [
            self.renderer.normals(self.field, bundle[i : i + chunk], distance[i : i + chunk])
            for i in range(0, len(bundle), chunk)
        ]
        normals = torch.cat(parts) * (coefficients.accumulation.flatten() > OCCUPIED_ACCUMULATION)[:, None]
        return normals.unflatten(0, (camera.height, camera.width))

    @torch.no_grad()
    def _keep_spectra_physical(self, step: int, progress: float) -> None:
        self.endmembers.clamp_(0, 1)
        self.specular_spectra.clamp_(0, 1)
