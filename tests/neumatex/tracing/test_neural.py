"""Neural materials against layered ones, and the shipped weights; other files are refused with a reason."""

import hashlib
import json
import math
from pathlib import Path

import pytest
import safetensors.torch
import torch
from torch.testing import assert_close

from tests.factories.surfaces import eye_directions, numbers
from tools.train_decoder import DecoderTraining, draw_materials, response_error, train, write_weights
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.tracing.families import LayeredFamily
from unmix_plugin.neumatex.tracing.neural import SHIPPED, Decoder, Encoder, NeuralFamily, read_weights

FAMILY = NeuralFamily()


def test_encoded_materials_look_like_the_layered_ones():
    generator = torch.Generator().manual_seed(77)
    layered = draw_materials(2000, generator)
    neural = FAMILY.from_layered(layered)
    assert torch.equal(neural[:, :3], layered[:, :3])
    assert 0 <= neural.min() <= neural.max() <= 1
    truth, found = LayeredFamily().stack(layered), FAMILY.stack(neural)
    error = response_error(truth, found, layered[:, :3].T, 16, generator)
    assert -10 * math.log10(float(error.mean())) > 36
    assert -10 * float(torch.log10(error).mean()) > 39


def test_decoded_parameters_reflect_and_are_drawn_alike():
    rows, wi, wo = numbers(200, 9), eye_directions(200, seed=5), eye_directions(200, seed=6)
    uniforms = torch.rand(200, 3, generator=torch.Generator().manual_seed(7))
    family, decoded = FAMILY.decoded(rows)
    assert_close(family.evaluate(decoded, wi, wo), FAMILY.evaluate(rows, wi, wo))
    assert_close(family.density(decoded, wi, wo), FAMILY.density(rows, wi, wo))
    assert_close(family.sample(decoded, wo, uniforms), FAMILY.sample(rows, wo, uniforms))
    assert torch.equal(family.base_colour(decoded), FAMILY.base_colour(rows))


def test_training_is_the_same_twice():
    settings = DecoderTraining(steps=10, materials=32, lights=2, seed=3)
    runs = []
    for _ in range(2):
        figures: list[float] = []
        decoder, _ = train(settings, lambda _, psnr, figures=figures: figures.append(psnr))
        runs.append((figures, decoder.last.weight.tolist()))
    assert runs[0] == runs[1]


def test_the_record_belongs_to_the_shipped_file():
    record, data = json.loads(SHIPPED.with_suffix(".json").read_text()), SHIPPED.read_bytes()
    assert record["sha256"] == hashlib.sha256(data).hexdigest()
    assert record["bytes"] == len(data) < 1_000_000
    DecoderTraining(**record["training"])  # every setting is still one
    decoder, encoder = read_weights()
    assert not any(parameter.requires_grad for parameter in [*decoder.parameters(), *encoder.parameters()])


def test_what_is_written_is_read_back_and_other_weights_are_refused_with_the_reason(tmp_path: Path):
    path, decoder, latents = tmp_path / "w.safetensors", Decoder(), torch.rand(5, 6)
    write_weights(path, decoder, Encoder(), {})
    assert_close(read_weights(path)[0].numbers(latents), decoder.numbers(latents))
    for write, said in (
        (lambda: write_weights(path, Decoder(width=7), Encoder(), {}), r"size mismatch for decoder\.hidden"),
        (lambda: path.write_bytes(safetensors.torch.save({"other": torch.zeros(2)})), "Missing key"),
        (lambda: path.write_text("no weights"), "w.safetensors: can't be read as weights of the material"),
    ):
        write()
        with pytest.raises(ConfigError, match=said):
            read_weights(path)
