"""A trained scene of any model that names its outputs, for methods that bring no scene of their own.

And what a scene may offer beside the common protocol: another light, and pictures that are estimates."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.model import Model
from unmix_plugin.engine.outputs import Output, named_output
from unmix_plugin.engine.runs.loading import SceneRecord
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.protocol import Probe, RenderableScene
from unmix_plugin.trained.run_views import RunView, recorded_views, world_frame
from unmix_plugin.trained.trained_scene import one_pixel


@dataclass(frozen=True)
class ModelView:
    """A rendered view: all that the model gives of it."""

    camera: Cameras
    tensors: dict[str, Tensor]
    num_estimates: int = 1
    """Independent estimates that it is the mean of."""
    num_wanted: int = 1
    """How many of them make a finished view."""

    def averaged(self, other: ModelView) -> ModelView:
        """The mean of this view and another estimate of it, each weighted by the estimates in it; ids stay."""
        count = self.num_estimates + other.num_estimates
        part = other.num_estimates / count
        tensors = {
            name: torch.lerp(values, other.tensors[name], part) if values.is_floating_point() else values
            for name, values in self.tensors.items()
        }
        return replace(self, tensors=tensors, num_estimates=count)

    @property
    def opacity(self) -> Tensor:
        """(H, W), [0, 1]; 1 where the model has no output `accumulation`."""
        if "accumulation" in self.tensors:
            return self.tensors["accumulation"]
        first = next(iter(self.tensors.values()))
        return torch.ones(self.camera.height, self.camera.width, device=first.device)

    @property
    def coverage(self) -> Tensor:
        """The opacity."""
        return self.opacity

    def __getitem__(self, name: str) -> Tensor:
        """An output by its name."""
        return self.tensors[name]


@dataclass(frozen=True, eq=False)
class ModelScene:
    """The protocol of a trained scene over a model's own outputs."""

    model: Model
    frame: Normalisation
    views: tuple[RunView, ...]
    outputs: tuple[Output, ...]
    notes: tuple[str, ...] = ()
    bands: Bands | None = None
    materials: Materials | None = None
    pixel_size: float | None = None
    fitted: tuple[Literal["pose", "gain"], ...] = ()

    @property
    def scene_box(self) -> SceneBox:
        """What is modelled, model space."""
        return self.model.scene_box

    @property
    def device(self) -> torch.device:
        """Where it is rendered."""
        return self.model.device

    @property
    def lit_head_on(self) -> ModelScene:
        """Itself: no lamp moves with the camera."""
        return self

    def output(self, name: str) -> Output:
        """As the protocol has it."""
        return named_output(self.outputs, name)

    def look(self, camera: Cameras, subpixels: int | None = None) -> ModelView:
        """Render all outputs of a view, one ray a pixel."""
        names = [output.name for output in self.outputs]
        return ModelView(camera, self.model.get_outputs_for_camera(camera, names))

    def render(self, camera: Cameras, names: Collection[str]) -> dict[str, Tensor]:
        """Outputs of a view by name, (H, W, ...)."""
        known = [self.output(name).name for name in names]
        return self.model.get_outputs_for_camera(camera, known)

    def probe(self, camera: Cameras, column: int, row: int) -> Probe:
        """All outputs in one pixel."""
        view = self.look(one_pixel(camera, column, row))
        values = {
            name: tensor.detach().reshape(-1).double().cpu().numpy() for name, tensor in view.tensors.items()
        }
        position = world = None
        if "ray_distance" in values:
            rays = view.camera.to("cpu").image_rays(0)
            position = (rays.origins + values["ray_distance"][0] * rays.directions)[0].double().numpy()
            world = self.frame.to_world(position[None])[0]
        return Probe(values, float(view.opacity.reshape(-1)[0]), position, world)


def model_scene(
    model: Model, record: SceneRecord, averages: Mapping[str, Tensor] | None = None
) -> ModelScene:
    """The scene of a model, which must name outputs, as it is now; training that goes on does not change it."""
    if not model.outputs:
        raise ConfigError(
            f"{type(model).__name__} names no outputs that could be shown: give its class `outputs`, a tuple of "
            "unmix_plugin.engine.Output (docs/guides/plugins.md, What other methods get)"
        )
    still = copy.deepcopy(model, model.frozen_parameters(averages)).eval()  # type: ignore[arg-type]
    nm = model.metadata.get("wavelengths_nm")
    bands = None if nm is None else Bands.of(nm)
    return ModelScene(still, world_frame(record), recorded_views(record), still.outputs, bands=bands)


@dataclass(frozen=True)
class LightChoice:
    """A light from far away, and how it is turned."""

    name: str | None = None
    """One of a scene's `lights`, or the path of an environment map; None: the light of its pictures."""
    rotation_deg: float = 0.0
    """Turns it further about the world's +z, counter-clockwise seen from above."""
    exposure_stops: float = 0.0
    """Makes it brighter by so many stops."""


@runtime_checkable
class RelightableScene(RenderableScene, Protocol):
    """A scene whose light can be exchanged."""

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the lights that it has; the first is that of its pictures."""
        ...

    def with_light(self, choice: LightChoice) -> RelightableScene:
        """The same scene under another light.

        Raises:
            ConfigError: there is no such light.
            SceneError: the file of an environment map is missing, damaged or unusable.
        """
        ...


@runtime_checkable
class EstimatedScene(RenderableScene, Protocol):
    """A scene whose pictures are random estimates, which become finer the more of them are averaged."""

    @property
    def num_estimates(self) -> int:
        """How many of them a finished picture takes."""
        ...

    def estimate(self, camera: Cameras, subpixels: int, number: int) -> ModelView:
        """A view with few samples; those of other numbers, from 0, are independent of it."""
        ...


def lights_of(scene: RenderableScene) -> tuple[str, ...]:
    """Names of the lights that a scene can be shown in beside files of environments; none where its light is fixed."""
    return scene.lights if isinstance(scene, RelightableScene) else ()


def relit(scene: RenderableScene, choice: LightChoice, method_name: str) -> RelightableScene:
    """A scene under another light, as its `with_light`; a ConfigError where its method has none from far away."""
    if not isinstance(scene, RelightableScene):
        raise ConfigError(
            f"the method {method_name} has no environment that could be exchanged: --environment needs a run of a "
            "method that separates light and material"
        )
    return scene.with_light(choice)
