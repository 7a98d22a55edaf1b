"""Neural materials: a base colour, and six latents that the shared decoder D_neu turns into reflection.

Notation as in `family`. With `passed` and `specular` decoded from the latents l,

    f = passed(l, wi, wo) base / pi + specular(l, wi, wo)

as in NeuMatEx, whose `T_neu` depends on `wi` alone; here it is a product of the same function of either direction, so
that light and eye can change places. The colour of a metal is in its latents.
"""

from copy import deepcopy

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.decoder import NUM_LATENTS, Decoder, Encoder
from unmix_plugin.neumatex.materials.decoder_weights import shipped_weights
from unmix_plugin.neumatex.materials.layer_stack import LayerStack
from unmix_plugin.neumatex.materials.layered import LayeredFamily
from unmix_plugin.neumatex.materials.stack_family import density_of_stack, evaluate_stack, sample_stack


class NeuralFamily:
    """Parameters: base colour (0 to 2, linear), latents (3 to 8, in [0, 1]); the decoder is frozen."""

    PARAMETERS = (
        "base colour R", "base colour G", "base colour B",
        "latent A R", "latent A G", "latent A B", "latent B R", "latent B G", "latent B B",
    )  # fmt: skip
    num_parameters = 3 + NUM_LATENTS
    num_colours = 3

    def __init__(
        self, device: torch.device | str = "cpu", weights: tuple[Decoder, Encoder] | None = None
    ) -> None:
        """Take decoder and encoder to a device; without any, those of the package.

        Raises:
            ConfigError: the package's weights can't be read, or have another shape.
        """
        decoder, encoder = weights if weights is not None else shipped_weights()
        self.decoder, self.encoder = deepcopy(decoder).to(device), deepcopy(encoder).to(device)

    def evaluate(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N C"]:
        """Reflectance, 1/sr, without the cosine; 0 where a direction is below the surface."""
        base, latents = parameters.split([3, NUM_LATENTS], 1)
        return evaluate_stack(self.decoder(latents), base, wi, wo)

    @torch.no_grad()
    def sample(
        self, parameters: Float[Tensor, "N P"], wo: Float[Tensor, "N 3"], uniforms: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Directions to the light, drawn from a cosine lobe and the decoded GGX lobes."""
        return sample_stack(self.stack(parameters), parameters[:, :3], wo, uniforms)

    @torch.no_grad()
    def density(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, " N"]:
        """Probability density of `sample`, 1/sr."""
        return density_of_stack(self.stack(parameters), parameters[:, :3], wi, wo)

    def base_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N C"]:
        """Diffuse base colour, linear."""
        return parameters[:, :3]

    def stack(self, parameters: Float[Tensor, "N P"]) -> LayerStack:
        """The layers that the latents are decoded to."""
        return self.decoder(parameters[:, 3:])

    @torch.no_grad()
    def from_layered(self, parameters: Float[Tensor, "N L"]) -> Float[Tensor, "N P"]:
        """The neural material that the encoder finds for each of `LayeredFamily`; the base colours are the same."""
        latents = self.encoder(LayeredFamily.stack(parameters))
        return torch.cat([parameters[:, :3], latents], -1)
