"""Is an object that is made of cubes alone right under other lights?

    python benchmarks/asset.py [--size 96] [--compares]

Writes procedural objects of four measured materials under a clear sky as a capture would have them: cubes, poses,
alpha, the lamp's spectrum, divided by a white reference that the sun lights head-on. Neither mesh nor environment are
among them. `unmix-asset` makes an object of each, which is compared with the truth: its pictures under two other
lights, its reflectances, its mesh, and where its main light is. With `--compares` materials are fitted from the same
field with the true mesh, with the true light, and with both, too.

Some objects are measured a second time, turned before the camera and their light on a turntable.

The seeds of the first objects were looked at while settings were chosen, those of the others were not.
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, Literal

import _common
import _machine
import numpy as np
import torch
import tyro
from neumatex_spectral import NUM_MATERIALS, written_object

RELIT = _common.Limit(33.0, unit=" dB")
ANGLE = _common.Limit(0.03, is_upper=True, unit=" rad")
CHAMFER = _common.Limit(1.0, is_upper=True, unit=" pixels")
LIGHT = _common.Limit(10.0, is_upper=True, unit=" degrees")
ALONE, TURNED = "cubes alone", "cubes alone, light that turns with the camera"
WAYS: dict[str, tuple[str, ...]] = {
    "true mesh": ("mesh",),
    "true light": ("environment",),
    "true mesh and light": ("mesh", "environment"),
}
COLUMNS = {
    "relit_psnr": "relit PSNR",
    "relit_psnr_image": "relit PSNR, whole pictures",
    "psnr": "PSNR",
    "reflectance_angle": "reflectance angle, rad",
    "light_angle_deg": "main light off, degrees",
    "mesh_to_truth_px": "mesh to truth, pixels",
    "truth_to_mesh_px": "truth to mesh, pixels",
    "seconds": "whole command, s",
}
_NUM_SAMPLES = 20_000
"""Points on each of two meshes that are compared."""


@dataclass(frozen=True)
class Options:
    """Make objects of cubes alone and measure them."""

    seeds: tuple[int, ...] = (2, 6)
    """Which objects."""
    kept_apart: tuple[int, ...] = (11, 12)
    """Objects that nobody looked at while settings were chosen."""
    turned: tuple[int, ...] = (2, 12)
    """Objects that are made again of cubes in light that turns with the camera."""
    size: int = 96
    """Rows and columns of the pictures."""
    views: int = 24
    """Pictures of an object under the light of training."""
    bands: int = 12
    """Bands."""
    field_seconds: float = 300.0
    """Of training the field; as long as `unmix-asset` does by default."""
    material_seconds: float = 240.0
    """Of fitting materials; the same."""
    compares: bool = False
    """Fit with the true mesh and light, too, which takes twice as long."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    runs: Path | None = None
    """Keep objects and run folders here."""
    results: Path | None = None
    """Folder for asset.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """One small object, a few seconds."""


def main(options: Options) -> None:
    """Make, measure, publish."""
    from unmix_plugin.neumatex.tracing.environment import MovingFrame

    size, views, bands = (24, 8, 8) if options.quick else (options.size, options.views, options.bands)
    times = (3.0, 2.0) if options.quick else (options.field_seconds, options.material_seconds)
    seeds = options.seeds[:1] if options.quick else (*options.seeds, *options.kept_apart)
    apart = ", ".join(str(seed) for seed in seeds if seed in options.kept_apart)
    setting = {
        "objects": f"procedural, {NUM_MATERIALS} materials, clear sky; seeds {', '.join(map(str, seeds))}, of which "
        f"are kept apart: {apart or 'none'}",
        "pictures": f"{views} of {size} x {size} pixels, {bands} bands; 2 held-out lights",
        "training": f"field {times[0]:g} s, materials {times[1]:g} s",
        "device": options.device,
    }
    machine = _machine.describe_machine(options.device)
    measured: dict[str, list[dict[str, Any]]] = {ALONE: []}
    measured |= {way: [] for way in WAYS if options.compares and not options.quick}
    measured |= {TURNED: []}
    with ExitStack() as stack:
        root = options.runs or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="asset-")))
        for seed in seeds:
            for way, rows in measured.items():
                if way == TURNED and seed not in options.turned:
                    continue
                name, moves = f"{seed}-{size}", None
                if way == TURNED:
                    name, moves = f"{name}-turned", MovingFrame("turntable", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
                truth = written_object(root / f"object-{name}", seed, size, views, bands, moves)
                capture = as_captured(truth, root / f"capture-{name}")
                if way in (ALONE, TURNED):
                    found = make_asset(capture, truth, root / "runs", times, options.device)
                else:
                    found = fit_given(
                        rows_of(measured, seed)["field"],
                        capture,
                        WAYS[way],
                        root / "runs",
                        times[1],
                        options.device,
                    )
                rows.append({"seed": seed, **found})
                print(f"object {seed}, {way}: {found}", flush=True)
    question = "Relit pictures, reflectance, mesh and light of objects that are made of cubes alone"
    figures = judge(measured, options.kept_apart)
    report = _common.Report(
        "asset", question, setting, machine, figures, without_paths(measured), (details(measured),)
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def rows_of(measured: Mapping[str, list[dict[str, Any]]], seed: int) -> dict[str, Any]:
    """What was found of an object from cubes alone."""
    return next(row for row in measured[ALONE] if row["seed"] == seed)


def as_captured(truth: Path, folder: Path) -> Path:
    """An object's cubes, divided by what a white surface reads that is lit best, without mesh and light; these lie in
    `given/`, the light divided too."""
    from unmix_plugin.formats.exr import write_exr
    from unmix_plugin.neumatex.fit.object_scene import load_object
    from unmix_plugin.neumatex.tracing.environment import directions_of_pixels, solid_angles
    from unmix_plugin.neumatex.tracing.light_files import read_exr

    if folder.is_dir():
        return folder
    known = load_object(truth)
    assert known.lamp is not None
    light = known.environment.image[..., int(np.argmax(known.lamp))]
    directions = directions_of_pixels(*light.shape).flatten(0, 1)
    powers = (light * solid_angles(*light.shape)[:, None].float()).flatten()
    normals = directions_of_pixels(24, 48).flatten(0, 1)
    white = float(((normals @ directions.T).clamp(min=0) @ powers).max()) / math.pi
    shutil.copytree(truth, folder, ignore=shutil.ignore_patterns("mesh.glb"))
    content = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    (folder / "environment.exr").unlink()
    for key in ("mesh_path", "environment_path", "environment_moves"):
        content.pop(key, None)
    for frame in content["frames"]:
        path = folder / frame["hyperspectral_file_path"]
        np.save(path, np.load(path).astype(np.float32) / np.float32(white))
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    given = folder / "given"
    given.mkdir()
    shutil.copyfile(truth / "mesh.glb", given / "mesh.glb")
    values, names, _ = read_exr(truth / "environment.exr")
    planes = {name: (values[..., at] / white).astype(np.float32) for at, name in enumerate(names)}
    write_exr(given / "environment.exr", planes, {})
    return folder


def make_asset(
    capture: Path, truth: Path, runs: Path, times: tuple[float, float], device: str
) -> dict[str, Any]:
    """What one command makes of a capture, beside the truth."""
    field_seconds, material_seconds = (f"{seconds:g}" for seconds in times)
    with tempfile.TemporaryDirectory(prefix="made-") as made:
        words = ["--data", str(capture), "--output", made, "--output-dir", str(runs), "--device", device]
        words += ["--field-seconds", field_seconds, "--material-seconds", material_seconds]
        words += ["--endmembers", str(NUM_MATERIALS), "--texture-size", "512", "--page-resolution", "64"]
        ended = _common.run_command([_common.console_script("unmix-asset"), *words, "--overwrite"])
        content = json.loads((Path(made) / "asset.json").read_text(encoding="utf-8"))
        figures = {name: content["figures"].get(name) for name in COLUMNS}
        off = light_angle_deg(Path(made) / "environment.exr", truth)
    decided = {each["subject"]: each["outcome"] for each in content["decisions"]}
    chamfer = mesh_distances(Path(content["runs"]["materials"]), truth)
    found = {**figures, **chamfer, "light_angle_deg": off, "seconds": ended.seconds}
    return {**found, "light": decided["light"], "field": content["runs"]["field"]}


def fit_given(
    field: str, capture: Path, given: tuple[str, ...], runs: Path, seconds: float, device: str
) -> dict[str, Any]:
    """Figures of materials fitted from a field, with some of the truth given."""
    files = {"mesh": "mesh.glb", "environment": "environment.exr"}
    words = ["neumatex", "--from-run", field, "--max-seconds", f"{seconds:g}", "--output-dir", str(runs)]
    words += ["--device", device]
    for name in given:
        words += [f"--{name}", str(capture / "given" / files[name])]
    trained = _common.run_command([_common.console_script("unmix-train"), *words])
    _common.run_command([_common.console_script("unmix-eval"), "--run", str(trained.run), "--device", device])
    figures = json.loads((trained.run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    return {name: figures.get(name) for name in COLUMNS}


def light_angle_deg(found: Path, truth: Path) -> float:
    """Between the brightest directions of an environment and of that of an object, as it stands for the first view."""
    from unmix_plugin.neumatex.fit.object_scene import load_object
    from unmix_plugin.neumatex.tracing.environment import directions_of_pixels
    from unmix_plugin.neumatex.tracing.light_files import read_exr

    known = load_object(truth)
    true = known.environment.seen_from(known.pictures.cameras.camera_to_world[0, :, 3])
    brightest = []
    for picture in (torch.from_numpy(read_exr(found)[0]), true.image):
        grey = picture.mean(dim=-1)
        brightest.append(directions_of_pixels(*grey.shape).flatten(0, 1)[int(grey.argmax())].double())
    return math.degrees(math.acos(float((brightest[0] @ brightest[1]).clamp(-1, 1))))


def mesh_distances(run: Path, truth: Path) -> dict[str, float]:
    """Mean distances from the mesh of a run to the true one and back, in pixels at the distance of the object."""
    import trimesh
    from scipy.spatial import KDTree

    from unmix_plugin.trained.open_run import load_run

    scene: Any = load_run(run, "cpu").scene
    mesh = trimesh.Trimesh(
        scene.frame.to_world(scene.mesh.vertices.double().numpy()), scene.mesh.faces.numpy()
    )
    true = trimesh.load_mesh(truth / "mesh.glb")
    content = json.loads((truth / "transforms.json").read_text(encoding="utf-8"))
    places = np.array([frame["transform_matrix"] for frame in content["frames"]])[:, :3, 3]
    pixel = float(np.linalg.norm(places, axis=1).mean()) / content["fl_x"]
    points = [np.asarray(trimesh.sample.sample_surface(one, _NUM_SAMPLES, seed=0)[0]) for one in (mesh, true)]
    there, back = (float(KDTree(points[1 - k]).query(points[k])[0].mean()) / pixel for k in (0, 1))
    return {"mesh_to_truth_px": there, "truth_to_mesh_px": back}


def judge(measured: Mapping[str, list[dict[str, Any]]], kept_apart: tuple[int, ...]) -> list[_common.Figure]:
    """The lines asked for, of means over the objects; those of objects kept apart; and the other ways beside them."""
    figures = []
    groups = {
        ALONE: measured[ALONE],
        f"{ALONE}, kept apart": [row for row in measured[ALONE] if row["seed"] in kept_apart],
        TURNED: measured[TURNED],
    }
    for name, rows in groups.items():
        if not rows:
            continue
        chamfer = mean((row["mesh_to_truth_px"] + row["truth_to_mesh_px"]) / 2 for row in rows)
        figures += [
            RELIT.judge(f"{name}: relit PSNR", mean(row["relit_psnr"] for row in rows)),
            ANGLE.judge(f"{name}: reflectance angle", mean(row["reflectance_angle"] for row in rows)),
            CHAMFER.judge(f"{name}: chamfer distance of the mesh", chamfer),
            LIGHT.judge(f"{name}: main light, worst", max(row["light_angle_deg"] for row in rows)),
        ]
    for way, rows in measured.items():
        if way in WAYS and rows:
            relit, angle = (mean(row[key] for row in rows) for key in ("relit_psnr", "reflectance_angle"))
            figures.append(
                _common.reported(f"{way}: relit, reflectance angle", f"{relit:.2f} dB, {angle:.4f} rad")
            )
    return figures


def without_paths(measured: Mapping[str, list[dict[str, Any]]]) -> dict[str, list[dict[str, Any]]]:
    """What is published: nothing of where it lay."""
    return {
        way: [{key: value for key, value in row.items() if key != "field"} for row in rows]
        for way, rows in measured.items()
    }


def details(measured: Mapping[str, list[dict[str, Any]]]) -> _common.DetailTable:
    """A line an object and way."""
    rows = [
        [str(row["seed"]), way, *("" if row.get(key) is None else f"{row[key]:.4g}" for key in COLUMNS)]
        for way, found in measured.items()
        for row in found
    ]
    return _common.DetailTable("Each object", ["object", "given", *COLUMNS.values()], sorted(rows))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
