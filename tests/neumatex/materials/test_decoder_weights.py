"""The shipped weights are those of their record, frozen and small; other files are refused with a reason."""

import hashlib
import json
from pathlib import Path

import pytest
import safetensors.torch
import torch
from torch.testing import assert_close

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.materials.decoder import Decoder, Encoder
from unmix_plugin.neumatex.materials.decoder_training import DecoderTraining
from unmix_plugin.neumatex.materials.decoder_weights import SHIPPED, read_weights, write_weights


def test_the_record_belongs_to_the_shipped_file():
    record, data = json.loads(SHIPPED.with_suffix(".json").read_text()), SHIPPED.read_bytes()
    assert record["sha256"] == hashlib.sha256(data).hexdigest()
    assert record["bytes"] == len(data) < 1_000_000
    DecoderTraining(**record["training"])  # every setting is still one


def test_shipped_weights_are_frozen():
    decoder, encoder = read_weights()
    assert not any(parameter.requires_grad for parameter in [*decoder.parameters(), *encoder.parameters()])


def test_what_is_written_is_read_back(tmp_path: Path):
    decoder, encoder = Decoder(), Encoder()
    write_weights(tmp_path / "w.safetensors", decoder, encoder, {})
    found, _ = read_weights(tmp_path / "w.safetensors")
    latents = torch.rand(5, 6)
    assert_close(found(latents).metal_colour, decoder(latents).metal_colour)


def test_weights_of_another_shape_are_refused(tmp_path: Path):
    write_weights(tmp_path / "w.safetensors", Decoder(width=7), Encoder(), {})
    with pytest.raises(
        ConfigError, match=r"weights of another shape .*decoder\.hidden\.0\.bias is \(7,\), expected"
    ):
        read_weights(tmp_path / "w.safetensors")


def test_missing_tensors_are_named(tmp_path: Path):
    (tmp_path / "w.safetensors").write_bytes(safetensors.torch.save({"other": torch.zeros(2)}))
    with pytest.raises(ConfigError, match=r"decoder\.hidden\.0\.bias is missing"):
        read_weights(tmp_path / "w.safetensors")


def test_a_file_of_another_kind_is_refused(tmp_path: Path):
    (tmp_path / "w.safetensors").write_text("no weights")
    with pytest.raises(ConfigError, match="can't read the material decoder's weights"):
        read_weights(tmp_path / "w.safetensors")
