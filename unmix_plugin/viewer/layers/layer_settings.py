"""What a user has chosen to see, and what layers need to know of the run beside the view itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.pca import PcaColours
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.viewer.inputs import choice, number, text
from unmix_plugin.viewer.layers.painting import BACKGROUNDS, COLOUR_MAPS
from unmix_plugin.viewer.layers.view_transforms import VIEW_TRANSFORMS, ViewTransform
from unmix_plugin.viewer.rendering.reference import Reference

EXPOSURE_BOUNDS, GAMMA_BOUNDS = (-8.0, 8.0), (0.2, 5.0)
_WAVELENGTH_BOUNDS = (1.0, 1e5)
_VALUE_BOUNDS = (-1e6, 1e6)
_LONGEST_INDEX = 1000
"""Letters that are kept: more than a formula may have, so that none becomes another one by being cut."""
_MOST_REMEMBERED = 32
_ValueT = TypeVar("_ValueT")


@dataclass(frozen=True)
class LayerSettings:
    """What is shown and how; every value lies within bounds."""

    layer: str = "rgb"
    wavelength_nm: float = 550.0
    """Of the layer `band`."""
    false_colour_nm: tuple[float, float, float] = (650.0, 550.0, 450.0)
    """Shown as red, green, blue by the layer `false-colour`."""
    endmember: int = 0
    """Of the layer `abundance`."""
    index: str = ""
    """Of the layer `index`: a name or a formula, as the output `index:` takes it; empty where none is chosen."""
    colour_map: str = "viridis"
    value_range: tuple[float, float] | None = None
    """Values at the ends of the colour map; None for the layer's own."""
    exposure_ev: float = 0.0
    """Stops."""
    gamma: float = 1.0
    view_transform: ViewTransform = "srgb"
    background: str = "grey"
    """Where nothing is seen; one of `BACKGROUNDS`."""

    def changed(self, name: str, value: Any) -> LayerSettings:
        """With one setting as a browser sent it, brought within its bounds; what makes no sense changes nothing."""
        return replace(self, **{name: _CHECKS[name](value, getattr(self, name))})


def first_settings(bands: Bands) -> LayerSettings:
    """What a page shows at first; false colour from the middles of the long, middle and short third of the bands."""
    centers_nm, count = bands.centers_nm.tolist(), len(bands)
    starts = (centers_nm[5 * count // 6], centers_nm[count // 2], centers_nm[count // 6])
    return LayerSettings(false_colour_nm=starts, index=next(iter(available_indices(bands)), ""))


def _checked_range(value: Any, before: tuple[float, float] | None) -> tuple[float, float] | None:
    if value is None:
        return None
    try:
        low, high = (number(part, *_VALUE_BOUNDS, fallback=math.nan) for part in value)
    except (TypeError, ValueError):
        return before
    return (low, high) if low < high else before


def _checked_wavelengths(value: Any, before: tuple[float, float, float]) -> tuple[float, float, float]:
    try:
        red, green, blue = value
    except (TypeError, ValueError):
        return before
    checked = [
        number(one, *_WAVELENGTH_BOUNDS, fallback=old)
        for one, old in zip((red, green, blue), before, strict=True)
    ]
    return (checked[0], checked[1], checked[2])


_CHECKS: dict[str, Callable[[Any, Any], Any]] = {
    "layer": lambda value, before: value if isinstance(value, str) and len(value) < 100 else before,
    "wavelength_nm": lambda value, before: number(value, *_WAVELENGTH_BOUNDS, fallback=before),
    "false_colour_nm": _checked_wavelengths,
    "endmember": lambda value, before: int(number(value, 0, 254, fallback=before)),
    "index": lambda value, before: (
        " ".join(text(value).split())[:_LONGEST_INDEX] if isinstance(value, str) else before
    ),
    "colour_map": lambda value, before: choice(value, COLOUR_MAPS, before),
    "value_range": _checked_range,
    "exposure_ev": lambda value, before: number(value, *EXPOSURE_BOUNDS, fallback=before),
    "gamma": lambda value, before: number(value, *GAMMA_BOUNDS, fallback=before),
    "view_transform": lambda value, before: choice(value, VIEW_TRANSFORMS, before),
    "background": lambda value, before: choice(value, BACKGROUNDS, before),
}

ErrorOf = Callable[[MaterialView], tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"], str]]
"""A view's error against the nearest training view, where it is known, and that view's name."""


@dataclass(frozen=True)
class LayerAids:
    """What layers need to know of the run."""

    reference: Reference
    scene_box: SceneBox
    error_of: ErrorOf | None = None
    why_no_error: str = "the scene is not at hand"
    _kept: dict[tuple[str, bytes], Any] = field(default_factory=dict, repr=False, compare=False)

    def colours_of(self, materials: Materials) -> Float[Tensor, "K 3"]:
        """sRGB colours that stand for the materials, as in all pictures of a run."""
        return self._remembered(
            "colours",
            materials,
            lambda: torch.as_tensor(endmember_colours(materials)).to(materials.endmembers),
        )

    def pca_of(self, materials: Materials) -> PcaColours:
        """Principal components of what the reference rays show with the materials."""
        return self._remembered("pca", materials, lambda: PcaColours.fit(self.reference.spectra(materials)))

    def depth_range(self, frame: MaterialView) -> tuple[float, float]:
        """Distances between which the scene box lies, world units."""
        aabb, scale = self.scene_box.aabb.cpu(), frame.scene.frame.scale
        middle, radius = aabb.mean(dim=0), float((aabb[1] - aabb[0]).norm()) / 2
        distance = float((frame.camera.camera_to_world[0, :, 3].cpu() - middle).norm())
        return (max(0.0, distance - radius) / scale, (distance + radius) / scale)

    def _remembered(self, what: str, materials: Materials, make: Callable[[], _ValueT]) -> _ValueT:
        """What `make` gives, remembered for the materials that clients look at."""
        spectra = torch.cat([materials.endmembers, materials.specular_spectra])
        key = (what, spectra.cpu().numpy().tobytes())
        found = self._kept.get(key)  # looked up once: another thread may clear what is kept at any moment
        if found is None:
            if len(self._kept) >= _MOST_REMEMBERED:
                self._kept.clear()
            found = self._kept[key] = make()
        return found
