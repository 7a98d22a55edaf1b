"""Check the files of every frame against each other: cubes, pictures, labels, masks, abundances.

Each check notes its faults and goes on, so that one reading names them all. Only one frame's values are in memory at
a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.scenes.reading.arrays import ArrayHeader, UnreadableArrayError, map_array, read_array_header
from unmix_plugin.scenes.reading.cube_values import (
    CubeValues,
    is_far_out_of_range,
    measure_cube,
    propose_scale,
)
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_colour, read_labels, read_mask
from unmix_plugin.scenes.reading.scene_paths import resolve_path
from unmix_plugin.scenes.reading.transforms_json import SceneEntry
from unmix_plugin.scenes.scene import UNLABELLED, SceneOptions


@dataclass(frozen=True)
class ImageSize:
    """Pixels of every image of a scene."""

    height: int
    width: int

    def __str__(self) -> str:
        return f"{self.width} x {self.height}"


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


def check_cubes(
    entry: SceneEntry, located: tuple[dict[str, Path], ...], options: SceneOptions, faults: Faults
) -> ImageSize | None:
    """Check shape, type and every value of all cubes; returns the scene's image size, None if no cube tells it."""
    bands = None if entry.wavelengths_nm is None else len(entry.wavelengths_nm)
    bands_from = "as 'wavelengths' lists"
    size, size_from = _stated_size(entry, faults), "as 'w' and 'h' say"
    measured: list[tuple[str, CubeValues]] = []
    for frame, paths in zip(entry.frames, located, strict=True):
        path = paths.get("hyperspectral_file_path")
        where = _name(frame.where, frame.paths.get("hyperspectral_file_path"))
        header = None if path is None else _read_header(path, 3, "(H, W, B)", where, faults)
        if path is None or header is None:
            continue
        found = ImageSize(header.shape[0], header.shape[1])
        if size is None:
            size, size_from = found, f"as {where} has"
        if bands is None:
            bands, bands_from = header.shape[2], f"as {where} has"
        if found != size:
            faults.add(where, f"the cube has {found} pixels (width x height); expected {size}, {size_from}")
        if header.shape[2] != bands:
            faults.add(where, f"the cube has {header.shape[2]} bands; expected {bands}, {bands_from}")
        values = measure_cube(path, options.value_scale)
        measured.append((where, values))
        if options.value_scale is not None or not values.is_integer:
            _note_invalid(values, options, where, faults)
    _note_scales(measured, options, faults)
    return size


def _note_invalid(values: CubeValues, options: SceneOptions, where: str, faults: Faults) -> None:
    if values.num_invalid_pixels == 0:
        return
    if options.invalid_pixels == "mask":
        if values.num_invalid_pixels == values.num_pixels:
            faults.add(where, "every pixel of the cube has a NaN, infinite or negative value; drop the frame")
        return
    counts = ((values.num_nan, "NaN"), (values.num_infinite, "infinite"), (values.num_negative, "negative"))
    found = ", ".join(f"{count} {kind}" for count, kind in counts if count)
    total = f"{values.num_invalid_pixels} of {values.num_pixels} pixels"
    faults.add(
        where,
        f"the cube has {found} values in {total}; mend it, or leave these out with invalid_pixels 'mask'",
    )


def _note_scales(measured: list[tuple[str, CubeValues]], options: SceneOptions, faults: Faults) -> None:
    """Integer cubes and cubes in other units; one proposal serves the whole scene, from its greatest value."""
    scale = options.value_scale
    integers = [(where, values) for where, values in measured if values.is_integer]
    if integers and scale is None:
        greatest = max(values.greatest for _, values in integers)
        proposal = propose_scale(greatest, is_integer=True)
        message = (
            f"the cube holds integers (up to {greatest:g} in this scene); set value_scale to {proposal:g}"
        )
        for where, _ in integers:
            faults.add(where, f"{message}, the number that stands for 1")
    is_judged = [(w, v) for w, v in measured if not (v.is_integer and scale is None)]
    far = [(where, values) for where, values in is_judged if is_far_out_of_range(values, scale)]
    if not far:
        return
    greatest = max(values.greatest for _, values in far)
    proposal = propose_scale(greatest, all(values.is_integer for _, values in far))
    given = "" if scale is None else f" after division by value_scale {scale:g}"
    for where, _ in far:
        message = (
            f"the cube's values are far outside [0, 1]{given} (up to {greatest:g} as stored in this scene)"
        )
        advice = f"set value_scale to {proposal:g}"
        if scale is None:
            advice += ", or to 1 to clip highlights at 1"
        faults.add(where, f"{message}; {advice}")


def check_colours(
    entry: SceneEntry, located: tuple[dict[str, Path], ...], size: ImageSize | None, faults: Faults
) -> bool:
    """Check all pictures; returns whether the scene has alpha.

    It has if some pixel of a picture is not opaque; then every frame must have a picture with an alpha channel.
    """
    has_channel: list[bool] = []
    example = None
    for frame, paths in zip(entry.frames, located, strict=True):
        path = paths.get("file_path")
        where = _name(frame.where, frame.paths.get("file_path"))
        pixels = None if path is None else _read_picture(path, read_colour, size, where, faults)
        has_channel.append(pixels is not None and pixels.shape[2] == 4)
        if pixels is not None and pixels.shape[2] == 4 and example is None and (pixels[..., 3] < 255).any():
            example = frame.where
    if example is None:
        return False
    for frame, paths, is_fine in zip(entry.frames, located, has_channel, strict=True):
        # a picture that is missing or cannot be read has its own fault already
        if not is_fine and ("file_path" in paths) == ("file_path" in frame.paths):
            message = f"has no picture with alpha, while {example} is transparent in places"
            faults.add(
                _name(frame.where, frame.paths.get("file_path")), f"{message}; give alpha to all or to none"
            )
    return True


def check_truth(
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    size: ImageSize | None,
    num_materials: int | None,
    faults: Faults,
) -> None:
    """Check labels, masks and abundances of all frames."""
    for frame, paths in zip(entry.frames, located, strict=True):
        if "seg_file_path" in paths:
            where = _name(frame.where, frame.paths["seg_file_path"])
            labels = _read_picture(paths["seg_file_path"], read_labels, size, where, faults)
            greatest = 0 if labels is None else int(labels.max(where=labels != UNLABELLED, initial=0))
            if num_materials is not None and greatest >= num_materials:
                faults.add(
                    where,
                    f"has label {greatest}; expected 0 to {num_materials - 1} for the materials, or {UNLABELLED}",
                )
        if "mask_path" in paths:
            where = _name(frame.where, frame.paths["mask_path"])
            mask = _read_picture(paths["mask_path"], read_mask, size, where, faults)
            if mask is not None and not mask.any():
                faults.add(
                    where, "the mask is black everywhere, so no pixel of the frame counts; drop the frame"
                )
        if "abundance_file_path" in paths:
            where = _name(frame.where, frame.paths["abundance_file_path"])
            _check_abundances(paths["abundance_file_path"], size, num_materials, where, faults)


def _check_abundances(
    path: Path, size: ImageSize | None, num_materials: int | None, where: str, faults: Faults
) -> None:
    header = _read_header(path, 3, "(H, W, K)", where, faults)
    if header is None:
        return
    found = ImageSize(header.shape[0], header.shape[1])
    if size is not None and found != size:
        faults.add(where, f"has {found} pixels (width x height); expected {size} as the cubes have")
    if num_materials is not None and header.shape[2] != num_materials:
        faults.add(
            where, f"has {header.shape[2]} abundances a pixel; expected {num_materials}, one a material"
        )
    values = map_array(path)
    if not (values.min() >= -0.01 and values.max() <= 1.01):  # false with any NaN
        faults.add(where, "has abundances outside [0, 1] or NaN; expected fractions")


def _stated_size(entry: SceneEntry, faults: Faults) -> ImageSize | None:
    stated: ImageSize | None = None
    for frame in entry.frames:
        lens = frame.intrinsics
        if lens is None or lens.width is None or lens.height is None:
            continue
        found = ImageSize(lens.height, lens.width)
        if stated is None:
            stated = found
        elif found != stated:
            faults.add(frame.where, f"'w' and 'h' say {found}; expected {stated}, one size for all frames")
    return stated


def _read_header(path: Path, axes: int, layout: str, where: str, faults: Faults) -> ArrayHeader | None:
    try:
        header = read_array_header(path)
    except UnreadableArrayError as error:
        faults.add(where, str(error))
        return None
    except OSError as error:
        faults.add(where, f"cannot be opened ({error.strerror})")
        return None
    if len(header.shape) != axes or 0 in header.shape:
        faults.add(where, f"has shape {header.shape}; expected {layout}")
        return None
    return header


def _read_picture(
    path: Path, read: Callable[[Path], Any], size: ImageSize | None, where: str, faults: Faults
) -> np.ndarray | None:
    try:
        pixels = read(path)
    except UnreadableImageError as error:
        faults.add(where, str(error))
        return None
    found = ImageSize(pixels.shape[0], pixels.shape[1])
    if size is not None and found != size:
        faults.add(
            where, f"the picture has {found} pixels (width x height); expected {size} as the cubes have"
        )
        return None
    return pixels


def _name(where: str, text: str | None) -> str:
    return where if text is None else f"{where} {text}"
