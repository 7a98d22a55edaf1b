"""`python -m unmix_plugin.neumatex.materials.train_decoder` trains the decoder of neural materials."""

import platform
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console

from unmix_plugin.neumatex.materials.decoder_training import DecoderTraining, train
from unmix_plugin.neumatex.materials.decoder_weights import SHIPPED, write_weights


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
        "command": "python -m unmix_plugin.neumatex.materials.train_decoder",
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
