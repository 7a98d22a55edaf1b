"""Small ENVI files."""

from pathlib import Path

import numpy as np

CODES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12, "u4": 13, "i8": 14, "u8": 15}
AXES = {"bsq": (2, 0, 1), "bil": (0, 2, 1), "bip": (0, 1, 2)}


def write_envi(header: Path, cube: np.ndarray, interleave: str, more: str = "") -> Path:
    """Write a cube (H, W, B) as a header and a file of its name without suffix."""
    header.write_text(header_text(cube, interleave, {}) + more + "\n")
    header.with_suffix("").write_bytes(cube.transpose(AXES[interleave]).tobytes())
    return header


def header_text(cube: np.ndarray, interleave: str, change: dict[str, str | None]) -> str:
    """Header of a cube; entries in `change` replace others, or take them away."""
    lines, samples, bands = cube.shape
    entries = {
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "data type": CODES[cube.dtype.str[1:]],
        "interleave": interleave,
        "byte order": int(cube.dtype.str[0] == ">"),
        **change,
    }
    return "ENVI\n" + "".join(f"{key} = {value}\n" for key, value in entries.items() if value is not None)
