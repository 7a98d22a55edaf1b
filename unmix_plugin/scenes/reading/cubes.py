"""Cubes of spectra: .npy files of unknown origin, their values, and what may be wrong with those.

A file is checked by its header before it is mapped into memory, without pickles. Values are judged after the division
by `value_scale`, a few rows at a time, so that a cube of any size takes little memory. One message serves all frames
that share a fault.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import prod
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.errors import name_some
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.transforms_json import SceneEntry, Size

READ_HEADER = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_ONE_PARSER = Lock()
"""NumPy parses headers as Python literals, which fails in CPython 3.11 if several threads do so at the same moment."""
_BLOCK_VALUES = 1 << 20
"""Values looked at together; 4 MiB as float32."""
_EXCESS_SHARE = 0.01
"""Share of values above 1 that is still taken for saturated highlights when no scale was given; also share of values
far below 0 that a cube with noise around black may have."""
_EXCESS_VALUE = 10.0
"""Greatest value that is still taken for a highlight when no scale was given."""
_NOISE = 0.1
"""Negative values above minus this may be noise around black."""
_EXCESS_SHARE_SCALED = 0.5
"""Share of values above 1 at which a scale that was given must be wrong."""
_SENSOR_BITS = (8, 10, 12, 14, 16)
"""Of cameras; the greatest number of each stands for 1."""
_REFLECTANCE_SCALE = 10000.0
"""Of reflectances kept as integers, as satellites deliver them."""
_FLOAT_SCALES = (100.0, 255.0, _REFLECTANCE_SCALE, 65535.0)
"""Per cent, or integers kept as floats."""
_MOST_READERS = 8
"""Cubes read at once: hashing and comparing take longer than a disk, and don't hold each other up."""


class UnreadableArrayError(ValueError):
    """A file is no .npy array of numbers; the text says why and what to do."""


@dataclass(frozen=True)
class _ArrayHeader:
    """What a .npy file says of itself before any value is read."""

    shape: tuple[int, ...]
    """Axis lengths."""
    dtype: np.dtype
    """Float or integer type."""


def read_array_header(path: Path) -> _ArrayHeader:
    """Read and check the header of a .npy file; no value and no pickle is read. Raises UnreadableArrayError: not a .npy
    file, a pickled one, cut short, or of a type that is not float or integer. Raises OSError: the file cannot be
    opened."""
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
        except ValueError as error:
            raise UnreadableArrayError("is not a .npy file; write it with numpy.save") from error
        if version not in READ_HEADER:
            raise UnreadableArrayError(f"is a .npy file of version {version}; write it with numpy.save")
        try:
            shape, _, dtype = parse_header(file, version)
        except Exception as error:  # numpy raises SyntaxError, TokenError, ValueError... for a damaged header
            raise UnreadableArrayError("has a damaged .npy header; write it again") from error
        found_bytes = path.stat().st_size - file.tell()
    if not all(type(length) is int and length >= 0 for length in shape):
        raise UnreadableArrayError(f"has the shape {shape} in its .npy header; write it again")
    if dtype.hasobject:
        raise UnreadableArrayError("holds pickled Python objects, which are never loaded: they can run code")
    if dtype.kind not in "fiu":
        raise UnreadableArrayError(f"holds {dtype} values; expected a float or an integer type")
    expected_bytes = prod(shape) * dtype.itemsize
    if found_bytes < expected_bytes:
        expected = f"{expected_bytes} expected for shape {shape}"
        raise UnreadableArrayError(f"is cut short: {found_bytes} bytes of values found, {expected}")
    return _ArrayHeader(shape, dtype)


def parse_header(file: Any, version: tuple[int, int]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether the first axis runs fastest, and type, of an open binary file behind its magic string. Raises
    Exception: of NumPy, of many kinds, for a damaged header."""
    with _ONE_PARSER:
        return READ_HEADER[version](file)


def map_array(path: Path) -> np.ndarray:
    """Map a checked .npy file into memory, read-only; values are read when touched."""
    with _ONE_PARSER:
        return np.load(path, mmap_mode="r", allow_pickle=False)


InvalidPixels = Literal["refuse", "mask", "clip"]


@dataclass(frozen=True)
class _CubeValues:
    """What one cube holds; counts are of single values unless they say pixels."""

    sha256: str
    """Of the whole file."""
    num_values: int
    num_pixels: int
    is_integer: bool
    greatest: float
    """Greatest finite value as stored, before any division; 0 if there is none."""
    least: float
    """Least finite value after the division; 0 if none is negative."""
    num_nan: int
    num_infinite: int
    num_negative: int
    num_far_negative: int
    """Of these, how many are further below 0 than noise around black."""
    num_above_one: int
    """Finite values above 1 after the division."""
    invalid: Bool[np.ndarray, "H W"] | None
    """Pixels with a NaN, infinite or (unless they are clipped) negative value in any band; None if there is none."""

    @property
    def is_noise(self) -> bool:
        """Whether what is negative may be noise around black."""
        return self.num_far_negative <= _EXCESS_SHARE * self.num_values

    @property
    def num_invalid_pixels(self) -> int:
        """How many pixels are invalid."""
        return 0 if self.invalid is None else int(self.invalid.sum())


def _measure_cube(path: Path, value_scale: float | None, invalid_pixels: InvalidPixels) -> _CubeValues:
    """What a checked (H, W, B) cube holds, read once; whatever `read_cube` would make of it."""
    cube = map_array(path)
    height, width, bands = cube.shape
    rows = max(1, _BLOCK_VALUES // max(1, width * bands))
    scale = np.float32(1.0 if value_scale is None else value_scale)
    digest, is_in_file_order = hashlib.sha256(), cube.flags.c_contiguous
    head, end = (cube.offset, cube.offset + cube.nbytes) if is_in_file_order else (-1, 0)  # type: ignore[attr-defined]
    digest.update(_read_bytes(path, 0, head))
    totals = np.zeros(5, dtype=np.int64)  # NaN, infinite, negative, further below 0 than noise, above 1
    greatest, least = 0.0, 0.0
    invalid = np.zeros((height, width), bool)
    for first in range(0, height, rows):
        raw = cube[first : first + rows]
        if is_in_file_order:
            digest.update(raw.view(np.uint8).data)
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # beyond float32 is infinite; both are counted as such
            compared = raw if cube.dtype.kind in "iu" else np.asarray(raw, dtype=np.float32)
            low, high = np.float32(compared.min()), np.float32(compared.max())
            if low >= 0.0 and high <= scale:  # false with any NaN; most blocks of a sound scene end here
                greatest = max(greatest, float(high))
                continue
            stored = np.asarray(compared, dtype=np.float32)
            block = stored if value_scale is None else stored / scale
        finite = np.isfinite(block)
        totals += (
            np.isnan(block).sum(),
            np.isinf(block).sum(),
            ((block < 0.0) & finite).sum(),
            ((block < -_NOISE) & finite).sum(),
            ((block > 1.0) & finite).sum(),
        )
        invalid[first : first + rows] = _find_invalid(block, invalid_pixels)
        greatest = max(greatest, float(stored.max(where=finite, initial=0.0)))
        least = min(least, float(block.min(where=finite, initial=0.0)))
    if is_in_file_order:
        digest.update(_read_bytes(path, end))
    return _CubeValues(
        digest.hexdigest(),
        cube.size,
        height * width,
        cube.dtype.kind in "iu",
        greatest,
        least,
        *(int(total) for total in totals),
        invalid=invalid if invalid.any() else None,
    )


def _read_bytes(path: Path, start: int, count: int = -1) -> bytes:
    with path.open("rb") as file:
        file.seek(start)
        return file.read(count)


def read_cube(
    path: Path,
    value_scale: float | None,
    invalid_pixels: InvalidPixels,
    part: tuple[slice | np.ndarray, ...] = (),
) -> Float32[np.ndarray, "*pixels B"]:
    """Spectra in [0, 1]: divided by the scale, values above 1 clipped as a saturated sensor does, unusable pixels 0.

    Args:
        part: What to read, as NumPy indexes it; all by default.
    """
    values = _read_scaled(path, value_scale, part)
    if invalid_pixels != "refuse":
        values[_find_invalid(values, invalid_pixels)] = 0.0
    return np.clip(values, 0.0, 1.0, out=values)


def read_invalid(
    path: Path,
    value_scale: float | None,
    invalid_pixels: InvalidPixels,
    part: tuple[slice | np.ndarray, ...] = (),
) -> Bool[np.ndarray, "*pixels"]:
    """Pixels that `read_cube` sets to 0."""
    if part:
        return _find_invalid(_read_scaled(path, value_scale, part), invalid_pixels)
    height, width, bands = map_array(path).shape
    rows, invalid = max(1, _BLOCK_VALUES // max(1, width * bands)), np.empty((height, width), bool)
    for first in range(0, height, rows):
        part = (slice(first, first + rows),)
        invalid[first : first + rows] = _find_invalid(_read_scaled(path, value_scale, part), invalid_pixels)
    return invalid


def _read_scaled(
    path: Path, value_scale: float | None, part: tuple[slice | np.ndarray, ...] = ()
) -> Float32[np.ndarray, "*pixels B"]:
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, hence invalid as NaN is
        values = np.array(map_array(path)[part], dtype=np.float32, order="C")
    return values if value_scale is None else np.divide(values, np.float32(value_scale), out=values)


def _find_invalid(values: np.ndarray, invalid_pixels: InvalidPixels) -> Bool[np.ndarray, "*pixels"]:
    """Pixels of (..., B) values, already divided, that can't be used: NaN, infinite or negative in some band.

    With `clip` negative values count as 0 and don't make a pixel invalid.
    """
    sound = np.isfinite(values)
    return ~np.all(sound if invalid_pixels == "clip" else sound & (values >= 0.0), axis=-1)


def _is_far_out_of_range(values: _CubeValues, value_scale: float | None) -> bool:
    """Whether values can't be meant as [0, 1]; saturated highlights in a few places can."""
    share = values.num_above_one / values.num_values
    if value_scale is None:
        return share > _EXCESS_SHARE or values.greatest > _EXCESS_VALUE
    return share > _EXCESS_SHARE_SCALED


def _propose_scale(greatest: float, is_integer: bool) -> float:
    """The `value_scale` that most likely brings stored values up to `greatest` into [0, 1].

    >>> [_propose_scale(greatest, True) for greatest in (243.0, 4000.0, 9100.0, 12000.0, 40000.0)]
    [255.0, 4095.0, 10000.0, 16383.0, 65535.0]
    >>> _propose_scale(87.0, False), _propose_scale(3.14, False)
    (100.0, 3.2)
    """
    bits = sorted([float(2**bits - 1) for bits in _SENSOR_BITS] + [_REFLECTANCE_SCALE])
    for scale in bits if is_integer else _FLOAT_SCALES:
        if greatest <= scale and (is_integer or greatest > _EXCESS_VALUE):
            return scale
    digits = int(np.floor(np.log10(max(greatest, 1e-30)))) - 1
    return float(np.round(np.ceil(greatest / 10.0**digits) * 10.0**digits, max(0, -digits)))


def _describe_scale(scale: float) -> str:
    """What a scale stands for, for messages; empty for one that nothing is known of.

    >>> _describe_scale(4095.0), _describe_scale(3.2)
    (' (12 bits; reflectances times 10000 need 10000)', '')
    """
    bits = {float(2**bits - 1): bits for bits in _SENSOR_BITS}.get(scale)
    if bits is None:
        return " (reflectances times 10000; 14 bits need 16383)" if scale == _REFLECTANCE_SCALE else ""
    return f" ({bits} bits{'; reflectances times 10000 need 10000' if 8 < bits < 16 else ''})"


def check_cube_headers(
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    operators: Sequence[np.ndarray | None],
    faults: Faults,
) -> tuple[list[Size | None], list[_ArrayHeader | None]]:
    """Check shapes and types against sizes and sensors.

    Args:
        operators: Of each frame, (channels, B); None where unknown.
    Returns:
        Sizes of the frames' images, None where nothing tells one, and the sound headers.
    """
    shared: tuple[Size, str] | None = None
    bands: tuple[int, str] | None = None
    sizes: list[Size | None] = []
    headers: list[_ArrayHeader | None] = []
    for frame, paths, operator in zip(entry.frames, located, operators, strict=True):
        path = paths.get("hyperspectral_file_path")
        where = frame.name_of("hyperspectral_file_path")
        header = None if path is None else _read_header(path, "(H, W, B)", where, faults)
        lens, expected = frame.intrinsics, shared
        if lens is not None and lens.width is not None and lens.height is not None:
            expected = (lens.height, lens.width), "as 'w' and 'h' say"
        headers.append(header)
        if header is not None:
            found = header.shape[0], header.shape[1]
            if expected is None:
                expected = shared = found, f"as {where} has"
            if found != expected[0]:
                wide = f"{found[1]} x {found[0]} pixels (width x height)"
                message = f"expected {expected[0][1]} x {expected[0][0]}, {expected[1]}"
                faults.add(where, f"the cube has {wide}; {message}")
                headers[-1] = None
            wanted = bands
            if operator is not None and "responses_path" in frame.paths:
                wanted = len(operator), "as its responses have"
            elif operator is not None:
                listed = "'wavelengths' lists" if frame.sensor.bands is None else "its 'bands' list"
                wanted = len(operator), f"as {listed}"
            if wanted is None:
                wanted = bands = header.shape[2], f"as {where} has"
            if header.shape[2] != wanted[0]:
                faults.add(where, f"the cube has {header.shape[2]} bands; expected {wanted[0]}, {wanted[1]}")
        sizes.append(None if expected is None else expected[0])
    return sizes, headers


def check_cube_values(
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    headers: list[_ArrayHeader | None],
    value_scale: float | None,
    invalid_pixels: InvalidPixels,
    faults: Faults,
) -> list[_CubeValues | None]:
    """Read and check every value of the cubes that have a header; returns what each frame's cube holds."""

    def measure(paths: dict[str, Path], header: _ArrayHeader | None) -> _CubeValues | None:
        if header is None:
            return None
        return _measure_cube(paths["hyperspectral_file_path"], value_scale, invalid_pixels)

    with ThreadPoolExecutor(min(_MOST_READERS, os.cpu_count() or 1)) as readers:
        measured = list(readers.map(measure, located, headers))
    named = [
        (frame.name_of("hyperspectral_file_path"), values)
        for frame, values in zip(entry.frames, measured, strict=True)
        if values is not None
    ]
    scaled = [(w, v) for w, v in named if value_scale is not None or not v.is_integer]
    _note_invalid(scaled, invalid_pixels, faults)
    _note_scales(named, value_scale, faults)
    return measured


def say_clipped(named: Sequence[tuple[str, _CubeValues]], value_scale: float | None) -> tuple[str, ...]:
    """Warnings of a given scale that makes more than highlights brighter than 1.

    Args:
        named: What each cube holds, and how messages call it.
    """
    shares = {where: values.num_above_one / values.num_values for where, values in named}
    clipped = {where: share for where, share in shares.items() if share > _EXCESS_SHARE}
    if value_scale is None or not clipped:
        return ()
    stored = [values for where, values in named if where in clipped]
    share, greatest = max(clipped.values()), max(values.greatest for values in stored)
    proposal = _propose_scale(greatest, all(values.is_integer for values in stored))
    found = f"up to {share:.0%} of the values are above 1 after division by the value scale {value_scale:g}"
    stored_as = f"and count as 1 (up to {greatest:g} as stored)"
    advice = f"if they are no highlights, give --value-scale {proposal:g}"
    return (f"{name_some(list(clipped))}: {found} {stored_as}; {advice}",)


def _read_header(path: Path, layout: str, where: str, faults: Faults) -> _ArrayHeader | None:
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
    header = _read_header(path, "(H, W, K)", where, faults)
    if header is None:
        return
    found = header.shape[0], header.shape[1]
    if size is not None and found != size:
        expected = f"{size[1]} x {size[0]} as the cubes have"
        faults.add(where, f"has {found[1]} x {found[0]} pixels (width x height); expected {expected}")
    if num_materials is not None and header.shape[2] != num_materials:
        abundances = f"has {header.shape[2]} abundances a pixel"
        faults.add(where, f"{abundances}; expected {num_materials}, one a material")
    values = map_array(path)
    if not (values.min() >= -0.01 and values.max() <= 1.01):  # false with any NaN
        faults.add(where, "has abundances outside [0, 1] or NaN; expected fractions")


def _note_invalid(
    named: list[tuple[str, _CubeValues]], invalid_pixels: InvalidPixels, faults: Faults
) -> None:
    """Unusable pixels; counts are summed over the frames, so that one message serves them all."""
    usable = []
    for where, values in named:
        if values.num_invalid_pixels == values.num_pixels and invalid_pixels != "refuse":
            faults.add(where, "every pixel of the cube has a NaN, infinite or negative value; drop the frame")
        elif invalid_pixels == "clip" and not values.is_noise:
            found = f"the cube has {values.num_far_negative} values far below 0"
            faults.add(where, f"{found}, which is not noise; check its dark frame")
        elif values.num_invalid_pixels:
            usable.append((where, values))
    if invalid_pixels != "refuse" or not usable:
        return
    cubes = [values for _, values in usable]
    nan, infinite, negative, invalid, pixels = (
        sum(getattr(values, name) for values in cubes)
        for name in ("num_nan", "num_infinite", "num_negative", "num_invalid_pixels", "num_pixels")
    )
    least = min(values.least for values in cubes)
    counts = ((nan, "NaN"), (infinite, "infinite"), (negative, "negative"))
    found = ", ".join(f"{count} {kind}" for count, kind in counts if count)
    remedy = "mend it, or leave these out with --invalid-pixels mask"
    if negative and all(values.is_noise for values in cubes):
        remedy += "; for noise around black --invalid-pixels clip, which sets negative values to 0"
    lowest = f", down to {least:.3g}" if negative else ""
    cube = "the cube has" if len(cubes) == 1 else "their cubes have"
    for where, _ in usable:
        faults.add(where, f"{cube} {found} values in {invalid} of {pixels} pixels{lowest}; {remedy}")


def _note_scales(measured: list[tuple[str, _CubeValues]], scale: float | None, faults: Faults) -> None:
    """Integer cubes and cubes in other units; one proposal serves the whole scene, from its greatest value."""
    integers = [(where, values) for where, values in measured if values.is_integer]
    if integers and scale is None:
        greatest = max(values.greatest for _, values in integers)
        proposal = _propose_scale(greatest, is_integer=True)
        holds = f"the cube holds integers (up to {greatest:g} in this scene)"
        meant = f"the number that stands for 1{_describe_scale(proposal)}"
        for where, _ in integers:
            faults.add(where, f"{holds}; give --value-scale {proposal:g}, {meant}")
    is_judged = [(w, v) for w, v in measured if not (v.is_integer and scale is None)]
    far = [(where, values) for where, values in is_judged if _is_far_out_of_range(values, scale)]
    if not far:
        return
    greatest = max(values.greatest for _, values in far)
    proposal = _propose_scale(greatest, all(values.is_integer for _, values in far))
    given = "" if scale is None else f" after division by --value-scale {scale:g}"
    advice = f"give --value-scale {proposal:g}"
    if scale is None:
        advice += ", or to 1 to clip highlights at 1"
    found = f"the cube's values are far outside [0, 1]{given} (up to {greatest:g} as stored in this scene)"
    for where, _ in far:
        faults.add(where, f"{found}; {advice}")
