"""Does known light part reflectance from shadows, where a radiance field alone cannot?

    python benchmarks/neumatex_spectral.py [--size 64] [--seconds 120]

Writes procedural objects of four measured materials under a clear sky, whose sun casts shadows, and fits each in three
ways, by the commands that a user would give and for the same time: neumatex with spectral materials; the same started
from a run of unmix-nerf; and unmix-nerf on the same pictures, which knows neither mesh nor environment but the lamp's
spectrum. All are told the number of materials.

Albedo is what a method says of the diffuse reflectance in a pixel of an evaluation view, mean over the bands,
after one factor for the object; of unmix-nerf abundances times endmembers over the lamp, which leaves its shading out.
What is left of shadows in it is the correlation of its relative error, estimate over truth less 1, with the light that
falls on the surface. The error, since the true albedo may correlate by chance. Materials may lie in the shade by chance
too; with a material that is too bright all over, the error then follows the light. So the table says beside it what
correlation is left within materials: that of what linear functions of the true abundances leave of error and light.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any, Literal

import _common
import _machine
import numpy as np
import torch
import tyro

if TYPE_CHECKING:
    from unmix_plugin.neumatex.tracing.environment import MovingFrame

ANGLE = _common.Limit(0.03, is_upper=True, unit=" rad")
CORRELATION = _common.Limit(0.1, is_upper=True)
MAIN, STARTED, FIELD = "neumatex spectral", "neumatex spectral, from the run", "unmix-nerf"
NUM_MATERIALS = 4
COLUMNS = {
    "endmember_angle": "endmember angle, rad",
    "error_correlation": "error of albedo with light",
    "shaded_correlation": "the same with shading",
    "within_correlation": "within materials",
    "albedo_error": "error of albedo",
    "abundance_rmse": "abundance RMSE",
    "psnr": "PSNR",
    "relit_psnr": "relit PSNR",
    "train_seconds": "training, s",
}
_DARKEST = 0.02
"""Light on a surface, as a part of the brightest, below which a pixel tells nothing."""


@dataclass(frozen=True)
class Options:
    """Fit spectral objects with and without their mesh and light."""

    seeds: tuple[int, ...] = (2, 6)
    """Which objects."""
    size: int = 64
    """Rows and columns of the pictures."""
    views: int = 24
    """Pictures of an object under the light of training."""
    bands: int = 16
    """Bands."""
    seconds: float = 120.0
    """Of training, for each way."""
    pixels: int = 2048
    """Pixels of a step of neumatex."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    runs: Path | None = None
    """Keep objects and run folders here."""
    results: Path | None = None
    """Folder for neumatex_spectral.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """One small object, two seconds."""


def main(options: Options) -> None:
    """Measure every object and way, and publish."""
    size, views, bands = (24, 8, 8) if options.quick else (options.size, options.views, options.bands)
    seconds, seeds = (2.0, options.seeds[:1]) if options.quick else (options.seconds, options.seeds)
    setting = {
        "objects": f"procedural, seeds {', '.join(map(str, seeds))}, {NUM_MATERIALS} materials, clear sky",
        "pictures": f"{views} of {size} x {size} pixels, {bands} bands; 2 held-out lights",
        "training": f"{seconds:g} s each; neumatex {options.pixels} pixels a step",
        "device": options.device,
    }
    machine = _machine.describe_machine(options.device)
    measured: dict[str, list[dict[str, Any]]] = {MAIN: [], STARTED: [], FIELD: []}
    with ExitStack() as stack:
        root = options.runs or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="spectral-")))
        for seed in seeds:
            folder = written_object(root / f"object-{seed}", seed, size, views, bands)
            field: Path | None = None
            for name in (FIELD, MAIN, STARTED):
                words = way_of_fitting(name, options.pixels, field)
                words += ["--max-seconds", str(seconds), "--device", options.device]
                run, found = measure(folder, words, options.device, root / "runs")
                field = run if name == FIELD else field
                measured[name].append({"seed": seed, **found})
                print(f"object {seed}, {name}: {found}", flush=True)
    question = (
        f"Reflectance and shadows after {seconds:g} s of training, with and without known mesh and light"
    )
    report = _common.Report(
        "neumatex_spectral",
        question,
        setting,
        machine,
        judge(measured),
        measured,
        (details(measured),),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def written_object(
    folder: Path, seed: int, size: int, views: int, bands: int, moves: MovingFrame | None = None
) -> Path:
    """An object's folder, made if it is not there; in light that turns with the camera in a frame."""
    from tools.procedural_objects import seeded_lights, seeded_mesh
    from unmix_plugin.neumatex.demo.objects import DEFAULT_SPECTRAL_LIGHTS, write_spectral_object
    from unmix_plugin.scenes.demo.scene import written_once

    def write(place: Path) -> None:
        print(f"object {seed}: rendering its pictures ...", flush=True)
        first = DEFAULT_SPECTRAL_LIGHTS[0]
        lights = [first, *[name for name in seeded_lights(seed) if name != first][:2]]
        write_spectral_object(place, seeded_mesh(seed), lights, size, views, bands, seed, moves=moves)

    return written_once(folder, f"object {seed}", write, Path.is_dir)


def way_of_fitting(name: str, pixels: int, field: Path | None) -> list[str]:
    """Method and settings."""
    if name == FIELD:
        words = ["unmix-nerf", "--pipeline.model.num-endmembers", str(NUM_MATERIALS)]
        return [*words, "--max-num-iterations", "1000000"]
    words = ["neumatex", "--pipeline.model.material", "spectral", "--max-num-iterations", "1000000"]
    words += ["--pipeline.datamanager.train-num-rays-per-batch", str(pixels)]
    if name == STARTED:
        return [*words, "--from-run", str(field)]
    return [*words, "--pipeline.model.num-endmembers", str(NUM_MATERIALS)]


def measure(folder: Path, words: list[str], device: str, runs: Path) -> tuple[Path, dict[str, Any]]:
    """Train and evaluate one object in one way."""
    load_average = _machine.load_average()
    method, *settings = words
    common = [method, "--data", str(folder), "--output-dir", str(runs)]
    trained = _common.run_command([_common.console_script("unmix-train"), *common, *settings])
    evaluate = [_common.console_script("unmix-eval"), "--run", str(trained.run), "--device", device]
    _common.run_command(evaluate)
    figures = json.loads((trained.run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    own = {name: figures.get(name) for name in ("psnr", "relit_psnr", "abundance_rmse")}
    own["train_seconds"] = seconds_of_training(trained.run)
    return trained.run, {**own, **materials(trained.run, folder), "load_average_at_start": load_average}


def seconds_of_training(run: Path) -> float:
    """As the newest checkpoint says."""
    from unmix_plugin.trained.open_run import load_run

    return load_run(run, "cpu").training.train_seconds


@torch.no_grad()
def materials(run: Path, folder: Path) -> dict[str, float]:
    """Angle of the endmembers as reflectances, and what of the albedo's error follows the light."""
    from unmix_plugin.neumatex.fit.object_scene import load_object
    from unmix_plugin.neumatex.fit.trained_object import TrainedObject
    from unmix_plugin.neumatex.tracing.families import SpectralFamily
    from unmix_plugin.spectral.metrics import endmember_angle
    from unmix_plugin.trained.open_run import load_run, require_materials

    truth, scene = load_object(folder), load_run(run, "cpu").scene
    assert truth.lamp is not None
    assert truth.true_materials is not None
    lamp = torch.from_numpy(truth.lamp).float()
    if isinstance(scene, TrainedObject):
        assert isinstance(scene.surface.family, SpectralFamily)
        endmembers = scene.surface.family.endmembers
    else:
        endmembers = require_materials(scene, FIELD).materials.endmembers.detach() / lamp
    true_endmembers = torch.from_numpy(truth.true_materials.spectra).float()
    pixels = [seen_pixels(truth, scene, endmembers, lamp, index) for index in truth.split.evaluation]
    parts = (torch.cat(part).double().numpy() for part in zip(*pixels, strict=True))
    light, true, found, shaded, abundances = parts
    error = relative_error(found, true)
    return {
        "endmember_angle": endmember_angle(endmembers, true_endmembers),
        "error_correlation": correlation(error, light),
        "shaded_correlation": correlation(relative_error(shaded, true), light),
        "within_correlation": correlation(left_over(error, abundances), left_over(light, abundances)),
        "true_albedo_correlation": correlation(true, light),
        "albedo_error": float(np.abs(error).mean()),
        "pixels": float(len(true)),
    }


def seen_pixels(
    truth: Any, scene: Any, endmembers: torch.Tensor, lamp: torch.Tensor, index: int
) -> tuple[torch.Tensor, ...]:
    """Of pixels that count: direct light, the true albedo, the one found, that with shading, the true abundances."""
    from unmix_plugin.spectral.evidence import OPAQUE_ALPHA

    light, alpha = direct_light(truth, index)
    name = truth.pictures.names[index]
    camera = next(view.camera for view in scene.views if view.name.endswith(name))
    view = scene.look(camera)
    opacity = view.opacity
    shown = (alpha >= OPAQUE_ALPHA) & (opacity > 0.9) & (light > _DARKEST * light.max())
    shares = view["abundances"][shown]
    found = (shares / shares.sum(dim=1, keepdim=True) @ endmembers).mean(dim=1)
    with_shading = found
    if hasattr(scene, "materials"):
        diffuse = scene.materials.diffuse(view.coefficients)[shown] / opacity[shown][:, None]
        with_shading = (diffuse / lamp).mean(dim=1)
    known = {name: torch.from_numpy(values) for name, values in truth.truth(index).items()}
    abundances = known["true_abundances"][shown]
    true = abundances @ known["true_endmembers"]
    return light[shown], true.mean(dim=1), found, with_shading, abundances


def direct_light(truth: Any, index: int) -> tuple[torch.Tensor, torch.Tensor]:
    """What a white matt surface would send to a view in direct light, mean over the bands; and alpha."""
    from unmix_plugin.neumatex.tracing.families import SpectralFamily
    from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
    from unmix_plugin.neumatex.tracing.rays import RayMesh

    class White:
        family = SpectralFamily(torch.ones(1, truth.environment.num_colours))

        def parameters(self, positions: torch.Tensor) -> torch.Tensor:
            return positions.new_tensor([1.0, 1.0, 0.0]).expand(len(positions), -1)

    traced = TracedObject(RayMesh(truth.mesh), truth.environment, White())
    generator = torch.Generator().manual_seed(0)
    image, alpha = traced.picture(truth.pictures.cameras, index, 64, bounces=0, generator=generator)
    return image.mean(dim=-1), alpha


def relative_error(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Estimate over truth less 1, after the factor that fits best."""
    factor = (found * true).sum() / (found * found).sum()
    return factor * found / true - 1


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's."""
    return float(np.corrcoef(a, b)[0, 1])


def left_over(values: np.ndarray, abundances: np.ndarray) -> np.ndarray:
    """What the linear function of the abundances that fits best leaves of the values."""
    return values - abundances @ np.linalg.lstsq(abundances, values, rcond=None)[0]


def judge(measured: dict[str, list[dict[str, Any]]]) -> list[_common.Figure]:
    """The lines asked for, of means over the objects, and those of the others beside them."""
    figures = []
    for name, runs in measured.items():
        angle = mean(run["endmember_angle"] for run in runs)
        shadows = mean(abs(run["error_correlation"]) for run in runs)
        if name == MAIN:
            figures += [
                ANGLE.judge(f"{name}: endmember angle", angle),
                CORRELATION.judge(f"{name}: correlation of albedo's error with the light, absolute", shadows),
            ]
            continue
        figures.append(_common.reported(f"{name}: endmember angle", f"{angle:.4f} rad"))
        figures.append(_common.reported(f"{name}: correlation of albedo's error", f"{shadows:.3f}"))
    return figures


def details(measured: dict[str, list[dict[str, Any]]]) -> _common.DetailTable:
    """A line an object and way."""
    rows = [
        [str(run["seed"]), name, *(_text(run.get(column)) for column in COLUMNS)]
        for name, runs in measured.items()
        for run in runs
    ]
    headers = ["object", "method", *COLUMNS.values()]
    return _common.DetailTable("Each object", headers, sorted(rows))


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
