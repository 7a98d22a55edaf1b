"""Do exported splats show what the field shows?

    python benchmarks/splats.py [--scenes demo] [--steps 1500]

Trains `unmix-nerf` on scenes, exports splats as a user does, reads splats.ply, draws it from the views that are kept
for evaluation, and compares the pictures with what was measured there: beside the field's own, and beside Gaussians
that nobody fitted, one for each vertex of the exported surface.

All pictures are sRGB on black. Splats are drawn as viewers do that show the object with 2, 4 and 8 times as many pixels
a side as the capture has, averaged to its pixels in linear light; the worst counts. For comparison they are drawn with
as many as the capture, too, where the blur that viewers add is more than half of a pixel. Where a sky or a backdrop is
behind the object, which splats leave out, only pixels of the object count.
"""

from __future__ import annotations

import math
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import mean
from typing import Any, Literal, TypeAlias

import _common
import _machine
import numpy as np
import torch
import tyro
from jaxtyping import Float
from plyfile import PlyData
from scipy.spatial.transform import Rotation
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.formats.meshes import least_turns
from unmix_plugin.products.splat_fit import FittedSplats, pinhole
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.metrics import psnr
from unmix_plugin.trained.evaluation import view_truth
from unmix_plugin.trained.open_run import find_scene, load_run
from unmix_plugin.trained.run_views import views_of
from unmix_plugin.trained.surface import SurfaceAppearance, look_at
from unmix_plugin.trained.surface_mesh import surface_of, vertex_areas
from unmix_plugin.trained.trained_scene import TrainedScene

LOSS = _common.Limit(1.5, is_upper=True, unit=" dB")
SIZE = _common.Limit(6.3, is_upper=True, unit=" MB")
FIT = _common.Limit(300, is_upper=True, unit=" s")
SIZES = (1, 2, 4, 8)
"""Pixels a side that a viewer shows for one of the capture's."""
COLUMNS = {
    "field": "PSNR of the field, dB",
    **{f"splats_{times}x": f"of splats at {times}x" for times in SIZES},
    **{f"unfitted_{times}x": f"of one Gaussian a vertex at {times}x" for times in SIZES},
    **{f"splats_{times}x_to_field": f"splats at {times}x against the field" for times in SIZES},
    "num_splats": "splats",
    "megabytes": "MB of PLY",
    "megabytes_glb": "MB of GLB",
    "seconds": "of the export, s",
}
Picture: TypeAlias = Float[Tensor, "H W 3"]


@dataclass(frozen=True)
class Options:
    """Export splats and compare them with the field."""

    scenes: tuple[str, ...] = ("demo",)
    """demo, or names of the scenes of scenes.py."""
    runs: tuple[Path, ...] = ()
    """Trained runs to measure instead."""
    steps: int = 1500
    """Of training."""
    megabytes: float = 6.0
    """Size of splats.ply that is asked for."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train and fit."""
    results: Path | None = None
    """Folder for splats.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """A few steps, few splats."""


def main(options: Options) -> None:
    """Train, export, compare, publish."""
    steps, fit = (60, ["--steps", "20"]) if options.quick else (options.steps, [])
    megabytes = 0.3 if options.quick else options.megabytes
    measured: dict[str, dict[str, float]] = {}
    with ExitStack() as stack:
        root = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="splats-")))
        runs = {run.parent.parent.name: run for run in options.runs}
        for name in () if runs else options.scenes:
            data = name if name == "demo" else str(_common.cached_scene(name))
            words = [
                "unmix-nerf",
                "--data",
                data,
                "--max-num-iterations",
                str(steps),
                "--device",
                options.device,
            ]
            words += ["--output-dir", str(root / "runs")]
            ended = _common.run_command([_common.console_script("unmix-train"), *words])
            runs = {**runs, name: ended.run}
        for name, run in runs.items():
            out = root / name
            words = [
                "splats",
                "--run",
                str(run),
                "--output",
                str(out),
                "--up",
                "z",
                "--device",
                options.device,
            ]
            words += ["--megabytes", f"{megabytes:g}", *fit]
            ended = _common.run_command([_common.console_script("unmix-export"), *words])
            measured[name] = {**compare(run, out / "splats.ply"), "seconds": ended.seconds}
            measured[name]["megabytes"] = (out / "splats.ply").stat().st_size / 1e6
            measured[name]["megabytes_glb"] = (out / "splats.glb").stat().st_size / 1e6
            print(f"{name}: {measured[name]}", flush=True)
    setting = {
        "scenes": ", ".join(measured),
        "training": "runs that were given" if options.runs else f"{steps} steps",
        "asked for": f"{megabytes:g} MB",
        "device": options.device,
    }
    figures = []
    for name, found in measured.items():
        figures += [
            LOSS.judge(
                f"{name}: PSNR lost from the field to the splats", found["field"] - worst(found, "splats")
            ),
            SIZE.judge(f"{name}: size of the PLY", found["megabytes"]),
            FIT.judge(f"{name}: whole export", found["seconds"]),
            _common.reported(
                f"{name}: field, splats, one Gaussian a vertex",
                ", ".join(
                    f"{value:.2f} dB"
                    for value in (found["field"], worst(found, "splats"), worst(found, "unfitted"))
                ),
            ),
        ]
    rows = [[name, *(f"{found[key]:.4g}" for key in COLUMNS)] for name, found in measured.items()]
    table = _common.DetailTable(
        "Each scene, means over the evaluation views", ["scene", *COLUMNS.values()], rows
    )
    question = "Pictures of exported splats and of the field against what was measured on views left out"
    machine = _machine.describe_machine(options.device)
    report = _common.Report("splats", question, setting, machine, figures, measured, (table,))
    _common.publish(report, _common.results_folder(options.results, options.quick))


def compare(run: Path, ply: Path) -> dict[str, float]:
    """PSNR of pictures of the evaluation views, means over these."""
    loaded = load_run(run, "cpu")
    scene = loaded.materials_scene
    measured = find_scene(loaded.record.summary, run, None)
    assert measured is not None, "the scene of the run is gone"
    splats, unfitted = read_splats(ply, scene), one_a_vertex(scene)
    ways: dict[str, Callable[[Cameras], Picture]] = {
        "field": lambda camera: scene.look(camera)["rgb"].float()
    }
    for times in SIZES:
        ways[f"splats_{times}x"] = partial(drawn, splats, times)
        ways[f"unfitted_{times}x"] = partial(drawn, unfitted, times)
    found: dict[str, list[float]] = defaultdict(list)
    for view, index in zip(views_of(scene.views, "eval"), measured.eval_indices, strict=True):
        truth = view_truth(measured, index)
        linear = truth.spectra.double().clamp(0, 1) @ rgb_matrix(scene.bands, torch.float64)
        target = linear_to_srgb(linear.clamp(0, 1)).float()
        counts = truth.shows_matter if scene.field.has_sky else truth.valid
        with torch.no_grad():
            shown = {name: draw(pinhole(view.camera)).clamp(0, 1) for name, draw in ways.items()}
        for name, picture in shown.items():
            found[name].append(psnr(picture, target, counts))
            if name.startswith("splats"):
                found[f"{name}_to_field"].append(psnr(picture, shown["field"], counts))
    return {**{name: mean(values) for name, values in found.items()}, "num_splats": float(len(splats))}


def drawn(splats: FittedSplats, times: int, camera: Cameras) -> Picture:
    """What a viewer shows with so many pixels a side for one of the camera's, averaged to these."""
    return splats.picture(camera, times)[..., :3]


def worst(found: Mapping[str, float], kind: str) -> float:
    """PSNR of splats at the size at which a viewer shows them worst, of those above the capture's."""
    return min(found[f"{kind}_{times}x"] for times in SIZES[1:])


def read_splats(path: Path, scene: TrainedScene) -> FittedSplats:
    """Gaussians of a PLY in the axes of the world, in model space."""
    columns = PlyData.read(path)["vertex"]

    def read(*names: str) -> np.ndarray:
        return np.stack([columns[name] for name in names], axis=1)

    frame = scene.frame
    turned = Rotation.from_matrix(frame.rotation) * Rotation.from_quat(
        read("rot_1", "rot_2", "rot_3", "rot_0")
    )
    harmonic = math.sqrt(1 / (4 * math.pi))
    values: list[Any] = [
        frame.to_model(read(*"xyz").astype(np.float64)),
        turned.as_quat(),
        read("scale_0", "scale_1", "scale_2") + math.log(frame.scale),
        columns["opacity"],
        0.5 + harmonic * read("f_dc_0", "f_dc_1", "f_dc_2"),
    ]
    return FittedSplats(*(torch.from_numpy(np.array(one)).float() for one in values))


def one_a_vertex(scene: TrainedScene) -> FittedSplats:
    """A flat Gaussian for each vertex of the surface, as wide as its part of the area, in the colour from above."""
    mesh, _ = surface_of(scene, 256)
    normals = mesh.normals
    places, along = (torch.from_numpy(values).float() for values in (mesh.vertices, -normals))
    seen = look_at(scene, places, along).map(lambda packed: packed / packed[:, :1].clamp(min=1e-6))
    looks = SurfaceAppearance(scene.materials, seen.abundances, scene.materials.spectra(seen))
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    areas = vertex_areas(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2, mesh.faces, len(mesh.vertices))
    widths = 0.75 * np.sqrt(np.maximum(areas, 0.01 * areas.mean()))
    turns = least_turns(np.array([0.0, 0.0, 1.0]), normals)
    scales = np.log(widths[:, None] * [1.0, 1.0, 0.1])
    values = (mesh.vertices, turns, scales, np.full(len(widths), math.log(0.98 / 0.02)), looks.srgb)
    return FittedSplats(*(torch.from_numpy(np.asarray(one)).float() for one in values))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
