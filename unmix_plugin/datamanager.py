"""Training batches of rays with their spectra, from a validated scene.

Notation: `R` pixels of a batch, `P` rays per pixel, `B` bands, `H x W` pixels of a view. A pixel measures the mean over
its area, so several rays are cast through it, one in each cell of a grid on it; they follow each other in a bundle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.decisions import Decision
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.engine.machine import step_generator
from unmix_plugin.engine.model import DataManager, TrainingCallback, TrainingCallbackLocation
from unmix_plugin.poses.knots import Knots
from unmix_plugin.presets import fill_auto, preset_for
from unmix_plugin.scenes.doctor import (
    Finding,
    check_bands,
    check_copies,
    check_lenses,
    check_masks,
    check_parallax,
    check_poses,
    check_rig,
)
from unmix_plugin.scenes.evidence import (
    AlphaEvidence,
    band_weights,
    judge_sensors,
    relative_power,
)
from unmix_plugin.scenes.geometry.carving import Masks, carve, share_explained
from unmix_plugin.scenes.geometry.surface_evidence import SurfaceEvidence
from unmix_plugin.scenes.geometry.view_agreement import (
    convention_decision,
)
from unmix_plugin.scenes.judged_views import JudgedViews, judge_views
from unmix_plugin.scenes.kept import judged_once
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.pixel_table import PixelRays, PixelTable
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import check_recorded_scene, scene_identity
from unmix_plugin.sensors.views import MeasuredPixels, to_batch
from unmix_plugin.settings import HyperspectralDataManagerConfig
from unmix_plugin.spectral.bad_values import BandNoise
from unmix_plugin.spectral.evidence import alpha_confidence, exposure_of
from unmix_plugin.spectral.unmixing.endmembers import typical_spectrum

_MANY_PIXELS = 4_000_000
"""Pixels of all training views beyond which one ray a pixel is enough."""
_MOST_INITIAL_PIXELS = 50_000
"""Pixels, drawn from all training views, from which the endmembers are initialised."""
_FAIRLY_EXPLAINED = 0.99
"""Share of the foreground that a hull must explain to be carved by refined cameras; where poses are off by many pixels,
views look through what others show."""
DEMO = Path("demo")
"""`--data demo` stands for the built-in scene."""


class HyperspectralDataManager(DataManager):
    """Serves pixels of the training views, drawn evenly from all valid ones.

    A training batch has R P rays, `spectra` (R, B), `alpha` (R), `alpha_confidence` (R, see `spectral.evidence`) and
    `pixels` (R), the number of each; an image batch has `spectra` (H, W, B),
    `alpha` (H, W), `valid` (H, W) and, where the scene has them, `labels` (H, W) and `abundances` (H, W, K).
    """

    config: HyperspectralDataManagerConfig

    def __init__(
        self, config: HyperspectralDataManagerConfig, *, data: Path, device: torch.device, seed: int = 0
    ) -> None:
        """
        Raises:
            SceneError: the scene is missing or malformed; all its faults in one message.
        """
        super().__init__(config, data=data, device=device, seed=seed)
        if data == DEMO:
            from unmix_plugin.scenes.demo.scene import demo_scene_path

            data = demo_scene_path()
        self.scene = load_scene(data, config.scene)
        self.scene_box, self._is_rig = self.scene.scene_box, self.scene.is_rig
        self.train_cameras = self.scene.cameras[list(self.scene.train_indices)]
        self.eval_cameras = self.scene.cameras[list(self.scene.eval_indices)]
        self._rays = PixelRays(self.scene, device)
        preset = preset_for(self.scene.has_alpha, self.scene.is_unbounded, self.scene.has_backdrop)
        self.config = fill_auto(
            config,
            subpixels=1 if self._num_train_pixels > _MANY_PIXELS else 2,
            single_ray_until=preset.single_ray_until,
        )
        self._num_rays = config.train_num_rays_per_batch
        self._choose_subpixels(step=0, progress=0.0)

    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Random valid pixels of the training views; the draw depends on (seed, step) only."""
        generator = step_generator(self.seed, step)
        rays, measured = [], []
        count = self.get_train_rays_per_batch() // self._subpixels**2
        for drawn in self._pixels.draw(count, generator, step, self._shares):
            rays.append(self._rays.through(drawn, self._subpixels, generator))
            own = MeasuredPixels(
                sensor=drawn.sensor if self._is_rig else None,
                num_rays=len(rays[-1]),
                spectra=drawn.spectra,
                alpha=drawn.alpha,
                pixels=drawn.numbers,
                alpha_confidence=alpha_confidence(
                    drawn.spectra, drawn.alpha, self._evidence.levels[drawn.sensor]
                ),
                surfaces=self._surfaces.points(drawn),
            )
            measured.append(own)
        return RayBundle.join(rays), to_batch(measured)

    def eval_image(self, index: int) -> tuple[Cameras, dict[str, Tensor]]:
        """Camera and whole image of one evaluation view."""
        view = self.scene.eval_indices[index]
        alpha, valid = self.scene.alpha(view), self.scene.valid_mask(view)
        arrays = {
            "spectra": self.scene.cube(view),
            "alpha": np.ones(valid.shape, np.float32) if alpha is None else alpha,
            "valid": valid,
            "labels": self.scene.labels(view),
            "abundances": self.scene.abundances(view),
        }
        if self._is_rig:
            arrays["sensor"] = np.array(self.scene.frames[view].sensor)
        batch = {
            name: torch.from_numpy(np.require(array, requirements="W")).to(self.device)
            for name, array in arrays.items()
            if array is not None
        }
        return self.eval_cameras[index], batch

    def get_train_rays_per_batch(self) -> int:
        """Rays of the next training batch."""
        return max(1, self._num_rays // self._subpixels**2) * self._subpixels**2

    def set_train_rays_per_batch(self, num_rays: int) -> None:
        """Let the next training batches have `num_rays` rays, but whole pixels and at least one."""
        self._num_rays = num_rays

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Cast more rays through a pixel once the first part of the training is over. Asked for before the training
        clock starts, hence the place to read the training pixels."""
        _ = self._pixels
        return [TrainingCallback(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, self._choose_subpixels)]

    def metadata(self) -> dict[str, Any]:
        """Bands, light and kind of the scene, and the size of the carving grid."""
        scene = self.scene
        return {
            "wavelengths_nm": scene.wavelengths_nm.tolist(),
            "illuminant": None if scene.illuminant is None else scene.illuminant.tolist(),
            "has_alpha": scene.has_alpha,
            "is_unbounded": scene.is_unbounded,
            "has_backdrop": scene.has_backdrop,
            "grid_resolution": self.config.grid_resolution,
            "pixel_size": min(self._rays.pixel_sizes.values()),
            "subpixels": self._final_subpixels,
            "num_train_views": len(self.train_cameras),
            "num_train_pixels": self._num_train_pixels,
            **({} if scene.fwhm_nm is None else {"fwhm_nm": scene.fwhm_nm.tolist()}),
            **({} if self.train_cameras.key_poses is None else {"line_rows": list(self._knots.rows)}),
            **({"sensors": [sensor.to_json() for sensor in scene.sensors]} if scene.is_rig else {}),
        }

    def initial_data(self) -> Mapping[str, np.ndarray]:
        """`pixels`: spectra pooled over all training views; `reachable`: where something may be; `knots`: where cameras
        stand whose poses may be corrected; `light`: fixed, camera or per-view, as far as pictures with alpha tell;
        `lamp`: numbers of the lamp that moves with the camera, none if it is not known;
        `exposure`, the factor that makes the foreground as bright as errors are meant for;
        `band_weights`, of squared errors, mean 1; `relative`, the power of brightness by which these are divided.

        Of a rig, pixels of the sensor with most channels, and of those the one with most pixels; `sensor`, which that
        is; and `typical`, a spectrum on all bands that fits the mean of each sensor's pixels.
        """
        return self._initial_data

    @cached_property
    def _initial_data(self) -> Mapping[str, np.ndarray]:
        most, seed, sensors = _MOST_INITIAL_PIXELS, self.seed, self.scene.sensors
        shares = self._pixels.shares
        chosen = max(shares, key=lambda sensor: (sensors[sensor].num_channels, shares[sensor]))
        opaque = self._pixels.sample_opaque(chosen, most, seed)
        found = {
            "knots": self._knots.positions(self.train_cameras).numpy(),
            "pixels": opaque.numpy(),
            "exposure": np.array(self._exposure(chosen, opaque)),
            "relative": np.array(relative_power(self.scene, opaque)),
            "reachable": self._judged.reachable,
            "band_weights": band_weights(self.scene, self._noise),
            "light": np.array(self._judged.light),
            **({"lamp": np.array(self._judged.lamp)} if self.scene.has_alpha else {}),
        }
        if not self._is_rig:
            return found
        pixels = [self._pixels.sample_opaque(sensor, most, seed) for sensor in shares]
        means = [seen.mean(dim=0) if len(seen) else seen.new_zeros(seen.shape[1]) for seen in pixels]
        matrices = [torch.from_numpy(sensors[sensor].matrix).float() for sensor in shares]
        return {**found, "sensor": np.array(chosen), "typical": typical_spectrum(means, matrices).numpy()}

    def carved_by(self, cameras: Cameras) -> Bool[Tensor, "X Y Z"] | None:
        """`reachable` by other cameras of the training views; None where alpha doesn't tell of it, or they are too far
        off to carve by."""
        foreground = self._foreground
        if foreground is None or self.scene.is_unbounded:
            return None
        hull = carve(self.scene, self.config.grid_resolution, foreground, cameras)
        is_right = share_explained(self.scene, hull, foreground, cameras) >= _FAIRLY_EXPLAINED
        return torch.from_numpy(hull) if is_right else None

    def summary(self) -> dict[str, Any]:
        """The scene's own record: files, splits, normalisation, truth, hashes."""
        return self.scene.summary()

    @classmethod
    def check_record(cls, metadata: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Refuse what no scene has: see `check_recorded_scene`."""
        check_recorded_scene(metadata)
        check_recorded_scene(summary)

    def reasons(self) -> list[str]:
        """Why the world is taken to end with the scene box or not, where that was found."""
        return [] if self.scene.world_reason is None else [self.scene.world_reason]

    def decisions(self) -> list[Decision]:
        """Convention of poses, backdrop, and what lies behind the box."""
        return [convention_decision(self._judged.conventions), *self.scene.decisions]

    def warnings(self) -> list[str]:
        """Poses that seem to follow another convention, cameras far off or at one place, masks that contradict
        each other, a backdrop, sensors that share no band or no place with another, and bad bands and values."""
        advice = "Poses may be off by some pixels (--poses refine corrects them), or masks have holes"
        return [
            *(
                finding.sentence(advice)
                for finding in [
                    check_poses(self._judged.conventions) or check_masks(self._judged.contradicted)
                ]
                if finding
            ),
            *self._pixels.notes,
            *self.scene.warnings,
            *(finding.sentence() for finding in self._findings()),
        ]

    def _findings(self) -> Iterator[Finding]:
        """What looks wrong with the scene beside its poses and masks."""
        checks = (
            check_parallax(self._initial_data["knots"], self.scene_box),
            check_lenses(self.train_cameras),
        )
        yield from (finding for finding in checks if finding is not None)
        scene, hashes = self.scene, self.scene.cube_hashes
        poses = scene.cameras.camera_to_world.cpu().numpy()
        yield from check_copies([frame.name for frame in scene.frames], hashes, poses)
        yield from check_bands(self.scene, self._noise, self._pixels.bad_share)
        if self.scene.has_backdrop:
            yield Finding.of(Message.PLAIN_BACKDROP)
        if self._is_rig:
            yield from check_rig(self.scene, self._judged.reachable)

    def identity(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        """Views, cameras, bands and the hashes of what was measured."""
        return scene_identity(summary)

    @cached_property
    def _knots(self) -> Knots:
        """Where corrections of the training views' poses apply."""
        return Knots.of(self.train_cameras)

    @cached_property
    def _pixels(self) -> PixelTable:
        """Read when training begins: evaluation needs none of it."""
        memory_gb = None if self.config.memory_gb == "auto" else self.config.memory_gb
        return PixelTable(
            self.scene,
            self.device,
            self.scene.train_indices,
            memory_gb,
            components=self.config.target_components,
            mends=self.config.mend_values,
            seed=self.seed,
        )

    @cached_property
    def _noise(self) -> dict[int, BandNoise]:
        return judge_sensors(self.scene, self._pixels, self.seed)

    @cached_property
    def _evidence(self) -> AlphaEvidence:
        return AlphaEvidence(self._pixels, self.scene.has_alpha and not self.config.trust_alpha)

    @cached_property
    def _judged(self) -> JudgedViews:
        given = {
            "files": self.scene.input_hashes,
            "scene": self.scene.options,
            "options": self.config,
            "seed": self.seed,
        }
        cells = self.config.grid_resolution
        return judged_once(
            JudgedViews, given, lambda: judge_views(self.scene, self._foreground, cells, self._evidence)
        )

    @property
    def _foreground(self) -> Masks | None:
        """For each training view True where something may be, by alpha or by a backdrop; None where neither tells."""
        if self.scene.has_alpha:
            return self._evidence.foreground()
        return None if self.scene.before_backdrop is None else self.scene.before_backdrop.masks()

    @cached_property
    def _surfaces(self) -> SurfaceEvidence:
        return SurfaceEvidence(self.scene, self._judged.depths, self.device)

    @cached_property
    def _shares(self) -> dict[int, float] | None:
        """Of the pixels of a batch, by sensor of a rig."""
        return self._rays.shares(self._pixels.shares) if self._is_rig else None

    def _choose_subpixels(self, step: int, progress: float) -> None:
        is_coarse = progress < float(self.config.single_ray_until)
        self._subpixels = 1 if is_coarse else self._final_subpixels

    @property
    def _final_subpixels(self) -> int:
        return int(self.config.subpixels)

    @property
    def _num_train_pixels(self) -> int:
        sizes = [self.train_cameras.size(index) for index in range(len(self.train_cameras))]
        return sum(width * height for width, height in sizes)

    def _exposure(self, sensor: int, opaque: Float[Tensor, "P b"]) -> float:
        """By opaque pixels of a sensor, but not by those that show a backdrop."""
        if self.scene.before_backdrop is not None:
            masks = self.scene.before_backdrop.masks()
            kept = torch.from_numpy(np.concatenate([mask.reshape(-1) for mask in masks]))
            opaque = self._pixels.sample_opaque(sensor, _MOST_INITIAL_PIXELS, self.seed, kept)
        return exposure_of(opaque)
