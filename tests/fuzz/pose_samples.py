"""Small files of poses, of every program: what damage starts from."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np

from tests.factories.poses import (
    BROWN,
    CALIBRATION,
    FLIP,
    ORIENTATION,
    RADIAL,
    llff_table,
    metashape_document,
    reconstruction,
    ring,
    text_of,
    transforms,
)
from unmix_plugin.captures.names import match_poses
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.posing import place_poses
from unmix_plugin.formats.meshes import read_ply_points

_SIMILARITY = (
    "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>-2499366.5 -4256836.25 4029217.75</translation>"
    "<scale>12.5</scale></transform>"
)
CALIBRATED = CALIBRATION.format(
    distortion=f"<ModPhgrStd><RadiaPart>{RADIAL.format(a='-2e-7')}</RadiaPart><P1>1e-6</P1></ModPhgrStd>"
).encode()
COLMAP_CAMERAS = (
    b"# cameras\n1 OPENCV 640 480 500 510 320 240 0.01 -0.02 0.001 0\n"
    b"2 OPENCV_FISHEYE 64 48 90 90 32 24 0 0 0 0\n"
)
COLMAP_IMAGES = (
    b"# images\n1 1 0 0 0 0 0 4 1 a b.jpg\n1.5 2 -1\n2 0.7 0.1 0 0.7 1 2 3 2 c.jpg\n\n"
    b"3 0 1 0 0 1 0 4 1 d.jpg\n\n"
)
COLMAP_POINTS = b"1 0.5 0.25 1 255 0 7 0.3 1 0 2 0\n2 1 2 3 1 2 3 0.5\n"


COLMAP_PARTS = ("cameras", "images", "points3D")


def colmap_files(is_binary: bool) -> dict[str, bytes]:
    """The model as files of either kind, by their names."""
    files = dict(zip(COLMAP_PARTS, (COLMAP_CAMERAS, COLMAP_IMAGES, COLMAP_POINTS), strict=True))
    if not is_binary:
        return {f"{name}.txt": data for name, data in files.items()}
    opencv, fisheye = (500, 510, 320, 240, 0.01, -0.02, 0.001, 0), (90, 90, 32, 24, 0, 0, 0, 0)
    cameras = struct.pack("<QiiQQ8diiQQ8d", 2, 1, 4, 640, 480, *opencv, 2, 5, 64, 48, *fisheye)
    images = struct.pack("<QI7dI", 2, 1, 1, 0, 0, 0, 0, 0, 4, 1) + b"a b.jpg\0"
    images += struct.pack("<Q2dQ", 1, 1.5, 2, 7)
    images += struct.pack("<I7dI", 2, 0.7, 0.1, 0, 0.7, 1, 2, 3, 2) + b"c.jpg\0" + struct.pack("<Q", 0)
    points = struct.pack("<QQ3d3BdQII", 2, 7, 0.5, 0.25, 1, 255, 0, 7, 0.3, 1, 1, 0)
    points += struct.pack("<Q3d3BdQ", 8, 1, 2, 3, 1, 2, 3, 0.5, 0)
    return {"cameras.bin": cameras, "images.bin": images, "points3D.bin": points}


def read_and_place(path: Path) -> None:
    """Read poses and do with them what a scene needs."""
    poses = read_poses(path)
    placed, _, _ = place_poses(poses)
    match_poses(poses, [(name, []) for name in poses.cameras])
    for camera in placed.cameras.values():
        assert np.isfinite(camera.camera_to_world).all()
        np.testing.assert_allclose(np.linalg.det(camera.camera_to_world[:, :3]), 1.0, atol=1e-6)


def read_points(path: Path) -> None:
    """Points of a PLY."""
    positions, colours = read_ply_points(path)
    assert positions.shape[1] == 3
    assert colours is None or len(colours) == len(positions)


def transforms_samples() -> tuple[bytes, ...]:
    """nerfstudio's form with all keys, Blender's, a bare list."""
    turn = [[0, 0, 1, 0.5], [1, 0, 0, -2], [0, 1, 0, 0.25]]
    applied = {"applied_transform": turn, "applied_scale": 0.5, "offset": [5e5, 5.4e6, 300.0]}
    whole = transforms(ring(3), **applied, camera_model="OPENCV", k3=0.01, ply_file_path="points.ply")
    blender = {"camera_angle_x": 0.7, "w": 64, "h": 48, "frames": whole["frames"]}
    return tuple(json.dumps(content).encode() for content in (whole, blender, whole["frames"]))


def opensfm_samples() -> tuple[bytes, ...]:
    """One and two reconstructions of both kinds of camera."""
    one, two = reconstruction(), reconstruction(BROWN)
    return json.dumps([one]).encode(), json.dumps([one, two]).encode()


def metashape_samples() -> tuple[bytes, ...]:
    """With and without a place in the world and higher terms."""
    terms = "<k1>0.01</k1><k3>0.001</k3><b2>0.1</b2>"
    documents = metashape_document(ring(3)), metashape_document(ring(3), component=_SIMILARITY, terms=terms)
    return tuple(document.encode() for document in documents)


def micmac_samples() -> tuple[bytes, ...]:
    """An orientation whose calibration lies beside it."""
    pose = next(iter(ring().values()))
    rows = dict(zip(("l1", "l2", "l3"), map(text_of, pose[:, :3] @ FLIP), strict=True))
    text = ORIENTATION.format(center=text_of(pose[:, 3]), convention="eConvApero_DistM2C", **rows)
    return (text.encode(),)


def llff_samples() -> tuple[bytes, ...]:
    """Poses as float64 and float32."""
    samples = []
    for dtype in (np.float64, np.float32):
        buffer = io.BytesIO()
        np.save(buffer, llff_table(ring(3).values()).astype(dtype))
        samples.append(buffer.getvalue())
    return tuple(samples)


def ply_samples() -> tuple[bytes, ...]:
    """Points as text and binary, with faces after them."""
    head = "ply\nformat {} 1.0\nelement vertex 2\nproperty {} x\nproperty float y\nproperty float z\n"
    colours = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    tail = "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    text = head.format("ascii", "double") + colours + tail + "0 1 2 255 0 3\n4 5 6 1 2 3\n"
    binary = head.format("binary_little_endian", "float") + tail
    return (text.encode(), binary.encode() + np.arange(6, dtype="<f4").tobytes())
