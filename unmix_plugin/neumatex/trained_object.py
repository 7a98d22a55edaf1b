"""The scene of a run of neumatex: a mesh with its materials, rendered under any light.

Notation: `H x W` pixels, `K` rays that meet the mesh, `P` parameters, `C` colours.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.outputs import Output, named_output
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.built_in import NAMES, built_in_environment
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.lighting.lamp import of_lamp, read_environment_of_bands
from unmix_plugin.neumatex.lighting.read_environment import SUFFIXES, read_environment
from unmix_plugin.neumatex.object_outputs import object_outputs, view_outputs
from unmix_plugin.neumatex.surface import Surface
from unmix_plugin.neumatex.tracing.primary_hits import pixel_hits
from unmix_plugin.neumatex.tracing.render_view import rays_radiance
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.trained.model_scene import ModelView
from unmix_plugin.trained.probe import one_pixel
from unmix_plugin.trained.protocol import Probe
from unmix_plugin.trained.relighting import LightChoice
from unmix_plugin.trained.run_views import RunView

OWN_LIGHT = "of the pictures"
"""Name of the light that the pictures were taken under."""

_GLANCE_SAMPLES = 4
"""Paths a pixel of one estimate."""

_SUBPIXELS = 2
"""Rays along a pixel's edge of a finished view."""


@dataclass(frozen=True)
class TrainedObject:
    """Mesh, materials and light; a value. `with_light` gives another one."""

    ray_mesh: RayMesh
    surface: Surface
    environment: Environment
    frame: Normalisation
    views: tuple[RunView, ...]
    scene_box: SceneBox
    curve: Callable[[Float[Tensor, "*pixels C"]], Float[Tensor, "*pixels 3"]]
    """From light to the sRGB numbers that are shown."""
    log_variance: Callable[[Float[Tensor, "N 3"]], Float[Tensor, "N P"]] | None = None
    """Logarithm of the expected squared error of each parameter at points of the surface; None: unknown."""
    samples: int = 64
    """Paths a pixel of a finished view."""
    bounces: int = 1
    """Reflections between parts of the object."""
    notes: tuple[str, ...] = ()
    own_light: Environment | None = None
    """The light of the pictures, once another one is in use."""
    bands: Bands | None = None
    """Of light and base reflectance; None for colours."""
    lamp: Float[Tensor, " B"] | None = None
    """Spectrum that environments in colours get; None for colours."""

    @property
    def mesh(self) -> Mesh:
        """In model space."""
        return self.ray_mesh.mesh

    @property
    def device(self) -> torch.device:
        """Where it is rendered."""
        return self.ray_mesh.device

    @property
    def outputs(self) -> tuple[Output, ...]:
        """All that can be shown of the materials and of the light that they reflect."""
        return object_outputs(self.surface.family, self.log_variance is not None)

    def output(self, name: str) -> Output:
        """An output by its name.

        Raises:
            ConfigError: there is none.
        """
        return named_output(self.outputs, name)

    @property
    def lights(self) -> tuple[str, ...]:
        """The light of the pictures, then those that are built in."""
        return (OWN_LIGHT, *NAMES)

    def with_light(self, choice: LightChoice) -> TrainedObject:
        """The object under another light.

        Raises:
            ConfigError: there is no such light.
            SceneError: the file of an environment map is missing, damaged or unusable.
        """
        own = self.own_light or self.environment
        light = own if choice.name in (None, OWN_LIGHT) else self._named_light(str(choice.name))
        turned = Environment(
            light.image.to(self.device),
            light.rotation_deg + choice.rotation_deg,
            light.exposure_stops + choice.exposure_stops,
        )
        return replace(self, environment=turned, own_light=own)

    def _named_light(self, name: str) -> Environment:
        if name in self.lights:
            light = built_in_environment(name)
            return light if self.lamp is None else of_lamp(light, self.lamp.cpu())
        if not name.lower().endswith(SUFFIXES):
            hint = did_you_mean(name, self.lights, likeness=0.5, form=" ({})")
            raise ConfigError(
                f"there is no environment {name!r}{hint}; known are {', '.join(self.lights)}, and the path of an "
                f"environment map ({', '.join(SUFFIXES)})"
            )
        path = Path(name)
        if self.bands is None or self.lamp is None:
            return _environment_file(path, path.stat().st_mtime_ns if path.exists() else 0)
        return read_environment_of_bands(path, self.bands, self.lamp.cpu().double().numpy())

    def look(self, camera: Cameras, subpixels: int | None = None) -> ModelView:
        """All outputs of a view; `subpixels` squared rays a pixel."""
        rays = _SUBPIXELS if subpixels is None else subpixels
        return self._rendered(camera, rays, self.samples, 0)

    @property
    def num_estimates(self) -> int:
        """Estimates that have as many paths together as a finished view."""
        return max(1, round(self.samples / _GLANCE_SAMPLES))

    def estimate(self, camera: Cameras, subpixels: int, number: int) -> ModelView:
        """All outputs of a view, with few paths; those of other numbers are independent of it."""
        view = self._rendered(camera, subpixels, _GLANCE_SAMPLES, number + 1)
        return replace(view, num_wanted=self.num_estimates)

    def render(self, camera: Cameras, names: Collection[str]) -> dict[str, Tensor]:
        """Outputs of a view by name, (H, W, ...).

        Raises:
            ConfigError: an unknown name.
        """
        known = [self.output(name).name for name in names]
        view = self.look(camera)
        return {name: view[name] for name in known}

    def probe(self, camera: Cameras, column: int, row: int) -> Probe:
        """All outputs in one pixel, and where its ray meets the mesh.

        Raises:
            ConfigError: the pixel is outside the image.
        """
        one = one_pixel(camera, column, row)
        view = self.look(one, 1)
        values = {name: tensor.reshape(-1).double().cpu().numpy() for name, tensor in view.tensors.items()}
        hits = pixel_hits(self.ray_mesh, one, 0)
        position = hits.points.positions[0].double().cpu().numpy() if len(hits) else None
        world = None if position is None else self.frame.to_world(position[None])[0]
        return Probe(values, float(view.opacity.reshape(-1)[0]), position, world)

    @torch.no_grad()
    def _rendered(self, camera: Cameras, subpixels: int, samples: int, number: int) -> ModelView:
        hits = pixel_hits(self.ray_mesh, camera, 0, subpixels)
        generator = torch.Generator(self.device).manual_seed(_seed(camera, number))
        light = rays_radiance(
            self.surface,
            self.ray_mesh,
            self.environment,
            hits,
            samples=samples,
            bounces=self.bounces,
            generator=generator,
        )
        return ModelView(camera, view_outputs(self, camera, hits, light))


@lru_cache(maxsize=2)
def _environment_file(path: Path, changed_ns: int) -> Environment:  # noqa: ARG001 - a changed file is another one
    """An environment map, kept while it stays as it is: a slider that turns it asks for it again and again."""
    return read_environment(path)


def _seed(camera: Cameras, number: int) -> int:
    """Of the samples of one view: another one for each strip of rows of a picture, always the same for the same one."""
    return 7919 * number + round(abs(float(camera.center_px[0, 1]))) % 7907
