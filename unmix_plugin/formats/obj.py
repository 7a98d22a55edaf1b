"""Wavefront OBJ with a material library beside it; colours of vertices follow their positions.

Notation: `P` vertices, `F` faces, `M` materials.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from unmix_plugin.formats.files import write_file


def obj_paths(path_without_suffix: Path) -> list[Path]:
    """Files that `write_obj` makes."""
    return [path_without_suffix.with_name(path_without_suffix.name + suffix) for suffix in (".obj", ".mtl")]


def write_obj(
    path_without_suffix: Path,
    positions: Float[np.ndarray, "P 3"],
    normals: Float[np.ndarray, "P 3"],
    srgb: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "F 3"],
    materials: Int[np.ndarray, " F"],
    names: Sequence[str],
    palette: Float[np.ndarray, "M 3"],
    comments: Sequence[str] = (),
) -> list[Path]:
    """Write a mesh as NAME.obj and NAME.mtl, with nine significant digits, exact for float32.

    Positions that are float64 have 17.

    Args:
        path_without_suffix: Folder, which is made, and NAME.
        positions, normals: Of the vertices; unit normals.
        srgb: Colours of the vertices in [0, 1], which most viewers show; others show the materials.
        faces, materials: Indices of vertices, and the material of each face.
        names, palette: Of the materials; in names what is not a letter or digit becomes `_`; sRGB.
        comments: First lines.
    """
    obj_path, library_path = obj_paths(path_without_suffix)
    plain = [f"material_{index}_{re.sub(r'[^0-9A-Za-z]+', '_', name)}" for index, name in enumerate(names)]
    text = io.StringIO()
    text.writelines(f"# {' '.join(line.split())}\n" for line in comments)
    text.write(f"mtllib {library_path.name}\n")
    digits = " ".join(3 * ["%.17g" if positions.dtype == np.float64 else "%.9g"])
    np.savetxt(text, np.hstack([positions, srgb]), fmt=f"v {digits} %.9g %.9g %.9g")
    np.savetxt(text, normals, fmt="vn %.9g %.9g %.9g")
    for index in np.unique(materials):
        text.write(f"usemtl {plain[index]}\n")
        corners = faces[materials == index] + 1
        np.savetxt(text, corners.repeat(2, axis=1), fmt="f %d//%d %d//%d %d//%d")
    library = "".join(
        f"newmtl {name}\nKd {colour[0]:.6g} {colour[1]:.6g} {colour[2]:.6g}\nillum 1\n\n"
        for name, colour in zip(plain, palette.tolist(), strict=True)
    )
    write_file(library_path, library.encode())
    return [write_file(obj_path, text.getvalue().encode("utf-8")), library_path]
