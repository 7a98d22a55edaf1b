"""The scene of a run of neumatex: a mesh with its materials, rendered under any light, and all that can be shown of it.

Notation: `H x W` pixels, `K` rays that meet the mesh, `P` parameters, `C` colours.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine import Cameras, Output, SceneBox, SceneRecord, named_output
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.neumatex.fit.tone import SpectralDisplay
from unmix_plugin.neumatex.tracing.built_in_lights import NAMES, built_in_environment
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import PbrFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.light_files import ENVIRONMENT_SUFFIXES, of_lamp, read_environment
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import PixelHits, RayMesh, pixel_hits
from unmix_plugin.neumatex.tracing.surface import Surface
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.segmentation import material_ids
from unmix_plugin.trained.model_scene import LightChoice, ModelView
from unmix_plugin.trained.protocol import Probe
from unmix_plugin.trained.run_views import RunView, recorded_views, world_frame
from unmix_plugin.trained.trained_scene import one_pixel

if TYPE_CHECKING:
    from unmix_plugin.neumatex.fit.model import NeumatexModel
    from unmix_plugin.products.page.page import PageContent

OWN_LIGHT = "of the pictures"
"""Name of the light that the pictures were taken under."""
_GLANCE_SAMPLES = 4
"""Paths a pixel of one estimate."""
_SUBPIXELS = 2
"""Rays along a pixel's edge of a finished view."""
_CHUNK = 1 << 17
_DARKEST = 0.02
"""Base colour below which shading is not divided by it."""

_COMMON = (
    Output(
        "rgb",
        "srgb",
        "colour",
        "sRGB",
        is_on_black=True,
        remarks=("0 to 1", "with the tones of the pictures"),
    ),
    Output("linear_rgb", "linear", "colour (linear)", "linear radiance", is_on_black=True),
    Output(
        "base_colour", "linear", "base colour", "linear base colour", is_on_black=True, remarks=("0 to 1",)
    ),
)
_PBR = (
    Output("roughness", "map", "roughness", "roughness", (0.0, 1.0), remarks=("0 to 1",)),
    Output("metallicity", "map", "metallicity", "metallicity", (0.0, 1.0), remarks=("0 to 1",)),
)
_LATENTS = (
    Output("latents_a", "picture", "latents A", "the decoder's latents 1 to 3 as red, green, blue"),
    Output("latents_b", "picture", "latents B", "the decoder's latents 4 to 6 as red, green, blue"),
)
_SPECTRAL = (
    Output(
        "spectral", "channels", "radiance", "radiance in every band", quantity="radiance", is_on_black=True
    ),
    Output(
        "reflectance",
        "channels",
        "reflectance",
        "diffuse reflectance in every band",
        quantity="reflectance",
        is_on_black=True,
        remarks=("0 to 1",),
    ),
    Output(
        "abundances",
        "shares",
        "abundances",
        "share of each endmember",
        (0.0, 1.0),
        remarks=("summing to opacity",),
    ),
    Output(
        "segmentation",
        "labels",
        "segmentation",
        "endmember of the largest share",
        nothing=255,
        remarks=("255 where nothing is",),
    ),
    Output(
        "roughness", "map", "roughness", "roughness of the specular layer", (0.0, 1.0), remarks=("0 to 1",)
    ),
    Output(
        "specular_level",
        "map",
        "specular level",
        "root of what the specular layer reflects straight on",
        (0.0, 1.0),
    ),
)
_UNCERTAINTY = Output(
    "uncertainty",
    "map",
    "uncertainty",
    "expected error of the material's parameters",
    None,
    "magma",
    remarks=("mean",),
)
_GEOMETRY = (
    Output("shading", "linear", "shading", "light divided by base colour", is_on_black=True),
    Output("normals", "vectors", "normals", "unit vectors in world axes", remarks=("0 where nothing is",)),
    Output(
        "depth",
        "map",
        "depth",
        "distance along the viewing axis",
        unit="world units",
        nothing=0,
        remarks=("0 where nothing is",),
    ),
    Output("accumulation", "map", "opacity", "part of the pixel that the mesh covers", (0.0, 1.0)),
)


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

    materials: Materials | None = None
    """None: its endmembers are those of a surface, not of a volume."""
    pixel_size: float | None = None
    fitted: tuple[Literal["pose", "gain"], ...] = ()

    @property
    def mesh(self) -> Mesh:
        """In model space."""
        return self.ray_mesh.mesh

    @property
    def device(self) -> torch.device:
        """Where it is rendered."""
        return self.ray_mesh.device

    @property
    def lit_head_on(self) -> TrainedObject:
        """Itself: what is exported of it holds no light."""
        return self

    @property
    def outputs(self) -> tuple[Output, ...]:
        """All that can be shown of the materials and of the light that they reflect, in the order of offering."""
        own = {SpectralFamily: _SPECTRAL, NeuralFamily: _LATENTS, PbrFamily: _PBR}
        uncertainty = () if self.log_variance is None else (_UNCERTAINTY,)
        return (*_COMMON, *own.get(type(self.surface.family), ()), *uncertainty, *_GEOMETRY)

    def output(self, name: str) -> Output:
        """An output by its name."""
        return named_output(self.outputs, name)

    @property
    def lights(self) -> tuple[str, ...]:
        """The light of the pictures, then those that are built in."""
        return (OWN_LIGHT, *NAMES)

    def with_light(self, choice: LightChoice) -> TrainedObject:
        """The object under another light."""
        own = self.own_light or self.environment
        light = own if choice.name in (None, OWN_LIGHT) else self._named_light(str(choice.name))
        angle, stops = light.rotation_deg + choice.rotation_deg, light.exposure_stops + choice.exposure_stops
        turned = Environment(light.image.to(self.device), angle, stops, light.moves)
        return replace(self, environment=turned, own_light=own)

    def _named_light(self, name: str) -> Environment:
        if name in self.lights:
            light = built_in_environment(name)
            return light if self.lamp is None else of_lamp(light, self.lamp.cpu())
        if not name.lower().endswith(ENVIRONMENT_SUFFIXES):
            hint = did_you_mean(name, self.lights, likeness=0.5, form=" ({})")
            raise ConfigError(
                f"there is no environment {name!r}{hint}; known are {', '.join(self.lights)}, and the path of an "
                f"environment map ({', '.join(ENVIRONMENT_SUFFIXES)})"
            )
        path = Path(name)
        if self.bands is None or self.lamp is None:
            return _environment_file(path, path.stat().st_mtime_ns if path.exists() else 0)
        return read_environment(path, bands=self.bands, lamp=self.lamp.cpu().double().numpy())

    def look(self, camera: Cameras, subpixels: int | None = None) -> ModelView:
        """All outputs of a view; `subpixels` squared rays per pixel."""
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
        """Outputs of a view by name, (H, W, ...)."""
        known = [self.output(name).name for name in names]
        view = self.look(camera)
        return {name: view[name] for name in known}

    def probe(self, camera: Cameras, column: int, row: int) -> Probe:
        """All outputs in one pixel, and where its ray meets the mesh."""
        one = one_pixel(camera, column, row)
        view = self.look(one, 1)
        values = {name: tensor.reshape(-1).double().cpu().numpy() for name, tensor in view.tensors.items()}
        hits = pixel_hits(self.ray_mesh, one, 0)
        position = hits.points.positions[0].double().cpu().numpy() if len(hits) else None
        world = None if position is None else self.frame.to_world(position[None])[0]
        return Probe(values, float(view.opacity.reshape(-1)[0]), position, world)

    @torch.no_grad()
    def page_content(self, resolution: int) -> PageContent:
        """What `unmix-export page` shows of it, with about so many vertices along the longest edge."""
        from unmix_plugin.neumatex.export.page import ObjectForPage, page_content

        view = next((view for view in self.views if view.split == "eval"), self.views[0])
        seen, eye = self.look(view.camera), view.camera.camera_to_world[0, :, 3].to(self.device)
        base_colour = linear_to_srgb(seen["base_colour"].clamp(0, 1))
        notes = list[str]()
        if (self.own_light or self.environment).moves is not None:
            notes.append(
                f"The light of the pictures turned with the camera: it is shown as it stood for {view.name}."
            )
        shown = ObjectForPage(
            mesh=self.mesh,
            surface=self.surface,
            bands=self.bands,
            curve=self.curve,
            frame=self.frame,
            lights={
                name: self.with_light(LightChoice(name)).environment.seen_from(eye) for name in self.lights
            },
            pictures={f"{view.name}, in colour": seen["rgb"], f"{view.name}, base colour": base_colour},
            notes=tuple(notes),
        )
        return page_content(shown, resolution)

    @torch.no_grad()
    def _rendered(self, camera: Cameras, subpixels: int, samples: int, number: int) -> ModelView:
        hits = pixel_hits(self.ray_mesh, camera, 0, subpixels)
        # Another seed for each strip of rows of a picture, always the same for the same one.
        seed = 7919 * number + round(float(camera.center_px[0, 1])) % 7907
        traced = TracedObject(self.ray_mesh, self.environment, self.surface)
        generator = torch.Generator(self.device).manual_seed(seed)
        light = traced.light_of_rays(hits, samples, self.bounces, generator)
        return ModelView(camera, self._view_outputs(camera, hits, light))

    def _view_outputs(
        self, camera: Cameras, hits: PixelHits, light: Float[Tensor, "K C"]
    ) -> dict[str, Tensor]:
        """All outputs of a view, (H, W, ...); colours are on black, everything else is a mean over what is seen in a
        pixel."""
        family, positions, alpha = self.surface.family, hits.points.positions, hits.alpha()
        parameters = _in_chunks(self.surface.parameters, positions, family.num_parameters)
        base, linear = family.base_colour(parameters), hits.image(light)
        seen = alpha[..., None].clamp(min=1e-6)
        in_colours = self.curve.rgb if isinstance(self.curve, SpectralDisplay) else (lambda values: values)
        rotation = torch.from_numpy(self.frame.rotation).to(positions)
        normals = torch.nn.functional.normalize(hits.image(hits.points.normals) / seen @ rotation, dim=-1)
        pose = camera.camera_to_world[0].to(positions)
        depths = -((positions - pose[:, 3]) @ pose[:, 2]) / self.frame.scale
        found = {
            "rgb": torch.where(alpha[..., None] > 0, self.curve(linear / seen), 0.0) * alpha[..., None],
            "linear_rgb": in_colours(linear),
            "base_colour": in_colours(hits.image(base)),
            "shading": hits.image(in_colours(light) / in_colours(base).clamp(min=_DARKEST)),
            "normals": normals * (alpha > 0)[..., None],
            "depth": (hits.image(depths[:, None]) / seen)[..., 0],
            "accumulation": alpha,
        }
        means = hits.image(parameters) / seen
        if isinstance(family, SpectralFamily):
            shares = hits.image(family.abundances(parameters))
            found |= {"spectral": linear, "reflectance": hits.image(base), "abundances": shares}
            found["segmentation"] = material_ids(shares, alpha)
            found["roughness"], found["specular_level"] = means[..., family.num_endmembers :].unbind(dim=-1)
        elif isinstance(family, NeuralFamily):
            found["latents_a"], found["latents_b"] = means[..., 3:6], means[..., 6:9]
        elif isinstance(family, PbrFamily):
            found["roughness"], found["metallicity"] = means[..., 3:5].unbind(dim=-1)
        if self.log_variance is not None:
            spread = (_in_chunks(self.log_variance, positions, family.num_parameters) / 2).exp()
            found["uncertainty"] = (hits.image(spread.mean(dim=1, keepdim=True)) / seen)[..., 0]
        return found


@lru_cache(maxsize=2)
def _environment_file(path: Path, changed_ns: int) -> Environment:  # noqa: ARG001 - a changed file is another one
    """An environment map, kept while it stays as it is: a slider that turns it asks for it again and again."""
    return read_environment(path)


def _in_chunks(
    look_up: Callable[[Tensor], Tensor], positions: Float[Tensor, "K 3"], width: int
) -> Float[Tensor, "K P"]:
    parts = [look_up(part) for part in positions.split(_CHUNK)] if len(positions) else []
    return torch.cat(parts) if parts else positions.new_zeros((0, width))


def trained_object(
    model: NeumatexModel, record: SceneRecord, averages: Mapping[str, Tensor] | None = None
) -> TrainedObject:
    """The object of a model as it is now, trained or in training; training that goes on does not change it.

    Args:
        model, averages: As `Model.frozen_parameters` takes them.
        record: Cameras and frame of its run.
    """
    frozen = model.frozen_parameters(averages)
    triplane = copy.deepcopy(model.triplane, dict(frozen))  # type: ignore[arg-type]
    curve = copy.deepcopy(model.curve, dict(frozen))  # type: ignore[arg-type]
    family = copy.deepcopy(model.family, dict(frozen))  # type: ignore[arg-type]
    with torch.no_grad():
        light, relief = copy.deepcopy((model.light, model.relief), dict(frozen))  # type: ignore[arg-type]
        traced = model.traced_with(light, relief)
    return TrainedObject(
        traced.ray_mesh,
        replace(model.surface, family=family, triplane=triplane),
        traced.environment,
        world_frame(record),
        recorded_views(record),
        record.scene_box,
        curve,
        None if model.record.is_spectral else triplane.log_variance,
        model.config.render_samples,
        model.config.bounces,
        bands=model.record.bands,
        lamp=torch.tensor(model.record.lamp) if model.record.is_spectral else None,
    )
