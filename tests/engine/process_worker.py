"""A process of a training of the second method, as the tests start it: `worker.py FOLDER ACTION`.

Each process writes what its model has at the end to FOLDER/rank-N.pt, and the names of the threads that are left when
it ends to FOLDER/threads-N.txt.
"""

import atexit
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from tests.factories.rgb_nerf import rgb_nerf
from unmix_plugin.commands.entry import run_command
from unmix_plugin.engine.pipeline import Pipeline
from unmix_plugin.engine.runs import loading
from unmix_plugin.engine.training.steps import (
    TrainingSteps,
    follow_training,
    joined_training,
    prepare_steps,
)
from unmix_plugin.engine.training.trainer import Trainer

STEPS = 12


def config_for(folder: Path) -> Any:
    """A short training of the second method."""
    scene, out = folder / "ball", folder / "outputs"
    scene.mkdir(exist_ok=True)
    limits = {"max_num_iterations": STEPS, "steps_per_save": 4}
    return replace(rgb_nerf.config, data=scene, output_dir=out, device="cpu", **limits)


def train(folder: Path, config: Any) -> None:
    """Train together; keep the parameters that each process ends with."""
    with joined_training(config) as processes:
        if processes.is_first:
            trainer = Trainer(config, processes=processes)
            trainer.train()
            model = trainer.pipeline.model
        else:
            model = follow_training(config, processes).pipeline.model
        torch.save(model.state_dict(), folder / f"rank-{processes.rank}.pt")


def gradients(folder: Path, config: Any) -> None:
    """Average the gradients of half a batch in each process; each keeps what it has then."""
    with joined_training(config) as processes:
        _, steps = prepare_steps(config, processes)
        steps.begin(0)
        rays, batch = fixed_batch(steps.pipeline)
        half = slice(processes.rank, None, processes.count)
        losses = steps.pipeline.model.get_loss_dict(
            steps.pipeline.model(rays[half]), {name: values[half] for name, values in batch.items()}
        )
        loss = torch.stack(list(losses.values())).sum()
        loss.backward()
        (mean,) = processes.average_gradients(list(steps.pipeline.model.parameters()), [loss])
        found = {name: p.grad for name, p in steps.pipeline.model.named_parameters()}
        torch.save({**found, "loss": mean.detach()}, folder / f"rank-{processes.rank}.pt")


def fixed_batch(pipeline: Pipeline) -> Any:
    """The same rays in each process, an even number of them."""
    pipeline.datamanager.seed = 7
    pipeline.datamanager.set_train_rays_per_batch(64)
    pipeline.model.eval()
    return pipeline.datamanager.next_train(0)


def interrupt_in(number: int) -> None:
    """Let this process get SIGINT in a step, as all processes of a terminal do at Ctrl-C."""
    take = TrainingSteps.take

    def interrupted(steps: TrainingSteps, step: int, progress: float) -> Any:
        if step == number:
            signal.raise_signal(signal.SIGINT)
        return take(steps, step, progress)

    setattr(TrainingSteps, "take", interrupted)  # noqa: B010


def name_threads(path: Path) -> None:
    """Of this process, where the system tells them."""
    path.write_text("".join(thread.read_text() for thread in Path("/proc/self/task").glob("*/comm")))


def main(argv: list[str]) -> None:
    """Do what was asked."""
    loading.find_method = lambda _: rgb_nerf
    folder, action = Path(argv[0]), argv[1]
    atexit.register(name_threads, folder / f"threads-{os.environ['RANK']}.txt")
    config, is_second = config_for(folder), os.environ.get("RANK") == "1"
    if action == "gradients":
        gradients(folder, config)
        return
    if action == "resume":
        (run,) = (folder / "outputs").glob("*/*/*")
        config = replace(loading.load_config(run), max_num_iterations=STEPS + 10)
    elif action == "other-seed":
        config = replace(config, seed=5 if is_second else 4)
    elif action == "no-scene" and is_second:
        config = replace(config, data=None)
    elif action == "interrupted":
        interrupt_in(STEPS // 2)
    elif action == "die" and is_second:
        setattr(TrainingSteps, "take", lambda *_: os._exit(9))  # noqa: B010
    train(folder, config)


if __name__ == "__main__":
    torch.set_num_threads(1)
    run_command(main, sys.argv[1:])
