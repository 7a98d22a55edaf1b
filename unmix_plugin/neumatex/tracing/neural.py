"""Neural materials: a base colour, and six latents that one shared decoder, D_neu, turns into reflection.

With `passed` and `specular` decoded from the latents l,

    f = passed(l, wi, wo) base / pi + specular(l, wi, wo)

as in NeuMatEx, whose `T_neu` depends on `wi` alone; here it is a product of the same function of either direction, so
that light and eye can change places. The colour of a metal is in its latents: `base_colour` reads it from there.

The last layer of the decoder names a stack of analytic layers: widths, colours and weights of lobes. Sharp highlights
then cost no more than soft ones, and the stack is reciprocal, never brighter than its light, and can be sampled
exactly. A network that gives reflectances themselves was worse: 31.8 dB after 1200 steps with latents that were learnt
already, against 36.0 dB of this one, which learnt its encoder too.

Notation as in `families`.
"""

from copy import deepcopy
from functools import lru_cache
from pathlib import Path

import safetensors.torch
import torch
from jaxtyping import Float
from safetensors import SafetensorError
from torch import Tensor, nn

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.tracing.families import LayeredFamily, MaterialFamily, Parameters, StackFamily
from unmix_plugin.neumatex.tracing.layers import (
    LARGEST_COVER,
    LARGEST_DIELECTRIC_F0,
    LARGEST_HAZE,
    LARGEST_SHEEN,
    NUM_NUMBERS,
    LayerStack,
)

NUM_LATENTS = 6
_NUM_FEATURES = 23
SHIPPED = Path(__file__).parent.parent / "weights" / "decoder.safetensors"


class Decoder(nn.Module):
    """Latents to layers: two hidden layers."""

    def __init__(self, width: int = 48) -> None:
        super().__init__()
        self.hidden = nn.ModuleList([nn.Linear(NUM_LATENTS, width), nn.Linear(width, width)])
        self.last = nn.Linear(width, NUM_NUMBERS)

    def forward(self, latents: Float[Tensor, "N 6"]) -> LayerStack:
        """The layers of latents in [0, 1]."""
        return LayerStack.of_numbers(self.numbers(latents))

    def numbers(self, latents: Float[Tensor, "N 6"]) -> Float[Tensor, "L N"]:
        """Numbers in [0, 1] that name the layers of latents."""
        x = 2.0 * latents - 1.0
        for layer in self.hidden:
            x = nn.functional.silu(layer(x))
        return torch.sigmoid(torch.addmm(self.last.bias[:, None], self.last.weight, x.T))


class Encoder(nn.Module):
    """Layers to latents: where the decoder comes nearest to them."""

    def __init__(self) -> None:
        super().__init__()
        width = 128
        self.hidden = nn.ModuleList([nn.Linear(_NUM_FEATURES, width), nn.Linear(width, width)])
        self.last = nn.Linear(width, NUM_LATENTS)

    def forward(self, stack: LayerStack) -> Float[Tensor, "N 6"]:
        """Latents in [0, 1]."""
        x = _features(stack)
        for layer in self.hidden:
            x = nn.functional.silu(layer(x))
        return torch.sigmoid(self.last(x))


def _features(stack: LayerStack) -> Tensor:
    """What is in the stack, in numbers that vanish with the layer that they belong to."""
    sheen, roughness = stack.sheen_colour / LARGEST_SHEEN, stack.roughness
    dust, level = stack.dust_cover / LARGEST_COVER, stack.dielectric_f0 / LARGEST_DIELECTRIC_F0
    coat, metallicity, haze = stack.coat_weight, stack.metallicity, stack.haze_weight / LARGEST_HAZE
    scalars = [
        dust, stack.sheen_roughness * sheen.amax(0), coat, coat * roughness[0], torch.sqrt(coat + 1e-4),
        roughness[1], torch.sqrt(roughness[1] + 1e-4), haze, haze * roughness[2], haze * (1 - roughness[1]),
        metallicity, level, level * (1.0 - metallicity), torch.sqrt(dust + 1e-4),
    ]  # fmt: skip
    metal = metallicity * stack.metal_colour
    return 2.0 * torch.cat([torch.stack(scalars), sheen, metal, torch.sqrt(metal + 1e-4)]).T - 1.0


def read_weights(path: Path = SHIPPED) -> tuple[Decoder, Encoder]:
    """Decoder and encoder, frozen. Raises ConfigError: they can't be read, or have other names or shapes."""
    decoder, encoder = Decoder(), Encoder()
    both = nn.ModuleDict({"decoder": decoder, "encoder": encoder}).requires_grad_(False)
    try:
        both.load_state_dict(safetensors.torch.load(path.read_bytes()))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise ConfigError(
            f"{path}: can't be read as weights of the material decoder; train them with python -m tools.train_decoder: "
            f"{error}"
        ) from error
    return decoder, encoder


_shipped_weights = lru_cache(maxsize=1)(read_weights)


class _DecodedFamily(StackFamily):
    """Parameters: diffuse colour (0 to 2, linear), then the numbers that a decoder made of latents."""

    num_parameters = 3 + NUM_NUMBERS

    def stack(self, parameters: Parameters) -> LayerStack:
        return LayerStack.of_numbers(parameters[:, 3:].T.contiguous())


class NeuralFamily(StackFamily):
    """Parameters: diffuse colour (0 to 2, linear), latents (3 to 8, in [0, 1]); the decoder is frozen."""

    PARAMETERS = (
        "base colour R", "base colour G", "base colour B",
        "latent A R", "latent A G", "latent A B", "latent B R", "latent B G", "latent B B",
    )  # fmt: skip
    num_parameters = 3 + NUM_LATENTS

    def __init__(self) -> None:
        """Take copies of the package's decoder and encoder. Raises ConfigError: their weights can't be read."""
        self.decoder, self.encoder = deepcopy(_shipped_weights())

    def stack(self, parameters: Parameters) -> LayerStack:
        return self.decoder(parameters[:, 3:])

    def decoded(self, parameters: Parameters) -> tuple[MaterialFamily, Float[Tensor, "N D"]]:
        numbers = self.decoder.numbers(parameters[:, 3:]).T
        return _DecodedFamily(), torch.cat([parameters[:, :3], numbers], -1)

    @torch.no_grad()
    def from_layered(self, parameters: Float[Tensor, "N L"]) -> Float[Tensor, "N P"]:
        """The neural material that the encoder finds for each of `LayeredFamily`; the base colours are the same."""
        return torch.cat([parameters[:, :3], self.encoder(LayeredFamily().stack(parameters))], -1)
