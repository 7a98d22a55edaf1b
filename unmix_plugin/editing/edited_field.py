"""The state of materials while a recipe changes them, how cameras see them, and the field after the change.

Cameras see an endmember shaded, under highlights and with traces of others, so that pictures of it have another colour
than its spectrum; how much is left to shading, hence how bright an endmember is, training leaves open. What pixels are
made of is linear: each channel of their mean sRGB colour rises with the same channel of the spectrum's linear colour,
and one can be solved for the other.

In the edited field a material that is removed is transparent: density is multiplied with a function of the share that
is kept, which is 0 up to a quarter and 1 from three quarters on, and abundances of what is left are renormalised. A
plain product with the share would leave everything where it is: unmixing sees a trace of each material everywhere, and
a trace of a dense surface is opaque.

Notation: `N` pixels, `S` samples, `B` bands, `K` endmembers, `J` specular coefficients, `G` mirrors; a pixel of an
endmember is one of which it has the largest share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from unmix_plugin.editing.recipe import Colour, Endmember
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.field import CoefficientField
from unmix_plugin.light.lamp import MovingLamp
from unmix_plugin.light.shading import Lamplight
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.colour.srgb import encode_srgb
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients, Materials, find_endmember
from unmix_plugin.trained.trained_scene import TrainedScene

_NUM_VIEWS = 8
_LONGEST_SIDE_PX = 32
_FEWEST_PIXELS = 16
"""Pixels of an endmember from which its look can be told."""
_LIT_QUANTILE = 0.95
"""Pixels this far up in brightness count as fully lit."""
_PURITY_EXPONENT = 4
"""Of the share, in the weight of a pixel: mixtures must not decide what the material itself looks like."""


def sample_seen(scene: TrainedScene) -> Coefficients:
    """What pixels are made of in coarse pictures of a few training views: rows of pixels (N, ...)."""
    cameras = [view.camera for view in scene.views if view.split == "train"]
    chosen = evenly_spaced(len(cameras), _NUM_VIEWS)
    found = []
    for camera in (cameras[index] for index in chosen):
        shrink = min(1.0, _LONGEST_SIDE_PX / max(camera.width, camera.height))
        width, height = (max(1, math.floor(side * shrink)) for side in (camera.width, camera.height))
        found.append(scene.look(camera.resized(width, height), subpixels=1).coefficients.flatten())
    return Coefficients.concatenate(found)


@dataclass(frozen=True)
class Appearance:
    """An endmember as cameras see it."""

    strengths: Float64[np.ndarray, " N"]
    """What its spectrum is multiplied with in each of its pixels: shading times share."""
    behind: Float64[np.ndarray, "N 3"]
    """Linear RGB of what the pixels show besides it."""
    weights: Float64[np.ndarray, " N"]
    """How much each pixel counts: the purer, the more."""

    @property
    def greatest_reflectance(self) -> float:
        """Bound of a reflectance that a fully lit pixel shows as at most 1."""
        return max(1.0, 1.0 / float(np.quantile(self.strengths, _LIT_QUANTILE)))

    def full_colour(self, srgb: Colour) -> Float64[np.ndarray, "3"]:
        """Linear RGB of the spectrum whose pixels have a wanted colour in the mean of sRGB, or come nearest to it where
        what they show besides is brighter."""
        wanted = np.array(srgb)
        low, high = np.zeros(3), np.full(3, 1.0 / self.strengths.min())
        for _ in range(60):
            middle = (low + high) / 2
            is_dark = self.mean_srgb(middle) < wanted
            low, high = np.where(is_dark, middle, low), np.where(is_dark, high, middle)
        return (low + high) / 2

    def mean_srgb(self, linear_rgb: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
        """What pixels show in the mean if the spectrum has this colour."""
        shown = np.clip(self.behind + self.strengths[:, None] * linear_rgb, 0, 1)
        return np.average(encode_srgb(shown), axis=0, weights=self.weights)


def appearance_of(state: MaterialState, index: int) -> Appearance | None:
    """How an endmember looks among the materials as they are now; None where too little of it is seen to tell."""
    seen = state.seen
    if seen is None:
        return None
    is_its = (seen.abundances.argmax(dim=-1) == index) & (seen.accumulation >= OCCUPIED_ACCUMULATION)
    is_its &= seen.scaled_abundances[..., index] > 0
    if int(is_its.sum()) < _FEWEST_PIXELS:
        return None
    scaled, specular = (_rows(values, is_its) for values in (seen.scaled_abundances, seen.specular))
    others = np.where(np.arange(scaled.shape[1]) == index, 0.0, scaled)
    spectra = others @ state.spectra + specular @ state.mirrored()[0]
    shares = _rows(seen.abundances[..., index] / seen.accumulation, is_its)
    return Appearance(
        scaled[:, index], spectra @ rgb_matrix(state.bands, torch.float64).numpy(), shares**_PURITY_EXPONENT
    )


def _rows(values: Tensor, chosen: Tensor) -> np.ndarray:
    return values[chosen].detach().double().cpu().numpy()


_GONE_SHARE, _WHOLE_SHARE = 0.25, 0.75
"""Kept share of a point up to which nothing of it is left, and from which it is as dense as before."""

_SMALLEST_SHARE = 1e-6


@dataclass
class MaterialState:
    """What edits act on; they change it in place."""

    bands: Bands
    light: Float64[np.ndarray, " B"]
    """Of the scene, relative power; flat where it is unknown."""
    names: list[str]
    spectra: Float64[np.ndarray, "K B"]
    """Radiance in the scene's light."""
    specular_spectra: Float64[np.ndarray, "J B"]
    is_kept: Bool[np.ndarray, " K"]
    """False for what is transparent."""
    gloss: Float64[np.ndarray, " K"]
    """Factor on the view-dependent part, by the share that an endmember has of a point."""
    mirrors: list[Colour | None]
    """sRGB colour that the highlights of each endmember are mirrored in."""
    mirror_reflectances: dict[Colour | None, Float64[np.ndarray, " B"]]
    """The surface that each of these colours stands for."""
    seen: Coefficients | None = None
    """What cameras see of materials and gloss as they are now, rows of pixels (N, ...); None where it is not known."""
    done: dict[tuple[str, int], str] = field(default_factory=dict)
    """Which edit did what to which endmember."""
    notes: list[str] = field(default_factory=list)
    """What the user has to be told about the result."""
    mirror_colours: dict[Colour, Colour] = field(default_factory=dict)
    """The sRGB colours that mirrors reach, by those asked for."""
    reached: dict[tuple[str, int], Colour] = field(default_factory=dict)
    """What colour an endmember got of the one asked for, by kind of edit (`retint`, `gloss`) and number."""

    @classmethod
    def of(cls, materials: Materials, light: Float64[np.ndarray, " B"] | None) -> MaterialState:
        """The materials of a model as they are, in a light (None: unknown)."""
        spectra = materials.endmembers.detach().to("cpu", torch.float64).numpy().copy()
        count = len(spectra)
        return cls(
            materials.bands,
            np.ones(len(materials.bands)) if light is None else light,
            list(materials.names),
            spectra,
            materials.specular_spectra.detach().to("cpu", torch.float64).numpy().copy(),
            np.ones(count, dtype=bool),
            np.ones(count),
            [None] * count,
            {None: np.ones(len(materials.bands))},
        )

    def mirrored(self) -> tuple[Float64[np.ndarray, "GJ B"], Float64[np.ndarray, "G K"] | None]:
        """Specular spectra mirrored in each colour, one after the other, and the gloss of each endmember in each of
        them; None where all materials have the same gloss, which the spectra describe fully."""
        colours = list(dict.fromkeys(self.mirrors))
        gloss = np.stack(
            [np.where([mirror == colour for mirror in self.mirrors], self.gloss, 0.0) for colour in colours]
        )
        mirrored = [self.mirror_reflectances[colour] * self.specular_spectra for colour in colours]
        if len(colours) == 1 and np.ptp(gloss) == 0:
            return mirrored[0] * gloss[0, 0], None
        return np.concatenate(mirrored), gloss

    @property
    def visibility(self) -> tuple[bytes, bytes | None]:
        """What coefficients of pixels depend on: which materials are kept, and the gloss of each."""
        _, gloss = self.mirrored()
        return self.is_kept.tobytes(), None if gloss is None else gloss.tobytes()

    def index_of(self, endmember: Endmember) -> int:
        """The number of an endmember.

        Raises:
            ConfigError: there is none of that name or number, with the nearest names; or two of that name.
        """
        if isinstance(endmember, int):
            if 0 <= endmember < len(self.names):
                return endmember
            raise ConfigError(f"there is no endmember {endmember}; the run has {self._listed()}")
        if self.names.count(endmember) > 1:
            raise ConfigError(f"two endmembers are called {endmember!r} here; say which by its number")
        if (found := find_endmember(endmember, self.names)) is not None:
            return found
        hint = did_you_mean(endmember, self.names, form="{} ")
        raise ConfigError(f"there is no endmember {endmember!r}; {hint}the run has {self._listed()}")

    def note(self, what: str, index: int, edit: str, refuse_after: str = "") -> None:
        """Remember that an edit did something to an endmember.

        Args:
            what: Was done, as in "replaced".
            index: Of the endmember.
            edit: Which edit did it, for messages.
            refuse_after: What must not be done before; empty for the same.
        Raises:
            ConfigError: another edit did that.
        """
        refused = refuse_after or what
        if before := self.done.get((refused, index)):
            name = self.names[index]
            raise ConfigError(
                f"{name!r} can't be {what}: {before} has it {refused} already; keep one of the two"
            )
        self.done[what, index] = edit

    def _listed(self) -> str:
        return ", ".join(f"{index} {name}" for index, name in enumerate(self.names))


class EditedField(CoefficientField):
    """Another field, seen without some of its materials and with another gloss; shares its weights."""

    is_kept: Tensor
    gloss: Tensor

    def __init__(
        self, field: CoefficientField, is_kept: Bool[Tensor, "K"], gloss: Float[Tensor, "G K"]
    ) -> None:
        """
        Args:
            field: What is edited; stays as it is.
            is_kept: False for endmembers that become transparent.
            gloss: Factor on the specular coefficients for each endmember, by its share of a point. Each row makes J
                coefficients of its own, for specular spectra that are mirrored in a colour of their own.
        """
        super().__init__()
        self.field = field
        self.register_buffer("is_kept", is_kept.clone(), persistent=False)
        self.register_buffer("gloss", gloss.clone(), persistent=False)
        self.removes = not bool(is_kept.all())
        """Whether any endmember is transparent."""

    @property
    def visibility(self) -> tuple[bytes, bytes]:
        """Equal where the same is removed, and the gloss is the same."""
        return self.is_kept.cpu().numpy().tobytes(), self.gloss.cpu().numpy().tobytes()

    @property
    def moving_lamp(self) -> MovingLamp | None:
        """That of the edited field; what is removed keeps its shadow."""
        return self.field.moving_lamp

    @classmethod
    def over(
        cls, field: CoefficientField, is_kept: Bool[Tensor, "K"], gloss: Float[Tensor, "G K"]
    ) -> EditedField:
        """The same over a field that may be edited already: both edits as one, since those of gloss do not chain."""
        if not isinstance(field, EditedField):
            return cls(field, is_kept, gloss)
        both = gloss[:, None] * field.gloss[None].to(gloss)
        return cls(field.field, is_kept & field.is_kept.to(is_kept), both.flatten(0, 1))

    def encode(
        self, positions: Float[Tensor, "S 3"], known: Float[Tensor, "S LF"] | None = None
    ) -> Float[Tensor, "S LF"]:
        """As the edited field does."""
        return self.field.encode(positions, known)

    @property
    def has_sky(self) -> bool:
        """Whether something is behind all that is rendered."""
        return self.field.has_sky

    def sky(self, rays: RayBundle) -> Float[Tensor, "R C"] | None:
        """The sky, without the light that removed materials stand for."""
        found = self.field.sky(rays)
        if found is None:
            return None
        return torch.cat([found[:, :-1] * self.is_kept.to(found), found[:, -1:]], dim=-1)

    def density_of(self, encoded: Float[Tensor, "S LF"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        """Density per scene unit of what is left, and geometry features."""
        densities, features = self.field.density_of(encoded)
        if self.removes:
            kept_share = self.field.abundances_of(features) @ self.is_kept.to(features)
            t = ((kept_share - _GONE_SHARE) / (_WHOLE_SHARE - _GONE_SHARE)).clamp(0, 1)
            densities = densities * (t * t * (3 - 2 * t))  # a cubic with level ends
        return densities, features

    def abundances_of(self, features: Float[Tensor, "S G"]) -> Float[Tensor, "S K"]:
        """Abundances of what is left, summing to 1."""
        abundances = self.field.abundances_of(features)
        return abundances * self._renormalising(abundances)

    def get_outputs(
        self,
        positions: Float[Tensor, "S 3"],
        directions: Float[Tensor, "S 3"],
        features: Float[Tensor, "S G"],
        light: Lamplight | None = None,
    ) -> dict[str, Tensor]:
        """`abundances`, `scaled_abundances` (S, K) of what is left, and `specular_coefficients` (S, G J)."""
        outputs = self.field.get_outputs(positions, directions, features, light)
        factors = self._renormalising(outputs["abundances"])
        abundances = outputs["abundances"] * factors
        shine = abundances @ self.gloss.T.to(abundances)
        specular = shine[:, :, None] * outputs["specular_coefficients"][:, None, :]
        return {
            "abundances": abundances,
            "scaled_abundances": outputs["scaled_abundances"] * factors,
            "specular_coefficients": specular.flatten(1),
        }

    def _renormalising(self, abundances: Float[Tensor, "S K"]) -> Float[Tensor, "S K"]:
        """What abundances are multiplied with, so that those of what is left sum to 1."""
        is_kept = self.is_kept.to(abundances)
        return is_kept / (abundances @ is_kept).clamp(min=_SMALLEST_SHARE)[:, None]
