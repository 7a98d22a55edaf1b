"""Poses of any program that we know, found by content; each has a file of its own, but LLFF, which is read here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.poses.colmap import find_models, read_colmap
from unmix_plugin.captures.poses.files import load_json, load_xml
from unmix_plugin.captures.poses.lens import Lens, require_unfolded
from unmix_plugin.captures.poses.matching import BY_ORDER
from unmix_plugin.captures.poses.metashape import read_metashape
from unmix_plugin.captures.poses.micmac import find_orientations, read_micmac
from unmix_plugin.captures.poses.opensfm import is_reconstruction, read_opensfm
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet, make_pose_set
from unmix_plugin.captures.poses.transforms_json import Size, has_frames, read_transforms
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, map_array, read_array_header
from unmix_plugin.scenes.reading.faults import describe

_KNOWN = (
    "transforms.json, a COLMAP model (.bin or .txt), Metashape's cameras as XML, OpenSfM's reconstruction.json, "
    "MicMac's Orientation-*.xml or LLFF's poses_bounds.npy"
)
_SPLIT_FILES = tuple(f"transforms_{split}.json" for split in ("train", "val", "eval", "test"))
_LLFF_FILE, _LLFF_PICTURES = "poses_bounds.npy", ("images", "exr")
"""Poses, and the folders with the pictures, in the order of whose names the poses come."""


def read_poses(path: Path, picture_sizes: Mapping[str, Size] | None = None) -> PoseSet:
    """Poses of a file or folder, whichever program wrote it.

    Args:
        path: A file, or a folder that holds the files.
        picture_sizes: Width and height of pictures by name, file name or stem, for sources without sizes.
    Raises:
        CaptureError: nothing known is there, or what is there is damaged or can't be represented.
    """
    if not path.exists():
        raise CaptureError(f"{path} is not there; give a file or folder with poses: {_KNOWN}")
    read = _read_folder if path.is_dir() else _read_file
    poses = read(path, picture_sizes or {})
    for lens in {camera.lens for camera in poses.cameras.values()} - {None}:
        if lens is not None and any(lens.higher_radial):
            require_unfolded(lens, str(path))
    return poses


def _read_file(path: Path, given: Mapping[str, Size]) -> PoseSet:
    start = _first_bytes(path).lstrip(b"\xef\xbb\xbf\t\r\n ")
    if path.suffix in (".bin", ".txt") and find_models(path.parent)[:1] == [path.parent]:
        return read_colmap(path.parent)
    if start[:1] in (b"{", b"["):
        return _read_json(path, given)
    if start[:1] == b"<":
        return _read_xml(path)
    if start.startswith(b"\x93NUMPY"):
        return _read_llff(path)
    hint = ": export the cameras as XML" if path.suffix in (".psx", ".psz") else ""
    raise CaptureError(f"{path} holds no poses that we know; expected {_KNOWN}{hint}")


def _read_json(path: Path, given: Mapping[str, Size]) -> PoseSet:
    content = load_json(path)
    if has_frames(content):
        return read_transforms({path: content}, given)
    if is_reconstruction(content):
        return read_opensfm(path, content)
    raise CaptureError(
        f"{path} holds {describe(content)} without poses; expected 'frames' with 'transform_matrix' "
        "(transforms.json) or 'shots' (OpenSfM)"
    )


def _read_xml(path: Path) -> PoseSet:
    root = load_xml(path)
    if root.tag == "document" or root.find("chunk") is not None:
        return read_metashape(path, root)
    if root.tag in ("ExportAPERO", "OrientationConique"):
        return read_micmac(find_orientations(path.parent) or [path])
    raise CaptureError(
        f"{path} is XML with the root <{root.tag}>; expected Metashape's <document> or MicMac's <ExportAPERO>"
    )


def _read_folder(folder: Path, given: Mapping[str, Size]) -> PoseSet:
    """The poses of a folder; where several programs left some, those of the first kind, and the others are named."""
    found: list[tuple[str, Callable[[], PoseSet]]] = []
    if (folder / "transforms.json").is_file():
        found.append(("transforms.json", lambda: _read_json(folder / "transforms.json", given)))
    splits = [folder / name for name in _SPLIT_FILES if (folder / name).is_file()]
    if splits:
        names = ", ".join(path.name for path in splits)
        found.append((names, lambda: read_transforms({path: load_json(path) for path in splits}, given)))
    if models := find_models(folder):
        found.append(("a COLMAP model", lambda: _greatest_model(models)))
    plain = [name for name in ("reconstruction.json", _LLFF_FILE) if (folder / name).is_file()]
    found += [(name, lambda name=name: _read_file(folder / name, given)) for name in plain]
    if orientations := find_orientations(folder):
        found.append(("MicMac's orientations", lambda: read_micmac(orientations)))
    elif sheets := [path for path in sorted(folder.glob("*.xml")) if b"<document" in _first_bytes(path)]:
        found.append((sheets[0].name, lambda: _read_xml(sheets[0])))
    if not found:
        raise CaptureError(f"{folder} holds no poses that we know; expected {_KNOWN}")
    (name, read), *others = found
    poses = read()
    if not others:
        return poses
    ignored = " and ".join(other for other, _ in others)
    return replace(poses, notes=(*poses.notes, f"{folder} has {ignored} too; {name} was read"))


def _greatest_model(models: list[Path]) -> PoseSet:
    """The model with the most images."""
    poses = max((read_colmap(model) for model in models), key=lambda found: len(found.cameras))
    if len(models) == 1:
        return poses
    note = f"{len(models)} COLMAP models are there; the one with the most images was read"
    return replace(poses, notes=(*poses.notes, note))


def _first_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(512)
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error


def _read_llff(path: Path) -> PoseSet:
    """poses_bounds.npy, (N, 17): a 3 x 5 matrix [R | t | h, w, f] (axes down, right, back), near, far.

    Cameras have the names of the pictures beside it, where there are as many.
    """
    try:
        shape = read_array_header(path).shape
        is_table = len(shape) == 2 and shape[0] > 0 and shape[1] in (15, 17)
        table = np.array(map_array(path), dtype=np.float64) if is_table else None
    except UnreadableArrayError as error:
        raise CaptureError(f"{path} {error}") from error
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error
    if table is None:
        raise CaptureError(f"{path} has the shape {shape}; expected (views, 17) numbers, as LLFF writes them")
    names = [f"{BY_ORDER}{index:04d}" for index in range(len(table))]
    note = "poses have no names: they go by the order of views"
    for place in [path.parent / name for name in reversed(_LLFF_PICTURES) if (path.parent / name).is_dir()]:
        there = sorted(entry.name for entry in place.iterdir() if not entry.name.startswith("."))
        if len(there) == len(table):
            names = [f"{place.name}/{name}" for name in there]
            note = f"poses are those of {place.name}/ in the order of names"
    cameras = []
    for name, row in zip(names, table[:, :15].reshape(-1, 3, 5), strict=True):
        down, right, back, position, (height, width, focal) = row.T
        if not (1 <= width <= 1e6 and 1 <= height <= 1e6 and 0 < focal < 1e9):
            raise CaptureError(
                f"{path}: the camera of {name} has height, width, focal length {height:g}, {width:g}, {focal:g}; "
                "expected pixels above 0"
            )
        center = (float(width) / 2, float(height) / 2)
        lens = Lens(round(width), round(height), (float(focal), float(focal)), center)
        cameras.append((name, PosedCamera(np.column_stack([right, -down, back, position]), lens)))
    return make_pose_set(cameras, f"LLFF's {path.name}", str(path), notes=[note])
