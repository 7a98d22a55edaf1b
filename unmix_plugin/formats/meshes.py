"""Meshes and points as PLY, Wavefront OBJ and binary glTF.

PLY is binary, little-endian, with any number of properties a vertex. An OBJ has its materials in a file beside it, and
colours of vertices after their positions. A GLB holds one mesh, in colours and any other numbers a vertex, or in the
textures of a metallic-roughness material.

Written here rather than by plyfile, which takes seconds for the faces of a fine mesh, and by trimesh, which rounds
colours to 8 bits and knows no samplers.
Source: Khronos Group, glTF 2.0 specification, sections 3.7 (meshes), 3.9 (materials), 4 (GLB) and appendix B.

Notation: `P` vertices, `F` faces, `M` materials.
"""

from __future__ import annotations

import io
import json
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, UInt8

from unmix_plugin import __version__
from unmix_plugin.formats.envi import beside
from unmix_plugin.formats.files import write_file
from unmix_plugin.limits import MOST_TABLE_BYTES, read_bounded
from unmix_plugin.spectral.colour.srgb import decode_srgb

_STANDARD = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
"""Properties of a PLY that every program knows."""
_SCALAR = "scalar_"
_TYPES = {"float32": "float", "float64": "double", "uint8": "uchar", "int32": "int"}
_FLOAT, _UNSIGNED_INT = 5126, 5125
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_POINTS = 0
_Y = np.array([0.0, 1.0, 0.0])
_LINEAR, _LINEAR_MIPMAPS, _CLAMP = 9729, 9987, 33071
_READ_TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_READ_TYPES |= {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"}
_READ_TYPES |= {"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"}


def with_scalar_fields(
    vertices: Mapping[str, np.ndarray], comments: Sequence[str]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Properties and comments of a PLY whose numbers CloudCompare opens as scalar fields without being asked: it takes
    those named `scalar_NAME`, and calls them NAME.

    Source: CloudCompare, libs/qCC_io/src/PlyFilter.cpp.
    """
    named = {name if name in _STANDARD else f"{_SCALAR}{name}": values for name, values in vertices.items()}
    return named, [*comments, f"properties {_SCALAR}NAME: the numbers that are called NAME here"]


def write_ply(
    path: Path,
    vertices: Mapping[str, np.ndarray],
    faces: Int[np.ndarray, "F 3"] | None = None,
    comments: Sequence[str] = (),
) -> Path:
    """Write vertices and, if given, triangles.

    Args:
        path: File; its folder is made.
        vertices: Properties by name (those of `_STANDARD` have a known meaning), each (P,) of float32, float64, uint8
            or int32.
        faces, comments: Indices of vertices, and lines of the header.
    Raises:
        KeyError: a property of another type.
    """
    kinds = [(name, values.dtype.newbyteorder("<")) for name, values in vertices.items()]
    count = len(next(iter(vertices.values())))
    table = np.empty(count, dtype=kinds)
    for name, values in vertices.items():
        table[name] = values
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {' '.join(line.split())}" for line in comments]
    header += [f"element vertex {count}"]
    header += [f"property {_TYPES[values.dtype.name]} {name}" for name, values in vertices.items()]
    body = table.tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        rows = np.empty(len(faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
        rows["count"], rows["indices"] = 3, faces
        body += rows.tobytes()
    return write_file(path, "\n".join([*header, "end_header", ""]).encode("ascii", "replace") + body)


def read_ply_points(path: Path) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None]:
    """Positions and, if there are any, colours of the vertices of a PLY, binary or text.

    Raises:
        ValueError: it is not a PLY, is cut short, or its vertices are not numbers x, y, z.
        OSError: it can't be read.
    """
    data = read_bounded(path, MOST_TABLE_BYTES)
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0 or not re.compile(rb"\S").search(data, start):
        raise ValueError("no PLY header, or nothing after it")
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
    kinds = [line[1] for line in lines if line[:1] == ["format"] and len(line) > 1]
    elements = [index for index, line in enumerate(lines) if line[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    if not kinds or kinds[0] not in order or first[1:2] != ["vertex"] or len(first) != 3:
        raise ValueError("its format is unknown, or vertices and their number are not its first element")
    count = int(first[2])
    stop = elements[1] if len(elements) > 1 else len(lines)
    named = [line for line in lines[elements[0] + 1 : stop] if line[:1] == ["property"]]
    if any(len(line) != 3 or line[1] not in _READ_TYPES for line in named):
        raise ValueError("a vertex has properties that are not plain numbers")
    names = [line[2] for line in named]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise ValueError("vertices have no x, y, z")
    is_text, begin = kinds[0] == "ascii", order[kinds[0]]
    dtype = np.dtype(
        [
            (name, "f8" if is_text else begin + _READ_TYPES[line[1]])
            for name, line in zip(names, named, strict=True)
        ]
    )
    if is_text:
        body = filter(bytes.strip, io.BytesIO(data[start:]))
        table = np.loadtxt(body, dtype, comments=None, max_rows=min(max(count, 1), len(data)), ndmin=1)
    else:
        held = min(count, (len(data) - start) // dtype.itemsize)
        table = np.frombuffer(data, dtype, max(held, 0), start)
    if len(table) != count:
        raise ValueError(f"{len(table)} vertices; its header promises {count}")
    positions = np.stack([table[axis] for axis in "xyz"], axis=1, dtype=np.float64)
    if not {"red", "green", "blue"} <= set(names):
        return positions, None
    colours = np.column_stack([table[name] for name in ("red", "green", "blue")])
    if not ((colours >= 0) & (colours <= 255) & (colours == np.round(colours))).all():
        raise ValueError("its colours are not whole numbers from 0 to 255")
    return positions, colours.astype(np.uint8)


def obj_paths(path_without_suffix: Path) -> list[Path]:
    """Files that `write_obj` makes."""
    return [beside(path_without_suffix, suffix) for suffix in (".obj", ".mtl")]


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
    textured: tuple[Float[np.ndarray, "U 2"], Int[np.ndarray, "F 3"], str] | None = None,
) -> list[Path]:
    """Write a mesh as NAME.obj and NAME.mtl, with nine significant digits, exact for float32; 17 of float64 positions.

    Args:
        path_without_suffix: Folder, which is made, and NAME.
        positions, normals: Of the vertices; unit normals.
        srgb: Colours of the vertices in [0, 1], which most viewers show; others show the materials.
        faces, materials: Indices of vertices, and the material of each face.
        names, palette: Of the materials; in names what is not a letter or digit becomes `_`; sRGB.
        comments: First lines.
        textured: Texture coordinates (u to the right, v downwards), those of each corner, and the file of the picture
            that all materials then show.
    """
    obj_path, library_path = obj_paths(path_without_suffix)
    plain = [f"material_{index}_{re.sub(r'[^0-9A-Za-z]+', '_', name)}" for index, name in enumerate(names)]
    text = io.StringIO()
    text.writelines(f"# {' '.join(line.split())}\n" for line in comments)
    text.write(f"mtllib {library_path.name}\n")
    digits = " ".join(3 * ["%.17g" if positions.dtype == np.float64 else "%.9g"])
    np.savetxt(text, np.hstack([positions, srgb]), fmt=f"v {digits} %.9g %.9g %.9g")
    np.savetxt(text, normals, fmt="vn %.9g %.9g %.9g")
    shown, corner, numbers = "", "%d//%d", [faces, faces]
    if textured is not None:
        uv, uv_faces, picture = textured
        np.savetxt(text, np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1), fmt="vt %.9g %.9g")
        shown, corner, numbers = f"map_Kd {picture}\n", "%d/%d/%d", [faces, uv_faces, faces]
        palette = np.ones_like(palette)
    corners = np.stack(numbers, axis=2).reshape(len(faces), -1) + 1
    for index in np.unique(materials):
        text.write(f"usemtl {plain[index]}\n")
        np.savetxt(text, corners[materials == index], fmt="f " + " ".join(3 * [corner]))
    library = "".join(
        f"newmtl {name}\nKd {red:.6g} {green:.6g} {blue:.6g}\n{shown}illum 1\n\n"
        for name, (red, green, blue) in zip(plain, palette.tolist(), strict=True)
    )
    write_file(library_path, library.encode())
    return [write_file(obj_path, text.getvalue().encode("utf-8")), library_path]


def write_glb(
    path: Path,
    positions: Float32[np.ndarray, "P 3"],
    normals: Float32[np.ndarray, "P 3"],
    linear_rgb: Float32[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "F 3"],
    numbers: Mapping[str, np.ndarray],
    extras: Mapping[str, Any],
    up: Float64[np.ndarray, "3"] = _Y,
    uv: Float32[np.ndarray, "P 2"] | None = None,
    pictures: Mapping[str, bytes] | None = None,
) -> Path:
    """Write a mesh in colours of its vertices, or in pictures.

    Args:
        path: File; its folder is made.
        positions, normals: Of the vertices; unit normals.
        linear_rgb: Colours, linear light in sRGB primaries, [0, 1], as glTF wants them.
        faces: Indices of vertices.
        numbers: More of each vertex, (P,) float32, by a name that starts with `_`.
        extras: What else the file says of the mesh, as JSON has it. Where its `metres_per_unit` is known, the node
            scales by it, since lengths of glTF are metres.
        up: The unit vector that is up; its node turns it to +y, as glTF prescribes, and extras say it.
        uv: Texture coordinates: u to the right, v downwards.
        pictures: PNG by name; the first is shown in place of the colours, the others are variants, shown unlit.
    Source:
        Khronos Group, KHR_materials_variants and KHR_materials_unlit.
    """
    plain: dict[str, Any] = {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}
    attributes = {"POSITION": positions, "NORMAL": normals, **numbers}
    if uv is None or not pictures:
        return _write_glb(path, {**attributes, "COLOR_0": linear_rgb}, faces, [plain], {}, extras, up)
    attributes["TEXCOORD_0"] = uv  # and no colours, which would be multiplied with the picture
    materials = []
    for index, name in enumerate(pictures):
        look = {"metallicFactor": 0.0, "baseColorTexture": {"index": index}}
        unlit = {"extensions": {"KHR_materials_unlit": {}}} if index > 0 else {}
        materials.append({**plain, "name": name, "pbrMetallicRoughness": look, **unlit})
    mappings = [{"material": index, "variants": [index]} for index in range(len(pictures))]
    of_primitive = {"KHR_materials_variants": {"mappings": mappings}}
    variants = {"KHR_materials_variants": {"variants": [{"name": name} for name in pictures]}}
    variants |= {"KHR_materials_unlit": {}} if len(pictures) > 1 else {}
    return _write_glb(path, attributes, faces, materials, pictures, extras, up, of_primitive, variants)


@dataclass(frozen=True)
class Gaussians:
    """Gaussians: ellipsoids whose opacity fades from their centres."""

    positions: Float32[np.ndarray, "P 3"]
    rotations: Float32[np.ndarray, "P 4"]
    """Unit quaternions x, y, z, w from an ellipsoid's axes to those of the world."""
    scales: Float32[np.ndarray, "P 3"]
    """Standard deviation along each axis."""
    srgb: Float32[np.ndarray, "P 3"]
    """[0, 1]; also beyond, where that is what fits."""
    opacities: Float32[np.ndarray, " P"]
    """At the centres, (0, 1)."""

    @property
    def _constant_harmonics(self) -> Float32[np.ndarray, "P 3"]:
        """The colour as coefficients of the harmonic of degree 0."""
        return ((self.srgb - 0.5) / _HARMONIC_0).astype(np.float32)


_HARMONIC_0 = 0.28209479177387814
"""sqrt(1 / (4 pi)): the spherical harmonic of degree 0."""


def write_splats_glb(
    path: Path,
    splats: Gaussians,
    numbers: Mapping[str, np.ndarray],
    extras: Mapping[str, Any],
    up: Float64[np.ndarray, "3"],
) -> Path:
    """Write Gaussians as points of a GLB, with their colours for programs that know points only; numbers, extras and up
    are as those of `write_glb`.

    Source:
        Khronos Group, KHR_gaussian_splatting.
    """
    own = "KHR_gaussian_splatting"
    attributes = {
        "POSITION": splats.positions,
        "COLOR_0": np.column_stack([decode_srgb(splats.srgb.clip(0, 1)), splats.opacities]),
        f"{own}:ROTATION": splats.rotations,
        f"{own}:SCALE": splats.scales,
        f"{own}:OPACITY": splats.opacities,
        f"{own}:SH_DEGREE_0_COEF_0": splats._constant_harmonics,
        **numbers,
    }
    how = {own: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    return _write_glb(path, attributes, None, [], {}, extras, up, how, {own: {}})


def write_splats_ply(
    path: Path, splats: Gaussians, numbers: Mapping[str, np.ndarray], comments: Sequence[str]
) -> Path:
    """Write Gaussians with the property names of the authors' own program (Kerbl et al. 2023), which viewers read:
    logarithms of scales, the logit of the opacity, quaternions w first; `numbers` (P,) come after them."""
    vertices = {
        **{name: splats.positions[:, axis] for axis, name in enumerate("xyz")},
        **{f"f_dc_{axis}": splats._constant_harmonics[:, axis] for axis in range(3)},
        "opacity": np.log(splats.opacities) - np.log1p(-splats.opacities),
        **{f"scale_{axis}": np.log(splats.scales[:, axis]) for axis in range(3)},
        **{f"rot_{index}": splats.rotations[:, axis] for index, axis in enumerate((3, 0, 1, 2))},
        **numbers,
    }
    return write_ply(path, vertices, comments=comments)


def write_textured_glb(
    path: Path,
    positions: Float32[np.ndarray, "P 3"],
    normals: Float32[np.ndarray, "P 3"],
    uv: Float32[np.ndarray, "P 2"],
    faces: Int[np.ndarray, "F 3"],
    base_colour_png: bytes,
    metallic_roughness_png: bytes,
    extras: Mapping[str, Any],
    up: Float64[np.ndarray, "3"] = _Y,
) -> Path:
    """Write a mesh with its material, a picture of sRGB colours and a linear one, green roughness, blue metallicity.

    The other arguments are as those of `write_glb`.
    """
    textures = {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}}
    look = {**textures, "metallicFactor": 1.0, "roughnessFactor": 1.0}
    material = {"name": "material", "doubleSided": True, "pbrMetallicRoughness": look}
    attributes = {"POSITION": positions, "NORMAL": normals, "TEXCOORD_0": uv}
    pictures = {"base_colour": base_colour_png, "metallic_roughness": metallic_roughness_png}
    return _write_glb(path, attributes, faces, [material], pictures, extras, up)


def _write_glb(
    path: Path,
    attributes: Mapping[str, np.ndarray],
    faces: Int[np.ndarray, "F 3"] | None,
    materials: Sequence[Mapping[str, Any]],
    pictures: Mapping[str, bytes],
    extras: Mapping[str, Any],
    up: Float64[np.ndarray, "3"] = _Y,
    extensions: Mapping[str, Any] | None = None,
    used: Mapping[str, Any] | None = None,
) -> Path:
    """A file of one mesh in the first of some materials, or of points: attributes, faces and pictures in one buffer;
    `extensions` are those of the mesh, `used` all of the file with what they say of the whole, if anything."""
    data, views, accessors = bytearray(), [], []

    def add(content: bytes, **view: int) -> int:
        """Append bytes, padded to a multiple of four; the index of their view."""
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content), **view})
        data.extend(content + b"\0" * (-len(content) % 4))
        return len(views) - 1

    for name, values in attributes.items():
        view = add(np.ascontiguousarray(values, "<f4").tobytes(), target=_VERTEX_BUFFER)
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessors.append({"bufferView": view, "componentType": _FLOAT, "count": len(values), "type": kind})
        if name == "POSITION" and len(values):
            accessors[-1] |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
    primitive: dict[str, Any] = {"attributes": {name: index for index, name in enumerate(attributes)}}
    if faces is None:
        primitive["mode"] = _POINTS
    else:
        primitive["indices"] = len(accessors)
        view = add(faces.astype("<u4").tobytes(), target=_INDEX_BUFFER)
        accessors.append(
            {"bufferView": view, "componentType": _UNSIGNED_INT, "count": faces.size, "type": "SCALAR"}
        )
    if materials:
        primitive["material"] = 0
    if extensions:
        primitive["extensions"] = dict(extensions)
    images = [
        {"name": name, "mimeType": "image/png", "bufferView": add(content)}
        for name, content in pictures.items()
    ]
    sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}
    metres = extras.get("metres_per_unit")
    scaled = {} if metres is None else {"scale": 3 * [metres]}
    content = {
        "asset": {"version": "2.0", "generator": f"unmix-nerf {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface", "rotation": least_turns(up, _Y).tolist(), **scaled}],
        "meshes": [{"primitives": [primitive], "extras": {**extras, "up": np.asarray(up).tolist()}}],
        "materials": list(materials),
        "extensionsUsed": list(used or {}),
        "extensions": {name: value for name, value in (used or {}).items() if value},
        "textures": [{"sampler": 0, "source": index} for index in range(len(images))],
        "samplers": [sampler] if images else [],
        "images": images,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps({name: value for name, value in content.items() if value not in ([], {})}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _JSON_CHUNK) + text
    chunks += struct.pack("<II", len(data), _BINARY_CHUNK) + data
    return write_file(path, b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)


def turn_to_y(up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The matrix of the least turn that takes a unit vector to +y; exact where it is along an axis.

    >>> turn_to_y(np.array([0.0, 0.0, 1.0])).tolist()
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    """
    x, y, z, w = least_turns(up, _Y)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    whole = np.round(matrix)
    return np.where(np.abs(matrix - whole) < 1e-12, whole + 0.0, matrix)


def turned_by(
    turn: Float64[np.ndarray, "3 3"], vectors: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P 3"]:
    """Vectors times a matrix, in their own type."""
    return (vectors.astype(np.float64) @ turn.T + 0.0).astype(vectors.dtype)


def least_turns(
    start: Float[np.ndarray, "*#turns 3"], end: Float[np.ndarray, "*#turns 3"]
) -> Float64[np.ndarray, "*turns 4"]:
    """Unit quaternions x, y, z, w of the least turns that take unit vectors to others."""
    start, end = np.broadcast_arrays(start, end)
    axes, whole = np.cross(start, end), 1 + np.sum(start * end, axis=-1, keepdims=True)
    beside = np.cross(start, np.eye(3)[np.abs(start).argmin(axis=-1)])  # half a turn may go either way
    quaternions = np.where(
        whole < 1e-9, np.append(beside, 0 * whole, axis=-1), np.append(axes, whole, axis=-1)
    )
    return quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
