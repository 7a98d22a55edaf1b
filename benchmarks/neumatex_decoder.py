"""How well does the decoder of neural materials stand for layered materials that it has not seen?

    python benchmarks/neumatex_decoder.py

Spheres of random layered materials under point lights and environments, tone-mapped with AgX: the neural material whose
latents the encoder gives, the same after a short fit to the pictures, and glTF's metallic-roughness material after the
same fit. Both fits start at what belongs to the truth's own parameters. Truth and candidate are sampled in the same
directions, so that their pictures share their noise.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import _common
import _machine
import numpy as np
import torch
import tyro
from _spheres import Sphere, environments, picture, psnr, sphere, under_environment, under_point_lights
from PIL import Image

from tools.train_decoder import draw_materials
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import LayeredFamily, MaterialFamily, PbrFamily
from unmix_plugin.neumatex.tracing.neural import NeuralFamily

Candidates: TypeAlias = dict[str, tuple[MaterialFamily, torch.Tensor]]
LAYERED, NEURAL, PBR = LayeredFamily(), NeuralFamily(), PbrFamily()
SEED = 1_000_003
"""Not one that the decoder was trained with."""


@dataclass(frozen=True)
class Options:
    """Compare neural and metallic-roughness materials with layered ones on lit spheres."""

    materials: int = 60
    """Number of materials."""
    fitted: int = 16
    """How many of them are fitted, which takes longer than all else."""
    fit_steps: int = 40
    """Steps of either fit."""
    size: int = 32
    """Pixels across a sphere; fits see one of 24."""
    samples: int = 8
    """Directions a pixel from each of environment, truth and candidate."""
    pictures: Path | None = None
    """Folder for pictures of the spheres: truth, encoded, fitted, metallic-roughness."""
    results: Path | None = None
    """Folder for the results; None: beside the benchmarks."""
    quick: bool = False
    """Two materials and few steps."""


def main(options: Options) -> None:
    """Measure and publish."""
    torch.set_num_threads(1)
    count, fits, steps = (
        (3, 2, 3) if options.quick else (options.materials, options.fitted, options.fit_steps)
    )
    truths = draw_materials(count, torch.Generator().manual_seed(SEED))
    on, lights = sphere(options.size), environments()
    rows: list[dict[str, float]] = []
    for index, truth in enumerate(truths):
        candidates: Candidates = {"encoded": (NEURAL, NEURAL.from_layered(truth[None])[0])}
        if index < fits:
            candidates |= fitted(truth, lights, steps)
        rows.append({name: psnr_of(truth, *one, on, lights, options) for name, one in candidates.items()})
        print(index, {name: f"{value:.2f}" for name, value in rows[-1].items()}, flush=True)
        if options.pictures is not None:
            save_pictures(options.pictures / f"{index:03d}.png", truth, candidates, on, lights, options)
    publish(options, truths, rows, steps)


def fitted(truth: torch.Tensor, lights: list[Environment], steps: int) -> Candidates:
    """The neural and the metallic-roughness material that fit the pictures."""
    on = sphere(24)
    plain = torch.cat([truth[:3], truth[4:5], truth[3:4]])
    return {
        "fitted": (NEURAL, fit(truth, NEURAL, NEURAL.from_layered(truth[None])[0], on, lights, steps)),
        "pbr": (PBR, fit(truth, PBR, plain, on, lights, steps)),
    }


def fit(
    truth: torch.Tensor,
    family: MaterialFamily,
    start: torch.Tensor,
    on: Sphere,
    lights: list[Environment],
    steps: int,
) -> torch.Tensor:
    """Parameters after steps of Adam on the pictures, one environment and the point lights a step."""
    at = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([at], 0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    shown = under_point_lights(LAYERED, truth, on)
    for step in range(steps):
        light = lights[step % len(lights)]
        wanted, found = under_environment([(LAYERED, truth), (family, at)], light, on, 4, seed=step)
        loss = (picture(found) - picture(wanted)).square().mean()
        points = under_point_lights(family, at, on)
        loss = loss + 0.25 * (picture(points) - picture(shown)).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            at.clamp_(0.0, 1.0)
    return at.detach()


@torch.no_grad()
def psnr_of(
    truth: torch.Tensor,
    family: MaterialFamily,
    found: torch.Tensor,
    on: Sphere,
    lights: list[Environment],
    options: Options,
) -> float:
    """PSNR over the pixels of all lights, dB."""
    shown = pairs(truth, family, found, on, lights, options)
    return psnr(torch.cat([one for one, _ in shown]), torch.cat([other for _, other in shown]))


@torch.no_grad()
def pairs(
    truth: torch.Tensor,
    family: MaterialFamily,
    found: torch.Tensor,
    on: Sphere,
    lights: list[Environment],
    options: Options,
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Light of truth and candidate under point lights and every environment."""
    both: list[tuple[MaterialFamily, torch.Tensor]] = [(LAYERED, truth), (family, found)]
    a, b = (under_point_lights(each, material, on) for each, material in both)
    shown = [(a, b)]
    for index, light in enumerate(lights):
        a, b = under_environment(both, light, on, options.samples, seed=1000 + index)
        shown.append((a, b))
    return shown


def save_pictures(
    path: Path,
    truth: torch.Tensor,
    candidates: Candidates,
    on: Sphere,
    lights: list[Environment],
    options: Options,
) -> None:
    """One row of spheres for the truth and for each candidate, a column a light."""
    shown = [pairs(truth, *one, on, lights, options) for one in candidates.values()]
    rows = [[a for a, _ in shown[0]], *([b for _, b in one] for one in shown)]
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = torch.cat([torch.cat([drawn(one, on) for one in row], 1) for row in rows])
    Image.fromarray((whole.numpy() * 255 + 0.5).astype(np.uint8)).save(path)


def drawn(light: torch.Tensor, on: Sphere) -> torch.Tensor:
    """A picture of the sphere on black."""
    image = torch.zeros(on.size * on.size, 3)
    image[on.inside] = picture(light)
    return image.reshape(on.size, on.size, 3)


def publish(options: Options, truths: torch.Tensor, rows: list[dict[str, float]], steps: int) -> None:
    """Judge and write."""
    of = {name: np.array([row[name] for row in rows if name in row]) for name in rows[0]}
    both = [row for row in rows if "pbr" in row]
    gain = float(np.mean([row["encoded"] - row["pbr"] for row in both]))
    at_least = _common.Limit(38.0, unit=" dB")
    figures = [
        at_least.judge("mean PSNR, latents by the encoder", float(of["encoded"].mean())),
        at_least.judge("mean PSNR, latents fitted", float(of["fitted"].mean())),
        _common.reported("mean PSNR, metallic-roughness fitted", f"{of['pbr'].mean():.2f} dB"),
        _common.reported("encoded over metallic-roughness fitted, same materials", f"{gain:.2f} dB"),
        *(_common.reported(f"lowest PSNR, {name}", f"{values.min():.2f} dB") for name, values in of.items()),
        _common.reported(
            "share of encoded materials of at least 38 dB", f"{(of['encoded'] >= 38).mean():.0%}"
        ),
        *(_common.reported(what, f"{value:.2f} s") for what, value in seconds_per_million().items()),
    ]
    measured: dict[str, Any] = {
        "psnr_db": rows,
        "parameters": [[round(float(x), 4) for x in row] for row in truths],
    }
    setting = {
        "materials": len(rows),
        "fitted": len(both),
        "fit_steps": steps,
        "size": options.size,
        "samples": options.samples,
        "seed": SEED,
    }
    question = "Neural against layered materials: AgX pictures of lit spheres"
    machine = _machine.describe_machine("cpu")
    report = _common.Report("neumatex_decoder", question, setting, machine, figures, measured)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def seconds_per_million() -> dict[str, float]:
    """Seconds of one core for a million points: reflectance, and its gradient too."""
    number = 1 << 17
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.rand(2, number, 3, generator=generator), dim=-1)
    times = {}
    for family in (PBR, LAYERED, NEURAL):
        parameters = torch.rand(number, family.num_parameters, generator=generator).requires_grad_()
        best = np.inf
        for _ in range(4):
            started = time.process_time()
            family.evaluate(parameters, directions[0], directions[1]).sum().backward()
            best = min(best, time.process_time() - started)
        times[f"{type(family).__name__}, a million reflectances with gradient"] = best * 1e6 / number
    return times


if __name__ == "__main__":
    main(tyro.cli(Options))
