"""Does a sharp RGB camera beside a coarse spectral one give sharp spectra?

    python benchmarks/rig.py [--scene FOLDER]

Of a rendered scene, the demo scene at 384 px if none is given, every other training view is kept as three broad
channels at full size, the others as 12 bands at a quarter of the size. Two models are trained for equal steps, on all
these views and on the spectral ones alone, and compared with the scene at full size in every band; so are the spectral
camera's own pictures of the evaluation views, enlarged by cubic interpolation. About 35 minutes on two quiet cores.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import _common
import _machine
import numpy as np
import tyro
from _rig_scene import FACTOR, NUM_BANDS, binned, write_rig

GAIN_DB = 3.0
"""By which the rig must be better, in every band."""
SIZE, QUICK_SIZE = 384, 48
"""Of the demo scene's pictures in px."""


@dataclass(frozen=True)
class Options:
    """Train on a rig and on its spectral camera alone, and compare every band at the sharp camera's size."""

    scene: Path | None = None
    """Scene folder with all bands in every view; None: the demo scene at 384 px with 12 bands."""
    steps: int = 10_000
    """Of each training."""
    quick: bool = False
    """A few steps, to see that the benchmark works."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    results: Path | None = None
    """Folder for rig.json and rig.md; None: beside the benchmarks."""


def main(options: Options) -> None:
    """Write the rig, train, measure, publish."""
    machine = _machine.describe_machine(options.device)
    steps = 30 if options.quick else options.steps
    found: dict[str, np.ndarray] = {}
    with tempfile.TemporaryDirectory() as folder:
        variant = options.scene.name if options.scene else ""
        scene = options.scene or demo(Path(folder) / "demo", QUICK_SIZE if options.quick else SIZE)
        for name, sensors in (("rig", ("rgb", "spectral")), ("spectral alone", ("spectral",))):
            data = write_rig(scene, Path(folder) / name.replace(" ", "-"), sensors)
            run = train(data, Path(folder) / "outputs", steps, options.device)
            found[name] = measure(run, options.device)
        found["enlarged"] = enlarged(data)
    _common.publish(report(found, scene.name, steps, machine, variant), _results(options))


def demo(folder: Path, size: int) -> Path:
    """The demo scene with as many bands as the rig has."""
    from unmix_plugin.scenes.demo.scene import make_demo_scene

    make_demo_scene(folder, size=size, bands=NUM_BANDS)
    return folder


def train(data: Path, output_dir: Path, steps: int, device: str) -> Path:
    """A run on a scene with the default settings."""
    words = ["unmix-nerf", "--data", data, "--output-dir", output_dir, "--device", device]
    words += ["--max-num-iterations", steps, "--viewer.no-enabled"]
    trainer = _common.quiet_trainer([str(word) for word in words])
    trainer.train()
    return trainer.run.path


def measure(run: Path, device: str) -> np.ndarray:
    """PSNR of each band in dB, mean over the evaluation views."""
    from unmix_plugin.engine.runs.loading import load_pipeline
    from unmix_plugin.trained.evaluation import render_view
    from unmix_plugin.trained.open_run import require_materials, snapshot

    loaded = load_pipeline(run, device)
    scene, name = loaded.pipeline.datamanager.scene, loaded.config.method_name  # type: ignore[attr-defined]
    trained = require_materials(snapshot(loaded.pipeline.model, name, loaded.record), name)
    found = [
        psnr_of_bands(render_view(trained, scene.cameras[index]).spectra.numpy(), scene.cube(index))
        for index in scene.eval_indices
    ]
    return np.mean(found, axis=0)


def enlarged(data: Path) -> np.ndarray:
    """PSNR of each band in dB of the spectral camera's pictures of the evaluation views, enlarged."""
    from scipy.ndimage import zoom

    from unmix_plugin.scenes.reading.loader import load_scene

    scene = load_scene(data)
    found = []
    for index in scene.eval_indices:
        cube = scene.cube(index)
        size = (FACTOR, FACTOR, 1)
        large = np.asarray(zoom(binned(cube, FACTOR), size, order=3, mode="nearest", grid_mode=True))
        found.append(psnr_of_bands(large, cube))
    return np.mean(found, axis=0)


def psnr_of_bands(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """In dB, over all pixels, peak 1."""
    error = (np.clip(predicted, 0, 1).astype(np.float64) - truth) ** 2
    return -10 * np.log10(error.mean(axis=(0, 1)))


def report(
    found: dict[str, np.ndarray], scene: str, steps: int, machine: dict[str, Any], variant: str
) -> _common.Report:
    """The least gain over bands, and all figures."""
    rig = found["rig"]
    figures = [
        _common.Limit(GAIN_DB, unit=" dB").judge(
            f"least gain of a band over {what}", float((rig - found[key]).min())
        )
        for what, key in (
            ("training on the spectral views alone", "spectral alone"),
            ("enlarging", "enlarged"),
        )
    ]
    figures += [
        _common.reported(f"{name}: mean PSNR over bands", f"{psnr.mean():.2f} dB")
        for name, psnr in found.items()
    ]
    rows = [[str(band), *(f"{psnr[band]:.2f}" for psnr in found.values())] for band in range(len(rig))]
    table = _common.DetailTable("PSNR of each band in dB", ["band", *found], rows)
    question = "Sharp spectra from a sharp RGB camera and a coarse spectral one"
    setting = {"scene": scene, "steps": steps, "coarser": FACTOR}
    measured = {name: psnr.tolist() for name, psnr in found.items()}
    return _common.Report("rig", question, setting, machine, figures, measured, (table,), variant)


def _results(options: Options) -> Path | None:
    return _common.results_folder(options.results, options.quick)


if __name__ == "__main__":
    main(tyro.cli(Options))
