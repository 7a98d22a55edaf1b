"""What a user measured and marked in a run, kept in its folder as `measures.json`: how long a unit of its world is, and
named regions of its surface.

The world is that of the scene's poses, in which probes and exports give positions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from jaxtyping import Float64
from msgspec import Meta

from unmix_plugin.engine.runs.run_folder import RunFolder, RunLock
from unmix_plugin.engine.runs.run_json import read_run_json, write_run_json
from unmix_plugin.errors import ConfigError, RunError, did_you_mean
from unmix_plugin.scenes.folder import METRES_KEY, METRES_RANGE
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.regions import (
    MOST_REGIONS,
    Region,
    WrittenRegion,
    check_name,
    read_region,
    region_to_json,
)

_LONGEST_TEXT = 200
_DAMAGE = (ValueError, RuntimeError, OverflowError, ConfigError)
"""What reading a file that holds something else raises."""
_LONGEST_CHANGE_S = 20.0
_CENTIMETRES_FROM_M, _METRES_FROM_M = 0.01, 1.0


@dataclass(frozen=True)
class Scale:
    """How long a unit of a scene's world is."""

    metres_per_unit: float
    """Metres."""
    how: str
    """Where this is known from, for people."""

    def __post_init__(self) -> None:
        low, high = METRES_RANGE
        if not low <= self.metres_per_unit <= high:
            raise ConfigError(
                f"a unit of the scene would be {self.metres_per_unit:g} m long; expected {low:g} to {high:g}: is the "
                "distance in metres?"
            )

    @property
    def in_words(self) -> str:
        """The scale as a line for people and for headers of files."""
        return f"1 unit is {self.metres_per_unit:.6g} m ({self.how})"


@dataclass(frozen=True)
class Measures:
    """What is kept with a run."""

    scale: Scale | None = None
    """As it was set for the run; None: as its scene says, if it does."""
    regions: Mapping[str, Region] = field(default_factory=dict)
    """By name, in the order in which they were kept."""

    def region(self, name: str) -> Region:
        """A region by its name; a ConfigError where there is none."""
        if name not in self.regions:
            kept = ", ".join(self.regions) or "none; unmix-export regions --add NAME keeps one"
            hint = did_you_mean(name, list(self.regions), likeness=0.4, form=" ({})")
            raise ConfigError(f"there is no region {name!r}{hint}; kept are {kept}")
        return self.regions[name]


def describe_scale(scale: Scale | None) -> str:
    """What headers of exported files say of lengths."""
    return "lengths are in units of the scene, of unknown size" if scale is None else scale.in_words


def describe_length(units: float, scale: Scale | None) -> str:
    """A length of the world in metres, centimetres or millimetres, or in its units where their size is unknown.

    >>> describe_length(0.5, Scale(0.1, "")), describe_length(0.5, None)
    ('5 cm', '0.5 units')
    """
    if scale is None:
        return f"{units:.4g} units"
    metres = units * scale.metres_per_unit
    if metres >= _METRES_FROM_M:
        return f"{metres:.4g} m"
    return f"{100 * metres:.4g} cm" if metres >= _CENTIMETRES_FROM_M else f"{1000 * metres:.4g} mm"


def describe_area(square_units: float, scale: Scale | None) -> str:
    """An area of the world in square metres or centimetres, or in its units where their size is unknown.

    >>> describe_area(0.5, Scale(0.1, "")), describe_area(0.5, None)
    ('50 cm²', '0.5 square units')
    """
    if scale is None:
        return f"{square_units:.4g} square units"
    square_metres = square_units * scale.metres_per_unit**2
    return f"{square_metres:.4g} m²" if square_metres >= 1.0 else f"{1e4 * square_metres:.4g} cm²"


class _WrittenScale(msgspec.Struct):
    metres_per_unit: float
    how: Annotated[str, Meta(max_length=_LONGEST_TEXT)]


class _WrittenMeasures(msgspec.Struct):
    """What `measures.json` holds."""

    scale: _WrittenScale | None = None
    regions: Annotated[dict[str, WrittenRegion], Meta(max_length=MOST_REGIONS)] = {}


def recorded_scale(summary: Mapping[str, Any]) -> Scale | None:
    """What the scene of a run said of its world's units; None where it did not, a RunError where that is damaged."""
    try:
        metres = msgspec.convert(summary.get(METRES_KEY), float | None)
        return None if metres is None else Scale(metres, "as the scene's poses say")
    except (ConfigError, ValueError) as error:
        raise RunError(f"the run's scene.json is damaged: {error}") from error


def read_measures(run: RunFolder) -> Measures:
    """What is kept with a run, nothing where nothing was measured; a RunError where the file is damaged."""
    path = measures_path(run)
    if not path.exists() and not path.is_symlink():
        return Measures()
    values = read_run_json(path)
    try:
        written = msgspec.convert(values, _WrittenMeasures)
        scale, regions = None, written.regions
        if written.scale is not None:
            how = "".join(letter for letter in written.scale.how if letter.isprintable())
            scale = Scale(written.scale.metres_per_unit, how)
        return Measures(
            scale, {check_name(name, regions): read_region(region) for name, region in regions.items()}
        )
    except _DAMAGE as error:
        raise RunError(f"{path} is damaged: {error}; remove it, and measure again") from error


def _write_measures(run: RunFolder, measures: Measures) -> Path:
    """Keep measures with a run, in place of those before; the file."""
    scale = measures.scale
    kept = {} if scale is None else {"scale": {"metres_per_unit": scale.metres_per_unit, "how": scale.how}}
    regions = {name: region_to_json(region) for name, region in measures.regions.items()}
    write_run_json(measures_path(run), {**kept, "regions": regions})
    return measures_path(run)


@contextmanager
def _changing(run: RunFolder) -> Iterator[Measures]:
    """Context with what is kept, in which no other process or thread changes it."""
    lock = RunLock(run.path / "measures.lock", "command or viewer", _LONGEST_CHANGE_S)
    try:
        yield read_measures(run)
    finally:
        lock.release()


def keep_scale(run: RunFolder, scale: Scale) -> Path:
    """Set the scale of a run, in place of the one before; the file."""
    with _changing(run) as measures:
        return _write_measures(run, replace(measures, scale=scale))


def keep_region(run: RunFolder, name: str, region: Region | None) -> Path:
    """Keep a region with a run, in place of one of its name; None removes that. The file.

    Raises:
        ConfigError: the name can't be one, there are too many regions, or there is none to remove.
    """
    with _changing(run) as measures:
        name = check_name(name, () if region is None else measures.regions)
        if region is None:
            measures.region(name)
        regions = {key: kept for key, kept in measures.regions.items() if key != name}
        if region is not None:
            regions[name] = region
        if len(regions) > MOST_REGIONS:
            raise ConfigError(f"a run keeps at most {MOST_REGIONS} regions; remove one first")
        return _write_measures(run, replace(measures, regions=regions))


def scale_between(first: Sequence[float], second: Sequence[float], distance_m: float) -> Scale:
    """The scale of a world in which two points (x, y, z) are so far apart.

    Raises:
        ConfigError: no distance, or no two points.
    """
    if not 0 < distance_m < math.inf:
        raise ConfigError(f"the distance is {distance_m:g} m; it must be greater than 0")
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    units = float(np.linalg.norm(b - a))
    if not units > 1e-9 * max(1.0, float(np.abs(a).max())):
        raise ConfigError("the two points are the same; choose two that are a known distance apart")
    return Scale(distance_m / units, f"{distance_m:g} m between {_text(a)} and {_text(b)}")


_TOLERANCE_PX = 4.0
"""By which a point may be before or behind what a view shows, in pixels as large as they are there."""


def require_on_surface(scene: RenderableScene, point: Sequence[float]) -> None:
    """Refuse a point of the world that lies on nothing that the scene's views show."""
    import torch

    world = np.asarray(point, dtype=np.float64)
    place = torch.from_numpy(scene.frame.to_model(world)).float()[None]
    nearest = math.inf
    for view in scene.views:
        camera = view.camera.to("cpu")
        coords, depths = camera.project(place, 0)
        column, row = (int(value) if math.isfinite(value) else -1 for value in coords[0].tolist())
        width, height = camera.size(0)
        if not (depths[0] > 0 and 0 <= column < width and 0 <= row < height):
            continue
        found = scene.probe(camera, column, row)
        if found.world_position is None or found.opacity < OCCUPIED_ACCUMULATION:
            continue
        pixel = float(depths[0] / camera.focal_px[0].min()) / scene.frame.scale
        nearest = min(nearest, float(np.linalg.norm(found.world_position - world)) / pixel)
        if nearest <= _TOLERANCE_PX:
            return
    seen = (
        "no view shows anything there" if math.isinf(nearest) else f"the nearest is {nearest:.0f} pixels off"
    )
    raise ConfigError(
        f"the point {_text(world)} is not on the object: {seen}; choose a point that views show"
    )


def _text(point: Float64[np.ndarray, "3"]) -> str:
    return " ".join(f"{value:.6g}" for value in point)


def measures_path(run: RunFolder) -> Path:
    """The file that keeps the measures of a run."""
    return run.path / "measures.json"
