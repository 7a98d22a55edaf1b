"""The large prior: every shape and count of the real size without memory, and a tiny one that runs."""

import json
import sys
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.testing import assert_close

from tests.factories.surfaces import generator
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.prior.wan import WanPrior, read_wan_prior
from unmix_plugin.neumatex.tracing.surface import Triplane

pytest.importorskip("diffusers", reason="needs the extra lmrm")
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
from diffusers.models.transformers.transformer_wan import WanTransformer3DModel

WAN_1_3B: dict[str, Any] = {
    "num_layers": 30, "num_attention_heads": 12, "attention_head_dim": 128, "ffn_dim": 8960, "patch_size": (1, 2, 2),
    "in_channels": 16, "out_channels": 16, "text_dim": 4096, "freq_dim": 256,
}  # fmt: skip
"""Configuration of the transformer of Wan2.1-T2V-1.3B; the autoencoder's is diffusers' default."""
TINY: dict[str, Any] = WAN_1_3B | {
    "num_layers": 2, "num_attention_heads": 2, "attention_head_dim": 12, "ffn_dim": 32, "text_dim": 8,
}  # fmt: skip
TINY_AUTOENCODER: dict[str, Any] = {"base_dim": 4, "dim_mult": [1, 1, 1, 1], "num_res_blocks": 1}


def tiny_models() -> tuple[WanTransformer3DModel, AutoencoderKLWan]:
    torch.manual_seed(0)  # diffusers draws weights from the global generator
    return WanTransformer3DModel(**TINY), AutoencoderKLWan(**TINY_AUTOENCODER)


def views(size: int, device: str = "cpu"):
    drawn = generator()
    return [(torch.rand(1, 3, count, size, size, generator=drawn) * 2 - 1).to(device) for count in (17, 6)]


@pytest.fixture(scope="module")
def real_size() -> WanPrior:
    with torch.device("meta"):
        return WanPrior(WanTransformer3DModel(**WAN_1_3B), AutoencoderKLWan(), num_parameters=9)


def test_the_real_size_has_the_published_parameters(real_size):
    # 2.84 GB in bfloat16 and 0.51 GB in float32 are what the files of Wan2.1-T2V-1.3B have.
    with torch.device("meta"):
        models = real_size.transformer, AutoencoderKLWan()
    found = [sum(parameter.numel() for parameter in model.parameters()) for model in models]
    assert (*found, len(real_size.transformer.blocks)) == (1_418_996_800, 126_892_531, 30)


def test_the_real_size_turns_views_into_planes_of_their_resolution(real_size):
    latents = real_size.encode(*views(512, "meta"))
    assert latents.shape == (1, 16, 11, 64, 64)
    planes = real_size.translate(latents)
    assert planes.shape == (1, 16, 3, 64, 64)
    assert real_size.decode(planes).shape == (1, 3, 12, 512, 512)


def test_a_tiny_prior_gives_a_triplane_that_can_be_optimised():
    prior = WanPrior(*tiny_models(), num_parameters=9, generator=generator())
    planes = prior(*views(32))
    triplane = Triplane.filled(prior.readers, planes[0], 32)
    assert_close(triplane.planes.detach(), planes[0].detach())
    assert triplane.parameters_at(torch.zeros(5, 3)).shape == (5, 9)
    (gradient,) = torch.autograd.grad(planes.square().mean(), prior.planes_head.weight)
    assert gradient.abs().sum() > 0
    assert not any(parameter.requires_grad for parameter in prior.autoencoder.encoder.parameters())


def test_each_plane_is_decoded_alone_and_the_decoder_starts_as_that_of_the_colours():
    transformer, autoencoder = tiny_models()
    latents = torch.randn(1, 16, 3, 4, 4, generator=generator())
    changed = latents.clone()
    changed[:, :, 1] += 1
    std, mean = (
        torch.tensor(autoencoder.config[f"latents_{name}"])[:, None, None, None] for name in ("std", "mean")
    )
    with torch.no_grad():
        films = (latents * std + mean).transpose(1, 2)[0][:, :, None]
        colours = torch.cat([autoencoder.decode(film[None], return_dict=False)[0][:, :, 0] for film in films])
        prior = WanPrior(transformer, autoencoder, num_parameters=5)
        before, after = prior.decode(latents), prior.decode(changed)
    assert_close(before[:, [0, 2]], after[:, [0, 2]])
    assert (before[:, 1] - after[:, 1]).abs().max() > 1e-4
    for start in range(0, 12, 3):
        assert_close(before[0, :, start : start + 3].clamp(-1, 1), colours)


@pytest.fixture
def folder(tmp_path):
    for name, model in zip(("transformer", "vae"), tiny_models(), strict=True):
        model.save_pretrained(tmp_path / name)
    return tmp_path


def test_weights_of_a_folder_are_those_that_were_written(folder):
    written = load_file(folder / "transformer" / "diffusion_pytorch_model.safetensors")
    embedding = torch.randn(512, 8, generator=generator(1))
    save_file({"embedding": embedding}, folder / "null_text.safetensors")
    prior = read_wan_prior(folder, num_parameters=9)
    for name, tensor in prior.transformer.state_dict().items():
        assert_close(tensor, written[name], rtol=0, atol=0)
    assert_close(prior.null_text, embedding)
    assert torch.isfinite(prior(*views(32))).all()


def test_a_folder_that_holds_other_weights_is_refused_and_they_are_named(folder, tmp_path):
    with pytest.raises(ConfigError, match=r"transformer: can't be read as a WanTransformer3DModel"):
        read_wan_prior(tmp_path / "elsewhere", num_parameters=9)
    save_file({"embedding": torch.zeros(3, 8)}, folder / "null_text.safetensors")
    with pytest.raises(ConfigError, match=r"has shape \(3, 8\), expected \(512, 8\)"):
        read_wan_prior(folder, num_parameters=9)
    path = folder / "vae" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "z_dim": 12}))
    with pytest.raises(ConfigError, match="vae: can't be read as a AutoencoderKLWan"):
        read_wan_prior(folder, num_parameters=9)
    path = folder / "transformer" / "diffusion_pytorch_model.safetensors"
    tensors = load_file(path)
    del tensors["proj_out.weight"]
    save_file(tensors, path)
    with pytest.raises(ConfigError, match=r"lack 1 tensors, such as proj_out\.weight"):
        read_wan_prior(folder, num_parameters=9)


def test_without_the_extra_the_message_names_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, AutoencoderKLWan.__module__, None)
    with pytest.raises(ConfigError, match='-m pip install "diffusers>=0'):
        read_wan_prior(tmp_path, num_parameters=9)
