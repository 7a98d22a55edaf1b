"""The shipped weights of decoder and encoder, and the record of how they were made."""

import hashlib
import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import nn

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.materials.decoder import Decoder, Encoder

SHIPPED = Path(__file__).parent / "weights" / "decoder.safetensors"


def read_weights(path: Path = SHIPPED) -> tuple[Decoder, Encoder]:
    """Decoder and encoder, frozen.

    Raises:
        ConfigError: the file can't be read, or its weights have another shape.
    """
    try:
        tensors = safetensors.torch.load(path.read_bytes())
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"can't read the material decoder's weights in {path}: {error}") from error
    both = _both()
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    expected = {name: tuple(tensor.shape) for name, tensor in both.state_dict().items()}
    for name in sorted(expected | found):
        if found.get(name) != expected.get(name):
            raise ConfigError(
                f"weights of another shape in {path}: {name} is {found.get(name, 'missing')}, "
                f"expected {expected.get(name, 'no such tensor')}; train them with "
                "python -m unmix_plugin.neumatex.materials.train_decoder"
            )
    both.load_state_dict(tensors)
    both.requires_grad_(False)
    return both["decoder"], both["encoder"]  # pyright: ignore[reportReturnType]


@lru_cache(maxsize=1)
def shipped_weights() -> tuple[Decoder, Encoder]:
    """Those of the package, read once."""
    return read_weights()


def write_weights(path: Path, decoder: Decoder, encoder: Encoder, record: Mapping[str, Any]) -> None:
    """Write the weights, and beside them `record` with their SHA-256 as JSON."""
    tensors = nn.ModuleDict({"decoder": decoder, "encoder": encoder}).state_dict()
    data = safetensors.torch.save({name: tensor.contiguous() for name, tensor in tensors.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    full = {**record, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    path.with_suffix(".json").write_text(json.dumps(full, indent=1) + "\n", encoding="utf-8")


def _both() -> nn.ModuleDict:
    return nn.ModuleDict({"decoder": Decoder(), "encoder": Encoder()})
