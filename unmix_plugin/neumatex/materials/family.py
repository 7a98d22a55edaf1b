"""What a family of materials offers: evaluation and importance sampling of its reflectances.

Notation: `N` surface points, `P` parameters of a material, `C` colours or bands. Directions are unit vectors in the
local frame of a point, whose z axis is the shading normal; `wi` points to the light, `wo` to the eye.
"""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class MaterialFamily(Protocol):
    """Reflectances with a common set of parameters, each parameter in [0, 1]; differentiable by the parameters."""

    @property
    def num_parameters(self) -> int:
        """P."""
        ...

    @property
    def num_colours(self) -> int:
        """C."""
        ...

    def evaluate(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N C"]:
        """Reflectance, 1/sr, without the cosine; 0 where a direction is below the surface."""
        ...

    def sample(
        self, parameters: Float[Tensor, "N P"], wo: Float[Tensor, "N 3"], uniforms: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Directions to the light, drawn about as the reflectance times the cosine is distributed; no gradient.

        Args:
            uniforms: Independent numbers in [0, 1).
        """
        ...

    def density(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, " N"]:
        """Probability density of `sample`, 1/sr; no gradient."""
        ...

    def base_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N C"]:
        """Base colour, linear, [0, 1]: what a metal reflects, and the diffuse albedo of everything else."""
        ...


@runtime_checkable
class DecodableFamily(MaterialFamily, Protocol):
    """A family whose parameters are decoded by a network, once for all directions at a point."""

    @property
    def decoded_family(self) -> MaterialFamily:
        """The same reflectances by decoded parameters, which need no network."""
        ...

    def decoded(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N D"]:
        """Parameters of `decoded_family`; differentiable."""
        ...
