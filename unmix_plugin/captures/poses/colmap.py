"""Poses of a COLMAP model: a folder with cameras, images and points3D, as .bin or .txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses import colmap_binary, colmap_text
from unmix_plugin.captures.poses.colmap_lens import colmap_lens
from unmix_plugin.captures.poses.colmap_model import ColmapCamera, ColmapImage
from unmix_plugin.captures.poses.pose_set import Lens, PoseSet
from unmix_plugin.captures.poses.raw_poses import RawCamera, SparsePoints, make_pose_set
from unmix_plugin.captures.poses.rigid import FLIP
from unmix_plugin.errors import CaptureError

PLACES = (".", "sparse", "colmap", "colmap/sparse", "sparse/*", "colmap/sparse/*", "colmap/*")
"""Where under a folder a model is looked for."""


def find_models(folder: Path) -> list[Path]:
    """Folders with a COLMAP model, as its programs lay them out."""
    places = [place for pattern in PLACES for place in _matching(folder, pattern)]
    return [place for place in dict.fromkeys(places) if _suffix(place) is not None]


def read_colmap(folder: Path) -> PoseSet:
    """Poses, lenses and sparse points of the model in a folder.

    Raises:
        CaptureError: a file is missing or damaged, an image names a camera that is not there, or a lens can't be
            represented.
    """
    suffix = _suffix(folder)
    if suffix is None:
        raise CaptureError(
            f"{folder} has no COLMAP model; expected cameras and images as .bin or .txt: give the folder that has both"
        )
    module = colmap_binary if suffix == "bin" else colmap_text
    cameras = module.read_cameras(folder / f"cameras.{suffix}")
    images = module.read_images(folder / f"images.{suffix}")
    points_path = folder / f"points3D.{suffix}"
    points: SparsePoints | None = module.read_points(points_path) if points_path.is_file() else None
    notes = [] if points is not None else [f"{points_path.name} is not there: no sparse points"]
    lenses = _lenses({image.camera for image in images}, cameras, folder / f"cameras.{suffix}", notes)
    where = str(folder / f"images.{suffix}")
    raw = [RawCamera(image.name, _matrix(image, where), lenses[image.camera]) for image in images]
    return make_pose_set(raw, f"COLMAP model in {folder}", where, points, None, notes)


def _lenses(
    used: set[int], cameras: dict[int, ColmapCamera], path: Path, notes: list[str]
) -> dict[int, Lens]:
    lenses = {}
    for number in sorted(used):
        if number not in cameras:
            raise CaptureError(
                f"{path} has no camera {number}, which images name; the files do not belong together"
            )
        camera = cameras[number]
        if not np.isfinite(camera.parameters).all() or not (
            0 < camera.width < 1e6 and 0 < camera.height < 1e6
        ):
            raise CaptureError(
                f"{path}: camera {number} is {camera.width} x {camera.height} with {camera.parameters}; expected "
                "a size and finite numbers: the file is damaged"
            )
        lens, note = colmap_lens(camera.model, camera.width, camera.height, camera.parameters, str(path))
        lenses[number] = lens
        notes += [] if note is None else [note]
    return lenses


def _matrix(image: ColmapImage, where: str) -> Float64[np.ndarray, "3 4"]:
    """Camera to world, OpenGL axes."""
    quaternion = np.array(image.quaternion)
    length = float(np.linalg.norm(quaternion))
    if not 1e-6 < length < 1e6:
        raise CaptureError(
            f"{where}: {image.name} has the quaternion {image.quaternion}; expected length 1: the file is damaged"
        )
    rotation = rotation_of(quaternion / length).T
    return np.column_stack([rotation @ FLIP, -rotation @ np.array(image.translation)])


def rotation_of(quaternion: Float64[np.ndarray, "4"]) -> Float64[np.ndarray, "3 3"]:
    """Matrix of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _suffix(folder: Path) -> str | None:
    """bin or txt; a folder with both is read from bin."""
    for suffix in ("bin", "txt"):
        if all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images")):
            return suffix
    return None


def _matching(folder: Path, pattern: str) -> list[Path]:
    return [folder] if pattern == "." else sorted(path for path in folder.glob(pattern) if path.is_dir())
