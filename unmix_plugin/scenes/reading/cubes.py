"""Cubes of spectra: .npy files of unknown origin, their values, and what may be wrong with those.

A file is checked by its header before it is mapped into memory, without pickles. Values are judged after the division
by `value_scale`, a few rows at a time, so that a cube of any size takes little memory. One message serves all frames
that share a fault.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import prod
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.errors import name_some
from unmix_plugin.formats.files import hash_of
from unmix_plugin.scenes.folder import CUBE_KEY
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.reading.entries import FrameEntry, Shape
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.settings import SceneOptions

READ_HEADER = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_ONE_PARSER = Lock()
"""NumPy parses headers as Python literals, which fails in CPython 3.11 if several threads do so at the same moment."""
_BLOCK_VALUES = 1 << 20
"""Values looked at together; 4 MiB as float32."""
_EXCESS_SHARE = 0.01
"""Share of values above 1 that is still taken for saturated highlights when no scale was given; also share of values
far below 0 that a cube with noise around black may have."""
_EXCESS_VALUE = 10.0
"""Greatest value that is still taken for a highlight; beyond it one is refused without a scale, and named with one."""
_LEAST_GREATEST = 0.01
"""Of the greatest value of all cubes; below it the scale must be wrong, or no light was there."""
_NOISE = 0.1
"""Negative values above minus this may be noise around black."""
_EXCESS_SHARE_SCALED = 0.5
"""Share of values above 1 at which a scale that was given must be wrong."""
_OR_REFLECTANCE = "; reflectances times 10000 need 10000"
_INTEGER_SCALES = {
    255.0: "8 bits",
    1023.0: f"10 bits{_OR_REFLECTANCE}",
    4095.0: f"12 bits{_OR_REFLECTANCE}",
    10000.0: "reflectances times 10000; 14 bits need 16383",
    16383.0: f"14 bits{_OR_REFLECTANCE}",
    65535.0: "16 bits",
}
"""What may stand for 1 in integers, and where."""
_FLOAT_SCALES = (100.0, 255.0, 10000.0, 65535.0)
"""Per cent, or integers kept as floats."""
_MOST_READERS = 8
"""Cubes read at once: hashing and comparing take longer than a disk, and don't hold each other up."""
Part = tuple[slice | np.ndarray, ...]
"""What to read of an array, as NumPy indexes it; all if it is empty."""


class UnreadableArrayError(ValueError):
    """A file is no .npy array of numbers; the text says why and what to do."""


@dataclass(frozen=True)
class _ArrayHeader:
    """What a .npy file says of itself before any value is read."""

    shape: tuple[int, ...]
    """Axis lengths."""
    dtype: np.dtype
    """Float or integer type."""
    offset: int
    """Bytes before the first value."""
    is_fortran: bool
    """Whether the first axis runs fastest."""


def read_array_header(path: Path) -> _ArrayHeader:
    """Read and check the header of a .npy file; no value and no pickle is read. Raises UnreadableArrayError: not a .npy
    file, a pickled one, cut short, or of a type that is not float or integer. Raises OSError: the file cannot be
    opened."""
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
        except ValueError as error:
            raise UnreadableArrayError(Message.NO_NPY.sentence()) from error
        if version not in READ_HEADER:
            raise UnreadableArrayError(Message.NPY_VERSION.sentence(version=version))
        try:
            shape, is_fortran, dtype = parse_header(file, version)
        except Exception as error:  # numpy raises SyntaxError, TokenError, ValueError... for a damaged header
            raise UnreadableArrayError(Message.NPY_DAMAGED.sentence()) from error
        offset = file.tell()
        found_bytes = path.stat().st_size - offset
    if not all(type(length) is int and length >= 0 for length in shape):
        raise UnreadableArrayError(Message.NPY_SHAPE.sentence(shape=shape))
    if dtype.hasobject:
        raise UnreadableArrayError(Message.NPY_PICKLED.sentence())
    if dtype.kind not in "fiu":
        raise UnreadableArrayError(Message.NPY_TYPE.sentence(dtype=dtype))
    expected_bytes = prod(shape) * dtype.itemsize
    if found_bytes < expected_bytes:
        values = {"found": found_bytes, "expected": expected_bytes, "shape": shape}
        raise UnreadableArrayError(Message.NPY_CUT.sentence(**values))
    return _ArrayHeader(shape, dtype, offset, is_fortran)


def parse_header(file: Any, version: tuple[int, int]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether the first axis runs fastest, and type, of an open binary file behind its magic string. Raises
    Exception: of NumPy, of many kinds, for a damaged header."""
    with _ONE_PARSER:
        return READ_HEADER[version](file)


def map_array(path: Path) -> np.ndarray:
    """Map a checked .npy file into memory, read-only; values are read when touched."""
    with _ONE_PARSER:
        return np.load(path, mmap_mode="r", allow_pickle=False)


@dataclass(frozen=True)
class _CubeValues:
    """What one cube holds; counts are of single values unless they say pixels."""

    where: str
    """How messages call it."""
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
    def share_above_one(self) -> float:
        """Of the values."""
        return self.num_above_one / self.num_values

    @property
    def num_invalid_pixels(self) -> int:
        """How many pixels are invalid."""
        return 0 if self.invalid is None else int(self.invalid.sum())


def measure_cube(path: Path, options: SceneOptions, where: str = "") -> _CubeValues:
    """What a checked (H, W, B) cube holds; whatever `read_cube` would make of it."""
    cube, value_scale = map_array(path), options.value_scale
    scale = np.float32(1.0 if value_scale is None else value_scale)
    totals = np.zeros(5, dtype=np.int64)  # NaN, infinite, negative, further below 0 than noise, above 1
    greatest, least, invalid = 0.0, 0.0, np.zeros(cube.shape[:2], bool)
    for rows in _row_blocks(cube):
        with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, and counted as such
            compared = cube[rows] if cube.dtype.kind in "iu" else np.asarray(cube[rows], dtype=np.float32)
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
        invalid[rows] = _find_invalid(block, options)
        greatest = max(greatest, float(stored.max(where=finite, initial=0.0)))
        least = min(least, float(block.min(where=finite, initial=0.0)))
    num_nan, num_infinite, num_negative, num_far_negative, num_above_one = totals.tolist()
    return _CubeValues(
        where=where,
        sha256=hash_of(path),
        num_values=cube.size,
        num_pixels=invalid.size,
        is_integer=cube.dtype.kind in "iu",
        greatest=greatest,
        least=least,
        num_nan=num_nan,
        num_infinite=num_infinite,
        num_negative=num_negative,
        num_far_negative=num_far_negative,
        num_above_one=num_above_one,
        invalid=invalid if invalid.any() else None,
    )


def _row_blocks(cube: np.ndarray) -> Iterator[slice]:
    """Rows that are looked at together."""
    height, width, bands = cube.shape
    step = max(1, _BLOCK_VALUES // max(1, width * bands))
    return (slice(first, first + step) for first in range(0, height, step))


def read_cube(path: Path, options: SceneOptions, part: Part = ()) -> Float32[np.ndarray, "*pixels B"]:
    """Spectra in [0, 1]: divided by the scale, values above 1 clipped as a saturated sensor does, unusable pixels 0."""
    values = _read_scaled(path, options, part)
    if options.invalid_pixels != "refuse":
        values[_find_invalid(values, options)] = 0.0
    return np.clip(values, 0.0, 1.0, out=values)


def read_invalid(path: Path, options: SceneOptions, part: Part = ()) -> Bool[np.ndarray, "*pixels"]:
    """Pixels that `read_cube` sets to 0."""
    parts = [part] if part else [(rows,) for rows in _row_blocks(map_array(path))]
    return np.concatenate([_find_invalid(_read_scaled(path, options, one), options) for one in parts])


def _read_scaled(path: Path, options: SceneOptions, part: Part) -> Float32[np.ndarray, "*pixels B"]:
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, hence invalid as NaN is
        values = np.array(map_array(path)[part], dtype=np.float32, order="C")
    scale = options.value_scale
    return values if scale is None else np.divide(values, np.float32(scale), out=values)


def _find_invalid(values: np.ndarray, options: SceneOptions) -> Bool[np.ndarray, "*pixels"]:
    """Pixels of (..., B) values, already divided, that can't be used: NaN, infinite or (unless they are clipped)
    negative in some band."""
    sound = np.isfinite(values)
    return ~np.all(sound if options.invalid_pixels == "clip" else sound & (values >= 0.0), axis=-1)


def _propose_scale(cubes: Sequence[_CubeValues]) -> float:
    """The `value_scale` that most likely brings the stored values of some cubes into [0, 1]."""
    greatest = max(cube.greatest for cube in cubes)
    is_integer = all(cube.is_integer for cube in cubes)
    for scale in _INTEGER_SCALES if is_integer else _FLOAT_SCALES:
        if greatest <= scale and (is_integer or greatest > _EXCESS_VALUE):
            return scale
    digits = int(np.floor(np.log10(max(greatest, 1e-30)))) - 1
    return float(np.round(np.ceil(greatest / 10.0**digits) * 10.0**digits, max(0, -digits)))


def check_cubes(
    frames: Sequence[FrameEntry],
    operators: Sequence[np.ndarray | None],
    options: SceneOptions,
    faults: Faults,
) -> tuple[list[Shape | None], list[_CubeValues | None]]:
    """Check shapes and types against sizes and sensors (operators of (channels, B)), then every value; gives the sizes
    of the frames' images, None where nothing tells one, and what sound cubes hold."""
    sizes: list[Shape | None] = []
    sound: list[Path | None] = []
    shared: tuple[Shape, str] | None = None
    for frame, operator in zip(frames, operators, strict=True):
        where, path, lens = frame.name_of(CUBE_KEY), frame.files.get(CUBE_KEY), frame.camera.lens
        shape = _read_shape(path, "(H, W, B)", where, faults)
        expected = shared
        if lens is not None and lens.width is not None and lens.height is not None:
            expected = (lens.height, lens.width), "as 'w' and 'h' say"
        elif expected is None and shape is not None:
            expected = shared = shape[:2], f"as {where} has"
        if shape is not None and expected is not None and shape[:2] != expected[0]:
            (high, wide), reason = expected
            values = {"width": shape[1], "height": shape[0], "wide": wide, "high": high, "reason": reason}
            faults.note(where, Message.CUBE_SIZE, **values)
            path = None
        elif shape is not None and operator is not None and shape[2] != len(operator):
            listed = "'wavelengths' lists" if frame.bands is None else "its 'bands' list"
            listed = "its responses have" if "responses_path" in frame.paths else listed
            values = {"found": shape[2], "expected": len(operator), "reason": listed}
            faults.note(where, Message.CUBE_BANDS, **values)
        sizes.append(None if expected is None else expected[0])
        sound.append(None if shape is None else path)
    return sizes, _check_values(frames, sound, options, faults)


def _check_values(
    frames: Sequence[FrameEntry], paths: Sequence[Path | None], options: SceneOptions, faults: Faults
) -> list[_CubeValues | None]:
    """Read and check every value of the cubes that have a path."""

    def measure(frame: FrameEntry, path: Path | None) -> _CubeValues | None:
        return None if path is None else measure_cube(path, options, frame.name_of(CUBE_KEY))

    with ThreadPoolExecutor(min(_MOST_READERS, os.cpu_count() or 1)) as readers:
        measured = list(readers.map(measure, frames, paths))
    cubes = [cube for cube in measured if cube is not None]
    unscaled = [cube for cube in cubes if cube.is_integer and options.value_scale is None]
    scaled = [cube for cube in cubes if not cube.is_integer or options.value_scale is not None]
    _note_invalid(scaled, options.invalid_pixels, faults)
    if unscaled:  # one proposal serves the whole scene, from its greatest value
        greatest, proposed = max(cube.greatest for cube in unscaled), _propose_scale(unscaled)
        meaning = f" ({_INTEGER_SCALES[proposed]})" if proposed in _INTEGER_SCALES else ""
        for cube in unscaled:
            faults.note(cube.where, Message.CUBE_INTEGER, greatest=greatest, scale=proposed, meaning=meaning)

    # Values that can't be meant as [0, 1], as saturated highlights in a few places can.
    scale = options.value_scale
    most_share = _EXCESS_SHARE if scale is None else _EXCESS_SHARE_SCALED
    most = _EXCESS_VALUE if scale is None else np.inf
    far_off = [cube for cube in scaled if cube.share_above_one > most_share or cube.greatest > most]
    if far_off:
        values = {
            "given": "" if scale is None else f" after division by --value-scale {scale:g}",
            "greatest": max(cube.greatest for cube in far_off),
            "scale": _propose_scale(far_off),
            "or_clip": ", or to 1 to clip highlights at 1" if scale is None else "",
        }
        for cube in far_off:
            faults.note(cube.where, Message.CUBE_FAR_OFF, **values)
    return measured


def warn_of_scale(cubes: Sequence[_CubeValues], value_scale: float | None) -> tuple[str, ...]:
    """Warnings of a given scale that makes more than highlights brighter than 1, or some far brighter; and of values
    that are all next to 0."""
    scale = value_scale or 1.0
    greatest = max((cube.greatest for cube in cubes), default=0.0)
    if 0.0 < greatest < _LEAST_GREATEST * scale:
        return (
            Message.DARK_VALUES.sentence(
                share=greatest / scale,
                given="" if value_scale is None else f" after division by the value scale {scale:g}",
                greatest=greatest,
                proposed=_propose_scale(cubes),
            ),
        )
    clipped = [
        cube
        for cube in cubes
        if cube.share_above_one > _EXCESS_SHARE or cube.greatest > _EXCESS_VALUE * scale
    ]
    if value_scale is None or not clipped:
        return ()
    warning = Message.CLIPPED.sentence(
        cubes=name_some([cube.where for cube in clipped]),
        share=max(cube.share_above_one for cube in clipped),
        scale=value_scale,
        greatest=max(cube.greatest for cube in clipped),
        proposed=_propose_scale(clipped),
    )
    return (warning,)


def _read_shape(path: Path | None, layout: str, where: str, faults: Faults) -> tuple[int, int, int] | None:
    """Of an array of three axes, none of length 0; None without a path, and with a noted fault for other files."""
    if path is None:
        return None
    try:
        shape = read_array_header(path).shape
    except UnreadableArrayError as error:
        return faults.add(where, str(error))
    except OSError as error:
        return faults.note(where, Message.FILE_CLOSED, reason=error.strerror)
    if len(shape) != 3 or 0 in shape:
        return faults.note(where, Message.NO_CUBE_SHAPE, shape=shape, expected=layout)
    height, width, depth = shape
    return height, width, depth


def check_abundances(
    frames: Sequence[FrameEntry], sizes: Sequence[Shape | None], num_materials: int | None, faults: Faults
) -> None:
    """Check the true abundances of all frames."""
    for frame, size in zip(frames, sizes, strict=True):
        path, where = frame.files.get("abundance_file_path"), frame.name_of("abundance_file_path")
        shape = _read_shape(path, "(H, W, K)", where, faults)
        if path is None or shape is None:
            continue
        if size is not None and shape[:2] != size:
            values = {"width": shape[1], "height": shape[0], "wide": size[1], "high": size[0]}
            faults.note(where, Message.ABUNDANCE_SIZE, **values)
        if num_materials is not None and shape[2] != num_materials:
            faults.note(where, Message.ABUNDANCE_COUNT, found=shape[2], expected=num_materials)
        values = map_array(path)
        if not (values.min() >= -0.01 and values.max() <= 1.01):  # false with any NaN
            faults.note(where, Message.ABUNDANCE_RANGE)


def _note_invalid(cubes: Sequence[_CubeValues], invalid_pixels: str, faults: Faults) -> None:
    """Unusable pixels; counts are summed over the frames, so that one message serves them all."""
    refused = []
    for cube in cubes:
        if invalid_pixels == "refuse" and cube.num_invalid_pixels:
            refused.append(cube)
        elif invalid_pixels != "refuse" and cube.num_invalid_pixels == cube.num_pixels:
            faults.note(cube.where, Message.CUBE_ALL_INVALID)
        elif invalid_pixels == "clip" and not cube.is_noise:
            faults.note(cube.where, Message.CUBE_FAR_NEGATIVE, count=cube.num_far_negative)
    if not refused:
        return
    nan, infinite, negative, invalid, pixels = (
        sum(getattr(cube, name) for cube in refused)
        for name in ("num_nan", "num_infinite", "num_negative", "num_invalid_pixels", "num_pixels")
    )
    counts = ((nan, "NaN"), (infinite, "infinite"), (negative, "negative"))
    found = ", ".join(f"{count} {kind}" for count, kind in counts if count)
    remedy = "mend it, or leave these out with --invalid-pixels mask"
    if negative and all(cube.is_noise for cube in refused):
        remedy += "; for noise around black --invalid-pixels clip, which sets negative values to 0"
    lowest = f", down to {min(cube.least for cube in refused):.3g}" if negative else ""
    subject = "the cube has" if len(refused) == 1 else "their cubes have"
    for cube in refused:
        values = {"pixels": invalid, "all_pixels": pixels, "lowest": lowest, "remedy": remedy}
        faults.note(cube.where, Message.CUBE_INVALID, subject=subject, found=found, **values)
