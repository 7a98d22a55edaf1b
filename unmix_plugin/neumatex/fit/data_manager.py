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
    AtStartOnly,
    Cameras,
    CommonFlag,
    DataManager,
    DataManagerConfig,
    Decision,
    RayBundle,
    SceneBox,
    Target,
    TrainingCallback,
    Within,
    short_flag,
    step_generator,
)
from unmix_plugin.errors import SceneError
from unmix_plugin.formats.files import numbered_apart
from unmix_plugin.neumatex.fit.object_scene import HeldOutLight, ObjectScene, PosedObject, load_object
from unmix_plugin.neumatex.fit.settings import ObjectRecord
from unmix_plugin.neumatex.fit.tone import TONE_MAPPINGS
from unmix_plugin.neumatex.prior.observations import well_spread
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.folder import METRES_KEY
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
    max_pixels: Annotated[int, Within("[1, inf)")] = 8_000_000
    """Training pixels kept in memory; of more, these are drawn evenly."""
    lamp: Annotated[str | None, CommonFlag] = None
    """For pictures of many bands: spectrum of the light, a .csv (wavelength,power), an ENVI spectral library or a name
    (D65, A, ...); None takes 'illuminant_path' of transforms.json."""

    mesh: Annotated[Path | None, CommonFlag, AtStartOnly, short_flag("mesh")] = None
    """Mesh in place of that of the data, or of --from-run."""
    environment: Annotated[Path | None, CommonFlag, AtStartOnly, short_flag("environment")] = None
    """Environment map in place of that of the data, or of --from-run; it is neither turned nor scaled."""
    mesh_triangles: Annotated[
        int, CommonFlag, AtStartOnly, short_flag("mesh-triangles"), Within("[100, 1000000]")
    ] = 20_000
    """Of the mesh that is made of a --from-run, at most."""


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
        """Read the object. Raises SceneError: it is missing or malformed."""
        super().__init__(config, data=data, device=device, seed=seed)
        self.options = config
        if str(data) in _DEMOS:
            from unmix_plugin.neumatex.demo.objects import demo_object_path

            data = demo_object_path(str(data), lambda line: sys.stderr.write(f"{line}\n"))
        self.object = load_object(data, config.lamp, mesh=config.mesh, environment=config.environment)
        pictures, split = self.object.pictures, self.object.split
        self.train_cameras = pictures.cameras[list(split.train)]
        self.eval_cameras = pictures.cameras[list(split.evaluation)]
        reach = self.object.mesh.vertices.abs().amax(dim=0).clamp(min=_THINNEST)
        self.scene_box = SceneBox(torch.stack([-reach, reach]))
        self._num_rays = config.train_num_rays_per_batch
        self._images: list[tuple[HeldOutLight | None, int]] = [(None, view) for view in split.evaluation]
        named = [pictures.names[view] for view in split.evaluation]
        for light in self.object.lights:
            self._images += [(light, view) for view in range(len(light.pictures))]
            named += [f"{light.name}-{name}" for name in light.pictures.names]
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
        light, view = self._images[index]
        pictures = self.object.pictures if light is None else light.pictures
        picture, camera = pictures.read(view), pictures.cameras[view]
        shown = picture.opacity
        if not picture.has_alpha:
            shown = shown * _sees_mesh(self._ray_mesh, camera).numpy()
        batch = {
            "numbers": torch.from_numpy(picture.numbers),
            "alpha": torch.from_numpy(shown),
            "tone": torch.tensor(TONE_MAPPINGS.index(pictures.tone)),
            "lights": torch.tensor(len(self.object.lights)),
        }
        if light is None:
            batch |= {name: torch.from_numpy(truth) for name, truth in self.object.truth(view).items()}
        else:
            given = light.environment
            placement = torch.tensor([given.rotation_deg, given.exposure_stops])
            batch |= {"environment": given.image, "environment_placement": placement}
        return camera, {name: values.to(self.device) for name, values in batch.items()}

    def eval_name(self, index: int) -> str:
        """The picture's name, after its light's where that is held out."""
        return self._names[index]

    def get_train_rays_per_batch(self) -> int:
        return self._num_rays

    def set_train_rays_per_batch(self, num_rays: int) -> None:
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
        estimated = self.object.estimated.light
        arrays["lamp_and_sky"] = None if estimated is None else estimated.to_tensor()
        buffers = {name: array.numpy() for name, array in arrays.items() if array is not None}
        return buffers | (view_arrays(self.object) if self.object.lamp is None else self._pixel_arrays())

    def summary(self) -> dict[str, Any]:
        """Files, splits, normalisation, hashes, and how long a unit is where that is known."""
        found = self.object
        return {
            "root": str(found.root),
            "frames": found.pictures.names,
            "train_indices": list(found.split.train),
            "eval_indices": list(found.split.evaluation),
            "normalisation": found.frame.to_json(),
            "tone_mapping": found.pictures.tone,
            "lights": {light.name: light.pictures.names for light in found.lights},
            "input_hashes": dict(found.input_hashes),
            **({} if found.metres_per_unit is None else {METRES_KEY: found.metres_per_unit}),
        }

    @classmethod
    def check_record(cls, metadata: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Refuse what no object has."""
        ObjectRecord.from_json(metadata)
        Normalisation.from_json(summary["normalisation"])

    def identity(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        """Views and the content of all files."""
        return {key: summary.get(key) for key in ("frames", "train_indices", "eval_indices", "input_hashes")}

    def decisions(self) -> list[Decision]:
        """What was decided about mesh and light when the object was made of a run."""
        return list(self.object.decisions)

    def warnings(self) -> list[str]:
        """What the reader noted of the mesh."""
        return list(self.object.notes)

    @cached_property
    def _pixels(self) -> PixelList:
        """Read when training begins: evaluation needs none of it."""
        return PixelList(self.object, self.options.max_pixels, self.seed)

    @cached_property
    def _ray_mesh(self) -> RayMesh:
        """Says which pixels show the object where alpha does not."""
        return RayMesh(self.object.mesh)

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


class PixelList:
    """Pixels of training views that show the mesh and nothing else: `views` (M), `corners` (M 2), column and row, and
    `numbers` (M C)."""

    def __init__(self, scene: ObjectScene | PosedObject, most: int, seed: int) -> None:
        """Read the training views; of more pixels than `most`, so many are drawn."""
        ray_mesh, parts = RayMesh(scene.mesh), []
        generator = torch.Generator().manual_seed(seed)
        share = most // len(scene.split.train) + 1
        for number, view in enumerate(scene.split.train):
            picture = scene.pictures.read(view)
            shown = torch.from_numpy(picture.opacity >= OPAQUE_ALPHA)
            places = (shown & _sees_mesh(ray_mesh, scene.pictures.cameras[view])).nonzero()
            if len(places) > share:
                places = places[torch.randperm(len(places), generator=generator)[:share]]
            rows, columns = places.unbind(dim=-1)
            numbers = torch.from_numpy(picture.numbers)[rows, columns]
            parts.append((torch.full_like(rows, number), places.flip(1), numbers))
        self.views, self.corners, self.numbers = (torch.cat(part) for part in zip(*parts, strict=True))
        if not len(self.views):
            raise SceneError(f"{scene.root}: no training view shows the mesh and opaque alpha in one pixel")

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


def view_arrays(scene: ObjectScene) -> dict[str, np.ndarray]:
    """Training views of frame cameras, which a prior may look at, as arrays by name."""
    train = [view for view in scene.split.train if not scene.pictures.cameras.is_line_camera(view)]
    arrays: dict[str, np.ndarray] = {}
    if not train:
        return arrays
    cameras = scene.pictures.cameras[train]
    for number, row in enumerate(well_spread(cameras.camera_to_world[:, :, 3], _MOST_VIEWS)):
        picture = scene.pictures.read(train[row])
        step = max(1, -(-max(picture.numbers.shape[:2]) // LONGEST_EDGE_PX))
        # Pixel c of a thinned-out view is pixel c step of the whole one; centres are at + 0.5.
        lens = torch.cat([cameras.focal_px[row] / step, (cameras.center_px[row] - 0.5) / step + 0.5])
        light = torch.from_numpy(picture.numbers[::step, ::step].copy())
        if scene.pictures.tone != "linear":
            light = srgb_to_linear(light)  # about; an unknown response is only known after the fit
        arrays[f"view_{number}_light"] = light.numpy()
        arrays[f"view_{number}_alpha"] = picture.opacity[::step, ::step].copy()
        arrays[f"view_{number}_pose"] = cameras.camera_to_world[row].numpy()
        arrays[f"view_{number}_lens"] = torch.cat([lens, cameras.distortion[row]]).numpy()
    return arrays
