"""Training batches of an object's pixels, and its evaluation images under its own light and others.

Notation: `M` pixels of training views, `R` of them in a batch, `C` colours or bands, `H x W` pixels of a view.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.engine import (
    Cameras,
    Common,
    DataManager,
    DataManagerConfig,
    RayBundle,
    SceneBox,
    Target,
    TrainingCallback,
    step_generator,
)
from unmix_plugin.errors import SceneError, require
from unmix_plugin.formats.files import numbered_apart
from unmix_plugin.neumatex.fit.object_scene import ObjectScene, load_object
from unmix_plugin.neumatex.fit.pictures import PosedPictures, has_alpha, opacity
from unmix_plugin.neumatex.fit.settings import ObjectRecord
from unmix_plugin.neumatex.fit.tone import TONE_MAPPINGS
from unmix_plugin.neumatex.prior.observations import well_spread
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.reading.loader import readable_name
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.colour.conversion import srgb_to_linear
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA

_DEMOS = ("demo-object", "demo-spectral-object")
"""What `--data` takes for the built-in objects, the latter with spectral pictures."""
_CORNERS = ((0.02, 0.02), (0.98, 0.02), (0.02, 0.98), (0.98, 0.98), (0.5, 0.5))
"""Where in a pixel the mesh has to be seen, so that every place in it sees it."""
_THINNEST = 1e-3
"""Least half edge of the scene box: a mesh may be flat."""
_MOST_VIEWS = 12
LONGEST_EDGE_PX = 512
"""Of the views that a prior sees; larger ones are thinned out."""
_NUM_PIXELS, _STREAM = 20_000, 7
"""Pixels that a spectral material starts from, and the stream of random numbers that draws them."""


@dataclass(frozen=True)
class ObjectDataManagerConfig(DataManagerConfig):
    """How an object's pictures are sampled."""

    _target: Target = field(default_factory=lambda: ObjectDataManager)
    train_num_rays_per_batch: int = 4096
    """Pixels of a training step, drawn from all training views where they show the mesh."""
    max_pixels: int = 8_000_000
    """Training pixels kept in memory; of more, these are drawn evenly."""
    lamp: Annotated[str | None, Common] = None
    """For pictures of many bands: spectrum of the light, a .csv (wavelength,power), an ENVI spectral library or a name
    (D65, A, ...); None takes 'illuminant_path' of transforms.json."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        super().__post_init__()
        require("the data manager", self, {"max-pixels of at least 1": self.max_pixels >= 1})


class ObjectDataManager(DataManager):
    """Serves pixels that show the object and nothing else.

    A training batch has `numbers` (R, C) as pictures hold them; rays pass through random places of their pixels. An
    image batch has `numbers` (H, W, C), `alpha` (H, W), `tone` (which of `TONE_MAPPINGS`), `lights` (how many are
    held out) and, where it is known, `base_colour` (H, W, 3), or of spectral pictures `true_abundances` (H, W, M) and
    `true_endmembers` (M, B). Images under a held-out light follow the evaluation
    views and have `environment` (h, w, C) and `environment_placement` (degrees, stops) too.
    """

    def __init__(
        self, config: ObjectDataManagerConfig, *, data: Path, device: torch.device, seed: int = 0
    ) -> None:
        """
        Raises:
            SceneError: the object is missing or malformed.
        """
        super().__init__(config, data=data, device=device, seed=seed)
        self.options = config
        self.object = load_object(_object_folder(data), config.lamp)
        pictures, split = self.object.pictures, self.object.split
        self.train_cameras = pictures.cameras[list(split.train)]
        self.eval_cameras = pictures.cameras[list(split.evaluation)]
        reach = self.object.mesh.vertices.abs().amax(dim=0).clamp(min=_THINNEST)
        self.scene_box = SceneBox(torch.stack([-reach, reach]))
        self._num_rays = config.train_num_rays_per_batch
        lights = [(light, view) for light in self.object.lights for view in range(len(light.pictures))]
        self._images = [*split.evaluation, *lights]
        named = [pictures.names[view] for view in split.evaluation]
        named += [f"{light.name}-{light.pictures.names[view]}" for light, view in lights]
        self._names = numbered_apart(map(readable_name, named))

    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Random object pixels of the training views; the draw depends on (seed, step) only."""
        views, places, numbers = self._pixels.draw(self._num_rays, step_generator(self.seed, step))
        rays = self.train_cameras.generate_rays(views, places)
        return rays.to(self.device), {"numbers": numbers.to(self.device)}

    @property
    def num_eval_images(self) -> int:
        """Evaluation views, and every picture under a held-out light."""
        return len(self._images)

    def eval_image(self, index: int) -> tuple[Cameras, dict[str, Tensor]]:
        """Camera and whole image; those under held-out lights come after the evaluation views."""
        place = self._images[index]
        if isinstance(place, int):
            return self._image(self.object.pictures, place, self._truth(place))
        light, view = place
        environment = light.environment
        placement = torch.tensor([environment.rotation_deg, environment.exposure_stops], device=self.device)
        entries = {"environment": environment.image.to(self.device), "environment_placement": placement}
        return self._image(light.pictures, view, entries)

    def eval_name(self, index: int) -> str:
        """The picture's name, after its light's where that is held out."""
        return self._names[index]

    def get_train_rays_per_batch(self) -> int:
        """Pixels of the next training batch."""
        return self._num_rays

    def set_train_rays_per_batch(self, num_rays: int) -> None:
        """Let the next training batches have `num_rays` pixels."""
        self._num_rays = num_rays

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """None; asked for before the training clock starts, hence the place to read the training pixels."""
        _ = self._pixels
        return []

    def metadata(self) -> dict[str, Any]:
        """Shapes of mesh and environment, and what the pictures' numbers are."""
        return ObjectRecord.of(self.object).to_json()

    def initial_data(self) -> Mapping[str, np.ndarray]:
        """Mesh and environment, which become buffers of the model, so that a run renders without its data; and some
        training views for a prior, which `views_of` puts together again, or of spectral pictures some pixels to start
        from."""
        mesh, light = self.object.mesh, self.object.environment
        arrays = {"vertices": mesh.vertices, "faces": mesh.faces, "normals": mesh.normals, "uv": mesh.uv}
        arrays["light_map"] = light.image
        buffers = {name: array.numpy() for name, array in arrays.items() if array is not None}
        return {
            **buffers,
            **(_view_arrays(self.object) if self.object.lamp is None else self._pixel_arrays()),
        }

    def summary(self) -> dict[str, Any]:
        """Files, splits, normalisation, hashes."""
        return self.object.summary()

    @classmethod
    def check_record(cls, metadata: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Refuse what no object has."""
        ObjectRecord.from_json(metadata)
        Normalisation.from_json(summary["normalisation"])

    def identity(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        """Views and the content of all files."""
        return {key: summary.get(key) for key in ("frames", "train_indices", "eval_indices", "input_hashes")}

    def warnings(self) -> list[str]:
        """What the reader noted of the mesh."""
        return list(self.object.notes)

    @cached_property
    def _pixels(self) -> _PixelList:
        """Read when training begins: evaluation needs none of it."""
        return _PixelList.of(self.object, self.options.max_pixels, self.seed)

    @cached_property
    def _ray_mesh(self) -> RayMesh:
        """Says which pixels show the object where alpha does not."""
        return RayMesh(self.object.mesh)

    def _image(
        self, pictures: PosedPictures, view: int, others: dict[str, Tensor]
    ) -> tuple[Cameras, dict[str, Tensor]]:
        picture = pictures.read(view)
        shown = opacity(picture)
        if not has_alpha(picture):
            shown = shown * _sees_mesh(self._ray_mesh, pictures.cameras[view]).numpy()
        batch = {
            "numbers": self._tensor(picture.numbers),
            "alpha": self._tensor(shown),
            "tone": torch.tensor(TONE_MAPPINGS.index(pictures.tone)),
            "lights": torch.tensor(len(self.object.lights)),
        }
        return pictures.cameras[view], {**batch, **others}

    def _truth(self, view: int) -> dict[str, Tensor]:
        """What is known of a view's materials."""
        if self.object.bands is None:
            colours = self.object.base_colour(view)
            return {} if colours is None else {"base_colour": self._tensor(colours)}
        materials = self.object.true_materials
        abundances = self.object.abundances(view)
        if materials is None or abundances is None:
            return {}
        endmembers = self._tensor(materials.endmembers.astype(np.float32))
        return {"true_abundances": self._tensor(abundances), "true_endmembers": endmembers}

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)

    def _pixel_arrays(self) -> dict[str, np.ndarray]:
        """Rays and spectra of some training pixels, the lamp, and where the model's axes are in the world."""
        assert self.object.lamp is not None
        generator = step_generator(self.seed, 0, stream=_STREAM)
        views, places, numbers = self._pixels.draw(_NUM_PIXELS, generator)
        rays = self.train_cameras.generate_rays(views, places)
        return {
            "pixels": numbers.numpy(),
            "pixel_origins": rays.origins.numpy(),
            "pixel_directions": rays.directions.numpy(),
            "lamp": self.object.lamp,
            "world_corners": self.object.frame.to_world(np.concatenate([np.zeros((1, 3)), np.eye(3)])),
        }


@dataclass(frozen=True)
class _PixelList:
    """Pixels of training views that show the mesh and nothing else, by view and place."""

    views: Int[Tensor, " M"]
    corners: Int[Tensor, "M 2"]
    """Column and row."""
    numbers: Float[Tensor, "M C"]

    @staticmethod
    def of(scene: ObjectScene, most: int, seed: int) -> _PixelList:
        """Read the training views; of more pixels than `most`, so many are drawn.

        Raises:
            SceneError: no view shows the mesh.
        """
        ray_mesh, parts = RayMesh(scene.mesh), []
        generator = torch.Generator().manual_seed(seed)
        share = most // len(scene.split.train) + 1
        for row, view in enumerate(scene.split.train):
            picture = scene.pictures.read(view)
            sees_mesh = _sees_mesh(ray_mesh, scene.pictures.cameras[view])
            rows, columns = (torch.from_numpy(opacity(picture) >= OPAQUE_ALPHA) & sees_mesh).nonzero(
                as_tuple=True
            )
            if len(rows) > share:
                kept = torch.randperm(len(rows), generator=generator)[:share]
                rows, columns = rows[kept], columns[kept]
            numbers = torch.from_numpy(picture.numbers)[rows, columns]
            parts.append((torch.full_like(rows, row), torch.stack([columns, rows], dim=-1), numbers))
        found = _PixelList(*(torch.cat(values) for values in zip(*parts, strict=True)))
        if not len(found.views):
            raise SceneError(f"{scene.root}: no training view shows the mesh and opaque alpha in one pixel")
        return found

    def draw(
        self, count: int, generator: torch.Generator
    ) -> tuple[Int[Tensor, " R"], Float[Tensor, "R 2"], Float[Tensor, "R C"]]:
        """Training view, a random place (x and y in pixels) and numbers of random pixels, all equally likely."""
        chosen = torch.randint(len(self.views), (count,), generator=generator)
        places = self.corners[chosen] + torch.rand(count, 2, generator=generator)
        return self.views[chosen], places, self.numbers[chosen]


def _sees_mesh(ray_mesh: RayMesh, camera: Cameras) -> Bool[Tensor, "H W"]:
    """Pixels of a view that the mesh covers."""
    seen = torch.ones(camera.height * camera.width, dtype=torch.bool)
    for place in _CORNERS:
        rays = camera.to(ray_mesh.device).image_rays(0, place)
        seen &= ray_mesh.closest(rays.origins, rays.directions).found.cpu()
    return seen.reshape(camera.height, camera.width)


def _view_arrays(scene: ObjectScene) -> dict[str, np.ndarray]:
    """Training views that a prior may look at, as arrays by name."""
    train = list(scene.split.train)
    cameras = scene.pictures.cameras[train]
    arrays: dict[str, np.ndarray] = {}
    for number, row in enumerate(well_spread(cameras.camera_to_world[:, :, 3], _MOST_VIEWS)):
        picture = scene.pictures.read(train[row])
        step = max(1, -(-max(picture.numbers.shape[:2]) // LONGEST_EDGE_PX))
        # Pixel c of a thinned-out view is pixel c step of the whole one; centres are at + 0.5.
        lens = torch.cat([cameras.focal_px[row] / step, (cameras.center_px[row] - 0.5) / step + 0.5])
        light = torch.from_numpy(picture.numbers[::step, ::step].copy())
        if scene.pictures.tone != "linear":
            light = srgb_to_linear(light)  # about; an unknown response is only known after the fit
        arrays[f"view_{number}_light"] = light.numpy()
        arrays[f"view_{number}_alpha"] = opacity(picture)[::step, ::step].copy()
        arrays[f"view_{number}_pose"] = cameras.camera_to_world[row].numpy()
        arrays[f"view_{number}_lens"] = torch.cat([lens, cameras.distortion[row]]).numpy()
    return arrays


def _object_folder(data: Path) -> Path:
    if str(data) not in _DEMOS:
        return data
    from unmix_plugin.neumatex.demo.objects import demo_object_path

    return demo_object_path(str(data), lambda line: sys.stderr.write(f"{line}\n"))
