"""How true are lengths and areas, once one distance is known?

    python benchmarks/measures.py [--run RUN]

Trains on the built-in scene (or takes a run of it that is there), gives it a scale by two pixels, away from outlines,
whose distance is that of the true surface, then compares distances between other pixels, and areas of regions, with the
true ones. One unit of the scene counts as 0.1 m. Takes about two minutes.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro

from unmix_plugin.scenes.demo.shading import THINGS
from unmix_plugin.scenes.demo.shapes import first_hits
from unmix_plugin.trained.measured_surface import MeasuredSurface
from unmix_plugin.trained.measures import scale_between
from unmix_plugin.trained.open_run import open_run
from unmix_plugin.trained.regions import Box
from unmix_plugin.trained.trained_scene import TrainedScene

METRES = 0.1
LENGTHS, AREAS = (_common.Limit(2.0, is_upper=True, unit=" %") for _ in range(2))
PAIRS, APART = 40, 0.6
"""Pairs of pixels, and their least distance in units of the scene."""
_AWAY_PX = 3
PARTS = {
    "square on the box": Box((0.3, 0.22, 0.5), (0.7, 0.62, 0.7)),
    "square on the plate": Box((-0.15, -1.15, -0.1), (0.15, -0.85, 0.1)),
    "cap of the ball": Box((-1.0, -0.9, 0.5), (0.0, 0.05, 0.9)),
    "half of the cylinder's side": Box((-0.8, 0.56, 0.2), (0.0, 0.9, 0.7)),
}


@dataclass(frozen=True)
class Options:
    """Compare lengths and areas with the truth."""

    run: Path | None = None
    """Run of the built-in scene, in place of training."""
    max_seconds: float = 45.0
    """Seconds of training."""
    results: Path | None = None
    """Folder for measures.json and measures.md; None: beside the benchmarks."""
    quick: bool = False
    """Two seconds of training."""


def main(options: Options) -> None:
    """Train, set the scale, compare, publish."""
    seconds = 2.0 if options.quick else options.max_seconds
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-measures-")))
        run = options.run
        if run is None:
            words = ["--data", "demo", "--output-dir", str(folder), "--max-seconds", f"{seconds:g}"]
            run = _common.run_command([_common.console_script("unmix-train"), "unmix-nerf", *words]).run
        scene = open_run(run, "cpu")
    ends = pairs_of_points(scene)
    (first, second), (true_first, true_second) = ends[0]
    known_m = METRES * float(np.linalg.norm(true_second - true_first))
    scene = replace(scene, scale=scale_between(first, second, known_m))
    measured = {"lengths": lengths(scene, ends[1:]), "areas": areas(scene)}
    errors = [abs(one["error_percent"]) for one in measured["lengths"]]
    off = {name: one["error_percent"] for name, one in measured["areas"].items()}
    figures = [
        LENGTHS.judge(f"error of {len(errors)} lengths, median", float(np.median(errors))),
        _common.reported("error of lengths, nine of ten below", f"{np.quantile(errors, 0.9):.2f} %"),
        *(AREAS.judge(f"error of the area, {name}", abs(value)) for name, value in off.items()),
        _common.reported("areas are", ", ".join(f"{name} {value:+.1f} %" for name, value in off.items())),
    ]
    setting = {
        "scene": "built-in, 96 x 96 pixels",
        "training": f"{seconds:g} s",
        "known distance": f"{known_m:.3f} m",
    }
    machine = _machine.describe_machine("cpu")
    report = _common.Report(
        "measures", "Lengths and areas with one known distance", setting, machine, figures, measured
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def pairs_of_points(scene: TrainedScene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs of points as probed and as they truly are, (2, 3) each; the first pair is the farthest apart."""
    generator, found = np.random.default_rng(0), []
    views = [view for view in scene.views if view.split == "eval"]
    while len(found) <= PAIRS:
        view = views[int(generator.integers(len(views)))]
        camera, ends, true = view.camera, [], []
        rays = camera.image_rays(0)
        for column, row in generator.integers(_AWAY_PX, camera.width - _AWAY_PX, (2, 2)).tolist():
            # Away from outlines, as one would choose points: what is around is the same thing.
            index = row * camera.width + column
            near = [index + _AWAY_PX * step for step in (0, -1, 1, -camera.width, camera.width)]
            origins = scene.frame.to_world(rays.origins[near].double().numpy())
            along = rays.directions[near].double().numpy() @ scene.frame.rotation
            distances, things = first_hits([thing.placement for thing in THINGS], origins, along)
            is_inside = bool(np.isfinite(distances).all() and (things == things[0]).all())
            probe = scene.probe(camera, column, row)
            if is_inside and probe.opacity > 0.9 and probe.world_position is not None:
                ends.append(probe.world_position)
                true.append(origins[0] + distances[0] * along[0])
        if len(ends) == 2 and np.linalg.norm(true[1] - true[0]) > APART:
            found.append((np.stack(ends), np.stack(true)))
    return sorted(found, key=lambda pair: -float(np.linalg.norm(pair[1][1] - pair[1][0])))


def lengths(scene: TrainedScene, pairs: list[tuple[np.ndarray, np.ndarray]]) -> list[dict[str, float]]:
    """Distances of pairs in metres, and their errors."""
    assert scene.scale is not None
    found = []
    for ends, true in pairs:
        metres = scene.scale.metres_per_unit * float(np.linalg.norm(ends[1] - ends[0]))
        truth = METRES * float(np.linalg.norm(true[1] - true[0]))
        found.append({"metres": metres, "true": truth, "error_percent": 100 * (metres / truth - 1)})
    return found


def areas(scene: TrainedScene) -> dict[str, dict[str, Any]]:
    """Areas of the parts in square centimetres, and their errors."""
    assert scene.scale is not None
    surface = MeasuredSurface.of(scene)
    truth = {
        "square on the box": 0.16,
        "square on the plate": 0.09,
        "cap of the ball": cap_of_the_ball(),
        "half of the cylinder's side": np.pi * 0.24 * 0.5,
    }
    found = {}
    for name, box in PARTS.items():
        cm2 = 1e4 * scene.scale.metres_per_unit**2 * surface.measure(box, name).area
        true = 1e4 * METRES**2 * truth[name]
        found[name] = {"cm2": cm2, "true": true, "error_percent": 100 * (cm2 / true - 1)}
    return found


def cap_of_the_ball() -> float:
    """Area of the ball (half axes 0.44, 0.44, 0.4 about z = 0.4) above z = 0.5, by parts."""
    angles = np.linspace(0.0, np.arccos(0.1 / 0.4), 20_001)
    radius, height = 0.44 * np.sin(angles), 0.4 * np.cos(angles)
    steps = np.hypot(np.diff(radius), np.diff(height))
    return float((np.pi * (radius[1:] + radius[:-1]) * steps).sum())


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
