"""The small prior's weights: one safetensors file and a JSON record of how it was made.

Latents mean something only beside the decoder that they were made for, so the record has that decoder's SHA-256.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError

from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.errors import RunError
from unmix_plugin.neumatex.materials import decoder_weights
from unmix_plugin.neumatex.prior.small_network import MaterialName, SmallPrior

SHIPPED = Path(__file__).parent / "weights"
_WEIGHTS, _RECORD = "small.safetensors", "small.json"


def write_small_prior(folder: Path, prior: SmallPrior, record: dict[str, Any]) -> None:
    """Put a prior and its record into a folder.

    Args:
        record: How it was made, JSON; `decoder_sha256` is the decoder of its latents.
    """
    data = safetensors.torch.save({name: part.contiguous() for name, part in prior.state_dict().items()})
    record = {**record, "sha256": hashlib.sha256(data).hexdigest()}
    write_file(folder / _WEIGHTS, data)
    write_file(folder / _RECORD, (json.dumps(record, indent=1) + "\n").encode())


def read_small_prior(
    material: MaterialName, folder: Path = SHIPPED, decoder_sha256: str | None = None
) -> SmallPrior:
    """The prior in a folder, ready to predict.

    Args:
        material: What it is to predict; only the neural one depends on the decoder.
        decoder_sha256: Of the decoder in use; the shipped one's by default.
    Raises:
        RunError: a file is missing or damaged, or the latents belong to another decoder.
    """
    record = read_record(folder)
    if material == "neural":
        expected = shipped_decoder_sha256() if decoder_sha256 is None else decoder_sha256
        _require_decoder(folder, record, expected)
    path = folder / _WEIGHTS
    try:
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != record.get("sha256"):
            raise RunError(f"{path} is not the file that {_RECORD} describes; install the package again")
        prior = SmallPrior()
        prior.load_state_dict(safetensors.torch.load(data))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise RunError(f"{path} can't be read as weights of the prior: {error}") from error
    return prior.eval().requires_grad_(requires_grad=False)


def read_record(folder: Path = SHIPPED) -> dict[str, Any]:
    """How a prior was made.

    Raises:
        RunError: the record is missing or no JSON.
    """
    path = folder / _RECORD
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"{path} can't be read: {error}") from error


def shipped_decoder_sha256() -> str:
    """Of the weights of the neural material that come with the package.

    Raises:
        RunError: they are missing.
    """
    try:
        return hashlib.sha256(decoder_weights.SHIPPED.read_bytes()).hexdigest()
    except OSError as error:
        raise RunError(
            f"{decoder_weights.SHIPPED} can't be read: {error}; install the package again"
        ) from error


def _require_decoder(folder: Path, record: dict[str, Any], expected: str) -> None:
    found = record.get("decoder_sha256")
    if found != expected:
        raise RunError(
            f"the prior in {folder} was trained for the material decoder {str(found)[:12]}, but the decoder in use is "
            f"{expected[:12]}: its latents would mean something else; train it again (python -m "
            "unmix_plugin.neumatex.prior.train_small) or use --pipeline.model.material pbr"
        )
