"""Make the small prior: `objects` renders training objects into a folder, `prior` trains on them.

python -m unmix_plugin.neumatex.prior.train_small objects --folder FOLDER
python -m unmix_plugin.neumatex.prior.train_small prior --folder FOLDER
"""

from __future__ import annotations

import platform
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Union

import torch
import tyro
from rich.console import Console

from unmix_plugin.neumatex.materials.neural import NeuralFamily
from unmix_plugin.neumatex.prior.reader_training import ReaderTraining, train_readers
from unmix_plugin.neumatex.prior.small_network import SmallPrior
from unmix_plugin.neumatex.prior.small_weights import (
    SHIPPED,
    read_record,
    read_small_prior,
    shipped_decoder_sha256,
    write_small_prior,
)
from unmix_plugin.neumatex.prior.training import PriorTraining, Truth, train, true_layers, true_pbr
from unmix_plugin.neumatex.prior.training_data import (
    TrainingObjects,
    read_objects,
    training_object,
    write_objects,
)

_OBJECTS_A_FILE = 50


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
        "command": "python -m unmix_plugin.neumatex.prior.train_small prior",
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
