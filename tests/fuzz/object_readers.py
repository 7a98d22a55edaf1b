"""Readers of what an object is given with, with valid samples: meshes, light, pictures of light, transforms.json."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh

from tests.factories import objects
from tests.fuzz.mutation import Mutator, Reader, mutate_bytes, mutate_json
from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.fit.object_scene import read_object_folder
from unmix_plugin.neumatex.fit.pictures import read_picture
from unmix_plugin.neumatex.tracing.light_files import read_environment
from unmix_plugin.neumatex.tracing.mesh import read_mesh


@cache
def _object() -> dict[str, bytes]:
    """Files of an object by their names."""
    with TemporaryDirectory() as place:
        folder = objects.write_object(Path(place), environment_rotation_deg=30.0, tone_mapping="linear")
        objects.write_spectral_object(folder / "spectral")
        tetrahedron = trimesh.Trimesh(np.eye(4)[:, :3], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        for suffix in ("ply", "obj", "glb", "gltf"):
            exported = tetrahedron.export(file_type=suffix)
            files = exported if isinstance(exported, dict) else {f"mesh.{suffix}": exported}
            for name, data in files.items():
                raw = data.encode() if isinstance(data, str) else data
                (folder / name.replace("model", "mesh")).write_bytes(raw)
        names = ["environment.exr", "images/000.exr", "spectral/cubes/000.npy", "transforms.json"]
        paths = [*folder.glob("mesh.*"), *folder.glob("*.bin"), *map(folder.joinpath, names)]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(paths)}


def _reader(
    name: str, read: Callable[[Path], object], samples: tuple[bytes, ...] = (), mutate: Mutator = mutate_bytes
) -> Reader:
    beside = tuple((other, data) for other, data in _object().items() if other.endswith(".bin"))
    return Reader(samples or (_object()[name],), Path(name).name, read, (SceneError,), mutate, beside)


def mesh_reader(suffix: str) -> Reader:
    """Of any of its formats."""

    def read(path: Path) -> None:
        mesh = read_mesh(path)
        assert mesh.vertices.isfinite().all()

    return _reader(f"mesh.{suffix}", read, mutate=mutate_json if suffix == "gltf" else mutate_bytes)


def environment_reader(suffix: str) -> Reader:
    """An even light of 8 x 16 pixels, in Radiance's format plain and in runs."""
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n"
    runs = b"\x02\x02\0\x10" + 4 * b"\x90\x81"
    radiance = (head + 8 * 16 * b"\x80\x81\x82\x81", head + 8 * runs)
    return _reader(f"environment.{suffix}", read_environment, radiance if suffix == "hdr" else ())


def picture_reader(name: str) -> Reader:
    """Light as OpenEXR or as a cube."""
    return _reader(name, read_picture)


def transforms_reader() -> Reader:
    """An object's own keys, with those of every scene."""

    def read(path: Path) -> None:
        read_object_folder(path.parent, [], needs_mesh=True)

    content, beside = json.loads(_object()["transforms.json"]), (("e.exr", b""), ("mesh.ply", b""))
    samples = tuple(json.dumps(content | more).encode() for more in ({}, {"environment_path": "e.exr"}))
    return Reader(samples, "transforms.json", read, (SceneError,), mutate_json, beside)
