"""Evaluation of a method that brings figures of its own, without spectral truth."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.runs.load_run import LoadedPipeline


def evaluate_by_model(loaded: LoadedPipeline, console: Console) -> None:
    """Write `eval/metrics.json`, the model's own figures over the evaluation views, and its pictures of the first.

    Raises:
        RunError: the run's folder can't be written.
    """
    from rich.table import Table

    from unmix_plugin.commands.reporting import working
    from unmix_plugin.formats.files import write_file
    from unmix_plugin.formats.png import rgba_png_bytes

    folder = loaded.run.eval
    with working(console, "evaluating views"):
        means, pictures = loaded.pipeline.get_average_eval_image_metrics_and_images()
    figures: dict[str, Any] = {
        **{name: value if math.isfinite(value) else None for name, value in means.items()},
        "views": loaded.pipeline.datamanager.num_eval_images,
        "train_seconds": loaded.training.train_seconds,
    }
    write_file(folder / "metrics.json", (json.dumps(figures, indent=1, allow_nan=False) + "\n").encode())
    for name, picture in pictures.items():
        pixels = (picture.clamp(0, 1) * 255 + 0.5).byte().cpu().numpy()
        write_file(folder / f"{name}.png", rgba_png_bytes(pixels, f"{name} of the first evaluation view"))
    table = Table("figure", "value", title=f"{loaded.run.path.name}: {figures['views']} evaluation views")
    for name, value in figures.items():
        table.add_row(name, "undefined" if value is None else f"{value:.4g}")
    console.print(table)
    print(f"{folder / 'metrics.json'}  these figures")
