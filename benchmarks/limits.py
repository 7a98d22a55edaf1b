"""What do the limits on strangers' files cost an honest one?

    python benchmarks/limits.py

One cube in each format that is checked before it is decoded, opened and read with the checks and without, in turn.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import _common
import _machine
import h5py
import numpy as np
import OpenEXR
import scipy.io
import tifffile
import tyro

from unmix_plugin.captures.readers import arrays, containers, exr, opening, tiff
from unmix_plugin.captures.readers.opening import open_spectral_file

MOST_SHARE = 0.02
CHECKS = ("allow_decoded", "allow_parts", "allow_depth")
READERS = (arrays, containers, exr, opening, tiff)


@dataclass(frozen=True)
class Options:
    """Time readers with their limits and without."""

    size: int = 400
    """Pixels along an edge of the cube."""
    bands: int = 100
    """Of the cube, as 16-bit integers."""
    pairs: int = 15
    """Readings of each kind."""
    results: Path | None = None
    """Folder for limits.json and limits.md; None: beside the benchmarks."""
    quick: bool = False
    """A tiny cube, twice."""


def main(options: Options) -> None:
    """Write, read, publish."""
    size, bands, pairs = (32, 4, 2) if options.quick else (options.size, options.bands, options.pairs)
    generator = np.random.default_rng(0)
    cube = generator.integers(0, 4096, (size, size, bands), dtype=np.uint16)
    with tempfile.TemporaryDirectory() as folder:
        files = write_cubes(Path(folder), cube)
        rows, shares = [], []
        for path in files:
            with_s, without_s = time_pairs(path, pairs)
            share = statistics.median(a / b for a, b in zip(with_s, without_s, strict=True)) - 1
            shares.append(share)
            rows.append(
                (
                    path.suffix,
                    *(f"{1000 * statistics.median(s):.1f}" for s in (with_s, without_s)),
                    f"{share:+.2%}",
                )
            )
    report = _common.Report(
        "limits",
        "What the limits on strangers' files cost an honest cube",
        {"cube": f"{size} x {size} x {bands}, uint16", "pairs": pairs},
        _machine.describe_machine(),
        [
            _common.Limit(100 * MOST_SHARE, is_upper=True, unit=" %").judge(
                "most, in the median", 100 * max(shares)
            )
        ],
        {"share": dict(zip([path.suffix for path in files], shares, strict=True))},
        (_common.DetailTable("Processor time", ("format", "with, ms", "without, ms", "difference"), rows),),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def write_cubes(folder: Path, cube: np.ndarray) -> list[Path]:
    """The cube in each format."""
    nm = np.linspace(400, 900, cube.shape[2])
    tifffile.imwrite(folder / "a.tif", np.moveaxis(cube, 2, 0), compression="zlib", photometric="minisblack")
    scipy.io.savemat(folder / "a.mat", {"cube": cube, "wavelengths": nm}, do_compression=True)
    np.savez_compressed(folder / "a.npz", cube=cube, wavelengths=nm)
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("cube", data=cube, compression="gzip", chunks=(32, 32, cube.shape[2]))
        file["wavelengths"] = nm
    planes = {
        f"{w:.1f}nm".replace(".", ",", 1): np.ascontiguousarray(cube[..., i], np.float32)
        for i, w in enumerate(nm)
    }
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {f"S0.{n}": p for n, p in planes.items()}).write(
        str(folder / "a.exr")
    )
    return [folder / f"a.{ending}" for ending in ("tif", "mat", "npz", "h5", "exr")]


def time_pairs(path: Path, pairs: int) -> tuple[list[float], list[float]]:
    """Processor seconds of reading with the checks and without, in turn."""

    def seconds(prepare: Callable[[ExitStack], object]) -> float:
        with ExitStack() as stack:
            prepare(stack)
            started = time.process_time()
            open_spectral_file(path).read()
            return time.process_time() - started

    def without(stack: ExitStack) -> None:
        for module in READERS:
            for name in CHECKS:
                if hasattr(module, name):
                    stack.enter_context(mock.patch.object(module, name, return_value=None))

    seconds(lambda _: None)
    taken = [(seconds(lambda _: None), seconds(without)) for _ in range(pairs)]
    return [a for a, _ in taken], [b for _, b in taken]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
