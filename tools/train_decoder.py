"""How the shipped decoder of neural materials was trained: python -m tools.train_decoder

Decoder and encoder are trained together, on layered materials under lights of every size. What is compared is what a
camera would see: reflected light after a tone curve. A light of some extent widens every lobe, so lights of all sizes
come down to lobes of more width.

Notation as in `microfacet`.
"""

import hashlib
import json
import math
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
import tyro
from jaxtyping import Float
from rich.console import Console
from torch import Tensor, nn

from unmix_plugin.neumatex.tracing.families import LayeredFamily
from unmix_plugin.neumatex.tracing.layers import LayerStack
from unmix_plugin.neumatex.tracing.microfacet import SMALLEST_ALPHA, alpha_of
from unmix_plugin.neumatex.tracing.neural import SHIPPED, Decoder, Encoder


def draw_materials(number: int, generator: torch.Generator) -> Float[Tensor, "N 14"]:
    """Parameters of `LayeredFamily`: every combination of layers, each layer in about four of ten materials.

    Dielectrics, metals and mixtures of both are about as frequent; a third of the base colours are greys.
    """

    def uniform(columns: int) -> Tensor:
        return torch.rand(number, columns, generator=generator)

    grey = (uniform(1) < 1 / 3).float()
    colours = uniform(3)
    base = grey * colours[:, :1] + (1.0 - grey) * colours
    kind = uniform(1)
    metallicity = torch.where(kind < 0.4, 0.0, torch.where(kind > 0.7, 1.0, uniform(1)))
    drawn = uniform(10)
    present = (uniform(4) < 0.4).float()
    for weight, layer in zip((2, 4, 7, 9), present.unbind(-1), strict=True):
        drawn[:, weight] *= layer
    return torch.cat([base, metallicity, drawn], -1)


@dataclass(frozen=True)
class DecoderTraining:
    """Settings of one training."""

    steps: int = 4000
    materials: int = 2048
    """Materials of a step; each is seen under `lights`."""
    lights: int = 8
    learning_rate: float = 3e-3
    latent_noise: float = 0.004
    """Standard deviation, which keeps neighbours in latent space alike."""
    seed: int = 0


def tone(radiance: Tensor) -> Tensor:
    """Brightness as a camera stores it, [0, 1]; however bright the light, more of it still makes a difference."""
    return torch.sqrt(radiance / (1.0 + radiance) + 1e-4)


def train(settings: DecoderTraining, report: Callable[[int, float], None]) -> tuple[Decoder, Encoder]:
    """Decoder and encoder.

    Args:
        report: Called now and then with the step and the PSNR in dB of tone-mapped light, of materials as they come.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        decoder, encoder = Decoder(), Encoder()
    parameters = [*decoder.parameters(), *encoder.parameters()]
    optimiser = torch.optim.Adam(parameters, settings.learning_rate, betas=(0.9, 0.98), eps=1e-12)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, settings.steps, pct_start=0.05, final_div_factor=100.0
    )
    running = math.nan
    for step in range(1, settings.steps + 1):
        loss = _loss(decoder, encoder, settings, generator)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 0.1)
        optimiser.step()
        schedule.step()
        running = loss.item() if math.isnan(running) else 0.98 * running + 0.02 * loss.item()
        if step % 200 == 0 or step == settings.steps:
            report(step, -10.0 * math.log10(running))
    return decoder, encoder


def _loss(
    decoder: Decoder, encoder: Encoder, settings: DecoderTraining, generator: torch.Generator
) -> Tensor:
    materials = draw_materials(settings.materials, generator)
    truth = LayeredFamily().stack(materials)
    latents = encoder(truth)
    noise = torch.randn(latents.shape, generator=generator)
    latents = (latents + settings.latent_noise * noise).clamp(0.0, 1.0)
    return response_error(truth, decoder(latents), materials[:, :3].T, settings.lights, generator).mean()


def response_error(
    truth: LayerStack, found: LayerStack, base: Float[Tensor, "3 N"], lights: int, generator: torch.Generator
) -> Float[Tensor, " N"]:
    """Mean squared difference of tone-mapped light, under lights of random direction, size and strength."""
    rows = base.shape[1] * lights
    size, strength = torch.rand(rows, generator=generator), torch.randn(rows, generator=generator)
    widening = (size - 0.2).clamp_min(0.0) ** 2
    base = base.repeat_interleave(lights, 1)
    truth, found = (_widened(_repeated(one, lights), widening) for one in (truth, found))
    wo = _eyes(rows, generator)
    with torch.no_grad():
        wi = truth.mixture(wo, base).sample(wo, torch.rand(rows, 3, generator=generator).T)
        # Where a lobe pointed below the surface, any direction above is as good.
        wi = torch.cat([wi[:2], wi[2:].abs().clamp_min(1e-3)])
        received = math.pi * torch.exp(strength) * wi[2]
        expected = tone(received * _reflected(truth, base, wi, wo))
    error = tone(received * _reflected(found, base, wi, wo)) - expected
    return error.square().mean(0).reshape(-1, lights).mean(-1)


def _reflected(stack: LayerStack, base: Tensor, wi: Tensor, wo: Tensor) -> Tensor:
    passed, specular = stack.reflectance(wi, wo)
    return (passed / math.pi) * base + specular


def _widened(stack: LayerStack, widening: Tensor) -> LayerStack:
    alpha = torch.sqrt(alpha_of(stack.roughness).square() + widening.square()).clamp_max(1.0)
    roughness = torch.sqrt(((alpha - SMALLEST_ALPHA) / (1.0 - SMALLEST_ALPHA)).clamp(1e-8, 1.0))
    return replace(stack, roughness=roughness)


def _repeated(stack: LayerStack, times: int) -> LayerStack:
    """Each material so many times in a row."""
    return LayerStack(**{name: part.repeat_interleave(times, -1) for name, part in vars(stack).items()})


def _eyes(number: int, generator: torch.Generator) -> Tensor:
    """As often as a picture of a sphere shows them, and some more of the grazing ones; (3 N)."""
    u = torch.rand(number, 3, generator=generator).T
    z = torch.where(u[2] < 0.7, torch.sqrt(u[0]), u[0]).clamp_min(0.02)
    sine, angle = torch.sqrt(1.0 - z * z), 2.0 * math.pi * u[1]
    return torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z])


def write_weights(path: Path, decoder: Decoder, encoder: Encoder, record: Mapping[str, Any]) -> None:
    """Write the weights, and beside them `record` with their SHA-256 as JSON."""
    tensors = nn.ModuleDict({"decoder": decoder, "encoder": encoder}).state_dict()
    data = safetensors.torch.save({name: tensor.contiguous() for name, tensor in tensors.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    full = {**record, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    path.with_suffix(".json").write_text(json.dumps(full, indent=1) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class Settings:
    """Train the decoder of neural materials."""

    output: Path = SHIPPED
    """File of the weights; their record is written beside it."""
    training: DecoderTraining = DecoderTraining()


def main() -> None:
    """Train, write, say how well it went."""
    settings = tyro.cli(Settings)
    torch.set_num_threads(1)
    console, figures = Console(), {}
    started = time.perf_counter()

    def report(step: int, psnr: float) -> None:
        figures[str(step)] = round(psnr, 3)
        console.print(f"step {step}: {psnr:.2f} dB, {time.perf_counter() - started:.0f} s")

    decoder, encoder = train(settings.training, report)
    record = {
        "command": "python -m tools.train_decoder",
        "training": asdict(settings.training),
        "psnr_db_of_training_light": list(figures.values())[-1],
        "seconds": round(time.perf_counter() - started),
        "torch": torch.__version__,
        "processor": platform.machine(),
    }
    write_weights(settings.output, decoder, encoder, record)
    console.print(f"written: {settings.output}")


if __name__ == "__main__":
    main()
