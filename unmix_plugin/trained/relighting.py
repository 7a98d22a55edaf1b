"""What a scene offers beside the common protocol if its light can be exchanged or its pictures are estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.model_scene import ModelView
from unmix_plugin.trained.protocol import RenderableScene


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


def relit(scene: RenderableScene, choice: LightChoice, method_name: str) -> RelightableScene:
    """A scene under another light.

    Raises:
        ConfigError: its method has no light from far away, or there is no such light.
        SceneError: the file of an environment map is missing, damaged or unusable.
    """
    if not isinstance(scene, RelightableScene):
        raise ConfigError(
            f"the method {method_name} has no environment that could be exchanged: --environment needs a run of a "
            "method that separates light and material"
        )
    return scene.with_light(choice)
