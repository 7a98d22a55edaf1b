"""Check every cube of a scene: shape, type and values; one message serves all frames that share a fault."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from unmix_plugin.scenes.reading.arrays import ArrayHeader, UnreadableArrayError, map_array, read_array_header
from unmix_plugin.scenes.reading.cube_values import (
    CubeValues,
    describe_scale,
    is_far_out_of_range,
    measure_cube,
    propose_scale,
)
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.transforms_json import FrameEntry, SceneEntry
from unmix_plugin.scenes.scene import SceneOptions

_MOST_READERS = 8
"""Cubes read at once: hashing and comparing take longer than a disk, and don't hold each other up."""
Size = tuple[int, int]
"""Height and width in pixels."""


def check_cube_headers(
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    operators: Sequence[np.ndarray | None],
    faults: Faults,
) -> tuple[list[Size | None], list[ArrayHeader | None]]:
    """Check shapes and types against sizes and sensors.

    Args:
        operators: Of each frame, (channels, B); None where unknown.
    Returns:
        Sizes of the frames' images, None where nothing tells one, and the sound headers.
    """
    shared: tuple[Size, str] | None = None
    bands: tuple[int, str] | None = None
    sizes: list[Size | None] = []
    headers: list[ArrayHeader | None] = []
    for frame, paths, operator in zip(entry.frames, located, operators, strict=True):
        path = paths.get("hyperspectral_file_path")
        where = frame.name_of("hyperspectral_file_path")
        header = None if path is None else read_header(path, "(H, W, B)", where, faults)
        expected = _stated_size(frame) or shared
        headers.append(header)
        if header is not None:
            found = header.shape[0], header.shape[1]
            if expected is None:
                expected = shared = found, f"as {where} has"
            if found != expected[0]:
                message = f"expected {describe_size(expected[0])}, {expected[1]}"
                faults.add(where, f"the cube has {describe_size(found)} pixels (width x height); {message}")
                headers[-1] = None
            wanted = bands if operator is None else (len(operator), _bands_from(frame))
            if wanted is None:
                wanted = bands = header.shape[2], f"as {where} has"
            if header.shape[2] != wanted[0]:
                faults.add(where, f"the cube has {header.shape[2]} bands; expected {wanted[0]}, {wanted[1]}")
        sizes.append(None if expected is None else expected[0])
    return sizes, headers


def check_cube_values(
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    headers: list[ArrayHeader | None],
    options: SceneOptions,
    faults: Faults,
) -> list[CubeValues | None]:
    """Read and check every value of the cubes that have a header; returns what each frame's cube holds."""

    def measure(paths: dict[str, Path], header: ArrayHeader | None) -> CubeValues | None:
        if header is None:
            return None
        return measure_cube(paths["hyperspectral_file_path"], options.value_scale, options.invalid_pixels)

    with ThreadPoolExecutor(min(_MOST_READERS, os.cpu_count() or 1)) as readers:
        measured = list(readers.map(measure, located, headers))
    named = [
        (frame.name_of("hyperspectral_file_path"), values)
        for frame, values in zip(entry.frames, measured, strict=True)
        if values is not None
    ]
    scaled = [(w, v) for w, v in named if options.value_scale is not None or not v.is_integer]
    _note_invalid(scaled, options, faults)
    _note_scales(named, options, faults)
    return measured


def read_header(path: Path, layout: str, where: str, faults: Faults) -> ArrayHeader | None:
    """The header of an array of three axes, none of length 0; None and a noted fault otherwise."""
    try:
        header = read_array_header(path)
    except UnreadableArrayError as error:
        faults.add(where, str(error))
        return None
    except OSError as error:
        faults.add(where, f"cannot be opened ({error.strerror})")
        return None
    if len(header.shape) != 3 or 0 in header.shape:
        faults.add(where, f"has shape {header.shape}; expected {layout}")
        return None
    return header


def check_abundances(
    path: Path, size: Size | None, num_materials: int | None, where: str, faults: Faults
) -> None:
    """Check one frame's true abundances."""
    header = read_header(path, "(H, W, K)", where, faults)
    if header is None:
        return
    found = header.shape[0], header.shape[1]
    if size is not None and found != size:
        faults.add(
            where,
            f"has {describe_size(found)} pixels (width x height); expected {describe_size(size)} as the cubes have",
        )
    if num_materials is not None and header.shape[2] != num_materials:
        faults.add(
            where, f"has {header.shape[2]} abundances a pixel; expected {num_materials}, one a material"
        )
    values = map_array(path)
    if not (values.min() >= -0.01 and values.max() <= 1.01):  # false with any NaN
        faults.add(where, "has abundances outside [0, 1] or NaN; expected fractions")


def describe_size(size: Size) -> str:
    """Width x height."""
    return f"{size[1]} x {size[0]}"


def _note_invalid(named: list[tuple[str, CubeValues]], options: SceneOptions, faults: Faults) -> None:
    """Unusable pixels; counts are summed over the frames, so that one message serves them all."""
    usable = []
    for where, values in named:
        if values.num_invalid_pixels == values.num_pixels and options.invalid_pixels != "refuse":
            faults.add(where, "every pixel of the cube has a NaN, infinite or negative value; drop the frame")
        elif options.invalid_pixels == "clip" and not values.is_noise:
            faults.add(
                where,
                f"the cube has {values.num_far_negative} values far below 0, which is not noise; check its dark frame",
            )
        elif values.num_invalid_pixels:
            usable.append((where, values))
    if options.invalid_pixels != "refuse" or not usable:
        return
    cubes = [values for _, values in usable]
    nan, infinite, negative, invalid, pixels = (
        sum(getattr(values, name) for values in cubes)
        for name in ("num_nan", "num_infinite", "num_negative", "num_invalid_pixels", "num_pixels")
    )
    least = min(values.least for values in cubes)
    counts = ((nan, "NaN"), (infinite, "infinite"), (negative, "negative"))
    found = ", ".join(f"{count} {kind}" for count, kind in counts if count)
    remedy = "mend it, or leave these out with invalid_pixels 'mask'"
    if negative and all(values.is_noise for values in cubes):
        remedy += "; for noise around black use 'clip', which sets negative values to 0"
    lowest = f", down to {least:.3g}" if negative else ""
    cube = "the cube has" if len(cubes) == 1 else "their cubes have"
    for where, _ in usable:
        faults.add(where, f"{cube} {found} values in {invalid} of {pixels} pixels{lowest}; {remedy}")


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
            faults.add(where, f"{message}, the number that stands for 1{describe_scale(proposal)}")
    is_judged = [(w, v) for w, v in measured if not (v.is_integer and scale is None)]
    far = [(where, values) for where, values in is_judged if is_far_out_of_range(values, scale)]
    if not far:
        return
    greatest = max(values.greatest for _, values in far)
    proposal = propose_scale(greatest, all(values.is_integer for _, values in far))
    given = "" if scale is None else f" after division by value_scale {scale:g}"
    advice = f"set value_scale to {proposal:g}"
    if scale is None:
        advice += ", or to 1 to clip highlights at 1"
    for where, _ in far:
        faults.add(
            where,
            f"the cube's values are far outside [0, 1]{given} (up to {greatest:g} as stored in this scene); {advice}",
        )


def _stated_size(frame: FrameEntry) -> tuple[Size, str] | None:
    lens = frame.intrinsics
    if lens is None or lens.width is None or lens.height is None:
        return None
    return (lens.height, lens.width), "as 'w' and 'h' say"


def _bands_from(frame: FrameEntry) -> str:
    if "responses_path" in frame.paths:
        return "as its responses have"
    return "as 'wavelengths' lists" if frame.sensor.bands is None else "as its 'bands' list"
