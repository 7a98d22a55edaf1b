"""The published prior's shape: Wan2.1's video transformer and its autoencoder, from 23 views to three planes.

Its published weights are not public, and neither is how eleven frames become three planes. Here a linear layer mixes
the frames of each place. Weights of Wan2.1 itself are what training starts from: with them alone the planes mean
nothing. The prior that is trained and shipped is `small`.

Weights are read from a folder in diffusers' layout, that of Wan-AI/Wan2.1-T2V-1.3B-Diffusers: transformer/ and vae/,
each config.json and safetensors; the text encoder is not needed. A file `null_text.safetensors` with one tensor
`embedding` (512 x 4096), the text encoder's output for an empty prompt, is used where there is one.

Notation: `B` objects, `S` pixels along an edge of a view and texels along an edge of a plane (512 as published), `L`
the same in latents (S / 8), `Z` channels of latents, `F` their frames (11 as published), `T` tokens of `D` numbers for
a text. Needs the extra `lmrm` (diffusers).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from unmix_plugin.errors import ConfigError, install_hint
from unmix_plugin.neumatex.tracing.surface import NUM_CHANNELS, Readers, Triplane

if TYPE_CHECKING:
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
    from diffusers.models.modeling_utils import ModelMixin
    from diffusers.models.transformers.transformer_wan import WanTransformer3DModel


ORBIT_VIEWS = 17
"""Views of a circle around the object, which the autoencoder takes for a film."""
CANONICAL_VIEWS = 6
"""Views along the axes, each taken for a film of one frame."""
LATENT_FRAMES = 1 + (ORBIT_VIEWS - 1) // 4 + CANONICAL_VIEWS
"""F: the autoencoder puts the first frame of a film alone, then four into one."""
TEXT_TOKENS = 512
"""Length of the text embedding that the transformer was trained with."""
_NULL_TEXT = "null_text.safetensors"


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
        self.transformer, self.autoencoder = transformer, widened(autoencoder)
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
        """Planes XY, YZ, XZ of objects.

        Args:
            orbit: Tone-mapped views in order around the object, [-1, 1].
            canonical: Tone-mapped views along +x, -x, +y, -y, +z, -z, [-1, 1].
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

    def triplane(self, planes: Float[Tensor, "3 12 S S"]) -> Triplane:
        """One object's planes with copies of the networks that read them."""
        return Triplane.filled(self.readers, planes, planes.shape[-1])

    def parameter_groups(self) -> dict[Literal["backbone", "networks"], list[nn.Parameter]]:
        """What training moves: the backbone slowly (published: 5e-5), what is new faster (5e-4)."""
        new = [*self.planes_head.parameters(), *self.readers.parameters()]
        known = {id(parameter) for parameter in new}
        rest = [p for p in self.parameters() if p.requires_grad and id(p) not in known]
        return {"backbone": rest, "networks": new}


def widened(autoencoder: AutoencoderKLWan) -> AutoencoderKLWan:
    """The autoencoder with a decoder of 12 channels, which starts as the three colours repeated four times."""
    last = autoencoder.decoder.conv_out
    repeats = NUM_CHANNELS // last.out_channels
    last.weight = nn.Parameter(last.weight.detach().repeat(repeats, 1, 1, 1, 1))
    if last.bias is not None:
        last.bias = nn.Parameter(last.bias.detach().repeat(repeats))
    last.out_channels = NUM_CHANNELS
    return autoencoder


def _diffusers_models() -> tuple[type[WanTransformer3DModel], type[AutoencoderKLWan]]:
    """The two classes of diffusers.

    Raises:
        ConfigError: the extra is not installed.
    """
    try:
        from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
        from diffusers.models.transformers.transformer_wan import WanTransformer3DModel
    except ImportError as error:
        raise ConfigError(
            f"the large prior needs diffusers, which is not installed: {install_hint('lmrm')}"
        ) from error
    return WanTransformer3DModel, AutoencoderKLWan


def read_wan_prior(folder: Path, num_parameters: int) -> WanPrior:
    """The prior that training starts from: Wan2.1's weights in float32, and new networks behind them.

    Args:
        num_parameters: P of the material.
    Raises:
        ConfigError: the extra is not installed, or a file or tensor is missing, damaged or of another shape.
    """
    transformer_class, autoencoder_class = _diffusers_models()
    transformer = _read_model(transformer_class, folder / "transformer")
    autoencoder = _read_model(autoencoder_class, folder / "vae")
    null_text = _read_null_text(folder / _NULL_TEXT, transformer.config["text_dim"])
    return WanPrior(transformer, autoencoder, num_parameters, null_text)


def _read_model(model_class: Any, folder: Path) -> Any:
    """A model of diffusers, after its files were compared with its configuration."""
    config = _read_config(folder / "config.json", model_class)
    with torch.device("meta"):
        expected = model_class.from_config(config)
    paths = sorted(folder.glob("*.safetensors"))
    if not paths:
        raise ConfigError(f"{folder} has no *.safetensors; weights in other formats are not read")
    _compare(folder, expected, paths)
    model = model_class.from_config(config)
    for path in paths:  # every tensor was found to be in one of them
        model.load_state_dict(load_file(path), strict=False)
    return model


def _read_config(path: Path, model_class: type) -> dict[str, Any]:
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path} is missing; name a folder in diffusers' layout, with transformer/ and vae/"
        ) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} can't be read as JSON: {error}") from error
    found = config.get("_class_name") if isinstance(config, dict) else None
    if found != model_class.__name__:
        raise ConfigError(f"{path} describes {found}; expected {model_class.__name__} of Wan2.1")
    return config


def _compare(folder: Path, expected: ModelMixin, paths: list[Path]) -> None:
    """Refuse files without a tensor, or with one of another shape; no tensor is read for that."""
    found: dict[str, tuple[int, ...]] = {}
    for path in paths:
        try:
            with safe_open(path, framework="pt") as file:
                found |= {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
        except (OSError, SafetensorError) as error:  # noqa: PERF203 - the file is named
            raise ConfigError(f"{path} can't be read: {error}; fetch it again") from error
    wanted = {name: tuple(tensor.shape) for name, tensor in expected.state_dict().items()}
    missing = sorted(wanted.keys() - found.keys())
    if missing:
        raise ConfigError(
            f"{folder}: {len(missing)} of {len(wanted)} tensors are missing, the first is {missing[0]}"
        )
    for name, shape in wanted.items():
        if found[name] != shape:
            raise ConfigError(
                f"{folder}: tensor {name} has shape {found[name]}, but config.json says {shape}; "
                "the two files are not of one model"
            )


def _read_null_text(path: Path, width: int) -> torch.Tensor | None:
    if not path.exists():
        return None
    try:
        embedding = load_file(path)["embedding"]
    except (OSError, SafetensorError, KeyError) as error:
        raise ConfigError(f"{path} can't be read, or has no tensor named embedding: {error}") from error
    if embedding.shape != (TEXT_TOKENS, width):
        raise ConfigError(
            f"{path}: embedding has shape {tuple(embedding.shape)}, expected {(TEXT_TOKENS, width)}"
        )
    return embedding
