"""The published prior's shape: Wan2.1's video transformer and its autoencoder, from 23 views to three planes.

Its published weights are not public, and neither is how eleven frames become three planes. Here a linear layer mixes
the frames of each place. Weights of Wan2.1 itself are what training starts from: with them alone the planes mean
nothing. The prior that is trained and shipped is `small`.

Notation: `B` objects, `S` pixels along an edge of a view and texels along an edge of a plane (512 as published), `L`
the same in latents (S / 8), `Z` channels of latents, `F` their frames (11 as published), `T` tokens of `D` numbers for
a text. Needs the extra `lmrm` (diffusers).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from unmix_plugin.errors import ConfigError, install_hint
from unmix_plugin.neumatex.tracing.surface import NUM_CHANNELS, Readers

if TYPE_CHECKING:
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
    from diffusers.models.transformers.transformer_wan import WanTransformer3DModel

ORBIT_VIEWS = 17
"""Views of a circle around the object, which the autoencoder takes for a film."""
CANONICAL_VIEWS = 6
"""Views along the axes, each taken for a film of one frame."""
LATENT_FRAMES = 1 + (ORBIT_VIEWS - 1) // 4 + CANONICAL_VIEWS
"""F: the autoencoder puts the first frame of a film alone, then four into one."""
TEXT_TOKENS = 512
"""Length of the text embedding that the transformer was trained with."""


class WanPrior(nn.Module):
    """Transformer, autoencoder and networks of a large material reconstruction model."""

    null_text: Tensor
    latents_mean: Tensor
    latents_std: Tensor

    def __init__(
        self,
        transformer: WanTransformer3DModel,
        autoencoder: AutoencoderKLWan,
        num_parameters: int,
        null_text: Float[Tensor, "T D"] | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """The prior around a transformer and an autoencoder, which it takes over and changes.

        Args:
            num_parameters: P of the material; 9 for the neural one, 5 for PBR.
            null_text: What every cross-attention reads; zeros without it.
            generator: Draws the networks that read the planes.
        """
        super().__init__()
        channels = autoencoder.config["z_dim"]
        self.transformer, self.autoencoder = transformer, _widened(autoencoder)
        for frozen in (autoencoder.encoder, autoencoder.quant_conv):
            frozen.requires_grad_(requires_grad=False)
        self.planes_head = nn.Linear(LATENT_FRAMES * channels, 3 * channels, device=transformer.device)
        self.readers = Readers(num_parameters, generator=generator)
        if null_text is None:
            null_text = torch.zeros(TEXT_TOKENS, transformer.config["text_dim"], device=transformer.device)
        self.register_buffer("null_text", null_text)
        for name in ("latents_mean", "latents_std"):
            values = torch.tensor(autoencoder.config[name]).to(transformer.device)
            self.register_buffer(name, values[:, None, None, None], persistent=False)

    def forward(
        self, orbit: Float[Tensor, "B 3 17 S S"], canonical: Float[Tensor, "B 3 6 S S"]
    ) -> Float[Tensor, "B 3 12 S S"]:
        """Planes XY, YZ, XZ of objects; `Triplane.filled` makes of one's planes and `readers` what a fit starts from.

        Args:
            orbit, canonical: Tone-mapped views, [-1, 1]: in order around the object; along +x, -x, +y, -y, +z, -z.
        """
        return self.decode(self.translate(self.encode(orbit, canonical)))

    def encode(
        self, orbit: Float[Tensor, "B 3 17 S S"], canonical: Float[Tensor, "B 3 6 S S"]
    ) -> Float[Tensor, "B Z F L L"]:
        """Normalised latents of the views, the orbit's frames first."""
        films = [orbit, *canonical.split(1, dim=2)]
        with torch.no_grad():
            frames = [self.autoencoder.encode(film, return_dict=False)[0].mode() for film in films]
        return (torch.cat(frames, dim=2) - self.latents_mean) / self.latents_std

    def translate(self, latents: Float[Tensor, "B Z F L L"]) -> Float[Tensor, "B Z 3 L L"]:
        """Latents of the three planes, by one deterministic pass of the transformer at t = 0."""
        count = latents.shape[0]
        time = torch.zeros(count, device=latents.device)
        text = self.null_text.expand(count, -1, -1)
        found: Tensor = self.transformer(latents, time, text, return_dict=False)[0]
        mixed = self.planes_head(found.flatten(1, 2).movedim(1, -1)).movedim(-1, 1)
        return mixed.unflatten(1, (found.shape[1], 3))

    def decode(self, latents: Float[Tensor, "B Z 3 L L"]) -> Float[Tensor, "B 3 12 S S"]:
        """Planes from their latents, each decoded alone as a film of one frame."""
        alone = (latents * self.latents_std + self.latents_mean).transpose(1, 2).flatten(0, 1)[:, :, None]
        planes = self.autoencoder.decoder(self.autoencoder.post_quant_conv(alone))
        return planes[:, :, 0].unflatten(0, (-1, 3))


def _widened(autoencoder: AutoencoderKLWan) -> AutoencoderKLWan:
    """The autoencoder with a decoder of 12 channels, which starts as the three colours repeated four times."""
    last = autoencoder.decoder.conv_out
    repeats = NUM_CHANNELS // last.out_channels
    last.weight = nn.Parameter(last.weight.detach().repeat(repeats, 1, 1, 1, 1))
    if last.bias is not None:
        last.bias = nn.Parameter(last.bias.detach().repeat(repeats))
    last.out_channels = NUM_CHANNELS
    return autoencoder


def read_wan_prior(folder: Path, num_parameters: int) -> WanPrior:
    """The prior that training starts from: Wan2.1's weights in float32, and new networks behind them.

    Args:
        folder: In diffusers' layout, as Wan-AI/Wan2.1-T2V-1.3B-Diffusers has it: transformer/ and vae/, each with
            config.json and safetensors; and perhaps null_text.safetensors with one tensor `embedding` (512 x 4096), the
            text encoder's output for an empty prompt.
        num_parameters: P of the material.
    Raises:
        ConfigError: the extra is not installed, or a file or tensor is missing, damaged or of another shape.
    """
    try:
        from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
        from diffusers.models.transformers.transformer_wan import WanTransformer3DModel
    except ImportError as error:
        raise ConfigError(f"the large prior needs diffusers: {install_hint('lmrm')}") from error
    transformer = _read_model(WanTransformer3DModel, folder / "transformer")
    autoencoder = _read_model(AutoencoderKLWan, folder / "vae")
    path, expected, null_text = folder / "null_text.safetensors", transformer.config["text_dim"], None
    if path.exists():
        try:
            null_text = load_file(path)["embedding"]
        except (OSError, SafetensorError, KeyError) as error:
            raise ConfigError(f"{path} can't be read, or has no tensor named embedding: {error}") from error
        if null_text.shape != (TEXT_TOKENS, expected):
            found = tuple(null_text.shape)
            raise ConfigError(f"{path}: embedding has shape {found}, expected {(TEXT_TOKENS, expected)}")
    return WanPrior(transformer, autoencoder, num_parameters, null_text)


def _read_model(model_class: Any, folder: Path) -> Any:
    """A model of diffusers, whose own reader needs one more package."""
    try:
        model = model_class.from_config(model_class.load_config(folder, local_files_only=True))
        missing = set(model.state_dict())
        for path in sorted(folder.glob("*.safetensors")):
            tensors = load_file(path)
            model.load_state_dict(tensors, strict=False)  # other shapes are refused all the same
            missing -= tensors.keys()
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise ConfigError(
            f"{folder}: can't be read as a {model_class.__name__} in diffusers' layout: {error}"
        ) from error
    if missing:
        raise ConfigError(f"{folder}: *.safetensors lack {len(missing)} tensors, such as {min(missing)}")
    return model
