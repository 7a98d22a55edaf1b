"""How long a unit of the poses' world is, by two points that are a known distance apart, each shown in two views."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses.pose_set import PosedCamera, where_rays_meet
from unmix_plugin.captures.spectral_file import CaptureView
from unmix_plugin.errors import ConfigError, did_you_mean

_FLAG = "--known-distance"
_DISTANCES_M = (1e-6, 1e6)
_LEAST_ANGLE_DEG = 2.0
"""Between the two rays of a point; narrower ones meet at a depth that a pixel decides."""
_MOST_MISS_PX, _MOST_MISS = 3.0, 0.005
"""By which a point may miss a pixel, or over the diagonal of the view: what is greater."""
_LEAST_APART_PX = 5.0

_Seen: TypeAlias = dict[str, tuple[float, float]]
"""Where views show a point, by their names: x and y in the file, the first pixel's centre at 0.5."""
KnownDistance: TypeAlias = tuple[_Seen, _Seen, float]
"""Two points, each in two views, and the metres between them."""


def asked_distance(options: ProcessOptions, views: Sequence[CaptureView]) -> KnownDistance | None:
    """What the user measured, if anything. Raises ConfigError: it is not what it must be, or markers give the scale."""
    if options.known_distance is None:
        return None
    if options.marker_size is not None:
        raise ConfigError(f"{_FLAG} and --marker-size both give the scale; give one of them")
    *texts, metres = options.known_distance
    low, high = _DISTANCES_M
    if not low <= metres <= high:
        raise ConfigError(f"{_FLAG}: the distance is {metres:g}; expected metres, {low:g} to {high:g}")
    sizes = {view.name: (view.cube.shape[1], view.cube.shape[0]) for view in views}
    seen = [_parse_pixel(text, sizes) for text in texts]
    first, second = dict(seen[:2]), dict(seen[2:])
    for number, point in enumerate((first, second), 1):
        if len(point) < 2:
            raise ConfigError(f"{_FLAG}: both pixels of point {number} are of one view; expected two views")
    return first, second, metres


def _parse_pixel(text: str, sizes: Mapping[str, tuple[int, int]]) -> tuple[str, tuple[float, float]]:
    match = re.fullmatch(r"(.+):\s*(-?\d+(?:\.\d*)?)\s*,\s*(-?\d+(?:\.\d*)?)\s*", text)
    if match is None:
        raise ConfigError(f"{_FLAG}: {text!r} is no pixel; expected VIEW:column,row, such as view_03:120,80")
    name, column, row = match[1], float(match[2]), float(match[3])
    if name not in sizes:
        hint = did_you_mean(name, sizes, likeness=0.4, form=" ({})")
        raise ConfigError(f"{_FLAG} {text}: no view {name!r}{hint}; expected such as {next(iter(sizes))}")
    right, bottom = (size - 1 for size in sizes[name])
    if not (0 <= column <= right and 0 <= row <= bottom):
        raise ConfigError(
            f"{_FLAG} {text}: outside the view; expected columns 0 to {right}, rows 0 to {bottom}"
        )
    return name, (column + 0.5, row + 0.5)


def metres_per_unit(known: KnownDistance, cameras: Mapping[str, PosedCamera]) -> tuple[float, str]:
    """Metres in a unit of the world that cameras with lenses stand in, and a sentence about it. Raises ConfigError: a
    view has no pose, the pixels of a point are not those of one, or the points are the same."""
    ends = np.stack([_meet(number, point, cameras) for number, point in enumerate(known[:2], 1)])
    shown = [cameras[name].pixels_of(ends) for point in known[:2] for name in point]
    apart = float(np.nanmax([np.linalg.norm(pixels[1] - pixels[0]) for pixels in shown]))
    if not apart > _LEAST_APART_PX:
        raise ConfigError(
            f"{_FLAG}: the two points are {apart:.1f} px apart; expected more than {_LEAST_APART_PX:g}: are they the "
            "same?"
        )
    said = f"the scale is that of two points {known[2]:g} m apart, {apart:.0f} px in the view that shows most"
    said += f": 1 px off there is {1 / apart:.1%} of all lengths or more"
    return known[2] / float(np.linalg.norm(ends[1] - ends[0])), said


def _meet(number: int, point: _Seen, cameras: Mapping[str, PosedCamera]) -> Float64[np.ndarray, "3"]:
    """Where the two rays of a point meet."""
    where, seen, rays = f"{_FLAG}: point {number}, views {' and '.join(point)}", [], []
    limit = _MOST_MISS_PX
    for name, pixel in point.items():
        if name not in cameras:
            raise ConfigError(f"{where}: {name} has no pose; choose another view that shows the point")
        camera = cameras[name]
        pixels = None if camera.lens is None else camera.lens.from_file(np.array([pixel]))
        ray = None if pixels is None else camera.rays_of(pixels)
        if camera.lens is None or pixels is None or ray is None:
            raise ConfigError(f"{where}: the lens of {name} can't be followed there; choose another view")
        seen.append((camera, pixels))
        rays.append(ray[0])
        limit = max(limit, _MOST_MISS * math.hypot(camera.lens.width, camera.lens.height))
    angle = math.degrees(math.asin(min(1.0, float(np.linalg.norm(np.cross(*rays))))))
    if angle < _LEAST_ANGLE_DEG:
        raise ConfigError(
            f"{where}: its rays are nearly parallel ({angle:.2f} degrees between them); expected "
            f"{_LEAST_ANGLE_DEG:g} or more: choose views that are farther apart"
        )
    met = where_rays_meet(seen)
    assert met is not None  # both lenses were followed
    miss = float(np.max(met[1]))
    if not miss <= limit:
        far = "meet behind a camera" if math.isnan(miss) else f"miss each other by {miss:.1f} px"
        raise ConfigError(
            f"{where}: its rays {far}; expected at most {limit:.1f} px: is it one point, and do the poses fit?"
        )
    return met[0][0]
