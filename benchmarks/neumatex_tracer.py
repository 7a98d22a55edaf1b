"""Does the path tracer agree with Mitsuba 3, and how fast is it beside it?

    pip install 'unmix-nerf[reference]'
    OMP_NUM_THREADS=1 python benchmarks/neumatex_tracer.py

Renders three procedural objects (Lambert, rough conductor, a blend of both) under one asymmetric environment with both
programs, direct light alone and with one bounce, with the same number of paths per pixel. Mitsuba runs its variant
`scalar_rgb`. Both use one thread; speeds are by processor time, since the machine may be busy. What is compared are
means over blocks of pixels, which have little noise; pixels that the object covers only in part are left out, since
the programs place rays in them differently. Takes some minutes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import _common
import _machine
import _mitsuba_scene
import numpy as np
import torch
import tyro
from _reference_materials import ConductorBlend, UniformSurface

from tools.procedural_objects import seeded_mesh
from unmix_plugin.neumatex.demo.objects import viewpoints
from unmix_plugin.neumatex.tracing.built_in_lights import built_in_environment
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh

ASKED = _common.Limit(1.0, is_upper=True, unit=" %")
OBJECTS = {
    "blob, rough conductor": (0, [0.95, 0.7, 0.4, 0.25, 1.0]),
    "vase, Lambert": (1, [0.8, 0.5, 0.3, 0.3, 0.0]),
    "parts, half of each": (2, [0.6, 0.8, 0.7, 0.15, 0.5]),
}
"""Seed of the shape, and parameters of `ConductorBlend`."""
LIGHT = built_in_environment("window-room", 5)
BLOCK = 8
"""Pixels along an edge of a block."""


@dataclass(frozen=True)
class Options:
    """Our path tracer beside Mitsuba."""

    size: int = 48
    """Rows and columns of the pictures, a multiple of 8."""
    paths: int = 1024
    """Paths a pixel."""
    results: Path | None = None
    """Folder for neumatex_tracer.json and the table; None: beside the benchmarks."""
    quick: bool = False
    """Few paths."""


@dataclass(frozen=True)
class Picture:
    """What a program rendered."""

    radiance: np.ndarray
    """(H, W, 3), over black."""
    seconds: float
    """Processor time."""


def ours(mesh: Mesh, parameters: list[float], bounces: int, options: Options) -> tuple[Picture, np.ndarray]:
    """Our picture and its alpha."""
    rays, cameras = RayMesh(mesh), camera(mesh, options)
    surface, generator = UniformSurface(ConductorBlend(), parameters), torch.Generator().manual_seed(1)
    started = time.process_time()
    radiance, alpha = TracedObject(rays, LIGHT, surface).picture(
        cameras, 0, options.paths, bounces, subpixels=4, generator=generator
    )
    return Picture(radiance.numpy(), time.process_time() - started), alpha.numpy()


def camera(mesh: Mesh, options: Options) -> Any:
    """One that sees the whole mesh from above."""
    return viewpoints(1, options.size, float(mesh.vertices.norm(dim=-1).max()), first=4)


def compare(name: str, bounces: int, options: Options) -> dict[str, Any]:
    """Both programs on one object."""
    seed, parameters = OBJECTS[name]
    mesh = seeded_mesh(seed, resolution=64)
    picture, alpha = ours(mesh, parameters, bounces, options)
    with TemporaryDirectory() as folder:
        scene = _mitsuba_scene.Scene(Path(folder), mesh, parameters, LIGHT, camera(mesh, options))
        radiance, seconds = scene.render(bounces, options.paths)
    covered = (alpha == 1).astype(np.float64)[..., None]
    a, b = (block_sums(image * covered) for image in (picture.radiance, radiance))
    used = block_sums(covered)[:, 0] >= BLOCK * BLOCK / 4
    # Mitsuba paths pixels without the object too, but those cost it one ray.
    paths = float((alpha > 0).sum()) * options.paths
    return {
        "object": name,
        "bounces": bounces,
        "mean_relative_difference_percent": 100 * float((np.abs(a - b)[used] / b[used]).mean()),
        "difference_of_means_percent": 100 * float(np.abs(a.sum(axis=0) / b.sum(axis=0) - 1).max()),
        "blocks": int(used.sum()),
        "paths_per_second": paths / picture.seconds,
        "mitsuba_paths_per_second": paths / seconds,
    }


def block_sums(image: np.ndarray) -> np.ndarray:
    """(blocks, C) sums over blocks of pixels."""
    rows, columns, colours = image.shape
    blocks = image.reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK, colours).sum(axis=(1, 3))
    return blocks.reshape(-1, colours)


def kind(bounces: int) -> Literal["direct", "one bounce"]:
    """Words for a number of bounces."""
    return "one bounce" if bounces else "direct"


def report(measured: list[dict[str, Any]], options: Options, machine: dict[str, Any]) -> _common.Report:
    """The table."""
    figures = [
        ASKED.judge(
            f"{row['object']}, {kind(row['bounces'])}: mean relative difference",
            row["mean_relative_difference_percent"],
        )
        for row in measured
    ]
    speeds, others = (
        np.median([row[key] for row in measured]) for key in ("paths_per_second", "mitsuba_paths_per_second")
    )
    figures.append(
        _common.reported(
            "paths a second of one core (median)", f"{speeds:,.0f}; Mitsuba scalar_rgb {others:,.0f}"
        )
    )
    rows = [
        (
            row["object"],
            kind(row["bounces"]),
            f"{row['mean_relative_difference_percent']:.2f} %",
            f"{row['difference_of_means_percent']:.2f} %",
            f"{row['paths_per_second']:,.0f}",
            f"{row['mitsuba_paths_per_second']:,.0f}",
        )
        for row in measured
    ]
    headers = ("object", "light", "blocks differ by", "means differ by", "paths/s", "Mitsuba paths/s")
    return _common.Report(
        "neumatex_tracer",
        "Does the path tracer agree with Mitsuba, and how fast is it beside it?",
        {
            "size": options.size,
            "paths per pixel": options.paths,
            "environment": "window-room",
            "threads": 1,
            "paths a second": "of pixels that show the object; Mitsuba also spends one ray a path on other pixels",
        },
        machine,
        figures,
        measured,
        (_common.DetailTable("Each object", headers, rows),),
    )


def main(options: Options) -> None:
    """Render, compare, publish."""
    if options.quick:
        options = Options(size=16, paths=32, results=options.results, quick=True)
    torch.set_num_threads(1)
    machine = _machine.describe_machine()
    compare(next(iter(OBJECTS)), 0, Options(size=16, paths=16))  # compiles kernels, loads Mitsuba
    measured = [compare(name, bounces, options) for name in OBJECTS for bounces in (0, 1)]
    _common.publish(
        report(measured, options, machine), _common.results_folder(options.results, options.quick)
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
