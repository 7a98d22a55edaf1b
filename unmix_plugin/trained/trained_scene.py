"""A trained scene of mixed materials as a value: it renders, is probed, and is edited into another one.

No trainer and no settings: what it shows follows from its parts alone.

Notation: `H x W` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.outputs import Output
from unmix_plugin.errors import ConfigError
from unmix_plugin.field import CoefficientField
from unmix_plugin.rendering.front_to_back import DIAGONAL, composite_view, evenly_in_pixel
from unmix_plugin.rendering.renderer import VolumeRenderer
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.intervals import COVERAGE, Interval, require_coverage
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients, Materials
from unmix_plugin.trained.intervals import SeenPlaces, as_interval
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.mixture_view import MaterialOutput, MixtureView, components_of
from unmix_plugin.trained.outputs import find_output, interval_ends
from unmix_plugin.trained.place_errors import PlaceErrors
from unmix_plugin.trained.plain_outputs import available_outputs
from unmix_plugin.trained.protocol import Probe, RenderedView, seen_place
from unmix_plugin.trained.run_views import RunView, cameras_of
from unmix_plugin.trained.unexplained_map import UnexplainedMap


def one_pixel(camera: Cameras, column: int, row: int) -> Cameras:
    """A view of one pixel of an image: what is rendered of it is that pixel; a ConfigError where it is outside."""
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise ConfigError(
            f"pixel {column},{row} (column, row) is outside the image; "
            f"columns are 0 to {camera.width - 1}, rows 0 to {camera.height - 1}"
        )
    return camera.crop(column, row, 1, 1)


@dataclass(frozen=True)
class MaterialView(MixtureView):
    """What one camera sees of a scene."""

    scene: TrainedScene
    """With the materials to show; the coefficients may be rendered with others on the same shapes."""
    camera: Cameras
    coefficients: Coefficients
    """(H, W, ...)."""

    @property
    def materials(self) -> Materials:
        """The spectra that the coefficients are multiplied with."""
        return self.scene.materials

    @property
    def opacity(self) -> Float[Tensor, "H W"]:
        """[0, 1]."""
        return self.coefficients.accumulation

    @property
    def coverage(self) -> Float[Tensor, "H W"]:
        """How much of a pixel shows something, [0, 1]: a sky or a backdrop is behind all."""
        return torch.ones_like(self.opacity) if self.scene.field.has_sky else self.opacity

    @property
    def spectra(self) -> Float[Tensor, "H W B"]:
        """Radiance on black."""
        return self.materials.spectra(self.coefficients)

    @property
    def ray_distance(self) -> Float[Tensor, "H W"]:
        """Along the ray, world units; 0 where nothing is."""
        return self.coefficients.ray_distance / self.scene.frame.scale

    @property
    def depth(self) -> Float[Tensor, "H W"]:
        """Along the viewing axis, world units; 0 where nothing is."""
        camera = self.camera.to(self.coefficients.packed.device)
        rays = camera.image_rays(0)
        assert rays.axes is not None
        along_axis = (rays.directions * rays.axes).sum(dim=-1)
        return self.ray_distance * along_axis.view_as(self.opacity)

    @property
    def normals(self) -> Float[Tensor, "H W 3"]:
        """Unit vectors in world axes; 0 where nothing is."""
        scene, seen = self.scene, self.coefficients
        rays = self.camera.to(scene.device).image_rays(0)
        normals = scene.renderer.normals(scene.field, rays, seen.ray_distance.flatten())
        turned = normals @ torch.as_tensor(scene.frame.rotation, dtype=normals.dtype).to(normals)
        return turned.view(*seen.accumulation.shape, 3) * seen.is_occupied[..., None]

    @property
    def unexplained(self) -> Float[Tensor, "H W"]:
        """Part of what was measured there that no mixture of the materials gives, [0, 1]; NaN where that is unknown."""
        scene, seen = self.scene, self.coefficients
        assert scene.unexplained is not None, "of such a scene the output is refused"
        rays = self.camera.to(seen.packed.device).image_rays(0)
        return (
            scene.unexplained.at(rays.at(seen.ray_distance.flatten()))
            .view_as(self.opacity)
            .where(seen.is_occupied, torch.nan)
        )

    @property
    def has_removed(self) -> bool:
        """Whether the scene is shown without some of its materials."""
        return self.scene.has_removed

    @property
    def seen_places(self) -> SeenPlaces:
        """What is seen in each pixel, and how far it is expected to be off; a ConfigError where that is unknown."""
        errors, seen = self.scene.require_errors(), self.coefficients
        rays = self.camera.to(errors.origin.device).image_rays(0)
        positions = rays.at(seen.ray_distance.flatten().to(rays.origins)).view(*self.opacity.shape, 3)
        opaque = self.opacity.clamp(min=1e-6)[..., None]
        spectra, abundances = self.spectra / opaque, seen.abundances / opaque
        local = errors.at(positions, abundances, spectra).to(self.opacity.device)
        return SeenPlaces(spectra, abundances, self.opacity, local)

    def map(self, function: Callable[[Tensor], Tensor]) -> MaterialView:
        """The same view with its coefficients on another device, or of some rows."""
        return MaterialView(self.scene, self.camera, self.coefficients.map(function))

    @torch.no_grad()
    def __getitem__(self, name: str) -> Tensor:
        """An output by its name, as `find_output` takes it."""
        return self.scene.output(name).compute(self)


def material_view(view: RenderedView) -> MaterialView | None:
    """The view, if it is of mixed materials."""
    return view if isinstance(view, MaterialView) else None


def with_cells(renderer: VolumeRenderer, change: Callable[[Tensor], Tensor]) -> VolumeRenderer:
    """The renderer with its tensors of cells changed."""
    opaque = renderer.opaque_skips
    return replace(
        renderer,
        skips=change(renderer.skips),
        opaque_skips=None if opaque is None else change(opaque),
    )


def _row(values: Tensor) -> Float64[np.ndarray, " n"]:
    return values.detach().reshape(-1).double().cpu().numpy()


def _text(point: Float64[np.ndarray, "3"]) -> str:
    return ",".join(f"{value:.9g}" for value in point)


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """A radiance field whose every point is a mixture of a few materials."""

    field: CoefficientField
    """Density, abundances and brightness at every point; in evaluation mode, without gradients."""
    renderer: VolumeRenderer
    """From rays to coefficients."""
    materials: Materials
    """Endmembers, specular spectra, names, and the light that they are seen in."""
    frame: Normalisation
    """From the world of the scene's transforms.json to model space."""
    views: tuple[RunView, ...]
    """Training views, then evaluation views."""
    pixel_size: float
    """Edge of a pixel in the middle of the scene, model units."""
    subpixels: int = 1
    """Rays through a pixel along each of its edges."""
    notes: tuple[str, ...] = ()
    """What a user has to be told of how it was edited."""
    visibility: tuple[bytes, bytes] | None = None
    """What edits removed, and the specular factors of what is left; None: as trained. Coefficients of scenes of one run
    fit each other where it is equal."""
    has_removed: bool = False
    """Whether edits removed a material."""
    reached_colours: Mapping[tuple[str, int], tuple[float, float, float]] = dataclass_field(
        default_factory=dict
    )
    """sRGB colours that edits gave, or the nearest that they could: by kind of edit (`retint`, `gloss`) and number of
    the endmember."""
    unedited: TrainedScene | None = None
    """What edits were made of; None: it is as trained."""
    fitted: tuple[Literal["pose", "gain"], ...] = ()
    """What training found for each of its views, so that other views are aligned before they are measured."""
    scale: Scale | None = None
    """How long a unit of its world is; None where that is unknown."""
    view_gains: Float[Tensor, "V B"] | None = None
    """What is rendered, times this, is as bright as each training view measured it; on the CPU. None: 1."""
    measured_errors: PlaceErrors | str = "errors are measured when a training ends"
    """How far it was from what its training views measured, as it was trained; or why that is unknown, for people."""
    unexplained: UnexplainedMap | None = None
    """Where no mixture of its materials gives what the training views measured; None where that is not known."""

    @property
    def errors(self) -> PlaceErrors | str:
        """How far it is expected to be off, or why that is unknown, for people."""
        if self.unedited is not None:
            return "the scene is edited, and errors are known of it only as it was trained"
        return self.measured_errors

    def require_errors(self) -> PlaceErrors:
        """The same; a ConfigError where it is unknown."""
        errors = self.errors
        if isinstance(errors, str):
            raise ConfigError(f"intervals are not determined: {errors}")
        return errors

    @property
    def as_trained(self) -> TrainedScene:
        """The scene before all edits."""
        return self if self.unedited is None else self.unedited

    @property
    def bands(self) -> Bands:
        """Spectral bands."""
        return self.materials.bands

    @property
    def light(self) -> Float[Tensor, "B"] | None:
        """Relative power of the light; None where it is unknown."""
        return self.materials.light

    @property
    def light_power(self) -> Float64[np.ndarray, " B"] | None:
        """The same for NumPy."""
        return None if self.light is None else self.light.cpu().double().numpy()

    @property
    def scene_box(self) -> SceneBox:
        """What is modelled, model space."""
        return self.renderer.box

    @property
    def device(self) -> torch.device:
        """Where it is rendered."""
        return self.materials.endmembers.device

    @property
    def outputs(self) -> tuple[MaterialOutput, ...]:
        """All outputs that take no argument, but those that its bands or its light don't allow."""
        found = available_outputs(self.materials)
        return tuple(
            one for one in found if self.unexplained is not None or "training views" not in one.needs
        )

    @property
    def lit_head_on(self) -> TrainedScene:
        """The same scene as if a lamp that moves with the camera shone on every place head-on and cast no shadow, for
        what no camera looks at from one place: such a lamp stands where the camera says."""
        return replace(self, renderer=replace(self.renderer, opaque_skips=None))

    def output(self, name: str) -> MaterialOutput:
        """An output by its name, such as `rgb`, `band:650nm` or `index:ndvi`; errors as those of `find_output`, and a
        ConfigError where intervals are asked for and not determined."""
        found = find_output(name, self.materials)
        if name.startswith("interval:"):
            _ = self.require_errors()
        if "training views" in found.needs and self.unexplained is None:
            raise ConfigError(
                f"the output {name} needs what the training views measured, which is compared when a training ends; "
                "train the run to its end, or go on with a larger --max-num-iterations"
            )
        return found

    def look(self, camera: Cameras, subpixels: int | None = None) -> MaterialView:
        """Render a view; `subpixels` squared rays per pixel, None for as many as in training, but two at most where
        pixels are half as wide as the finest that were measured, or less: rays are as close as there."""
        places = evenly_in_pixel(self.subpixels if subpixels is None else subpixels)
        if subpixels is None and len(places) > len(DIAGONAL):
            measured = max((float(view.camera.focal_px.max()) for view in self.views), default=math.inf)
            is_fine = float(camera.focal_px.min()) >= 2 * measured
            places = DIAGONAL if is_fine else places
        return MaterialView(self, camera, composite_view(self.renderer, self.field, camera, places))

    def render(self, camera: Cameras, names: Collection[str]) -> dict[str, Tensor]:
        """Outputs of a view by name, (H, W, ...); an unknown one is refused before anything is rendered."""
        outputs = {name: self.output(name) for name in names}
        view = self.look(camera)
        with torch.no_grad():
            return {name: output.compute(view) for name, output in outputs.items()}

    @torch.no_grad()
    def probe(self, camera: Cameras, column: int, row: int) -> Probe:
        """What is seen in a pixel: the same numbers as in a render of the whole view."""
        one = one_pixel(camera, column, row).to(self.device)
        found, materials = self.look(one).coefficients.flatten(), self.materials
        opacity = float(found.accumulation)
        diffuse, specular = materials.diffuse(found), materials.specular(found)
        place = None
        if opacity > 0:
            rays = one.image_rays(0)
            place = _row(rays.at(found.ray_distance))
        seen = Probe(
            {
                "predicted": _row(diffuse + specular),
                "diffuse": _row(diffuse),
                "specular": _row(specular),
                "abundances": _row(found.abundances) / max(opacity, 1e-6),
                "scaled_abundances": _row(found.scaled_abundances),
            },
            opacity,
            place,
            None if place is None else self.frame.to_world(place[None])[0],
        )
        return self._with_errors(seen)

    def _with_errors(self, probe: Probe) -> Probe:
        """The same that knows how far it is expected to be off, or why that is unknown, for people."""
        errors, spectrum = self.errors, probe.values["predicted"] / max(probe.opacity, 1e-6)
        if isinstance(errors, str) or probe.position is None:
            return replace(probe, errors=errors if isinstance(errors, str) else "nothing is there")
        place = (torch.from_numpy(one) for one in (probe.position, probe.abundances, spectrum))
        return replace(probe, errors=errors.at(*(one.to(errors.origin) for one in place)))

    def interval(self, probe: Probe, name: str, coverage: float = COVERAGE) -> Interval:
        """Where an output at a place lies, with this probability; where that is unknown, the interval says why.

        Outputs are `abundances`, `abundance:0`, `spectral`, `band:650nm`, `reflectance`, and numbers of reflectance
        such as `index:ndvi`; of light, it is that of what is seen, as if it were opaque.

        Errors are those of `output`, and a ConfigError where the output has no intervals.
        """
        require_coverage(coverage)
        ends = interval_ends(name, self.materials)
        if isinstance(probe.errors, str) or probe.opacity < OCCUPIED_ACCUMULATION:
            reason = probe.errors if isinstance(probe.errors, str) else "hardly anything is there"
            return Interval.unknown(np.zeros(()), coverage, reason)
        return as_interval(name, ends(seen_place(probe, probe.errors), coverage), probe.errors, coverage)

    def endmember_interval(self, coverage: float = COVERAGE) -> Interval:
        """Where each endmember lies in each band, (K, B), radiance under the scene's light and as bright as it is; of
        those that are not determined it says why. A ConfigError where there is none of that coverage."""
        require_coverage(coverage)
        errors, spectra = self.errors, self.materials.endmembers.detach().double().cpu().numpy()
        if isinstance(errors, str):
            return Interval.unknown(spectra, coverage, errors)
        return Interval.of_endmembers(spectra, errors.endmember_deviations.double().cpu().numpy(), coverage)

    @torch.no_grad()
    def probe_point(self, x: float, y: float, z: float) -> Probe:
        """What a point of the world in the scene box is made of, lit head-on, without the view-dependent part."""
        world = np.array([x, y, z], dtype=np.float64)
        place = self.frame.to_model(world)
        inside = torch.from_numpy(place).float()[None].to(self.device)
        if not bool(self.scene_box.contains(inside).all()):
            corners = np.stack(np.meshgrid(*self.scene_box.aabb.T.cpu().double().numpy()), -1).reshape(-1, 3)
            world_corners = self.frame.to_world(corners)
            least, greatest = world_corners.min(axis=0), world_corners.max(axis=0)
            raise ConfigError(
                f"the point {_text(world)} is outside the scene box, which lies between {_text(least)} and "
                f"{_text(greatest)} of the world"
            )
        density, features = self.field.get_density(inside)
        none = torch.zeros(1, dtype=torch.int64, device=self.device)
        here = RayBundle(inside, torch.zeros_like(inside), none)
        normals = self.renderer.normals(self.field, here, inside.new_zeros(1))
        outputs = self.field.get_outputs(inside, -normals, features)
        is_there = self.renderer.is_occupied(inside).to(density)
        predicted = is_there[:, None] * (outputs["scaled_abundances"] @ self.materials.endmembers)
        found = Probe(
            {
                "predicted": _row(predicted),
                "abundances": _row(is_there[:, None] * outputs["abundances"]),
                "scaled_abundances": _row(is_there[:, None] * outputs["scaled_abundances"]),
            },
            float(is_there * -torch.expm1(-density * self.pixel_size)),
            place,
            world,
        )
        return self._with_errors(found)

    def to(self, device: torch.device | str) -> TrainedScene:
        """The same scene on another device; `self` stays where it is."""
        if torch.device(device) == self.device:
            return self
        renderer = with_cells(self.renderer, lambda cells: cells.to(device))
        renderer = replace(renderer, space=replace(renderer.space, box=self.scene_box.to(device)))
        field = copy.deepcopy(self.field).to(device)
        unedited, errors = None if self.unedited is None else self.unedited.to(device), self.measured_errors
        return replace(
            self,
            field=field,
            renderer=renderer,
            materials=self.materials.to(device),
            unedited=unedited,
            measured_errors=errors if isinstance(errors, str) else errors.map(lambda one: one.to(device)),
        )


_NUM_CAMERAS = 6
_NUM_RAYS = 6000
"""Of reference rays: through so many of the training cameras, about so many in all."""


@torch.no_grad()
def reference_rays(scene: TrainedScene, cameras: Cameras) -> tuple[Coefficients, Float[Tensor, "N 3"]]:
    """Coefficients of rays through some of the cameras, spread over all, and where they end, model space.

    Colours of pictures are chosen by them, so that they mean the same from everywhere.
    """
    step, cameras = max(1, len(cameras) // _NUM_CAMERAS), cameras.one_size()
    chosen = range(0, len(cameras), step)[:_NUM_CAMERAS]
    aspect = cameras.width / cameras.height
    height = max(1, min(cameras.height, int((_NUM_RAYS / len(chosen) / aspect) ** 0.5)))
    parts, points = [], []
    for index in chosen:
        camera = cameras[index].resized(max(1, round(aspect * height)), height)
        seen = scene.look(camera, subpixels=1).coefficients.flatten()
        rays = camera.to(scene.device).image_rays(0)
        parts.append(seen.map(lambda packed, is_seen=seen.is_occupied: packed[is_seen]))
        points.append(rays.at(seen.ray_distance)[seen.is_occupied])
    return Coefficients.concatenate(parts), torch.cat(points)


def judged_together(outputs: Collection[Output], views: Sequence[RenderedView]) -> dict[str, Output]:
    """By name: the outputs whose numbers are judged against all views, rather than each against itself; principal
    components against the training views, as everywhere."""
    seen = [view for view in views if isinstance(view, MaterialView)]
    found: dict[str, Output] = {}
    for output in outputs:
        if not seen or not isinstance(output, MaterialOutput):
            continue
        scene = seen[0].scene
        if output.name == "pca":
            rays, _ = reference_rays(scene, cameras_of(scene.views, "train"))
            found["pca"] = output.with_components(components_of(scene.materials, rays))
        elif output.score is not None:
            rows = [
                view.materials.reflectance(view.coefficients)[view.coefficients.is_occupied] for view in seen
            ]
            found[output.name] = output.judged_against(torch.cat(rows))
    return found
