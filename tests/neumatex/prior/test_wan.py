"""The large prior: every shape and count of the real size without memory, and a tiny one that runs."""

import builtins
import json
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.testing import assert_close

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.prior.wan import WanPrior, _diffusers_models, read_wan_prior

WAN_1_3B: dict[str, Any] = {
    "num_layers": 30,
    "num_attention_heads": 12,
    "attention_head_dim": 128,
    "ffn_dim": 8960,
}
WAN_1_3B |= {
    "patch_size": (1, 2, 2),
    "in_channels": 16,
    "out_channels": 16,
    "text_dim": 4096,
    "freq_dim": 256,
}
"""Configuration of the transformer of Wan2.1-T2V-1.3B; the autoencoder's is diffusers' default."""

TINY: dict[str, Any] = {
    "num_layers": 2,
    "num_attention_heads": 2,
    "attention_head_dim": 12,
    "ffn_dim": 32,
    "text_dim": 8,
}
TINY = {**WAN_1_3B, **TINY}
TINY_AUTOENCODER: dict[str, Any] = {"base_dim": 4, "dim_mult": [1, 1, 1, 1], "num_res_blocks": 1}


def tiny_models():
    transformer, autoencoder = _diffusers_models()
    return transformer(**TINY), autoencoder(**TINY_AUTOENCODER)


def views(size: int, device="cpu"):
    g = torch.Generator().manual_seed(0)
    orbit, canonical = (torch.rand(1, 3, count, size, size, generator=g) * 2 - 1 for count in (17, 6))
    return orbit.to(device), canonical.to(device)


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.fixture(scope="module")
def real_size() -> WanPrior:
    with torch.device("meta"):
        transformer, autoencoder = _diffusers_models()
        models = transformer(**WAN_1_3B), autoencoder()
    return WanPrior(*models, num_parameters=9)


def test_the_real_size_has_the_published_parameters(real_size):
    # 2.84 GB in bfloat16 and 0.51 GB in float32 are what the files of Wan2.1-T2V-1.3B have.
    assert count(real_size.transformer) == 1_418_996_800
    _, autoencoder = _diffusers_models()
    with torch.device("meta"):
        assert count(autoencoder()) == 126_892_531
    assert len(real_size.transformer.blocks) == 30


def test_the_real_size_turns_views_into_planes_of_their_resolution(real_size):
    latents = real_size.encode(*(view.to("meta") for view in views(512)))
    assert latents.shape == (1, 16, 11, 64, 64)
    planes = real_size.translate(latents)
    assert planes.shape == (1, 16, 3, 64, 64)
    assert real_size.decode(planes).shape == (1, 3, 12, 512, 512)


def test_a_tiny_prior_gives_a_triplane_that_can_be_optimised():
    torch.manual_seed(0)  # diffusers draws weights from the global generator
    prior = WanPrior(*tiny_models(), num_parameters=9, generator=torch.Generator().manual_seed(0))
    planes = prior(*views(32))
    assert planes.shape == (1, 3, 12, 32, 32)
    triplane = prior.triplane(planes[0])
    assert_close(triplane.planes.detach(), planes[0].detach())
    assert triplane.parameters_at(torch.zeros(5, 3)).shape == (5, 9)
    planes.square().mean().backward()
    groups = prior.parameter_groups()
    assert all(p.grad is None for p in prior.autoencoder.encoder.parameters())
    assert prior.planes_head.weight.grad is not None
    assert prior.planes_head.weight.grad.abs().sum() > 0
    trained = {id(p) for group in groups.values() for p in group}
    assert trained == {id(p) for p in prior.parameters() if p.requires_grad}


def test_each_plane_is_decoded_alone():
    torch.manual_seed(0)
    prior = WanPrior(*tiny_models(), num_parameters=5)
    latents = torch.randn(1, 16, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    changed = latents.clone()
    changed[:, :, 1] += 1
    with torch.no_grad():
        before, after = prior.decode(latents), prior.decode(changed)
    assert_close(before[:, [0, 2]], after[:, [0, 2]])
    assert (before[:, 1] - after[:, 1]).abs().max() > 1e-4


def test_the_decoder_starts_as_the_colours_of_the_autoencoder():
    torch.manual_seed(0)
    transformer, autoencoder = tiny_models()
    latents = torch.randn(1, 16, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    std, mean = (
        torch.tensor(autoencoder.config[f"latents_{name}"])[:, None, None, None] for name in ("std", "mean")
    )
    with torch.no_grad():
        films = (latents * std + mean).transpose(1, 2)[0][:, :, None]
        colours = torch.cat([autoencoder.decode(film[None], return_dict=False)[0][:, :, 0] for film in films])
        planes = WanPrior(transformer, autoencoder, num_parameters=5).decode(latents)[0]
    for start in range(0, 12, 3):
        assert_close(planes[:, start : start + 3].clamp(-1, 1), colours)


@pytest.fixture
def folder(tmp_path):
    torch.manual_seed(0)
    for name, model in zip(("transformer", "vae"), tiny_models(), strict=True):
        model.save_pretrained(tmp_path / name)
    return tmp_path


def test_weights_of_a_folder_are_those_that_were_written(folder):
    written = load_file(folder / "transformer" / "diffusion_pytorch_model.safetensors")
    embedding = torch.randn(512, 8, generator=torch.Generator().manual_seed(1))
    save_file({"embedding": embedding}, folder / "null_text.safetensors")
    prior = read_wan_prior(folder, num_parameters=9)
    for name, tensor in prior.transformer.state_dict().items():
        assert_close(tensor, written[name], rtol=0, atol=0)
    assert_close(prior.null_text, embedding)
    assert torch.isfinite(prior(*views(32))).all()


def test_a_folder_that_holds_other_weights_is_refused_and_they_are_named(folder, tmp_path):
    with pytest.raises(
        ConfigError, match=r"transformer.config\.json is missing; name a folder in diffusers'"
    ):
        read_wan_prior(tmp_path / "elsewhere", num_parameters=9)
    save_file({"embedding": torch.zeros(3, 8)}, folder / "null_text.safetensors")
    with pytest.raises(ConfigError, match=r"has shape \(3, 8\), expected \(512, 8\)"):
        read_wan_prior(folder, num_parameters=9)
    path = folder / "vae" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "z_dim": 12}))
    with pytest.raises(ConfigError, match=r"vae: tensor \S+ has shape \(.*\), but config.json says \("):
        read_wan_prior(folder, num_parameters=9)
    (folder / "transformer" / "config.json").write_text('{"_class_name": "FluxTransformer2DModel"}')
    with pytest.raises(ConfigError, match="describes FluxTransformer2DModel; expected WanTransformer3DModel"):
        read_wan_prior(folder, num_parameters=9)


def test_without_the_extra_the_message_names_it(monkeypatch, tmp_path):
    real_import = builtins.__import__

    def without_diffusers(name, *rest):
        if name.split(".")[0] == "diffusers":
            raise ImportError(name)
        return real_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_diffusers)
    with pytest.raises(ConfigError, match='-m pip install "diffusers>=0'):
        read_wan_prior(tmp_path, num_parameters=9)
