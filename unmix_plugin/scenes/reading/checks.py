"""The files of a scene's frames: found, read and checked, one frame's values at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.scenes.reading.cubes import check_abundances, check_cubes, say_clipped
from unmix_plugin.scenes.reading.faults import Faults, resolve_path
from unmix_plugin.scenes.reading.images import check_colours, check_labels, check_masks
from unmix_plugin.scenes.reading.sensors import group_by_sensor, read_operators
from unmix_plugin.scenes.reading.transforms_json import CUBE_KEY, FrameEntry, SceneEntry, Size
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.sensor import SceneSensor

_Pixels = Bool[np.ndarray, "_ _"]


@dataclass(frozen=True)
class CheckedFrame:
    """What the checks found of a frame."""

    cube: Path
    sha256: str
    """Of the cube."""
    size: Size
    """Of its pictures."""
    sensor: int
    """Which of the sensors took it."""
    unknown: _Pixels | None
    """Pixels that are not valid or masked out; None without."""
    foreground: _Pixels | None
    """Pixels that may show something: not fully transparent, or unknown; None where the scene has no alpha."""


@dataclass(frozen=True)
class CheckedFiles:
    """All frames, at least one, and what they have in common."""

    frames: tuple[CheckedFrame, ...]
    sensors: tuple[SceneSensor, ...]
    warnings: tuple[str, ...]

    @property
    def has_alpha(self) -> bool:
        """Whether some pixel of a picture is not opaque."""
        return self.frames[0].foreground is not None

    @property
    def sizes(self) -> list[Size]:
        """Of each frame's pictures."""
        return [frame.size for frame in self.frames]


def locate_files(root: Path, entry: SceneEntry, allow_outside: bool, faults: Faults) -> SceneEntry:
    """The entry whose frames know where their files are; a file that two frames share as their cube is a fault."""
    frames: list[FrameEntry] = []
    owner: dict[Path, str] = {}
    for frame in entry.frames:
        files: dict[str, Path] = {}
        for key, text in frame.paths.items():
            least_parts = 1 if key in ("file_path", CUBE_KEY) else 2
            path = resolve_path(root, text, allow_outside, frame.where, faults, least_parts)
            if path is not None:
                files[key] = path
        if CUBE_KEY in files:
            first = owner.setdefault(files[CUBE_KEY].resolve(), frame.where)
            if first != frame.where:
                text = frame.paths[CUBE_KEY]
                faults.add(frame.where, f"is a duplicate: its cube {text!r} is that of {first} too; drop one")
        frames.append(replace(frame, files=files))
    return replace(entry, frames=tuple(frames))


def check_files(
    frames: Sequence[FrameEntry],
    wavelengths_nm: Float64[np.ndarray, " B"] | None,
    num_materials: int | None,
    options: SceneOptions,
    faults: Faults,
) -> CheckedFiles | None:
    """Read and check all files of all frames; None with noted faults if a cube or a sensor is not sound."""
    operators = read_operators(frames, wavelengths_nm, faults)
    sizes, values = check_cubes(frames, operators, options, faults)
    shown, masks = check_colours(frames, sizes, faults), check_masks(frames, sizes, faults)
    check_labels(frames, sizes, num_materials, faults)
    check_abundances(frames, sizes, num_materials, faults)
    cubes = [cube for cube in values if cube is not None]
    known_sizes = [size for size in sizes if size is not None]
    known_operators = [operator for operator in operators if operator is not None]
    if not cubes or len(cubes) < len(frames) or len(known_operators) < len(frames):
        return None
    unknown = [
        _union(cube.invalid, None if mask is None else ~mask) for cube, mask in zip(cubes, masks, strict=True)
    ]
    for cube, mask, missing in zip(cubes, masks, unknown, strict=True):
        has_valid = cube.num_invalid_pixels < cube.num_pixels
        if has_valid and mask is not None and mask.any() and missing is not None and missing.all():
            message = "the mask leaves only pixels with NaN, infinite or negative values; drop the frame"
            faults.add(cube.where, message)
    foreground: list[_Pixels | None] = [None] * len(frames)
    if shown is not None:
        foreground = [
            _union(np.ones(size, bool) if seen is None else seen, missing)
            for size, seen, missing in zip(known_sizes, shown, unknown, strict=True)
        ]
    sensors, indices = group_by_sensor(frames, known_operators, known_sizes, faults)
    paths = [frame.files[CUBE_KEY] for frame in frames]
    hashes = [cube.sha256 for cube in cubes]
    columns = zip(paths, hashes, known_sizes, indices, unknown, foreground, strict=True)
    checked = tuple(CheckedFrame(*row) for row in columns)
    return CheckedFiles(checked, sensors, say_clipped(cubes, options.value_scale))


def _union(one: _Pixels | None, other: _Pixels | None) -> _Pixels | None:
    """Pixels of either set; None is the empty one."""
    if one is None or other is None:
        return other if one is None else one
    return one | other
