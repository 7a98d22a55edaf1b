"""Poses of any program that we know, found by content."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from unmix_plugin.captures.poses.colmap import find_models, read_colmap
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.poses.sizes import PictureSizes, Size
from unmix_plugin.captures.poses.transforms_json import has_frames, read_transforms
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.json_values import UnreadableJsonError, describe, read_json_file

KNOWN = "transforms.json, a COLMAP model (.bin or .txt)"
SPLIT_FILES = tuple(f"transforms_{split}.json" for split in ("train", "val", "eval", "test"))


def read_poses(path: Path, picture_sizes: Mapping[str, Size] | None = None) -> PoseSet:
    """Poses of a file or folder, whichever program wrote it.

    Args:
        path: A file, or a folder that holds the files.
        picture_sizes: Width and height of pictures by name, file name or stem, for sources without sizes.
    Raises:
        CaptureError: nothing known is there, or what is there is damaged or can't be represented.
    """
    if path.is_dir():
        return _read_folder(path, picture_sizes or {})
    if not path.is_file():
        raise CaptureError(f"{path} is not there; give a file or folder with poses: {KNOWN}")
    return _read_file(path, picture_sizes or {})


def _read_file(path: Path, given: Mapping[str, Size]) -> PoseSet:
    start = _first_bytes(path).lstrip(b"\xef\xbb\xbf\t\r\n ")
    if path.suffix in (".bin", ".txt") and find_models(path.parent)[:1] == [path.parent]:
        return read_colmap(path.parent)
    if start[:1] in (b"{", b"["):
        return _read_json(path, given)
    raise CaptureError(f"{path} holds no poses that we know; expected {KNOWN}")


def _read_json(path: Path, given: Mapping[str, Size]) -> PoseSet:
    content = _load_json(path)
    if has_frames(content):
        return read_transforms({path: content}, PictureSizes(given, path.parent))
    raise CaptureError(
        f"{path} holds {describe(content)} without poses; expected 'frames' with 'transform_matrix' (transforms.json)"
    )


def _read_folder(folder: Path, given: Mapping[str, Size]) -> PoseSet:
    """The poses of a folder; where several programs left some, those of the first kind, and the others are named."""
    found: list[tuple[str, Any]] = []
    if (folder / "transforms.json").is_file():
        found.append(("transforms.json", lambda: _read_json(folder / "transforms.json", given)))
    splits = [folder / name for name in SPLIT_FILES if (folder / name).is_file()]
    if splits:
        sizes = PictureSizes(given, folder)
        found.append(
            (
                ", ".join(path.name for path in splits),
                lambda: read_transforms({path: _load_json(path) for path in splits}, sizes),
            )
        )
    models = find_models(folder)
    if models:
        found.append(("a COLMAP model", lambda: _greatest_model(models)))
    if not found:
        raise CaptureError(f"{folder} holds no poses that we know; expected {KNOWN}")
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


def _load_json(path: Path) -> Any:
    try:
        return read_json_file(path)
    except UnreadableJsonError as error:
        raise CaptureError(f"{path} {error}") from error
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error


def _first_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(512)
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error
