"""The field as the method's paper and its authors' code have it, for the method `unmix-nerf-published`.

Notation: `S` samples, `K` endmembers, `B` bands. A hash grid gives density and geometry features g; with a positional
encoding PE of the point, one network gives abundances and the tint h, another a scale for each endmember in (0, 1).
The view-dependent spectrum sees direction and PE only, one value a band.

Source: Perez et al. 2025, section 3, and the authors' code. docs/background/method.md lists what still differs.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.field import NUM_FEATURES, FieldSpace, GridField
from unmix_plugin.light.shading import (
    NUM_DIRECTION_FEATURES,
    Lamplight,
    bias_free_network,
    direction_features,
)
from unmix_plugin.settings import UnmixFieldConfig

_NUM_FREQUENCIES = 2
_NUM_POSITION_FEATURES = 3 * 2 * _NUM_FREQUENCIES


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
        super().__init__(config, space, num_endmembers)
        self.num_specular = num_specular
        width, num_features = config.hidden_width, NUM_FEATURES + _NUM_POSITION_FEATURES
        self.material_network = bias_free_network(num_features, width, width, num_endmembers + 1)
        self.scale_network = bias_free_network(num_features, width, width, num_endmembers)
        if num_specular:
            seen = NUM_DIRECTION_FEATURES + 1 + _NUM_POSITION_FEATURES
            self.specular_network = bias_free_network(seen, 16, num_specular)
        self._add_sky()

    def encode(
        self, positions: Float[Tensor, "S 3"], known: Float[Tensor, "S L"] | None = None
    ) -> Float[Tensor, "S L"]:
        """The hash grid's encoding of positions, then PE; `known` as `hash_encode` takes it."""
        first = None if known is None else known[:, : self.num_encoded].contiguous()
        return torch.cat([self.encoded(positions, first), _position_features(positions)], -1)

    def density_of(self, encoded: Float[Tensor, "S L"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        """Density per scene unit; g and PE."""
        density, raw = self.density_and_raw(encoded[:, : self.num_encoded])
        return density, torch.cat([raw[:, 1:], encoded[:, self.num_encoded :]], dim=-1)

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


def _position_features(positions: Float[Tensor, "S 3"]) -> Float[Tensor, "S 12"]:
    """Sines and cosines of 2 pi times 1 and 2 periods a unit, of uncontracted positions."""
    angles = torch.cat([2 * math.pi * 2.0**power * positions for power in range(_NUM_FREQUENCIES)], dim=-1)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
