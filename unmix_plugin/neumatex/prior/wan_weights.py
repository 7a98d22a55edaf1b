"""Weights of Wan2.1 from a folder in diffusers' layout: transformer/ and vae/, each config.json and safetensors.

The folder is that of Wan-AI/Wan2.1-T2V-1.3B-Diffusers; its text encoder is not needed. A file `null_text.safetensors`
with one tensor `embedding` (512 x 4096), the text encoder's output for an empty prompt, is used where there is one.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.prior.wan import TEXT_TOKENS, WanPrior, diffusers_models

if TYPE_CHECKING:
    from diffusers.models.modeling_utils import ModelMixin

_NULL_TEXT = "null_text.safetensors"


def read_wan_prior(folder: Path, num_parameters: int) -> WanPrior:
    """The prior that training starts from: Wan2.1's weights in float32, and new networks behind them.

    Args:
        num_parameters: P of the material.
    Raises:
        ConfigError: the extra is not installed, or a file or tensor is missing, damaged or of another shape.
    """
    transformer_class, autoencoder_class = diffusers_models()
    transformer = _read_model(transformer_class, folder / "transformer")
    autoencoder = _read_model(autoencoder_class, folder / "vae")
    null_text = _read_null_text(folder / _NULL_TEXT, transformer.config["text_dim"])
    return WanPrior(transformer, autoencoder, num_parameters, null_text)


def _read_model(model_class: Any, folder: Path) -> Any:
    """A model of diffusers, after its files were compared with its configuration."""
    config = _read_config(folder / "config.json", model_class)
    with torch.device("meta"):
        expected = model_class.from_config(config)
    _compare(folder, expected, _shapes(folder))
    model = model_class.from_config(config)
    for path in _files(folder):
        model.load_state_dict(
            load_file(path), strict=False
        )  # every tensor was found to be in one of the files
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


def _files(folder: Path) -> list[Path]:
    paths = sorted(folder.glob("*.safetensors"))
    if not paths:
        raise ConfigError(f"{folder} has no *.safetensors; weights in other formats are not read")
    return paths


def _shapes(folder: Path) -> dict[str, tuple[int, ...]]:
    """Shape of every tensor in a folder's weights, without reading them."""
    return {name: shape for path in _files(folder) for name, shape in _file_shapes(path).items()}


def _file_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    try:
        with safe_open(path, framework="pt") as file:
            return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"{path} can't be read: {error}; fetch it again") from error


def _compare(folder: Path, expected: ModelMixin, found: dict[str, tuple[int, ...]]) -> None:
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
