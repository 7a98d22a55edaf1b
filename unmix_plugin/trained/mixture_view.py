"""A rendered view of mixed materials, an output of it with its function, and what pictures of outputs are painted from.

Notation: `H x W` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.outputs import Output
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients, Materials
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.intervals import SeenPlaces
from unmix_plugin.trained.protocol import RenderedView
from unmix_plugin.trained.reflectance_maps import ReflectanceMap, Score


class MixtureView(ABC):
    """What outputs of mixed materials are computed from: a view of one camera, (H, W, ...)."""

    coefficients: Coefficients

    @property
    @abstractmethod
    def materials(self) -> Materials:
        """The spectra that the coefficients are multiplied with."""

    @property
    @abstractmethod
    def opacity(self) -> Tensor:
        """[0, 1]."""

    @property
    @abstractmethod
    def coverage(self) -> Tensor:
        """How much of a pixel shows something, [0, 1]."""

    @property
    @abstractmethod
    def spectra(self) -> Tensor:
        """Radiance on black."""

    @property
    @abstractmethod
    def ray_distance(self) -> Tensor:
        """Along the ray, world units; 0 where nothing is."""

    @property
    @abstractmethod
    def depth(self) -> Tensor:
        """Along the viewing axis, world units; 0 where nothing is."""

    @property
    @abstractmethod
    def normals(self) -> Tensor:
        """Unit vectors in world axes; 0 where nothing is."""

    @property
    @abstractmethod
    def unexplained(self) -> Tensor:
        """Part of what was measured that no mixture of the materials gives, [0, 1]; NaN where that is unknown."""

    @property
    @abstractmethod
    def has_removed(self) -> bool:
        """Whether the scene is shown without some of its materials."""

    @property
    @abstractmethod
    def seen_places(self) -> SeenPlaces:
        """What is seen in each pixel, and how far it is expected to be off; a ConfigError where that is unknown."""

    @abstractmethod
    def map(self, function: Callable[[Tensor], Tensor]) -> MixtureView:
        """The same view with its coefficients on another device, or of some rows."""


Capability: TypeAlias = Literal["light", "training views"]
"""What a scene may lack that an output needs: a known light, a comparison with what its training views measured."""


_LEAST_SEEN = 1e-3
"""Opacity under which nothing can be said of what is seen."""


@dataclass(frozen=True)
class MaterialOutput(Output):
    """An output of a scene of mixed materials, with its function."""

    compute: Callable[[MixtureView], Tensor] = field(kw_only=True)
    """From a rendered view to (H, W, ...)."""
    needs: frozenset[Capability] = field(default=frozenset(), kw_only=True)
    fewest_bands: int = field(default=1, kw_only=True)
    """With light, that it takes."""
    light: Callable[[MixtureView], Tensor] | None = field(default=None, kw_only=True)
    """Of outputs that are cut at white: the linear light before that, which pictures are painted from."""
    score: ReflectanceMap | None = field(default=None, kw_only=True)
    """Of outputs that are made of reflectance."""

    def judged_against(self, background: Float[Tensor, "N B"]) -> MaterialOutput:
        """The same where what is seen is judged against reflectances of all views, rather than of the view itself."""
        if self.score is None:
            return self
        score = self.score.fit(background)
        return replace(self, compute=lambda view: scored(view, score))

    def with_components(self, colours: PcaColours) -> MaterialOutput:
        """The output `pca` with the components of all views, rather than of the view itself."""
        return replace(self, compute=lambda view: shown_components(view, colours))


@dataclass(frozen=True)
class PictureValues:
    """What a picture of an output is painted from."""

    output: Output
    values: Tensor
    """(H, W, ...)."""
    opacity: Float[Tensor, "H W"]
    """How much of each pixel they fill, [0, 1]: light also comes from a sky."""

    @property
    def seen(self) -> Tensor:
        """The numbers of what is seen, where something is."""
        is_there, values = self.opacity > OCCUPIED_ACCUMULATION, self.values
        if self.output.is_premultiplied or self.output.kind == "grey":
            parts = self.opacity.clamp(min=_LEAST_SEEN)
            values = values / parts.view(*parts.shape, *(1,) * (values.dim() - parts.dim()))
        return values[is_there]


@torch.no_grad()
def values_of(view: RenderedView, output: Output) -> Tensor:
    """The numbers of an output of a view, (H, W, ...)."""
    if isinstance(output, MaterialOutput) and isinstance(view, MixtureView):
        return output.compute(view)
    return view[output.name]


_TRACE_OPACITY = 0.25
"""Opacity under which a pixel counts as empty once materials are removed: these leave faint specks where they were
mixed with others."""


@torch.no_grad()
def picture_values(view: RenderedView, output: Output) -> PictureValues:
    """What a picture of an output is painted from: its numbers, or the light before it is cut at white."""
    if not isinstance(output, MaterialOutput) or not isinstance(view, MixtureView):
        return _filled(view, output, view[output.name])
    mixture: MixtureView = view
    if mixture.has_removed:
        is_there = (mixture.opacity >= _TRACE_OPACITY)[..., None]
        mixture = mixture.map(lambda packed: packed * is_there)
    if output.light is not None:
        return _filled(mixture, replace(output, kind="linear"), output.light(mixture))
    return _filled(mixture, output, output.compute(mixture))


def _filled(view: RenderedView | MixtureView, output: Output, values: Tensor) -> PictureValues:
    if output.name == "accumulation":  # opacity itself is shown everywhere, also where there is little of it
        return PictureValues(output, values, torch.ones_like(view.opacity))
    is_light = output.kind in ("srgb", "linear", "grey", "channels")
    return PictureValues(output, values, view.coverage if is_light else view.opacity)


def shown_components(view: MixtureView, colours: PcaColours) -> Tensor:
    """Principal components of what is seen, stretched to [0, 1]; 0 where nothing is."""
    opacity = view.opacity[..., None]
    seen = view.materials.through(view.coefficients, colours.axes) / opacity.clamp(min=_LEAST_SEEN)
    components = seen - colours.mean @ colours.axes
    stretched = (components - colours.low) / (colours.high - colours.low).clamp(min=1e-9)
    return stretched.clamp(0, 1) * (opacity >= _LEAST_SEEN)


def components_of(materials: Materials, seen: Coefficients) -> PcaColours:
    """Principal components of the spectra of rays that end on something, as if each ended fully on it."""
    return PcaColours.fit(materials.spectra(seen) / seen.accumulation[..., None])


_CHUNK = 1 << 16
"""Pixels whose spectra are held at once."""


def scored(view: MixtureView, score: Score) -> Tensor:
    """Numbers made of reflectance, chunk by chunk: the spectra of a whole picture may not fit into memory."""
    rows = view.coefficients.flatten()
    chunks = [rows.map(lambda _, part=part: part) for part in rows.packed.split(_CHUNK)]
    return torch.cat([score(view.materials.reflectance(chunk)) for chunk in chunks]).view(view.opacity.shape)


def usual_range(values: Float[Tensor, "*values"], low_at_most: float = math.inf) -> tuple[float, float]:
    """From the 1st percentile of what is known, or `low_at_most` if that is less, to the 99th; never empty."""
    known = values[values.isfinite()].float()
    if len(known) == 0:
        return 0.0, 1.0
    low, high = torch.quantile(known, known.new_tensor([0.01, 0.99])).tolist()
    low = min(low, low_at_most)
    return low, high if high - low > 1e-6 * max(abs(low), abs(high)) else low + max(1.0, abs(low))
