"""How the shipped prior was trained: true materials at surface points against what it says of them.

python -m tools.train_prior objects --folder FOLDER    renders training objects into a folder
python -m tools.train_prior prior --folder FOLDER      trains on them

The networks that read planes are trained apart: they learn to be fitted fast, to the truth and to what the prior says.

Notation: `B` objects, `N` points, `P` parameters of a material.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Union

import safetensors.torch
import torch
import tyro
from jaxtyping import Float, Int
from rich.console import Console
from torch import Tensor

from tools.prior_objects import TrainingObjects, read_objects, training_object, write_objects
from unmix_plugin.formats.files import write_file
from unmix_plugin.neumatex.prior.observations import Observations
from unmix_plugin.neumatex.prior.small import (
    RECORD,
    RESOLUTION,
    SHIPPED,
    WEIGHTS,
    Estimates,
    MaterialName,
    SmallPrior,
    TaskName,
    fit_loss,
    read_record,
    read_small_prior,
    shipped_decoder_sha256,
)
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.surface import NUM_CHANNELS

Truth = dict[TaskName, Tensor]
"""What is to be learnt of each task, B x N x P."""
_PBR_COLUMNS = [0, 1, 2, 4, 3]
"""Base colour, roughness and metallicity among the parameters of `LayeredFamily`."""
_DESCRIBED = {6: [7], 8: [9, 10], 11: [12]}
"""Weights of coat, sheen and haze, and the parameters that describe these layers."""
_OBJECTS_A_FILE = 50


def beta_nll(
    predicted: Float[Tensor, "*n P"],
    log_variance: Float[Tensor, "*n P"],
    target: Float[Tensor, "*n P"],
    beta: float = 0.5,
) -> Float[Tensor, ""]:
    """Mean negative log-likelihood of Gaussians, without its constant, each weighted by its variance to the power beta.

    The weight carries no gradient. With beta 0 it is the plain likelihood, with beta 1 the mean's gradient is that of
    half the squared error.

    Source:
        Seitzer et al. 2022, On the Pitfalls of Heteroscedastic Uncertainty Estimation with Probabilistic Neural
        Networks.
    """
    likelihood = 0.5 * ((predicted - target).square() * torch.exp(-log_variance) + log_variance)
    return (likelihood * torch.exp(beta * log_variance.detach())).mean()


@dataclass(frozen=True)
class PriorTraining:
    """Settings of one training."""

    seconds: float = 1500.0
    """How long to train; the learning rate follows the clock, so that it ends at 0 on any machine."""
    batch: int = 12
    """Objects a step."""
    points: int = 128
    """Points of an object."""
    views: int = 8
    """Views of an object that the prior sees at most."""
    learning_rate: float = 1.5e-3
    nll_weight: float = 1.0
    nll_from: float = 0.15
    """Part of the training after which the likelihood counts, first a little."""
    nll_full_from: float = 0.2
    """Part of the training after which it counts fully."""
    seed: int = 0


def true_pbr(materials: Float[Tensor, "*n L"]) -> Float[Tensor, "*n 5"]:
    """Base colour, roughness and metallicity of layered materials, as if there were no other layers."""
    return materials[..., _PBR_COLUMNS]


def true_layers(materials: Float[Tensor, "*n L"]) -> Float[Tensor, "*n L"]:
    """Parameters of `LayeredFamily`, those of a layer times its weight: where it is absent they mean nothing."""
    layers = materials.clone()
    for weight, described in _DESCRIBED.items():
        layers[..., described] *= materials[..., weight : weight + 1]
    return layers


def train(
    prior: SmallPrior,
    objects: TrainingObjects,
    truth: Truth,
    settings: PriorTraining,
    report: Callable[[int, float, float], None],
) -> int:
    """Train a prior in place, and say how many steps it took.

    Args:
        truth: What is to be learnt of each task, at all points.
        report: Called now and then with the step, the part that is done, and the running loss.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    moved = [p for name, p in prior.named_parameters() if "readers" not in name]
    optimiser = torch.optim.AdamW(moved, lr=settings.learning_rate, weight_decay=1e-3)
    started, step, running, done = time.monotonic(), 0, math.nan, 0.0
    while done < 1:
        for group in optimiser.param_groups:
            group["lr"] = (
                settings.learning_rate * min(1.0, (step + 1) / 50) * (1 + math.cos(math.pi * done)) / 2
            )
        loss = training_loss(
            prior, *draw_batch(objects, truth, settings, generator), nll_weight(settings, done)
        )
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(moved, 1.0)
        optimiser.step()
        running = loss.item() if math.isnan(running) else 0.98 * running + 0.02 * loss.item()
        step += 1
        done = (time.monotonic() - started) / settings.seconds
        if step % 50 == 0:
            report(step, done, running)
    return step


def nll_weight(settings: PriorTraining, done: float) -> float:
    """What the likelihood counts beside the squared error, when this part of the training is done."""
    ramp = (done - settings.nll_from) / (settings.nll_full_from - settings.nll_from)
    return settings.nll_weight * min(1.0, max(0.0, ramp))


def training_loss(
    prior: SmallPrior, observations: Observations, truth: Truth, weight: float
) -> Float[Tensor, ""]:
    """Squared error of the material, and `weight` times the likelihood."""
    embeddings = prior(observations)
    total = embeddings.new_zeros(())
    for task, target in truth.items():
        predicted, log_variance = prior.estimate(embeddings, task)
        total = total + (predicted - target).square().mean()
        if weight > 0:
            total = total + weight * beta_nll(predicted, log_variance, target)
    return total


def selected(o: Observations, points: Int[Tensor, " n"], views: Int[Tensor, " v"]) -> Observations:
    """Some of the points and some of the views, in the order asked for."""
    per_view = ("colours", "visible", "cosines", "mirrored", "mirror_open")
    some = {name: values[:, points] for name, values in vars(o).items()}
    return Observations(
        **{name: part[:, :, views] if name in per_view else part for name, part in some.items()}
    )


def draw_batch(
    objects: TrainingObjects, truth: Truth, settings: PriorTraining, generator: torch.Generator
) -> tuple[Observations, Truth]:
    """Some objects, each turned and mirrored, with some of its points and views."""
    rows = torch.randint(len(objects), (settings.batch,), generator=generator).tolist()
    batch = objects.select(rows).observations
    positions = _turned(batch.positions, generator)
    num_points, num_views = batch.visible.shape[1:]
    points = torch.randperm(num_points, generator=generator)[: settings.points]
    views = torch.randperm(num_views, generator=generator)[: settings.views]
    seen = selected(replace(batch, positions=positions), points, views)
    hidden = torch.rand(settings.batch, 1, len(views), generator=generator)
    hidden = hidden < 0.6 * torch.rand(settings.batch, 1, 1, generator=generator)
    seen = replace(seen, visible=seen.visible & ~hidden)
    return seen, {task: values[rows][:, points] for task, values in truth.items()}


def _turned(positions: Float[Tensor, "B N 3"], generator: torch.Generator) -> Float[Tensor, "B N 3"]:
    """Each object with its axes permuted and mirrored: nothing else that is observed changes."""
    count = len(positions)
    order = torch.rand(count, 3, generator=generator).argsort(dim=1)
    signs = 1.0 - 2.0 * torch.randint(2, (count, 1, 3), generator=generator)
    return positions.gather(2, order[:, None].expand_as(positions)) * signs


@dataclass(frozen=True)
class ReaderTraining:
    """Settings of one training."""

    seconds: float = 300.0
    """How long to train each material's readers."""
    group: int = 8
    """Objects fitted at the same time."""
    steps: int = 60
    """Steps of a group."""
    learning_rate: float = 2e-3
    """Of the readers at the start; it falls to 0."""
    plane_rate: float = 0.05
    seed: int = 0


def train_readers(
    prior: SmallPrior,
    objects: TrainingObjects,
    truth: Truth,
    material: MaterialName,
    settings: ReaderTraining,
    report: Callable[[int, float, float], None],
) -> int:
    """Train one material's readers in place, and say how many groups they saw.

    Args:
        report: Called after each group with its number, the part that is done, and its last loss.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    readers = prior.readers_of(material)
    optimiser = torch.optim.Adam(readers.parameters(), lr=settings.learning_rate)
    started, group, done = time.monotonic(), 0, 0.0
    while done < 1:
        rows = torch.randint(len(objects), (settings.group,), generator=generator).tolist()
        estimates = what_is_said(prior, objects.select(rows), truth[material][rows], material, group % 2 == 0)
        planes = torch.zeros(settings.group, 3, NUM_CHANNELS, RESOLUTION, RESOLUTION, requires_grad=True)
        plane_optimiser = torch.optim.Adam([planes], lr=settings.plane_rate)
        loss = planes.new_zeros(())
        for parameters in optimiser.param_groups:
            parameters["lr"] = settings.learning_rate * (1 - done)
        for _ in range(settings.steps):
            loss = fit_loss(readers, planes, estimates)
            optimiser.zero_grad()
            plane_optimiser.zero_grad()
            # A texel's gradient is that of its own object, however many are fitted at a time.
            loss.backward()
            optimiser.step()
            plane_optimiser.step()
        group += 1
        done = (time.monotonic() - started) / settings.seconds
        report(group, done, loss.item())
    return group


@torch.no_grad()
def what_is_said(
    prior: SmallPrior, objects: TrainingObjects, truth: torch.Tensor, material: MaterialName, use_truth: bool
) -> Estimates:
    """What the prior says of points, or the truth with the prior's log-variances."""
    parameters, log_variance = prior.estimate(prior(objects.observations), material)
    return Estimates(objects.observations.positions, truth if use_truth else parameters, log_variance)


def write_small_prior(folder: Path, prior: SmallPrior, record: dict[str, Any]) -> None:
    """Put a prior and its record into a folder.

    Args:
        record: How it was made, JSON; `decoder_sha256` is the decoder of its latents.
    """
    data = safetensors.torch.save({name: part.contiguous() for name, part in prior.state_dict().items()})
    record = {**record, "sha256": hashlib.sha256(data).hexdigest()}
    write_file(folder / WEIGHTS, data)
    write_file(folder / RECORD, (json.dumps(record, indent=1) + "\n").encode())


@dataclass(frozen=True)
class MakeObjects:
    """Render training objects; files that are there already are kept."""

    folder: Path
    """Where the files go, 0.3 MB an object."""
    count: int = 2000
    """How many objects, made in files of 50."""
    samples: int = 24
    """Paths a point and view."""
    demo_share: float = 0.75
    """Chance of a material like those of the built-in objects."""
    first_seed: int = 0
    """Seed of the first object; each has its own. Seeds from 1000000 on are for evaluation."""


@dataclass(frozen=True)
class TrainPrior:
    """Train the small prior on all objects of a folder and write its weights."""

    folder: Path
    """Files that `objects` wrote."""
    output: Path = SHIPPED
    """Folder of the weights and their record."""
    start: Path | None = None
    """Folder of weights to go on from."""
    training: PriorTraining = PriorTraining()
    readers: ReaderTraining = ReaderTraining()


_Commands = Union[  # noqa: UP007 - tyro's names for subcommands
    Annotated[MakeObjects, tyro.conf.subcommand("objects")],
    Annotated[TrainPrior, tyro.conf.subcommand("prior")],
]


def make_objects(settings: MakeObjects, console: Console) -> None:
    """Render objects, file after file."""
    settings.folder.mkdir(parents=True, exist_ok=True)
    last = settings.first_seed + settings.count
    for first in range(settings.first_seed, last, _OBJECTS_A_FILE):
        path = settings.folder / f"objects-{first:07d}.safetensors"
        if not path.exists():
            seeds = range(first, min(first + _OBJECTS_A_FILE, last))
            write_objects(path, [_made(settings, seed) for seed in seeds])
            console.print(f"written: {path}")


def _made(settings: MakeObjects, seed: int) -> TrainingObjects:
    return training_object(seed, samples=settings.samples, demo_share=settings.demo_share)


def truth_of(objects: TrainingObjects) -> Truth:
    """What is to be learnt, at every point of every object."""
    family, layered = NeuralFamily(), objects.materials.float()
    neural = torch.stack([family.from_layered(one) for one in layered])
    return {"neural": neural, "pbr": true_pbr(layered), "layers": true_layers(layered)}


def train_prior(settings: TrainPrior, console: Console) -> None:
    """Train, and write the weights with the record of how they were made."""
    decoder = shipped_decoder_sha256()
    objects = read_objects(sorted(settings.folder.glob("objects-*.safetensors")))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.training.seed)
        prior = SmallPrior()
    before: dict[str, Any] = {}
    if settings.start is not None:
        prior.load_state_dict(read_small_prior("pbr", settings.start).state_dict())
        before = read_record(settings.start)
    started = time.process_time()
    losses: dict[str, float] = {}

    def report(step: int, done: float, loss: float) -> None:
        losses[str(step)] = round(loss, 5)
        console.print(f"step {step}, {100 * done:.0f} %: loss {loss:.5f}")

    truth = truth_of(objects)
    steps = train(prior, objects, truth, settings.training, report)
    final_loss = list(losses.values())[-1] if losses else None
    groups = [
        train_readers(prior, objects, truth, material, settings.readers, report)
        for material in ("neural", "pbr")
    ]
    record = {
        "command": "python -m tools.train_prior prior",
        "training": asdict(settings.training),
        "objects": len(objects),
        "points_per_object": objects.materials.shape[1],
        "steps": steps,
        "reader_training": asdict(settings.readers),
        "reader_groups": groups,
        "final_loss": final_loss,
        "processor_seconds": round(time.process_time() - started),
        "torch": torch.__version__,
        "processor": platform.machine(),
        "decoder_sha256": decoder,
        "before": before,
    }
    write_small_prior(settings.output, prior, record)
    console.print(f"written: {settings.output}")


def main() -> None:
    """Run the subcommand."""
    torch.set_num_threads(1)
    settings = tyro.cli(_Commands)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if isinstance(settings, MakeObjects):
        make_objects(settings, Console())
    else:
        train_prior(settings, Console())


if __name__ == "__main__":
    main()
