"""What is composited along rays, the spectra that it is multiplied with, and every picture that follows from both.

A ray's diffuse spectrum is linear in the endmembers, sum_i w_i E^T S_i a_i = E^T sum_i w_i S_i a_i. So a renderer
composites 2 + 2 K + J numbers per ray, one packed tensor, and the B bands are made once a ray.

Notation: `B` bands, `K` endmembers, `J` spectra of the specular dictionary, `C` columns of a matrix on spectra, `*rays`
any leading axes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import colour_mode, rgb_matrix
from unmix_plugin.spectral.colour.names import colour_words, numbered_words
from unmix_plugin.spectral.colour.srgb import encode_srgb
from unmix_plugin.spectral.library.material_library import DARK_LIGHT
from unmix_plugin.spectral.library.spectra_csv import SpectraTable
from unmix_plugin.spectral.segmentation import material_ids, material_scores

_WHITE = 1e-3
"""Power of every band differs from 1 by no more where radiance is reflectance."""
OCCUPIED_ACCUMULATION = 0.5
"""A ray shows a material only where at least this much of it ends on something."""


@dataclass(frozen=True)
class Coefficients:
    """Weighted sums over the samples of each ray."""

    packed: Float[Tensor, "*rays C"]
    """Accumulation, distance, K abundances, K scaled abundances, J specular coefficients."""
    num_endmembers: int
    """K."""

    @staticmethod
    def of(
        accumulation: Float[Tensor, "*rays"],
        distance: Float[Tensor, "*rays"],
        abundances: Float[Tensor, "*rays K"],
        scaled_abundances: Float[Tensor, "*rays K"],
        specular: Float[Tensor, "*rays J"],
    ) -> Coefficients:
        """Pack the parts, as the properties of the same names give them back."""
        columns = [accumulation[..., None], distance[..., None], abundances, scaled_abundances, specular]
        return Coefficients(torch.cat(columns, dim=-1), abundances.shape[-1])

    @property
    def accumulation(self) -> Float[Tensor, "*rays"]:
        """Opacity, [0, 1]."""
        return self.packed[..., 0]

    @property
    def distance(self) -> Float[Tensor, "*rays"]:
        """Sum of weight times distance along the ray, model units."""
        return self.packed[..., 1]

    @property
    def abundances(self) -> Float[Tensor, "*rays K"]:
        """a, summing to the accumulation."""
        return self.packed[..., 2 : 2 + self.num_endmembers]

    @property
    def scaled_abundances(self) -> Float[Tensor, "*rays K"]:
        """S a: what the endmembers are multiplied with."""
        return self.packed[..., 2 + self.num_endmembers : 2 + 2 * self.num_endmembers]

    @property
    def specular(self) -> Float[Tensor, "*rays J"]:
        """h u: what the specular dictionary is multiplied with; J = 0 without a view-dependent part."""
        return self.packed[..., 2 + 2 * self.num_endmembers :]

    @property
    def ray_distance(self) -> Float[Tensor, "*rays"]:
        """Mean distance along the ray to what it ends on, model units; 0 where nothing is."""
        return self.distance / self.accumulation.clamp(min=1e-6)

    @property
    def is_occupied(self) -> Bool[Tensor, "*rays"]:
        """Rays that show a material."""
        return self.accumulation > OCCUPIED_ACCUMULATION

    def before(self, sky: Float[Tensor, "*rays C"]) -> tuple[Coefficients, Float[Tensor, "*rays K"]]:
        """With the light of what is infinitely far away, K abundances and their factor, and no more opacity; and the
        abundances of all that is seen, the sky's among them."""
        first = 2 + self.num_endmembers
        transmittance = (1 - self.packed[..., 0])[..., None]
        packed = self.packed.clone()
        packed[..., first : first + self.num_endmembers] += transmittance * sky[..., -1:] * sky[..., :-1]
        return replace(self, packed=packed), self.packed[..., 2:first] + transmittance * sky[..., :-1]

    def map(self, function: Callable[[Tensor], Tensor]) -> Coefficients:
        """The same after a change of leading axes, device or dtype."""
        return replace(self, packed=function(self.packed))

    def unflatten(self, height: int, width: int) -> Coefficients:
        """Rays in rows as an image."""
        return self.map(lambda packed: packed.unflatten(0, (height, width)))

    def flatten(self) -> Coefficients:
        """An image as rays in rows."""
        return self.map(lambda packed: packed.flatten(0, -2))

    @staticmethod
    def concatenate(parts: Sequence[Coefficients]) -> Coefficients:
        """The rays of all parts, in order."""
        return Coefficients(torch.cat([part.packed for part in parts]), parts[0].num_endmembers)


def seen_reflectance(
    spectra: Float[Tensor, "*rays B"], opacity: Float[Tensor, "*rays"], light: Float[Tensor, "B"] | None
) -> Float[Tensor, "*rays B"]:
    """Reflectance of what is seen, from radiance on black times its opacity; radiance where the light is unknown.

    NaN where less than `OCCUPIED_ACCUMULATION` is seen, and in bands that the light (relative power) leaves dark, as
    `DARK_LIGHT` says.
    """
    is_seen = (opacity >= OCCUPIED_ACCUMULATION)[..., None]
    radiance = torch.where(is_seen, spectra / opacity.clamp(min=1e-6)[..., None], torch.nan)
    if light is None:
        return radiance
    power = light.to(radiance)
    return radiance / torch.where(power > DARK_LIGHT * power.max(), power, torch.nan)


SegmentationMethod = Literal["abundances", "probe"]


@cache
def default_names(count: int) -> tuple[str, ...]:
    """Names of materials of which no colour is known.

    >>> default_names(2)
    ('material 1', 'material 2')
    """
    return numbered_words(["material"] * count)


_BY_NUMBER = re.compile(r"(?:endmember[_ ])?(\d{1,9})")
"""An endmember by its number, or by the name that it had in earlier releases."""


def find_endmember(asked: str, names: Sequence[str]) -> int | None:
    """The number of the endmember of a name, or whose number is asked for; None where there is none.

    Args:
        asked: A name, a number from 0 such as `1`, or `endmember_1`, as the second was called in earlier releases.

    >>> names = ("tan 1", "green 1")
    >>> [find_endmember(asked, names) for asked in ("green 1", "1", "endmember_0", "blue 1")]
    [1, 1, 0, None]
    """
    if asked in names:
        return names.index(asked)
    by_number = _BY_NUMBER.fullmatch(asked)
    return int(by_number[1]) if by_number and int(by_number[1]) < len(names) else None


@dataclass(frozen=True)
class Materials:
    """Endmembers with names, the specular dictionary, and the light that they are seen in."""

    bands: Bands
    endmembers: Float[Tensor, "K B"]
    """Radiance in the scene's light."""
    specular_spectra: Float[Tensor, "J B"]
    segmentation: SegmentationMethod = "abundances"
    """How a ray's material is chosen: its largest abundance, or as published the endmember of smallest angle to the
    ray's spectrum."""
    names: tuple[str, ...] = ()
    """One for each endmember, distinct. None given: `default_names`; `called_by_colour` gives better ones."""
    light: Float[Tensor, "B"] | None = None
    """Relative power of the light that the spectra are seen in; None where it is unknown."""
    is_light_assumed: bool = False
    """Whether `light` was lit in place of an unknown one, which was taken as flat."""
    light_name: str | None = None
    """Of the light that was lit in place of the recorded one; None: it is the recorded one."""
    margin_error: Float[Tensor, ""] | None = None
    """Standard error of the margin of the largest abundance over the second; None where it is unknown."""
    sensor: str | None = None
    """Name of another camera whose channels the bands are; None: they are the run's own."""

    def __post_init__(self) -> None:
        count = len(self.endmembers)
        if not self.names:
            object.__setattr__(self, "names", default_names(count))
        if len(set(self.names)) != count or len(self.names) != count:
            raise SpectrumError(f"{count} endmembers need {count} distinct names; found {list(self.names)}")

    @property
    def is_light_known(self) -> bool:
        """Whether radiance over `light` is reflectance."""
        return self.light is not None and not self.is_light_assumed

    @property
    def quantity(self) -> Literal["reflectance", "radiance"]:
        """What the spectra are: reflectance where the light is known to be 1 in every band, as after a white reference;
        radiance otherwise, as in a flat light in which a white is darker than 1."""
        if self.light is None or not self.is_light_known:
            return "radiance"
        return "reflectance" if bool(((self.light - 1).abs() <= _WHITE).all()) else "radiance"

    @property
    def is_lit(self) -> Bool[Tensor, "B"]:
        """Bands with light enough, `DARK_LIGHT`, to compare reflectances in; all where the light is unknown."""
        light = self.endmembers.new_ones(len(self.bands)) if self.light is None else self.light
        return light > DARK_LIGHT * light.max()

    def called_by_colour(self) -> Materials:
        """The same with names by which people tell them: the word for the colour that each has in the scene's light,
        and a number; unchanged where the bands see no colours."""
        if colour_mode(self.bands) != "true-colour":
            return self
        linear = self.endmembers.detach().cpu().double().clamp(min=0) @ rgb_matrix(self.bands, torch.float64)
        srgb = encode_srgb(linear.clamp(0, 1).numpy())
        return replace(self, names=numbered_words(colour_words(srgb)))

    def table(self) -> SpectraTable:
        """The endmembers with their names: spectra under the scene's light, [0, 1]."""
        return SpectraTable(self.bands, self.names, self.endmembers.detach().to("cpu", torch.float64).numpy())

    def to(self, device: torch.device | str) -> Materials:
        """The same spectra on another device, without gradients."""
        moved = {
            name: getattr(self, name).detach().to(device)
            for name in ("endmembers", "specular_spectra", "light", "margin_error")
            if getattr(self, name) is not None
        }
        return replace(self, **moved)

    def diffuse(self, coefficients: Coefficients) -> Float[Tensor, "*rays B"]:
        """Spectra on black without the view-dependent part."""
        return coefficients.scaled_abundances @ self.endmembers

    def specular(self, coefficients: Coefficients) -> Float[Tensor, "*rays B"]:
        """Spectra of the view-dependent part; zero without one."""
        return coefficients.specular @ self.specular_spectra

    def spectra(self, coefficients: Coefficients) -> Float[Tensor, "*rays B"]:
        """Spectra seen along the rays, on black."""
        diffuse = coefficients.scaled_abundances @ self.endmembers
        return diffuse + coefficients.specular @ self.specular_spectra

    def through(
        self,
        coefficients: Coefficients,
        matrix: Float[Tensor, "B C"],
        *,
        diffuse: bool = True,
        specular: bool = True,
    ) -> Float[Tensor, "*rays C"]:
        """Spectra times a matrix, without ever making the spectra: a linear map commutes with mixing."""
        matrix = matrix.to(self.endmembers)
        parts = []
        if diffuse:
            parts.append(coefficients.scaled_abundances @ (self.endmembers @ matrix))
        if specular:
            parts.append(coefficients.specular @ (self.specular_spectra @ matrix))
        return torch.stack(parts).sum(dim=0)

    def reflectance(self, coefficients: Coefficients) -> Float[Tensor, "*rays B"]:
        """Reflectance of what is seen, as `seen_reflectance` defines it."""
        return self.reflectance_of(self.spectra(coefficients), coefficients.accumulation)

    def reflectance_of(
        self, spectra: Float[Tensor, "*rays B"], opacity: Float[Tensor, "*rays"]
    ) -> Float[Tensor, "*rays B"]:
        """The same of spectra on black that were computed before, on any device."""
        return seen_reflectance(spectra, opacity, self.light)

    def scores(self, coefficients: Coefficients) -> Float[Tensor, "*rays K"]:
        """What the material of a ray is chosen by: abundances, or cosines to the endmembers."""
        if self.segmentation == "abundances":
            return coefficients.abundances
        return self.scores_of(self.spectra(coefficients), coefficients.abundances)

    def scores_of(
        self, spectra: Float[Tensor, "*rays B"], abundances: Float[Tensor, "*rays K"]
    ) -> Float[Tensor, "*rays K"]:
        """The same of spectra and abundances on any device."""
        if self.segmentation == "abundances":
            return abundances
        return material_scores(spectra, self.endmembers.detach().to(spectra))

    def name_of(self, spectrum: Float[np.ndarray, " B"], abundances: Float[np.ndarray, " K"]) -> str:
        """Name of the material of one place, chosen as in segmentations."""
        scores = self.scores_of(torch.from_numpy(spectrum).float(), torch.from_numpy(abundances))
        return self.names[int(scores.argmax())]

    def ids(self, coefficients: Coefficients) -> UInt8[Tensor, "*rays"]:
        """Material of each ray, 255 where nothing is."""
        return material_ids(self.scores(coefficients), coefficients.accumulation, OCCUPIED_ACCUMULATION)

    def confidence(self, coefficients: Coefficients) -> Float[Tensor, "*rays"]:
        """Estimated probability that the material of `ids` is right, 0 where nothing is.

        By its margin in abundance over the best other material, which has a normal error; the margin itself where that
        error is unknown.
        """
        abundances, accumulation = coefficients.abundances, coefficients.accumulation
        if abundances.shape[-1] == 1:
            return coefficients.is_occupied.to(accumulation)
        chosen = self.scores(coefficients).argmax(dim=-1, keepdim=True)
        own = abundances.gather(-1, chosen)[..., 0]
        others = abundances.scatter(-1, chosen, -torch.inf).amax(dim=-1)
        margin = (own - others) / accumulation.clamp(min=OCCUPIED_ACCUMULATION)
        if self.margin_error is not None:
            margin = torch.special.ndtr(margin / self.margin_error.clamp(min=1e-3))
        return margin.clamp(min=0) * coefficients.is_occupied
