"""The field as the method's paper and its authors' code have it, for the method `unmix-nerf-published`.

Notation: `S` samples, `K` endmembers, `B` bands. A hash grid gives density and geometry features g; with a positional
encoding PE of the point, one network gives abundances and the tint h, another a scale for each endmember in (0, 1).
The view-dependent spectrum sees direction and PE only, one value a band.

Source: Perez et al. 2025, section 3, and the authors' code. docs/method.md lists what still differs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.engine.instantiate import Target
from unmix_plugin.field import (
    NUM_DIRECTION_FEATURES,
    CoefficientField,
    UnmixFieldConfig,
    bounded_exp,
    direction_features,
)
from unmix_plugin.rendering.hash_encoding import HashGridLayout, hash_encode

_NUM_FREQUENCIES = 2
_NUM_POSITION_FEATURES = 3 * 2 * _NUM_FREQUENCIES


@dataclass(frozen=True)
class PublishedFieldConfig(UnmixFieldConfig):
    """Sizes as published; `cells_per_pixel`, `scale` and `specular_bias` have no effect here."""

    _target: Target = field(default_factory=lambda: PublishedField)
    num_levels: int = 16
    features_per_level: int = 2
    log2_rows_per_level: int = 19
    finest_resolution: int = 2048
    """Cells along the scene box's longest edge on the finest level."""
    temperature: float = 0.4


class PublishedField(CoefficientField):
    """Density, abundances, scales and one view-dependent value a band, of points in a scene box."""

    aabb: Tensor

    def __init__(
        self,
        config: PublishedFieldConfig,
        scene_box: SceneBox,
        num_endmembers: int,
        num_specular: int,
        initial_density: float,
        pixel_size: float,
    ) -> None:
        """
        Args:
            config: Sizes.
            scene_box: Where the field is defined, model space.
            num_endmembers: K.
            num_specular: B, or 0 without a view-dependent part.
            initial_density: Density of the untrained field, per model unit.
            pixel_size: Not used: sizes are as published, whatever the images.
        """
        super().__init__()
        self.config = config
        self.num_specular, self.num_endmembers = num_specular, num_endmembers
        self.log_initial_density = math.log(initial_density)
        self.layout = HashGridLayout(
            config.num_levels,
            config.features_per_level,
            config.coarsest_resolution,
            config.finest_resolution,
            config.log2_rows_per_level,
        )
        self.register_buffer("aabb", scene_box.aabb.clone())
        table = torch.empty(self.layout.num_rows, config.features_per_level)
        self.table = nn.Parameter(nn.init.uniform_(table, -1e-4, 1e-4))
        self.num_encoded = config.num_levels * config.features_per_level
        width, num_features = config.hidden_width, config.num_features + _NUM_POSITION_FEATURES
        self.density_network = _network(self.num_encoded, [width], 1 + config.num_features)
        self.material_network = _network(num_features, [width, width], num_endmembers + 1)
        self.scale_network = _network(num_features, [width, width], num_endmembers)
        if num_specular:
            seen = NUM_DIRECTION_FEATURES + 1 + _NUM_POSITION_FEATURES
            self.specular_network = _network(seen, [16], num_specular)

    def encode(
        self, positions: Float[Tensor, "S 3"], known: Float[Tensor, "S L"] | None = None
    ) -> Float[Tensor, "S L"]:
        """Hash encoding of positions, then PE; `known` as `hash_encode` takes it."""
        unit_positions = (positions - self.aabb[0]) / (self.aabb[1] - self.aabb[0])
        first = None if known is None else known[:, : self.num_encoded].contiguous()
        return torch.cat(
            [hash_encode(unit_positions, self.table, self.layout, first), _position_features(positions)], -1
        )

    def get_density(self, positions: Float[Tensor, "S 3"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        """Density per model unit; g and PE."""
        return self.density_of(self.encode(positions))

    def density_of(self, encoded: Float[Tensor, "S L"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        """The same where the encoding is known."""
        features = self.density_network(encoded[:, : self.num_encoded])
        density = bounded_exp(features[:, 0] + self.log_initial_density)
        return density, torch.cat([features[:, 1:], encoded[:, self.num_encoded :]], dim=-1)

    def get_outputs(
        self,
        positions: Float[Tensor, "S 3"],
        directions: Float[Tensor, "S 3"],
        features: Float[Tensor, "S G"],
    ) -> dict[str, Tensor]:
        """`abundances` (S, K), `scaled_abundances` S a (S, K) and `specular_coefficients` h u (S, B)."""
        logits = self.material_network(features)
        abundances = torch.softmax(logits[:, :-1] / self.config.temperature, dim=-1)
        scales = torch.sigmoid(self.scale_network(features))
        return {
            "abundances": abundances,
            "scaled_abundances": scales * abundances,
            "specular_coefficients": self._specular(directions, features, torch.sigmoid(logits[:, -1:])),
        }

    def abundances_of(self, features: Float[Tensor, "S G"]) -> Float[Tensor, "S K"]:
        """Abundances a of points with these features, summing to 1."""
        return torch.softmax(self.material_network(features)[:, :-1] / self.config.temperature, dim=-1)

    def _specular(
        self, directions: Float[Tensor, "S 3"], features: Float[Tensor, "S G"], tint: Float[Tensor, "S 1"]
    ) -> Float[Tensor, "S B"]:
        if self.num_specular == 0:
            return features.new_zeros(len(features), 0)
        seen = [
            torch.ones_like(tint),
            direction_features(directions),
            features[:, -_NUM_POSITION_FEATURES:],
        ]
        return tint * torch.sigmoid(self.specular_network(torch.cat(seen, dim=-1)))


def _position_features(positions: Float[Tensor, "S 3"]) -> Float[Tensor, "S 12"]:
    """Sines and cosines of 2 pi times 1 and 2 periods a unit, of uncontracted positions."""
    angles = torch.cat([2 * math.pi * 2.0**power * positions for power in range(_NUM_FREQUENCIES)], dim=-1)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def _network(num_inputs: int, widths: list[int], num_outputs: int) -> nn.Sequential:
    """Linear layers without biases, with a ReLU between them."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(num_inputs, width, bias=False), nn.ReLU(inplace=True)]
        num_inputs = width
    return nn.Sequential(*layers, nn.Linear(num_inputs, num_outputs, bias=False))
