"""A mesh's materials as the path tracer reads them: a family, and the triplane that holds its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.neumatex.materials.family import MaterialFamily
from unmix_plugin.neumatex.materials.layered import LayeredFamily
from unmix_plugin.neumatex.materials.neural import NeuralFamily
from unmix_plugin.neumatex.materials.pbr import PbrFamily
from unmix_plugin.neumatex.materials.spectral import SpectralFamily
from unmix_plugin.neumatex.triplane import Triplane

MaterialName = Literal["neural", "pbr", "spectral"]
"""Families that can be trained."""
PLAIN_GLOSS = (0.5, 0.2)
"""Roughness and specular level of a common dielectric, half rough."""
_START_RANGE = (0.05, 0.95)
"""Of parameters, away from where a sigmoid has no slope."""
_START_PLANES = 0.2
"""Of the planes' random values: texels that few pixels see keep theirs, which shows as grain."""
_START_SPREAD = 0.3
"""Of the last layer's random weights."""


@dataclass(frozen=True)
class TriplaneSurface:
    """Materials of a family, their parameters looked up in a triplane; see `surface.Surface`."""

    family: MaterialFamily
    triplane: Triplane

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters at points of model space, (0, 1)."""
        return self.triplane.parameters_at(positions)


def material_family(
    name: MaterialName,
    endmembers: Float[Tensor, "K B"] | None = None,
    gains: Float[Tensor, " K"] | None = None,
) -> MaterialFamily:
    """The family of that name; the neural one with the shipped decoder, the spectral one with these endmembers and
    gains.

    Raises:
        ConfigError: the shipped decoder can't be read.
    """
    if endmembers is not None:
        return SpectralFamily(endmembers, gains)
    families: dict[MaterialName, type] = {"neural": NeuralFamily, "pbr": PbrFamily}
    return families[name]()


def plain_parameters(family: MaterialFamily) -> Float[Tensor, "P"]:
    """Parameters of a rough grey surface that is not metal and has no layers: where a fit without a prior starts.

    From the middle of all parameters, which is half a metal, a fit puts the colours of what is diffuse into what the
    metal reflects.
    """
    if isinstance(family, NeuralFamily):
        layered = torch.zeros(1, LayeredFamily.num_parameters)
        layered[0, :3], layered[0, 4:6] = 0.5, 0.5
        return family.from_layered(layered)[0].clamp(*_START_RANGE)
    if isinstance(family, SpectralFamily):
        shares = torch.full((family.num_endmembers,), 1 / family.num_endmembers)
        return torch.cat([shares, torch.tensor(PLAIN_GLOSS)])
    return torch.tensor([0.5, 0.5, 0.5, 0.5, 0.0]).clamp(*_START_RANGE)


def start_plain(triplane: Triplane, family: MaterialFamily) -> None:
    """Make a new triplane give the plain material nearly everywhere."""
    network = next(part for name, part in triplane.named_modules() if name.endswith("material_network"))
    *_, last = network.children()
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        triplane.planes.mul_(_START_PLANES)
        last.weight.mul_(_START_SPREAD)
        plain = plain_parameters(family)
        raw = plain.logit()
        if triplane.num_shares:
            raw[: triplane.num_shares] = plain[: triplane.num_shares].log()
        last.bias.copy_(raw)


def frozen_parts(family: MaterialFamily) -> dict[str, nn.Module]:
    """Networks of a family by name, which have to be on the model's device and stay as they are."""
    parts = {name: getattr(family, name, None) for name in ("decoder", "encoder")}
    return {name: part.requires_grad_(False) for name, part in parts.items() if isinstance(part, nn.Module)}
