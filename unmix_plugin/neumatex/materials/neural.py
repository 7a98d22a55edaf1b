"""Neural materials: a base colour, and six latents that the shared decoder D_neu turns into reflection.

Notation as in `family`. With `passed` and `specular` decoded from the latents l,

    f = passed(l, wi, wo) base / pi + specular(l, wi, wo)

as in NeuMatEx, whose `T_neu` depends on `wi` alone; here it is a product of the same function of either direction, so
that light and eye can change places. The colour of a metal is in its latents: `base_colour` reads it from there.
"""

from copy import deepcopy

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.decoder import NUM_LATENTS, NUM_NUMBERS, Decoder, Encoder, layers_of
from unmix_plugin.neumatex.materials.decoder_weights import shipped_weights
from unmix_plugin.neumatex.materials.layer_stack import LayerStack
from unmix_plugin.neumatex.materials.layered import LayeredFamily
from unmix_plugin.neumatex.materials.stack_family import StackFamily


class DecodedFamily(StackFamily):
    """Parameters: diffuse colour (0 to 2, linear), then the numbers that a decoder made of latents."""

    num_parameters = 3 + NUM_NUMBERS

    def stack(self, parameters: Float[Tensor, "N P"]) -> LayerStack:
        """The layers that the numbers name."""
        return layers_of(parameters[:, 3:].T.contiguous())


class NeuralFamily(StackFamily):
    """Parameters: diffuse colour (0 to 2, linear), latents (3 to 8, in [0, 1]); the decoder is frozen."""

    PARAMETERS = (
        "base colour R", "base colour G", "base colour B",
        "latent A R", "latent A G", "latent A B", "latent B R", "latent B G", "latent B B",
    )  # fmt: skip
    num_parameters = 3 + NUM_LATENTS

    def __init__(
        self, device: torch.device | str = "cpu", weights: tuple[Decoder, Encoder] | None = None
    ) -> None:
        """Take decoder and encoder to a device; without any, those of the package.

        Raises:
            ConfigError: the package's weights can't be read, or have another shape.
        """
        decoder, encoder = weights if weights is not None else shipped_weights()
        self.decoder, self.encoder = deepcopy(decoder).to(device), deepcopy(encoder).to(device)

    def stack(self, parameters: Float[Tensor, "N P"]) -> LayerStack:
        """The layers that the latents are decoded to."""
        return self.decoder(parameters[:, 3:])

    @property
    def decoded_family(self) -> DecodedFamily:
        """The family of what `decoded` gives: the same reflectances, without a network for each direction."""
        return DecodedFamily()

    def decoded(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N D"]:
        """Parameters of `decoded_family`; differentiable."""
        return torch.cat([parameters[:, :3], self.decoder.numbers(parameters[:, 3:]).T], -1)

    @torch.no_grad()
    def from_layered(self, parameters: Float[Tensor, "N L"]) -> Float[Tensor, "N P"]:
        """The neural material that the encoder finds for each of `LayeredFamily`; the base colours are the same."""
        latents = self.encoder(LayeredFamily().stack(parameters))
        return torch.cat([parameters[:, :3], latents], -1)
