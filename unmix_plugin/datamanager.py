"""Training batches of rays with their spectra, from a validated scene.

Notation: `R` pixels of a batch, `P` rays a pixel, `B` bands, `H x W` pixels of a view. A pixel measures the mean over
its area, so several rays are cast through it, one in each cell of a grid on it; they follow each other in a bundle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.alpha_preset import Auto, choose, preset_for
from unmix_plugin.engine.data_manager import DataManager, DataManagerConfig
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.engine.instantiate import Target
from unmix_plugin.engine.training.callbacks import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.engine.training.seeding import step_generator
from unmix_plugin.errors import ConfigError, SceneError, require
from unmix_plugin.scenes.geometry.carving import carve
from unmix_plugin.scenes.geometry.pose_check import check_scene_poses
from unmix_plugin.scenes.identity import scene_identity
from unmix_plugin.scenes.pixel_store import PixelStore
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.recorded_scene import check_recorded_scene
from unmix_plugin.scenes.scene import Scene, SceneOptions

DEMO = Path("demo")
"""`--data demo` stands for the built-in scene."""


@dataclass(frozen=True)
class HyperspectralDataManagerConfig(DataManagerConfig):
    """How a scene of spectral images is read and sampled."""

    _target: Target = field(default_factory=lambda: HyperspectralDataManager)
    train_num_rays_per_batch: int = 2048
    """Rays of the first training step; the model adapts the number to its budget of samples."""
    scene: SceneOptions = SceneOptions()
    """How the files are read and split."""
    subpixels: int = 2
    """Rays cast through a pixel, along each of its edges; their mean is the pixel, in training and in rendering."""
    single_ray_until: float | Auto = "auto"
    """Part of the training in which one ray a pixel has to do: coarse shape needs many pixels, not exact ones. Auto is
    0.4 where alpha is known, else 0.8."""
    grid_resolution: int | Auto = "auto"
    """Cells along an edge of the occupancy grid, from which space is carved that the views show to be empty. Auto is
    128 where alpha is known, else 64: only what few cameras see can be carved then."""
    max_initial_pixels: int = 50_000
    """Pixels, drawn from all training views, from which the endmembers are initialised."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        super().__post_init__()
        rules = {
            "subpixels of 1 to 8": 1 <= self.subpixels <= 8,
            "single-ray-until in [0, 1] or auto": self.single_ray_until == "auto"
            or 0 <= self.single_ray_until <= 1,
            "grid-resolution of 8 to 512 or auto": self.grid_resolution == "auto"
            or 8 <= self.grid_resolution <= 512,
            "max-initial-pixels of at least 1": self.max_initial_pixels >= 1,
        }
        require("the data manager", rules)


class HyperspectralDataManager(DataManager):
    """Serves pixels of the training views, drawn evenly from all valid ones.

    A training batch has R P rays, `spectra` (R, B), `alpha` (R) and `pixels` (R), the
    number of each; an image batch has `spectra` (H, W, B),
    `alpha` (H, W), `valid` (H, W) and, where the scene has them, `labels` (H, W) and `abundances` (H, W, K).
    """

    def __init__(
        self,
        config: HyperspectralDataManagerConfig,
        *,
        data: Path,
        device: torch.device,
        seed: int = 0,
    ) -> None:
        """
        Raises:
            SceneError: the scene is missing or malformed; all its faults in one message.
        """
        super().__init__(config, data=data, device=device, seed=seed)
        self.options = config
        self.scene = _load(_scene_folder(data), config.scene)
        self.scene_box = self.scene.scene_box
        self.train_cameras = self.scene.cameras[list(self.scene.train_indices)]
        self.eval_cameras = self.scene.cameras[list(self.scene.eval_indices)]
        self._device_cameras = self.train_cameras.to(device)
        self._preset = preset_for(self.scene.has_alpha)
        self._num_rays = config.train_num_rays_per_batch
        self._choose_subpixels(step=0, progress=0.0)

    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Random valid pixels of the training views; the draw depends on (seed, step) only."""
        generator = step_generator(self.seed, step)
        chosen = self._pixels.draw(self._pixels_for(self._num_rays), generator)
        return self._batch(self._device_cameras, self._pixels, chosen, generator)

    def eval_image(self, index: int) -> tuple[Cameras, dict[str, Tensor]]:
        """Camera and whole image of one evaluation view."""
        view = self.scene.eval_indices[index]
        alpha = self.scene.alpha(view)
        arrays = {
            "spectra": self.scene.cube(view),
            "alpha": np.ones(self._image_shape, np.float32) if alpha is None else alpha,
            "valid": self.scene.valid_mask(view),
            "labels": self.scene.labels(view),
            "abundances": self.scene.abundances(view),
        }
        batch = {
            name: torch.tensor(array, device=self.device)
            for name, array in arrays.items()
            if array is not None
        }
        return self.eval_cameras[index], batch

    def get_train_rays_per_batch(self) -> int:
        """Rays of the next training batch."""
        return self._pixels_for(self._num_rays) * self._subpixels**2

    def set_train_rays_per_batch(self, num_rays: int) -> None:
        """Let the next training batches have `num_rays` rays, but whole pixels and at least one."""
        self._num_rays = num_rays

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Cast more rays through a pixel once the first part of the training is over.

        Asked for before the training clock starts, hence the place to read the training pixels.
        """
        _ = self._pixels
        return [TrainingCallback(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, self._choose_subpixels)]

    def metadata(self) -> dict[str, Any]:
        """Bands, light and kind of the scene, and the size of the carving grid."""
        illuminant = self.scene.illuminant
        return {
            "wavelengths_nm": self.scene.wavelengths_nm.tolist(),
            "illuminant": None if illuminant is None else illuminant.tolist(),
            "has_alpha": self.scene.has_alpha,
            "grid_resolution": self._grid_resolution,
            "pixel_size": self._pixel_size(),
            "subpixels": self.options.subpixels,
        }

    def initial_data(self) -> Mapping[str, np.ndarray]:
        """`pixels`: spectra pooled over all training views; `reachable`: where something may be."""
        return {
            "pixels": self._pixels.sample_opaque(self.options.max_initial_pixels, self.seed),
            "reachable": carve(self.scene, self._grid_resolution),
        }

    def summary(self) -> dict[str, Any]:
        """The scene's own record: files, splits, normalisation, truth, hashes."""
        return self.scene.summary()

    @classmethod
    def check_record(cls, metadata: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Refuse what no scene has: see `check_recorded_scene`."""
        check_recorded_scene(metadata)
        check_recorded_scene(summary)

    def warnings(self) -> list[str]:
        """Poses that seem to follow another convention."""
        warning = check_scene_poses(self.scene)
        return [] if warning is None else [warning]

    def identity(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        """Views, cameras, bands and the hashes of what was measured."""
        return scene_identity(summary)

    @cached_property
    def _pixels(self) -> _DrawnPixels:
        """Read when training asks: evaluation needs none of it."""
        return _DrawnPixels(self.scene, self.device, self.scene.train_indices)

    def _pixels_for(self, num_rays: int) -> int:
        return max(1, num_rays // self._subpixels**2)

    def _choose_subpixels(self, step: int, progress: float) -> None:
        until = choose(self.options.single_ray_until, self._preset.single_ray_until)
        self._subpixels = 1 if progress < until else self.options.subpixels

    @property
    def _grid_resolution(self) -> int:
        return choose(self.options.grid_resolution, self._preset.grid_resolution)

    def _pixel_size(self) -> float:
        """Edge of a pixel where it looks at the middle of the scene box, median over the training views."""
        centre = self.scene_box.aabb.mean(dim=0)
        distances = (self.train_cameras.camera_to_world[:, :, 3] - centre).norm(dim=-1)
        return float((distances / self.train_cameras.focal_px.mean(dim=-1)).median())

    @property
    def _image_shape(self) -> tuple[int, int]:
        return self.scene.cameras.height, self.scene.cameras.width

    def _batch(
        self, cameras: Cameras, pixels: _DrawnPixels, chosen: Int[Tensor, "R"], generator: torch.Generator
    ) -> tuple[RayBundle, dict[str, Tensor]]:
        height, width = self._image_shape
        within = chosen % (height * width)
        corners = torch.stack([within % width, within // width], dim=-1)
        offsets = _scattered_offsets(len(chosen), self._subpixels, generator).to(corners.device)
        points = (corners[:, None] + offsets).flatten(0, 1)
        views = (chosen // (height * width)).repeat_interleave(offsets.shape[1])
        bundle = cameras.generate_rays(views, points)
        found = {"spectra": pixels.store.spectra(chosen), "alpha": pixels.store.alpha[chosen]}
        return bundle, {**found, "pixels": chosen}


def _scattered_offsets(num_pixels: int, subpixels: int, generator: torch.Generator) -> Float[Tensor, "R P 2"]:
    """One random point in each cell of a subpixels x subpixels grid on every pixel, (x, y) in [0, 1)."""
    cells = torch.arange(subpixels)
    grid = torch.stack(torch.meshgrid(cells, cells, indexing="xy"), dim=-1).reshape(1, -1, 2)
    return (grid + torch.rand(num_pixels, subpixels**2, 2, generator=generator)) / subpixels


class _DrawnPixels:
    """The pixels of some views, drawn evenly from the valid ones."""

    def __init__(self, scene: Scene, device: torch.device, views: tuple[int, ...]) -> None:
        self.store = PixelStore(scene, device, views)
        valid = self.store.valid
        self._valid = None if bool(valid.all()) else valid.nonzero()[:, 0]
        if self._valid is not None and len(self._valid) == 0:
            raise ConfigError("no valid pixel is left in the training views: masks leave out every one")

    def draw(self, count: int, generator: torch.Generator) -> Int[Tensor, "R"]:
        """Indices of random valid pixels."""
        pool = len(self.store) if self._valid is None else len(self._valid)
        drawn = torch.randint(pool, (count,), generator=generator)
        chosen = drawn if self._valid is None else self._valid[drawn]
        return chosen.to(self.store.alpha.device)

    def sample_opaque(self, count: int, seed: int) -> Float[np.ndarray, "pixels B"]:
        """Spectra of at most `count` random valid pixels that are opaque."""
        pool = torch.arange(len(self.store)) if self._valid is None else self._valid
        opaque = pool[(self.store.alpha.cpu()[pool] > 0.99)]
        chosen = opaque[torch.randperm(len(opaque), generator=step_generator(seed, 0))[:count]]
        return self.store.spectra(chosen.to(self.store.alpha.device)).cpu().numpy()


def _load(folder: Path, options: SceneOptions) -> Scene:
    """The scene; where an error names an option of it, the option's flag is added."""
    try:
        return load_scene(folder, options)
    except SceneError as error:
        named = [item.name for item in fields(SceneOptions) if item.name in str(error)]
        flags = [f"{name} is --pipeline.datamanager.scene.{name.replace('_', '-')}" for name in named]
        raise SceneError("\n".join([str(error), *flags])) from error


def _scene_folder(data: Path) -> Path:
    if data == DEMO:
        from unmix_plugin.scenes.demo.scene import demo_scene_path

        return demo_scene_path()
    return data
