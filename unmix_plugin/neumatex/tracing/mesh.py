"""A triangle mesh with shading normals, read from glTF, OBJ and PLY files and checked.

Coordinates are taken as they are, as those of the cameras' world: a file whose axes were exchanged on export (many
programs write glTF with +y up) has to be exported without that. Only our own glTF is taken back to the world, since its
extras say what was done to it: metres, +y up, another origin.

Notation: `V` vertices, `F` triangles. Triangles are counter-clockwise seen from outside, which only who looks at a mesh
can tell: in files they may be wound either way.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.errors import SceneError
from unmix_plugin.formats.json_values import read_number
from unmix_plugin.formats.meshes import least_turns
from unmix_plugin.limits import (
    MOST_TABLE_BYTES,
    MOST_TEXT_BYTES,
    open_regular,
    parse_json,
    read_bounded,
    refuse,
)
from unmix_plugin.scenes.folder import METRES_KEY, METRES_RANGE
from unmix_plugin.scenes.reading.faults import find_named

MAX_TRIANGLES = 5_000_000
"""More are refused: the tree over them and the memory of a training would not fit common machines."""
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
"""Formats that are read."""
_FAR = 1e9
"""Positions, texture coordinates and normals beyond it are damage, as positions of cameras are."""
_HARMLESS = re.compile("KHR_(materials|texture|lights|mesh_quantization|xmp|animation)|EXT_texture")
"""Extensions of glTF that move no vertex."""
_INSTANCING = "EXT_mesh_gpu_instancing"
_FAN = 6
"""Mode of a glTF primitive."""
_CORNER_0 = re.compile(rb"^[ \t]*f[ \t](?:[^\r\n]*[ \t])?0(?=[/\s]|\Z)[^\r\n]{0,40}", re.MULTILINE)
"""A face of an OBJ with a vertex 0."""
_SMALLEST_FACE = 1e-14
"""Part of the squared bounding box diagonal; triangles of less area are dropped, since they have no normal."""


@dataclass(frozen=True)
class Mesh:
    """Triangles of one object; `mesh_of` makes one from vertices and faces."""

    vertices: Float[Tensor, "V 3"]
    """Positions: in world units as read, float64 since the world's origin may be far away; in [-1, 1] in model space,
    float32."""
    faces: Int[Tensor, "F 3"]
    """Vertices of each triangle, int32."""
    normals: Float[Tensor, "V 3"]
    """Unit shading normals, outward."""
    uv: Float[Tensor, "V 2"] | None = None
    """Texture coordinates of the file, v upwards; None if it has none."""

    def transformed(self, scale: float, offset: Float[Tensor, "3"]) -> Mesh:
        """The mesh with vertices `scale * (vertices + offset)`, scale > 0."""
        return replace(self, vertices=(scale * (self.vertices.double() + offset)).float())

    def with_y_upwards(self) -> Mesh:
        """The mesh turned by 90 degrees about x, so that its y axis points along z, as the world's upward axis does."""
        vertices, normals = (
            torch.stack([v[:, 0], -v[:, 2], v[:, 1]], dim=1) for v in (self.vertices, self.normals)
        )
        return replace(self, vertices=vertices.contiguous(), normals=normals.contiguous())

    def to(self, device: torch.device | str) -> Mesh:
        """The same mesh on another device."""
        uv = None if self.uv is None else self.uv.to(device)
        return Mesh(self.vertices.to(device), self.faces.to(device), self.normals.to(device), uv)

    def corners(self) -> Float[Tensor, "F 3 3"]:
        """Positions of each triangle's vertices."""
        return self.vertices[self.faces.long()]

    def to_model_space(self) -> tuple[float, Float[Tensor, "3"]]:
        """Scale and offset for `transformed` that centre the bounding box and give its longest half edge length 1."""
        low, high = self.vertices.min(dim=0).values, self.vertices.max(dim=0).values
        return 2.0 / float((high - low).max()), -(low + high) / 2


def mesh_of(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    normals: Float[Tensor, "V 3"] | None = None,
    uv: Float[Tensor, "V 2"] | None = None,
) -> Mesh:
    """A mesh of float32 vertices, with area-weighted normals where none are given."""
    faces = faces.int().contiguous()
    if normals is None:
        normals = _area_weighted_normals(vertices, faces)
    normals = torch.nn.functional.normalize(normals.float(), dim=-1)
    return Mesh(vertices.float().contiguous(), faces, normals, uv)


def _area_weighted_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Unit normals of vertices: means over their triangles, weighted by area; +z where they cancel."""
    a, b, c = vertices.double()[faces.long()].unbind(dim=1)
    doubled_areas = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(vertices, dtype=torch.float64)
    sums.index_add_(0, faces.reshape(-1).long(), doubled_areas.repeat_interleave(3, dim=0))
    lengths = sums.norm(dim=-1, keepdim=True)
    upwards = sums.new_tensor((0.0, 0.0, 1.0))
    return torch.where(lengths > 1e-30, sums / lengths.clamp(min=1e-30), upwards).float()


def turned_to_viewers(mesh: Mesh, seen: Float[Tensor, " F"]) -> tuple[Mesh, int]:
    """The mesh with each connected piece turned so that what is seen of it is its front.

    Args:
        mesh: Its triangles may face either way, those of one piece alike.
        seen: How much each triangle is seen from its front, less how much it is from behind.
    Returns:
        The mesh, with normals on the front, and how many triangles were turned.
    """
    from trimesh.graph import connected_component_labels

    corners = _places(mesh.vertices.numpy())[mesh.faces.numpy()]
    edges = np.concatenate([corners[:, :2], corners[:, 1:]])
    of_places = connected_component_labels(edges, node_count=int(corners.max()) + 1)
    pieces = torch.from_numpy(of_places[corners[:, 0]]).long()

    def is_negative(values: Float[Tensor, " F"]) -> Bool[Tensor, " F"]:
        sums = torch.zeros(len(pieces), dtype=torch.float64).index_add(0, pieces, values.double())
        return (sums < 0)[pieces]

    is_turned = is_negative(seen)
    faces = torch.where(is_turned[:, None], mesh.faces.flip(1), mesh.faces)
    a, b, c = mesh.vertices.double()[faces.long()].unbind(dim=1)
    agreement = (torch.linalg.cross(b - a, c - a) * mesh.normals[faces.long()].sum(dim=1)).sum(dim=1)
    signs = torch.ones(len(mesh.vertices), 1)
    signs[faces[is_negative(agreement)].long()] = -1
    return replace(mesh, faces=faces, normals=signs * mesh.normals), int(is_turned.sum())


@np.errstate(all="ignore")  # what is not finite is refused by name
def read_mesh(path: Path, notes: list[str] | None = None) -> Mesh:
    """The triangles of a file in units of the world, all objects of its scene graph in one mesh.

    Args:
        notes: Gets a sentence if the mesh is open, which is unusual but usable.
    Raises:
        SceneError: the file is missing, damaged or of another kind, or has no triangle with an area, positions that
            are not finite, or too many triangles.
    """
    parts = [_placed(path, *part) for part in _parts(path)]
    firsts = np.cumsum([0, *(len(part["vertices"]) for part in parts)])
    faces = np.concatenate([part["faces"] + first for part, first in zip(parts, firsts, strict=False)])
    vertices, normals, uv = (
        np.concatenate([part[name] for part in parts]) if all(name in part for part in parts) else None
        for name in ("vertices", "normals", "uv")
    )
    assert vertices is not None
    faces = _sound_faces(path, vertices, faces)
    if notes is not None and not _is_closed(vertices, faces):
        notes.append(
            f"{path.name}: the mesh is open; light may pass through its holes, and its inside has the materials of "
            "its outside"
        )
    mesh = mesh_of(
        torch.as_tensor(vertices),
        torch.as_tensor(faces),
        None if normals is None else torch.as_tensor(normals),
        None if uv is None else torch.as_tensor(uv.astype(np.float32)),
    )
    return replace(mesh, vertices=torch.as_tensor(vertices))


@dataclass(frozen=True)
class _Beside:
    """Files that a mesh names: those of its own folder, which are read with the same care."""

    folder: Path

    def __getitem__(self, name: str) -> bytes:
        found = find_named(self.folder, name)
        if found is None:
            raise FileNotFoundError(f"there is no file {name[:80]!r} in {self.folder}")
        return read_bounded(found, MOST_TABLE_BYTES)

    get = __getitem__


def _parts(path: Path) -> list[tuple[Any, np.ndarray]]:
    """The meshes of a file's scene graph, each with its 4 x 4 transform to the world."""
    import trimesh

    if not path.is_file():
        raise SceneError(f"{path}: there is no such mesh file")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise SceneError(
            f"{path}: is not a mesh format that is read here; convert it to one of {', '.join(MESH_SUFFIXES)}"
        )
    if path.suffix.lower() in (".glb", ".gltf"):
        _check_gltf(path)
    try:
        is_whole = path.suffix.lower() == ".obj" and not _has_corner_normals(path)
        beside = cast("Any", _Beside(path.parent))
        scene = trimesh.load_scene(path, resolver=beside, process=False, maintain_order=is_whole)
        placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
        for mesh in scene.geometry.values():
            _check_lengths(path, mesh.metadata.get("_ply_raw", {}))
    except SceneError:
        raise
    except Exception as error:
        raise SceneError(f"{path}: can't be read as a mesh ({error}); export it again") from error
    parts = [
        (scene.geometry[name], _to_world(np.asarray(transform), scene.geometry[name].metadata))
        for transform, name in placed
    ]
    parts = [part for part in parts if isinstance(part[0], trimesh.Trimesh) and len(part[0].faces)]
    if not parts:
        raise SceneError(f"{path}: has no triangles; export the object as a triangle mesh")
    number = sum(len(mesh.faces) for mesh, _ in parts)  # which may be the same mesh many times
    if number > MAX_TRIANGLES:
        raise SceneError(
            f"{path}: has {number:,} triangles, at most {MAX_TRIANGLES:,} are read; decimate the mesh"
        )
    return parts


def _check_gltf(path: Path) -> None:
    """Refuse glTF by name that asks for more than trimesh follows, which leaves such things out without a word; and
    numbers without any bytes in the file, which would be zeros.

    Source: glTF 2.0 specification, sections 3.6.2 (accessors) and 3.7 (geometry), KHR_mesh_quantization.
    """
    try:
        with open_regular(path) as file:
            head, size = file.read(20), MOST_TEXT_BYTES
            if head.startswith(b"glTF"):
                head, size = b"", int.from_bytes(head[12:16], "little")
            content = parse_json((head + file.read(size)).decode("utf-8-sig"))
        accessors, nodes = content.get("accessors", ()), content.get("nodes", ())
        meshes = content.get("meshes", ())
        primitives = [primitive for mesh in meshes for primitive in mesh["primitives"]]
        zeros = sum(int(one.get("count", 0)) for one in accessors if "bufferView" not in one)
        read = {one["attributes"].get(name) for one in primitives for name in ("POSITION", "TEXCOORD_0")}
        asked = [*content.get("extensionsRequired", ())]
        asked += [name for one in nodes for name in one.get("extensions", ()) if name == _INSTANCING]
        children = [child for node in nodes for child in node.get("children", ())]
        found = {
            **{f"the extension {name}": not _HARMLESS.match(name) for name in asked},
            "sparse accessors": any("sparse" in one for one in accessors),
            "positions or texture coordinates as normalized whole numbers": any(
                accessors[index].get("normalized") for index in read - {None}
            ),
            "skins": any("skin" in one for one in nodes),
            "triangle fans": any(one.get("mode") == _FAN for one in primitives),
            "morph targets": any(any(one.get("weights", ())) for one in [*meshes, *nodes]),
            "a node with several parents": len(set(children)) < len(children),
        }
    except (OSError, ValueError, RecursionError, AttributeError, TypeError, LookupError) as error:
        raise SceneError(
            f"{path}: can't be read as a mesh ({type(error).__name__}); export it again"
        ) from error
    if zeros > MAX_TRIANGLES:
        refuse(path, f"{zeros:,} numbers that are not in the file", f"at most {MAX_TRIANGLES:,}", SceneError)
    if left_out := [what for what, is_there in found.items() if is_there]:
        raise SceneError(
            f"{path}: {' and '.join(left_out)}: not read here; export it as plain triangles, uncompressed"
        )


def _has_corner_normals(path: Path) -> bool:
    """Whether an OBJ has normals, so that vertices are split: in the file's order trimesh would give them the normal at
    the mean of the indices. Without, they stay whole, and smooth at seams of texture. Refuses an OBJ whose corners
    count from 0: trimesh takes the last vertex for it."""
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        if found := _CORNER_0.search(text):
            line = found[0].decode("ascii", "replace").strip()
            raise SceneError(f"{path}: '{line}' names vertex 0; an OBJ counts from 1: export the mesh again")
        # By the mark trimesh loses the first vertex, and all faces move on by one.
        if text[:4] == b"\xef\xbb\xbfv":
            raise SceneError(f"{path}: begins with a byte order mark; save it as UTF-8 without one")
        return text.find(b"\nvn ") >= 0


def _check_lengths(path: Path, elements: Mapping[str, Any]) -> None:
    """Refuse a PLY in text that ends before all is there that its header promises; of others trimesh sees it."""
    for name, element in elements.items():
        columns = element.get("data")
        for column in columns.values() if isinstance(columns, dict) else ():
            if len(column) != element["length"]:
                found = f"has {len(column)} of {element['length']} elements '{name}'"
                raise SceneError(f"{path}: is cut short: {found}; copy it again")


def _to_world(transform: np.ndarray, extras: Mapping[str, Any]) -> np.ndarray:
    """A mesh's transform to the world that it comes from, where it says how `write_glb` took it from there."""
    from scipy.spatial.transform import Rotation  # slow to import

    back, metres = np.eye(4), read_number(extras.get(METRES_KEY))
    up, offset = _vector(extras, "up"), _vector(extras, "offset")
    if up is not None and abs(np.linalg.norm(up) - 1) < 1e-6:
        back[:3, :3] = Rotation.from_quat(least_turns(up, np.eye(3)[1])).inv().as_matrix()
        back[:3, 3] = 0 if offset is None else offset
    if metres is not None and METRES_RANGE[0] <= metres <= METRES_RANGE[1]:
        back[:3, :3] /= metres
    return back @ transform


def _vector(extras: Mapping[str, Any], key: str) -> np.ndarray | None:
    """Three numbers below `_FAR`; None where there are none."""
    values = extras.get(key)
    numbers = [read_number(value) for value in values] if isinstance(values, list) else []
    sound = [number for number in numbers if number is not None and abs(number) < _FAR]
    return np.array(sound) if len(sound) == len(numbers) == 3 else None


def _placed(path: Path, loaded: Any, transform: np.ndarray) -> dict[str, np.ndarray]:
    """`vertices` and `faces` in the world, and `normals` and `uv` if the file has usable ones."""
    linear, vertices = transform[:3, :3], np.asarray(loaded.vertices, dtype=np.float64)
    is_affine = np.isfinite(transform).all() and np.abs(transform[3] - (0, 0, 0, 1)).max() < 1e-6
    if vertices.shape[1:] != (3,) or not is_affine:
        raise SceneError(
            f"{path}: positions of shape {vertices.shape}, moved by {transform.tolist()}; expected 3 finite numbers "
            "each, and a last row 0, 0, 0, 1: export the mesh again"
        )
    faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
    is_mirrored = np.linalg.det(linear) < 0
    found = {
        "vertices": vertices @ linear.T + transform[:3, 3],
        "faces": faces[:, ::-1] if is_mirrored else faces,
    }
    if "vertex_normals" in loaded._cache.cache:  # others would be made up
        normals = np.array(loaded.vertex_normals, dtype=np.float64)
        lengths = np.linalg.norm(normals, axis=1) if normals.shape == vertices.shape else np.zeros(1)
        if ((lengths > 1e-6) & (lengths < _FAR)).all():
            found["normals"] = normals @ np.linalg.pinv(linear)
    uv: Any = getattr(loaded.visual, "uv", None)
    if np.shape(uv) == (len(vertices), 2) and (np.abs(uv) < _FAR).all():
        found["uv"] = np.asarray(uv)
    return found


def _sound_faces(path: Path, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The triangles that have an area; vertices of no triangle are moved to others, wherever they are."""
    from trimesh import triangles

    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError(f"{path}: a triangle names vertex {faces.max()} of {len(vertices)}; export it again")
    sound = np.all(np.abs(vertices) < _FAR, axis=1)  # false for NaN
    if not sound[faces].all():
        index, found = int(np.flatnonzero(~sound)[0]), vertices[~sound][0].tolist()
        raise SceneError(
            f"{path}: the position of vertex {index} is not finite, or too far away: {found}; expected numbers below "
            f"{_FAR:g}: export the mesh again"
        )
    vertices[~sound] = vertices[faces[0, 0]]
    diagonal = np.ptp(vertices[faces.reshape(-1)], axis=0)
    keep = triangles.area(vertices[faces]) > _SMALLEST_FACE * float(diagonal @ diagonal)
    if not keep.any():
        raise SceneError(f"{path}: none of its {len(faces)} triangles has an area; export the mesh again")
    return faces[keep]


def _places(vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " V"]:
    """A number for the place of each vertex: files split them at seams of texture and normals, but what is joined is
    said by positions alone."""
    return np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)


def _is_closed(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether each edge is shared by two triangles that run along it in opposite directions."""
    corners = _places(vertices)[faces]
    starts, ends = corners.reshape(-1), np.roll(corners, -1, axis=1).reshape(-1)
    forward, backward = starts * len(vertices) + ends, ends * len(vertices) + starts
    return bool(np.array_equal(np.sort(forward), np.sort(backward)))
