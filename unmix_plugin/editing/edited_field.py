"""A field of which some materials are gone and others have another gloss.

Notation: `S` samples, `K` endmembers, `J` specular coefficients, `G` mirrors. A material that is removed is
transparent: density is multiplied with a function of the share that is kept, which is 0 up to a quarter and 1 from
three quarters on, and abundances of what is left are renormalised. A plain product with the share would leave
everything where it is: unmixing sees a trace of each material everywhere, and a trace of a dense surface is opaque.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.field import CoefficientField
from unmix_plugin.light.lamp import MovingLamp
from unmix_plugin.light.shading import Lamplight

_GONE_SHARE, _WHOLE_SHARE = 0.25, 0.75
"""Kept share of a point up to which nothing of it is left, and from which it is as dense as before."""

_SMALLEST_SHARE = 1e-6


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
        self._removes = not bool(is_kept.all())

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

    def sky(self, directions: Float[Tensor, "R 3"]) -> Float[Tensor, "R C"] | None:
        """The sky, without the light that removed materials stand for."""
        found = self.field.sky(directions)
        if found is None:
            return None
        return torch.cat([found[:, :-1] * self.is_kept.to(found), found[:, -1:]], dim=-1)

    def get_density(self, positions: Float[Tensor, "S 3"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        """Density per scene unit of what is left, and geometry features."""
        return self.density_of(self.encode(positions))

    def density_of(self, encoded: Float[Tensor, "S LF"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S G"]]:
        """The same where the encoding is known."""
        densities, features = self.field.density_of(encoded)
        if self._removes:
            kept_share = self.field.abundances_of(features) @ self.is_kept.to(features)
            densities = densities * _left_of(kept_share)
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


def _left_of(kept_share: Float[Tensor, "S"]) -> Float[Tensor, "S"]:
    """Factor on the density: a cubic with level ends."""
    t = ((kept_share - _GONE_SHARE) / (_WHOLE_SHARE - _GONE_SHARE)).clamp(0, 1)
    return t * t * (3 - 2 * t)
