"""Reflectance, sampling and density of a layer stack over a diffuse base, in the shapes that `family` asks for."""

import math

from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.layer_stack import LayerStack


def evaluate_stack(
    stack: LayerStack, base: Float[Tensor, "N C"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
) -> Float[Tensor, "N C"]:
    """Reflectance, 1/sr: what passes the layers times the base over pi, and what they reflect."""
    passed, specular = stack.reflectance(wi.T.contiguous(), wo.T.contiguous())
    return ((passed / math.pi) * base.T + specular).T


def sample_stack(
    stack: LayerStack, base: Float[Tensor, "N C"], wo: Float[Tensor, "N 3"], uniforms: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Directions to the light, drawn from the stack's mixture of lobes."""
    wo = wo.T.contiguous()
    return stack.mixture(wo, base.T).sample(wo, uniforms.T.contiguous()).T.contiguous()


def density_of_stack(
    stack: LayerStack, base: Float[Tensor, "N C"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
) -> Float[Tensor, " N"]:
    """Density of `sample_stack`, 1/sr."""
    wo = wo.T.contiguous()
    return stack.mixture(wo, base.T).density(wi.T.contiguous(), wo)
