"""A mesh's materials as the path tracer reads them: a family, and the triplane that holds its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.neumatex.materials.family import MaterialFamily
from unmix_plugin.neumatex.materials.neural import NeuralFamily
from unmix_plugin.neumatex.materials.pbr import PbrFamily
from unmix_plugin.neumatex.triplane import Triplane

MaterialName = Literal["neural", "pbr"]
"""Families that can be trained."""


@dataclass(frozen=True)
class TriplaneSurface:
    """Materials of a family, their parameters looked up in a triplane; see `surface.Surface`."""

    family: MaterialFamily
    triplane: Triplane

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters at points of model space, (0, 1)."""
        return self.triplane.parameters_at(positions)


def material_family(name: MaterialName) -> MaterialFamily:
    """The family of that name; the neural one with the shipped decoder.

    Raises:
        ConfigError: the shipped decoder can't be read.
    """
    families: dict[MaterialName, type] = {"neural": NeuralFamily, "pbr": PbrFamily}
    return families[name]()


def frozen_parts(family: MaterialFamily) -> dict[str, nn.Module]:
    """Networks of a family by name, which have to be on the model's device and stay as they are."""
    parts = {name: getattr(family, name, None) for name in ("decoder", "encoder")}
    return {name: part.requires_grad_(False) for name, part in parts.items() if isinstance(part, nn.Module)}
