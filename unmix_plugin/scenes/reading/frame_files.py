"""The files of every frame: find them, and check them against each other.

Each check notes its faults and goes on, so that one reading names them all. Only one frame's values are in memory at
a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from unmix_plugin.scenes.reading.cube_checks import check_abundances, check_cube_headers, check_cube_values
from unmix_plugin.scenes.reading.faults import Faults, resolve_path
from unmix_plugin.scenes.reading.images import Size
from unmix_plugin.scenes.reading.picture_checks import check_colours, check_labels, check_masks
from unmix_plugin.scenes.reading.sensors import group_by_sensor, read_operators
from unmix_plugin.scenes.reading.transforms_json import SceneEntry
from unmix_plugin.scenes.scene import SceneOptions
from unmix_plugin.spectral.scene_sensor import SceneSensor


@dataclass(frozen=True)
class CheckedFiles:
    """What the checks found on their way through the files."""

    sizes: list[Size]
    """Of each frame's images."""
    sensors: tuple[SceneSensor, ...]
    sensor_indices: tuple[int, ...]
    """Which sensor took each frame."""
    foreground: tuple[Bool[np.ndarray, "_ _"], ...] | None
    """For each frame the pixels that may show something: not fully transparent, or not to be trusted. None where the
    scene has no alpha."""
    cube_hashes: dict[Path, str]
    """SHA-256 of each cube, in the order of the frames."""


def locate_files(
    root: Path, entry: SceneEntry, options: SceneOptions, faults: Faults
) -> tuple[dict[str, Path], ...]:
    """The files of each frame by the key that names them; a file that two frames share as their cube is a fault."""
    located: list[dict[str, Path]] = []
    owner: dict[Path, str] = {}
    for frame in entry.frames:
        paths: dict[str, Path] = {}
        for key, text in frame.paths.items():
            path = resolve_path(root, text, options.allow_outside_paths, frame.where, faults)
            if path is not None:
                paths[key] = path
        cube = paths.get("hyperspectral_file_path")
        if cube is not None:
            first = owner.setdefault(cube.resolve(), frame.where)
            if first != frame.where:
                text = frame.paths["hyperspectral_file_path"]
                faults.add(frame.where, f"is a duplicate: its cube {text!r} is that of {first} too; drop one")
        located.append(paths)
    return tuple(located)


def check_files(
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    num_materials: int | None,
    options: SceneOptions,
    faults: Faults,
) -> CheckedFiles | None:
    """Read and check all files of all frames; None with noted faults if no cube is sound."""
    entries = [
        (frame.where, frame.sensor, paths.get("responses_path"))
        for frame, paths in zip(entry.frames, located, strict=True)
    ]
    operators = read_operators(entries, entry.wavelengths_nm, faults)
    sizes, headers = check_cube_headers(entry, located, operators, faults)
    values = check_cube_values(entry, located, headers, options, faults)
    seen = check_colours(entry, located, sizes, faults)
    masks = check_masks(entry, located, sizes, faults)
    check_labels(entry, located, sizes, num_materials, faults)
    for frame, paths, size in zip(entry.frames, located, sizes, strict=True):
        if "abundance_file_path" in paths:
            where = frame.name_of("abundance_file_path")
            check_abundances(paths["abundance_file_path"], size, num_materials, where, faults)
    cubes = [cube for cube in values if cube is not None]
    known_sizes = [size for size in sizes if size is not None]
    known_operators = [operator for operator in operators if operator is not None]
    if len(cubes) != len(values) or len(known_operators) != len(operators) or not cubes:
        return None
    foreground = None
    if seen is not None:
        foreground = tuple(
            (np.ones(size, bool) if shown is None else shown)
            | (False if cube.invalid is None else cube.invalid)
            | (False if mask is None else ~mask)
            for shown, cube, mask, size in zip(seen, cubes, masks, known_sizes, strict=True)
        )
    paths = [paths["hyperspectral_file_path"] for paths in located]
    sensors, indices = group_by_sensor(entries, known_operators, known_sizes, faults)
    hashes = {path: cube.sha256 for path, cube in zip(paths, cubes, strict=True)}
    return CheckedFiles(known_sizes, sensors, indices, foreground, hashes)
