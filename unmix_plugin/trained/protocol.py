"""What every method offers of a trained scene: outputs by name, render, probe, and where it lies.

A method that gives this gets `unmix-render`, the viewer and `unmix-eval`. `trained_scene.TrainedScene` is that of
unmix-nerf; `model_scene.ModelScene` serves any model that names its outputs.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.outputs import Output
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.intervals import COVERAGE, Interval, require_coverage
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Materials
from unmix_plugin.trained.intervals import SeenPlaces, as_interval
from unmix_plugin.trained.place_errors import LocalErrors
from unmix_plugin.trained.run_views import RunView


@dataclass(frozen=True)
class Probe:
    """What a scene shows in one pixel, or is at one point."""

    values: dict[str, Float64[np.ndarray, " n"]]
    """By name: of unmix-nerf `predicted`, `diffuse` and `specular` radiance on black (B), and `abundances` of what is
    there (K), summing to 1."""
    opacity: float
    """[0, 1]."""
    position: Float64[np.ndarray, "3"] | None
    """Of the surface in the pixel, or the point, model space; None where nothing is."""
    world_position: Float64[np.ndarray, "3"] | None
    """The same in the world of the scene's transforms.json."""
    errors: LocalErrors | str = "the method measures no errors"
    """How far it is expected to be off, or why that is unknown, for people."""

    @property
    def spectra(self) -> dict[str, Float64[np.ndarray, " B"]]:
        """`predicted` radiance on black, and its parts."""
        names = ("predicted", "diffuse", "specular")
        return {name: self.values[name] for name in names if name in self.values}

    @property
    def abundances(self) -> Float64[np.ndarray, " K"]:
        """Of what is there, summing to 1; 0 where nothing is."""
        return self.values["abundances"]

    def interval(
        self, name: Literal["abundances", "predicted"] = "abundances", coverage: float = COVERAGE
    ) -> Interval:
        """Where each abundance lies, or the radiance of each band, with this probability; where that is unknown, the
        interval says why. A ConfigError where there is none of that name or coverage."""
        require_coverage(coverage)
        if name not in ("abundances", "predicted"):
            raise ConfigError(f"a probe has intervals of abundances and predicted; found {name!r}")
        values, errors = self.values[name], self.errors
        if isinstance(errors, str) or self.opacity < OCCUPIED_ACCUMULATION:
            reason = errors if isinstance(errors, str) else "hardly anything is there"
            return Interval.unknown(values, coverage, reason)
        seen = seen_place(self, errors)
        ends = seen.of_abundances(coverage) if name == "abundances" else seen.of_spectra(coverage)
        found = as_interval(name, ends, errors, coverage)
        if name == "abundances":
            return found
        return replace(found, low=found.low * self.opacity, high=found.high * self.opacity)


def seen_place(probe: Probe, errors: LocalErrors) -> SeenPlaces:
    """What a probe shows, as intervals are made of it."""
    device = errors.spectra.device
    spectrum = torch.from_numpy(probe.values["predicted"] / max(probe.opacity, 1e-6)).to(device)
    abundances = torch.from_numpy(probe.values["abundances"]).to(device)
    return SeenPlaces(spectrum, abundances, torch.tensor(probe.opacity, device=device), errors)


@runtime_checkable
class RenderedView(Protocol):
    """One view of one `camera`, rendered once; all its outputs follow from that.

    Of (H, W) pixels, in [0, 1]: `opacity`, and `coverage`, how much of a pixel shows something, a sky included; nothing
    shines through that part.
    """

    @property
    def camera(self) -> Cameras: ...

    @property
    def opacity(self) -> Tensor: ...

    @property
    def coverage(self) -> Tensor: ...

    def __getitem__(self, name: str) -> Tensor:
        """An output by its name; a ConfigError where there is none."""
        ...


@runtime_checkable
class RenderableScene(Protocol):
    """A trained scene of any method; a value that nothing changes."""

    @property
    def scene_box(self) -> SceneBox:
        """What is modelled, model space."""
        ...

    @property
    def frame(self) -> Normalisation:
        """From the world of the scene's transforms.json to model space."""
        ...

    @property
    def views(self) -> tuple[RunView, ...]:
        """Training views, then evaluation views, with their cameras."""
        ...

    @property
    def device(self) -> torch.device:
        """Where it is rendered."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user has to be told of it."""
        ...

    @property
    def bands(self) -> Bands | None:
        """Of its spectra; None where it has none, or no wavelengths of them are known."""
        ...

    @property
    def materials(self) -> Materials | None:
        """Its endmembers and the light that they are seen in; None where it is not made of mixed materials."""
        ...

    @property
    def pixel_size(self) -> float | None:
        """Edge of a pixel of its views in the middle of the scene, model units; None where that is unknown."""
        ...

    @property
    def fitted(self) -> tuple[Literal["pose", "gain"], ...]:
        """What training found for each of its views."""
        ...

    @property
    def lit_head_on(self) -> RenderableScene:
        """The same scene as if a lamp that moves with the camera shone on every place head-on and cast no shadow, for
        what no camera looks at from one place; itself without such a lamp."""
        ...

    @property
    def outputs(self) -> tuple[Output, ...]:
        """All outputs that take no argument, in the order in which they are offered."""
        ...

    def output(self, name: str) -> Output:
        """An output by its name, which may have an argument as in `band:650nm`.

        Raises:
            ConfigError: there is none, or its argument can't be read.
            SpectrumError: the bands don't cover what it needs.
        """
        ...

    def look(self, camera: Cameras, subpixels: int | None = None) -> RenderedView:
        """Render a view; `subpixels` squared rays per pixel, None for as many as in training."""
        ...

    def render(self, camera: Cameras, names: Collection[str]) -> dict[str, Tensor]:
        """Outputs of a view by name, (H, W, ...)."""
        ...

    def probe(self, camera: Cameras, column: int, row: int) -> Probe:
        """What is seen in a pixel; a ConfigError where it is outside the image."""
        ...
