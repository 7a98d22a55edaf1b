"""Where the path tracer gets materials from: one family, and its parameters at points of a mesh.

The parameters of an object lie in three planes of features, read by two small networks.

Notation: `N` points in model space, where the mesh lies in [-1, 1]^3; `P` parameters of a material; `C` channels and
`R` texels along an edge of a plane. Plane 0 is XY, plane 1 YZ, plane 2 XZ; the first letter runs along a plane's
columns, the second along its rows. The first texel lies at -1, the last at +1, and points outside read the border.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from unmix_plugin.neumatex.tracing.families import MaterialFamily

NUM_CHANNELS = 12
"""Channels of a plane, as published."""
_NUM_FREQUENCIES = 3
"""Bands of the positional encoding, as published."""
PLANE_AXES = ((0, 1), (1, 2), (0, 2))
"""Axes of the model that run along the columns and the rows of XY, YZ, XZ."""
LOG_VARIANCE_RANGE = (-9.0, 0.0)
"""Least and largest log-variance of a parameter: standard deviations of 0.011 and 1, the parameters being in [0, 1]."""
_WIDTH = 64


@runtime_checkable
class Surface(Protocol):
    """A mesh's materials."""

    @property
    def family(self) -> MaterialFamily:
        """The reflectances that the parameters stand for."""
        ...

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters of the material at surface points, [0, 1]; differentiable.

        Args:
            positions: Model space, where the mesh fits in [-1, 1]^3.
        """
        ...


@dataclass(frozen=True)
class TriplaneSurface:
    """A `Surface` of a family, its parameters looked up in a triplane."""

    family: MaterialFamily
    triplane: Triplane

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        return self.triplane.parameters_at(positions)


class Readers(nn.Module):
    """Two networks that read features of points: the material's parameters, and how wrong they may be."""

    def __init__(
        self,
        num_parameters: int,
        generator: torch.Generator | None = None,
        num_shares: int = 0,
        mixes_others: bool = False,
    ) -> None:
        """Random networks.

        Args:
            num_parameters: P.
            generator: Draws the weights.
            num_shares: How many of the first parameters are shares, which sum to 1.
            mixes_others: Whether the parameters after the shares are mixed by these of one set per share, in place of
                being free at every point.
        """
        super().__init__()
        inputs = 3 * NUM_CHANNELS + 3 + 6 * _NUM_FREQUENCIES
        self.num_parameters = num_parameters
        self.num_shares = num_shares
        read = num_shares if mixes_others else num_parameters
        self.material_network = _network(inputs, read, generator)
        others = torch.zeros(num_shares, num_parameters - num_shares)
        self.others_of_shares = nn.Parameter(others) if mixes_others else None
        """Logits."""
        self.variance_network = _network(inputs, num_parameters, generator)

    def material(self, features: Float[Tensor, "N F"]) -> Float[Tensor, "N P"]:
        """Parameters in (0, 1) of points whose `plane_features` are given."""
        raw = self.material_network(features)
        if not self.num_shares:
            return torch.sigmoid(raw)
        logits, others = raw.tensor_split([self.num_shares], dim=-1)
        shares, others = torch.softmax(logits, dim=-1), torch.sigmoid(others)
        if self.others_of_shares is not None:
            others = shares @ torch.sigmoid(self.others_of_shares)
        return torch.cat([shares, others], dim=-1)

    def log_variance(self, features: Float[Tensor, "N F"]) -> Float[Tensor, "N P"]:
        """Log-variances within `LOG_VARIANCE_RANGE` of points whose `plane_features` are given."""
        return bounded_log_variance(self.variance_network(features))


class Triplane(nn.Module):
    """Parameters of a material and their log-variance at points of one object."""

    def __init__(
        self,
        num_parameters: int,
        resolution: int = 128,
        generator: torch.Generator | None = None,
        num_shares: int = 0,
        mixes_others: bool = False,
    ) -> None:
        """A random material, nearly the same everywhere.

        Args:
            num_parameters: P; 9 for the neural material, 5 for base colour, roughness and metallicity.
            resolution: R, at least 2.
            generator: Draws the planes and the networks.
            num_shares, mixes_others: As of `Readers`.
        """
        super().__init__()
        texels = (3, NUM_CHANNELS, resolution, resolution)
        self.planes = nn.Parameter(0.1 * torch.randn(texels, generator=generator))
        self.readers = Readers(num_parameters, generator, num_shares, mixes_others)

    @staticmethod
    def filled(readers: Readers, planes: Float[Tensor, "3 C R R"], resolution: int) -> Triplane:
        """Planes in a resolution of its own with copies of the networks that read them."""
        triplane, size = Triplane(readers.num_parameters, resolution), (resolution, resolution)
        triplane.readers.load_state_dict(readers.state_dict())
        if planes.shape[-1] != resolution:
            planes = functional.interpolate(planes, size, mode="bilinear", align_corners=True)
        with torch.no_grad():
            triplane.planes.copy_(planes)
        return triplane

    def parameters_at(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters of the material in (0, 1); differentiable by planes and networks."""
        return self.readers.material(plane_features(self.planes, positions))

    def log_variance(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Logarithm of the expected squared error of each parameter, within `LOG_VARIANCE_RANGE`."""
        return self.readers.log_variance(plane_features(self.planes, positions))


def plane_features(planes: Float[Tensor, "3 C R R"], positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N F"]:
    """What the networks read: 3 C numbers of the planes, the position, and its sines and cosines."""
    return torch.cat([look_up(planes, positions), positions, encode(positions)], dim=-1)


def look_up(planes: Float[Tensor, "3 C R R"], positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3*C"]:
    """Bilinear look-ups in the three planes, one after the other."""
    places = torch.stack([positions[:, list(axes)] for axes in PLANE_AXES])[:, None]
    found = functional.grid_sample(planes, places, padding_mode="border", align_corners=True)
    return found[:, :, 0].permute(2, 0, 1).flatten(1)


def encode(positions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n E"]:
    """Sines and cosines of the position times pi, 2 pi and 4 pi: 18 numbers."""
    angles = torch.cat([positions * (math.pi * 2.0**band) for band in range(_NUM_FREQUENCIES)], dim=-1)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def bounded_log_variance(raw: Float[Tensor, "*n P"]) -> Float[Tensor, "*n P"]:
    """Log-variances within `LOG_VARIANCE_RANGE` from any numbers."""
    low, high = LOG_VARIANCE_RANGE
    return low + (high - low) * torch.sigmoid(raw)


def _network(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Sequential:
    sizes = [inputs, _WIDTH, _WIDTH, _WIDTH, outputs]
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        is_last = len(layers) == 2 * (len(sizes) - 2)
        layer = nn.Linear(before, after, device="meta").to_empty(device="cpu")  # no global random numbers
        bound = (3 if is_last else 6) ** 0.5 / before**0.5
        nn.init.uniform_(layer.weight, -bound, bound, generator)
        nn.init.zeros_(layer.bias)
        layers += [layer] if is_last else [layer, nn.ReLU()]
    return nn.Sequential(*layers)
