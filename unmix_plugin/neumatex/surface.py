"""Where the path tracer gets materials from: one family, and its parameters at points of a mesh."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.family import DecodableFamily, MaterialFamily


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
class DecodedSurface:
    """The same materials, their parameters decoded where they are looked up; see `Surface`."""

    encoded: Surface
    decodable: DecodableFamily
    """Of `encoded`."""

    @property
    def family(self) -> MaterialFamily:
        """Of the decoded parameters."""
        return self.decodable.decoded_family

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Decoded parameters at surface points."""
        return self.decodable.decoded(self.encoded.parameters(positions))


def decoded_once(surface: Surface) -> Surface:
    """The same materials so that a network, where the family has one, is evaluated once a point, not once a
    direction."""
    family = surface.family
    return DecodedSurface(surface, family) if isinstance(family, DecodableFamily) else surface
