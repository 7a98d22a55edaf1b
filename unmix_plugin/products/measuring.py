"""What users measure in a run: the scale, by two points of known distance."""

from __future__ import annotations

import re
from pathlib import Path

from unmix_plugin.errors import ConfigError
from unmix_plugin.products import scene_products as products
from unmix_plugin.products.product import Job
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.measures import (
    Scale,
    describe_scale,
    keep_scale,
    require_on_surface,
    scale_between,
)
from unmix_plugin.trained.run_views import find_view


def set_scale(job: Job, asked: products.Scale) -> list[Path]:
    """Keep the scale of a run, or say what is kept where nothing is given."""
    points, distance_m, metres_per_unit = asked.points, asked.distance, asked.metres_per_unit
    if points is None and distance_m is None and metres_per_unit is None:
        job.say(describe_scale(job.loaded.scale))
        return []
    if metres_per_unit is not None:
        if points is not None or distance_m is not None:
            raise ConfigError("give --points and --distance, or --metres-per-unit alone")
        scale = Scale(metres_per_unit, "as set by --metres-per-unit")
    elif points is None or distance_m is None:
        raise ConfigError("give both, --points and the --distance between them")
    else:
        first, second = (find_point(job, text) for text in points)
        scale = scale_between(first, second, distance_m)
        for point in (first, second):
            require_on_surface(job.loaded.scene, point)
    job.say(scale.said)
    return [keep_scale(job.loaded.folder, scale)]


def find_point(job: Job, text: str) -> tuple[float, float, float]:
    """A point of the world: three numbers, or what a view shows in a pixel (VIEW:column,row).

    Raises:
        ConfigError: neither, or the view shows nothing there.
    """
    parts = re.split(r"[\s,]+", text.strip().strip("()"))
    try:
        x, y, z = (float(part) for part in parts)
    except ValueError:
        return _seen_point(job, text)
    if not all(abs(value) < float("inf") for value in (x, y, z)):
        raise ConfigError(f"the point {text} is not finite")
    return x, y, z


def _seen_point(job: Job, text: str) -> tuple[float, float, float]:
    match = re.fullmatch(r"(.+):\s*(\d+)\s*,\s*(\d+)\s*", text)
    if match is None:
        raise ConfigError(
            f"{text!r} is no point: expected x y z in the world, such as '0.1 0.2 0.5', or a pixel of a view as "
            "VIEW:column,row, such as eval_002:120,80"
        )
    view = find_view(job.views("eval"), match[1], job.views("train"))
    found = job.loaded.scene.probe(view.camera, int(match[2]), int(match[3]))
    if found.world_position is None or found.opacity < OCCUPIED_ACCUMULATION:
        raise ConfigError(f"{text}: the view shows nothing there; choose a pixel on the object")
    x, y, z = found.world_position.tolist()
    return x, y, z
