"""Where the path tracer gets materials from: one family, and its parameters at points of a mesh."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.family import MaterialFamily


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
