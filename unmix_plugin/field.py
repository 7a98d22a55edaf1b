"""The field of UnMix-NeRF: what a point is made of, how brightly it is lit, and what it reflects towards a direction.

Notation: `S` samples, `K` endmembers, `J` specular coefficients (spectra of a dictionary, or bands). A hash grid and a
small network give density and features g(x); heads on g give abundances a = softmax(logits / T), scales s in (0, 1) and
specular coefficients in (0, 8) that already carry the tint h.

Source: Perez et al. 2025, UnMix-NeRF, section 3; the coefficients replace the paper's spectra a sample, see model.py.

`PublishedField` is as the paper and its authors' code have it, for the method `unmix-nerf-published`: with a positional
encoding PE of the point beside g, one network gives abundances and the tint h, another a scale for each endmember in
(0, 1), and the view-dependent spectrum, one value a band (J = B), sees direction and PE only.
docs/background/method.md lists what still differs.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.engine.geometry.space import RayBundle, SceneBox, contracted_unit
from unmix_plugin.engine.model import Field
from unmix_plugin.light.lamp import Lamp, MovingLamp
from unmix_plugin.light.shading import (
    LOBES,
    NUM_BACKDROP_FEATURES,
    NUM_DIRECTION_FEATURES,
    NUM_SKY_FEATURES,
    Lamplight,
    LampShading,
    backdrop_features,
    bias_free_network,
    direction_features,
    in_parts,
    rows_of_outputs,
    sky_features,
)
from unmix_plugin.operators.hash_encoding import HashGridLayout, hash_encode
from unmix_plugin.settings import UnmixFieldConfig

_LARGEST_LOG_DENSITY = 15.0
NUM_FEATURES = 15
"""Geometry features that the heads see."""
_BRIGHTEST = 8.0
"""Of specular reflection, in the brightness at which a sensor saturates: a lamp that fills a small part of a pixel
saturates all of it. And of a sky, in that of its endmembers, which are near its mean: what is brighter must not wait at
the limit."""
_SPECULAR_BIAS = -3.0 - math.log(_BRIGHTEST)
"""Logit of the view-dependent part at the start; low, so that colour is first explained by materials."""


class CoefficientField(Field):
    """What the renderer needs of a field: densities by way of an encoding, and the coefficients of spectra."""

    @property
    def moving_lamp(self) -> MovingLamp | None:
        """The lamp that moves with the camera; None where light is fixed or its place is not known."""
        return None

    @property
    def has_sky(self) -> bool:
        """Whether something is behind all that is rendered: the sky of an unbounded world, or a backdrop."""
        return False

    @abstractmethod
    def get_outputs(
        self,
        positions: Float[Tensor, "S 3"],
        directions: Float[Tensor, "S 3"],
        features: Float[Tensor, "S G"],
        light: Lamplight | None = None,
    ) -> dict[str, Tensor]:
        """`abundances` (S, K), `scaled_abundances` (S, K) and `specular_coefficients` (S, J) along `directions`, in the
        `light` that reaches each sample of `moving_lamp`; None where there is no such lamp, or to see all places as if
        it shone on them head-on, without specular reflection."""

    @abstractmethod
    def encode(
        self, positions: Float[Tensor, "S 3"], known: Float[Tensor, "S LF"] | None = None
    ) -> Float[Tensor, "S LF"]:
        """The encoding of positions; `known` as `hash_encode` takes it."""

    @abstractmethod
    def density_of(self, encoded: Float[Tensor, "S LF"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        """Density per scene unit and geometry features where the encoding is `encoded`."""

    @abstractmethod
    def abundances_of(self, features: Float[Tensor, "S G"]) -> Float[Tensor, "S K"]:
        """Abundances a of points with these geometry features, summing to 1."""

    def sky(self, rays: RayBundle) -> Float[Tensor, "R C"] | None:
        """What is behind all that is rendered: K abundances, and what they are multiplied with; None if nothing."""
        return None

    def get_density(self, positions: Float[Tensor, "S 3"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        return self.density_of(self.encode(positions))


@dataclass(frozen=True)
class FieldSpace:
    """Where a field is defined, and how it is before training."""

    box: SceneBox
    """The scene box, model space."""
    initial_density: float
    """Density of the untrained field, per scene unit."""
    is_unbounded: bool = False
    """Whether the field is defined in all of space, contracted around the box, with a sky behind."""
    has_backdrop: bool = False
    """Whether a bounded scene has something behind it, too."""
    coarse_to_fine: bool = False
    """Whether the grid's levels have weights, as refining poses needs them."""


_NUM_FREQUENCIES = 2
_NUM_POSITION_FEATURES = 3 * 2 * _NUM_FREQUENCIES


class GridField(CoefficientField):
    """Densities and geometry features of points from a hash grid, and what is behind all of them; a kind of field adds
    heads, which lie between: random numbers are drawn for grid, heads and sky in this order."""

    origin: Tensor
    edge: Tensor
    """What is 0, and what is 1, of the coordinates that the hash grid takes, or that are contracted first."""
    level_weights: Tensor | None
    """(L), by which the grid's levels are multiplied; None where all count alike."""

    def __init__(
        self,
        config: UnmixFieldConfig,
        space: FieldSpace,
        num_endmembers: int,
        *,
        sees_positions: bool = False,
    ) -> None:
        """
        Args:
            config: Sizes, none of them `auto`.
            num_endmembers: K.
            sees_positions: Whether features have PE beside g, and not the number that density is made of.
        """
        super().__init__()
        self.sees_positions = sees_positions
        self.config, self.num_endmembers = config, num_endmembers
        self.is_unbounded, self._has_backdrop = space.is_unbounded, space.has_backdrop
        self.num_encoded = config.num_levels * config.features_per_level
        self.log_initial_density = math.log(space.initial_density)
        self.layout = HashGridLayout(
            config.num_levels,
            config.features_per_level,
            config.coarsest_resolution,
            int(config.finest_resolution) * (2 if space.is_unbounded else 1),
            int(config.log2_rows_per_level),
        )
        low, high = space.box.aabb
        self.register_buffer("aabb", space.box.aabb.clone())
        origin = (low + high) / 2 if space.is_unbounded else low.clone()
        edge = (high - low).max() / 2 if space.is_unbounded else high - low
        self.register_buffer("origin", origin, persistent=False)
        self.register_buffer("edge", edge, persistent=False)
        table = torch.empty(self.layout.num_rows, config.features_per_level)
        self.table = nn.Parameter(nn.init.uniform_(table, -1e-4, 1e-4))
        self.density_network = bias_free_network(self.num_encoded, config.hidden_width, 1 + NUM_FEATURES)
        self.register_buffer("level_weights", torch.ones(config.num_levels) if space.coarse_to_fine else None)
        self.sky_network: nn.Sequential | None = None

    def _add_sky(self) -> None:
        """The network of the sky or the backdrop, where there is one; the last that is made."""
        if self.is_unbounded or self._has_backdrop:
            num_features = NUM_SKY_FEATURES if self.is_unbounded else NUM_BACKDROP_FEATURES
            outputs = self.num_endmembers + 1
            self.sky_network = bias_free_network(num_features, self.config.hidden_width, outputs)

    @property
    def has_sky(self) -> bool:
        return self.sky_network is not None

    def encode(
        self, positions: Float[Tensor, "S 3"], known: Float[Tensor, "S L"] | None = None
    ) -> Float[Tensor, "S L"]:
        """The hash grid's encoding of positions, and PE where it is seen; `known` as `hash_encode` takes it."""
        unit = (positions - self.origin) / self.edge
        if self.is_unbounded:
            unit = contracted_unit(unit)
        if not self.sees_positions:
            return hash_encode(unit, self.table, self.layout, known)
        of_grid = None if known is None else known[:, : self.num_encoded].contiguous()
        # Sines and cosines of 2 pi times 1 and 2 periods a unit, of uncontracted positions.
        angles = torch.cat([2 * math.pi * 2.0**power * positions for power in range(_NUM_FREQUENCIES)], -1)
        encoded = hash_encode(unit, self.table, self.layout, of_grid)
        return torch.cat([encoded, torch.cat([angles.sin(), angles.cos()], dim=-1)], dim=-1)

    def density_of(self, encoded: Float[Tensor, "S L"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        """Density per scene unit; the network's outputs, of which it is the first, or g and PE."""
        of_grid = encoded[:, : self.num_encoded] if self.sees_positions else encoded
        if self.level_weights is not None:
            of_grid = of_grid * self.level_weights.repeat_interleave(self.config.features_per_level)
        features = in_parts(self.density_network, of_grid)
        raw = features[:, 0] + self.log_initial_density
        # Clamped in value only: a point that grew too dense can still become less dense.
        density = (raw + (raw.clamp(max=_LARGEST_LOG_DENSITY) - raw).detach()).exp()
        if self.sees_positions:
            features = torch.cat([features[:, 1:], encoded[:, self.num_encoded :]], dim=-1)
        return density, features

    def sky(self, rays: RayBundle) -> Float[Tensor, "R C"] | None:
        if self.sky_network is None:
            return None
        features = sky_features(rays.directions) if self.is_unbounded else backdrop_features(rays)
        found = self.sky_network(features)
        shares = torch.softmax(found[:, :-1] / self.config.temperature, dim=-1)
        brightness = _BRIGHTEST * torch.sigmoid(found[:, -1:] - math.log(_BRIGHTEST))
        return torch.cat([shares, brightness], dim=-1)


class UnmixField(GridField):
    """Density, abundances, scales and specular coefficients of points in a scene box."""

    def __init__(
        self,
        config: UnmixFieldConfig,
        space: FieldSpace,
        num_endmembers: int,
        num_specular: int,
        *,
        exposure: float = 1.0,
        lit_by_camera: bool = False,
        lamp: Lamp | None = None,
    ) -> None:
        """
        Args:
            config, space, num_endmembers: As `GridField` takes them.
            num_specular: J; 0 leaves the view-dependent part out.
            exposure: How dark the scene is: the view-dependent part starts so many times darker.
            lit_by_camera: Whether the light moves with the camera, so that scales depend on the direction of view.
            lamp: Where its lamp is at the start of training; None if that is not known.
        """
        super().__init__(config, space, num_endmembers)
        self.num_specular, self.lit_by_camera = num_specular, lit_by_camera
        self.lamp = MovingLamp(lamp) if lamp is not None and lit_by_camera else None
        self.lamp_shading: LampShading | None = None
        self.specular_bias = _SPECULAR_BIAS - math.log(exposure)
        width, num_features = config.hidden_width, 1 + NUM_FEATURES
        num_scales = 1 if config.scale == "shared" else num_endmembers
        num_seen = NUM_DIRECTION_FEATURES if self.lamp is None else len(LOBES)
        self.material_network = bias_free_network(num_features, width, num_endmembers + num_scales)
        if num_specular:
            self.specular_network = bias_free_network(num_features + num_seen, width, num_specular + 1)
        if lit_by_camera:
            self.shading_network = bias_free_network(num_features, width, NUM_DIRECTION_FEATURES)
        if self.lamp is not None:
            self.lamp_shading = LampShading(num_features, width, self.lamp.axis)
        self._add_sky()

    @property
    def moving_lamp(self) -> MovingLamp | None:
        return self.lamp

    def get_outputs(
        self,
        positions: Float[Tensor, "S 3"],
        directions: Float[Tensor, "S 3"],
        features: Float[Tensor, "S G"],
        light: Lamplight | None = None,
    ) -> dict[str, Tensor]:
        shading = self.lamp_shading
        lit = None if light is None or shading is None else shading(features, directions, light)
        material = rows_of_outputs(self.material_network, features)
        # A softmax along a last axis of a few numbers takes ten times as long.
        abundances = torch.softmax(material[: self.num_endmembers] / self.config.temperature, dim=0).t()
        scales = material[self.num_endmembers :].t()
        if self.lit_by_camera:
            # A sum over harmonics rather than a network of both: that took textures for shading.
            changes = self.shading_network(features) * direction_features(directions)
            scales = scales + changes.sum(dim=-1, keepdim=True)
        scales = torch.sigmoid(scales)
        if lit is not None:
            scales = scales * lit.brightness

        specular = features.new_zeros(len(features), 0)
        if self.num_specular:
            if self.lamp is None:
                seen = direction_features(directions)
            else:
                seen = features.new_zeros(len(features), len(LOBES)) if lit is None else lit.lobes
            logits = rows_of_outputs(self.specular_network, features, seen) + self.specular_bias / 2
            factors = torch.sigmoid(logits)
            specular = (_BRIGHTEST * factors[:1] * factors[1:]).t()
        return {
            "abundances": abundances,
            "scaled_abundances": scales * abundances,
            "specular_coefficients": specular,
        }

    def abundances_of(self, features: Float[Tensor, "S G"]) -> Float[Tensor, "S K"]:
        material = rows_of_outputs(self.material_network, features)
        return torch.softmax(material[: self.num_endmembers] / self.config.temperature, dim=0).t()


class PublishedField(GridField):
    """Density, abundances, scales and one view-dependent value a band (J = B), of points in a scene box."""

    def __init__(
        self, config: UnmixFieldConfig, space: FieldSpace, num_endmembers: int, num_specular: int
    ) -> None:
        """
        Args:
            config, space, num_endmembers: As `GridField` takes them.
            num_specular: J; 0 leaves the view-dependent part out.
        """
        super().__init__(config, space, num_endmembers, sees_positions=True)
        self.num_specular = num_specular
        width, num_features = config.hidden_width, NUM_FEATURES + _NUM_POSITION_FEATURES
        self.material_network = bias_free_network(num_features, width, width, num_endmembers + 1)
        self.scale_network = bias_free_network(num_features, width, width, num_endmembers)
        if num_specular:
            seen = NUM_DIRECTION_FEATURES + 1 + _NUM_POSITION_FEATURES
            self.specular_network = bias_free_network(seen, 16, num_specular)
        self._add_sky()

    def get_outputs(
        self,
        positions: Float[Tensor, "S 3"],
        directions: Float[Tensor, "S 3"],
        features: Float[Tensor, "S G"],
        light: Lamplight | None = None,
    ) -> dict[str, Tensor]:
        """With the tint from the network of the abundances."""
        logits = self.material_network(features)
        abundances = torch.softmax(logits[:, :-1] / self.config.temperature, dim=-1)
        scaled = torch.sigmoid(self.scale_network(features)) * abundances
        tinted = features.new_zeros(len(features), 0)
        if self.num_specular:
            tint, places = torch.sigmoid(logits[:, -1:]), features[:, -_NUM_POSITION_FEATURES:]
            seen = [torch.ones_like(tint), direction_features(directions), places]
            tinted = tint * torch.sigmoid(self.specular_network(torch.cat(seen, dim=-1)))
        return {"abundances": abundances, "scaled_abundances": scaled, "specular_coefficients": tinted}

    def abundances_of(self, features: Float[Tensor, "S G"]) -> Float[Tensor, "S K"]:
        return torch.softmax(self.material_network(features)[:, :-1] / self.config.temperature, dim=-1)
