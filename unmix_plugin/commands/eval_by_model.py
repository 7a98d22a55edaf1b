"""Evaluation of a method that brings figures of its own, without spectral truth."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.runs.load_run import LoadedPipeline


def evaluate_by_model(loaded: LoadedPipeline, console: Console) -> None:
    """Write `eval/metrics.json`, the model's own figures over the evaluation images, and its pictures of each.

    Raises:
        RunError: the run's folder can't be written.
    """
    from rich.table import Table

    from unmix_plugin.engine.pipeline import average_metrics
    from unmix_plugin.formats.files import write_file

    per_image = _evaluate_images(loaded, console)
    means = average_metrics([{k: v for k, v in image.items() if k != "name"} for image in per_image])
    figures: dict[str, Any] = {
        **_finite_or_none(means),
        "views": len(loaded.pipeline.datamanager.eval_cameras),
        "train_seconds": loaded.training.train_seconds,
    }
    content = {**figures, "per_image": [_finite_or_none(image) for image in per_image]}
    folder = loaded.run.eval
    write_file(folder / "metrics.json", (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    table = Table("figure", "value", title=f"{loaded.run.path.name}: {figures['views']} evaluation views")
    for name, value in figures.items():
        table.add_row(name, "undefined" if value is None else f"{value:.4g}")
    console.print(table)
    print(f"{folder / 'metrics.json'}  these figures, and those of each image")


def _evaluate_images(loaded: LoadedPipeline, console: Console) -> list[dict[str, Any]]:
    """Name and metrics of each image; its pictures go to a folder for each kind."""
    from unmix_plugin.commands.reporting import follow
    from unmix_plugin.formats.files import write_file
    from unmix_plugin.formats.png import rgba_png_bytes

    images = loaded.pipeline.evaluate_images()
    found = []
    for _ in follow(console, "evaluating images", range(loaded.pipeline.datamanager.num_eval_images)):
        name, metrics, pictures = next(images)
        found.append({"name": name, **metrics})
        for kind, picture in pictures.items():
            pixels = (picture.clamp(0, 1) * 255 + 0.5).byte().cpu().numpy()
            path = loaded.run.eval / kind / f"{name}.png"
            write_file(path, rgba_png_bytes(pixels, f"{kind} of {name}"))
    return found


def _finite_or_none(values: dict[str, Any]) -> dict[str, Any]:
    """JSON has no nan and no infinity."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
