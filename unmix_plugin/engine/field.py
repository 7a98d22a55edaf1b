"""The interface of a field: what is at a position, and how it looks from a direction."""

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn


class Field(nn.Module, ABC):
    """A function of space with parameters."""

    @abstractmethod
    def get_density(self, positions: Float[Tensor, "*samples 3"]) -> tuple[Float[Tensor, "*samples"], Tensor]:
        """Density (per scene unit, >= 0) at `positions` in model space, and features for `get_outputs`."""

    @abstractmethod
    def get_outputs(
        self,
        positions: Float[Tensor, "*samples 3"],
        directions: Float[Tensor, "*samples 3"],
        features: Tensor,
    ) -> dict[str, Tensor]:
        """What the field says at `positions` seen along unit `directions`, given the features of `get_density`."""

    def forward(
        self, positions: Float[Tensor, "*samples 3"], directions: Float[Tensor, "*samples 3"]
    ) -> tuple[Float[Tensor, "*samples"], dict[str, Tensor]]:
        """Densities and outputs."""
        densities, features = self.get_density(positions)
        return densities, self.get_outputs(positions, directions, features)
