"""Frames of transforms.json, and the files that they name: what the layouts with such a file have in common."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TypeAlias

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.layouts.registry import LayoutOptions
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.json_values import UnreadableJsonError, describe, read_json_file

Split: TypeAlias = Literal["train", "eval"]
SPLIT_OF_FILE: dict[str, Split] = {"train": "train", "val": "eval", "eval": "eval", "test": "eval"}
"""What transforms_<name>.json is for."""
NAME_KEYS = ("file_path", "hyperspectral_file_path")
"""Of a frame: the first that is there names it in lists and among poses."""
MOST_NAMED = 3


@dataclass(frozen=True)
class Frame:
    """One element of `frames`."""

    where: str
    """How messages call it."""
    values: dict[str, Any]
    split: Split | None = None

    @property
    def name(self) -> str:
        """The path that names it, without a leading `./`; empty where there is none."""
        return next((self.text(key) for key in NAME_KEYS if self.text(key)), "")

    def text(self, key: str) -> str:
        """A path in it, without a leading `./`; empty where it is absent or no text."""
        value = self.values.get(key)
        return value.strip().removeprefix("./") if isinstance(value, str) else ""


@dataclass(frozen=True)
class FrameList:
    """All frames of a folder, and what stands above them."""

    source: Path
    """transforms.json, or the folder that holds one for each split."""
    frames: tuple[Frame, ...]
    top: dict[str, Any]
    notes: tuple[str, ...]


def read_frames(root: Path) -> FrameList:
    """Frames of transforms.json, or of transforms_train.json and its like; repeated ones are left out and noted.

    Raises:
        CaptureError: none of these is there, or one has no frames.
    """
    whole = root / "transforms.json"
    files: dict[Path, Split | None] = {whole: None}
    if not whole.is_file():
        files = {root / f"transforms_{name}.json": split for name, split in SPLIT_OF_FILE.items()}
        files = {path: split for path, split in files.items() if path.is_file()}
    if not files:
        raise CaptureError(
            f"{root} holds no transforms.json and no transforms_train.json; expected one of them with 'frames': "
            "give the folder that holds it with --data, or name another layout"
        )
    top: dict[str, Any] = {}
    frames: dict[str, Frame] = {}
    repeated: dict[str, int] = defaultdict(int)
    for path, split in files.items():
        content = _read(path)
        top = {**(content if isinstance(content, dict) else {}), **top}
        listed = content.get("frames") if isinstance(content, dict) else content
        for index, values in enumerate(_checked(listed, path)):
            frame = Frame(f"{path.name}: frames[{index}]", values, split)
            if frames.setdefault(frame.name or frame.where, frame) is not frame:
                repeated[path.name] += 1
    notes = [f"{count} frames of {name} are listed before: left out" for name, count in repeated.items()]
    source = whole if whole in files else root
    return FrameList(source, _split_by_lists(tuple(frames.values()), top), top, tuple(notes))


def _read(path: Path) -> Any:
    try:
        return read_json_file(path)
    except UnreadableJsonError as error:
        raise CaptureError(f"{path} {error}") from error
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error


def _checked(listed: Any, path: Path) -> list[dict[str, Any]]:
    if not isinstance(listed, list) or not all(isinstance(values, dict) for values in listed):
        found = "absent" if listed is None else describe(listed)
        raise CaptureError(f"{path}: 'frames' is {found}; expected a list with one object a view")
    return listed


def _split_by_lists(frames: tuple[Frame, ...], top: dict[str, Any]) -> tuple[Frame, ...]:
    """Splits from `train_filenames` and the like: evaluation is test if there is any, else validation."""
    lists = {
        name: {
            text.removeprefix("./") for text in top.get(f"{name}_filenames") or [] if isinstance(text, str)
        }
        for name in ("train", "val", "test")
    }
    evaluation = lists["test"] or lists["val"]
    if not evaluation:
        return frames

    def split_of(frame: Frame) -> Split | None:
        names = {frame.text(key) for key in NAME_KEYS}
        if names & evaluation:
            return "eval"
        return "train" if not lists["train"] or names & lists["train"] else None

    return tuple(replace(frame, split=split_of(frame)) for frame in frames)


class FoundFiles:
    """Looks for the files of a capture and tells of all that are missing in one message."""

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()
        self._missing: list[str] = []

    def look(self, where: str, *texts: str) -> Path | None:
        """The first of some paths in the folder that is a file; None if none is.

        Raises:
            CaptureError: the path leaves the folder.
        """
        for text in texts:
            path = self._root / text
            try:
                is_inside = path.resolve().is_relative_to(self._root) and not Path(text).is_absolute()
                is_file = path.is_file()
            except (OSError, RuntimeError, ValueError) as error:
                raise CaptureError(
                    f"{where}: {text!r} can't be followed ({error}); expected a path in the folder"
                ) from error
            if not is_inside:
                raise CaptureError(
                    f"{where}: {text!r} leaves the folder {self._root}; copy the file into it and name it from there"
                )
            if is_file:
                return path
        return None

    def find(self, where: str, text: str, *others: str) -> Path | None:
        """The same; noted as missing if none is.

        Raises:
            CaptureError: the path leaves the folder.
        """
        path = self.look(where, text, *others)
        self._missing += [] if path else [text]
        return path

    def refuse_missing(self, advice: str) -> None:
        """End here if a file was missing.

        Raises:
            CaptureError: some were; the message names a few.
        """
        if self._missing:
            shown = ", ".join(self._missing[:MOST_NAMED])
            more = len(self._missing) - MOST_NAMED
            raise CaptureError(
                f"{self._root} lacks {len(self._missing)} files that belong to views: {shown}"
                f"{f' and {more} more' if more > 0 else ''}; {advice}"
            )


def view_names(texts: Sequence[str], where: str) -> list[str]:
    """Names of views from the paths of their files: the stems, or with their folders where stems repeat.

    Raises:
        CaptureError: two paths give the same name.
    """
    paths = [PurePosixPath(text.replace("\\", "/")) for text in texts]
    stems = [path.name if path.suffix[1:].isdecimal() else path.stem for path in paths]
    if len(set(stems)) < len(stems):
        stems = ["_".join([*path.parent.parts, stem]) for path, stem in zip(paths, stems, strict=True)]
    names = [re.sub(r"[^\w.+-]+", "_", stem).strip("._") or "view" for stem in stems]
    seen: dict[str, str] = {}
    for name, text in zip(names, texts, strict=True):
        other = seen.setdefault(name.casefold(), text)
        if other is not text:
            raise CaptureError(
                f"{where}: {other} and {text} would both be the view '{name}'; rename one of them"
            )
    return names


def make_capture(
    layout: str, root: Path, listed: FrameList, views: Sequence[CaptureView], notes: Iterable[str] = ()
) -> Capture:
    """Views with the poses of their frames, in the order of their names.

    Poses that can't be used are noted, as the user may give others.

    Args:
        views: One a frame, in the order of the frames.
    """
    posed = dict(zip((frame.name for frame in listed.frames), views, strict=True))
    sizes = {name: (view.cube.shape[1], view.cube.shape[0]) for name, view in posed.items()}
    poses, said = None, [*listed.notes, *notes]
    try:
        poses = read_poses(listed.source, sizes)
        cameras = {view.name: poses.cameras[name] for name, view in posed.items() if name in poses.cameras}
        poses = replace(poses, cameras=cameras)
    except CaptureError as error:
        said.append(f"the poses of the capture can't be used: {error}")
    return Capture(layout, root, tuple(sorted(views, key=lambda view: view.name)), poses, tuple(said))


def with_wavelengths(file: SpectralFile, options: LayoutOptions) -> SpectralFile:
    """The file with the wavelengths that a user gives; unchanged where there are none.

    Raises:
        CaptureError: another number of them than of bands.
    """
    given = options.wavelengths_nm
    if given is None:
        return file
    if len(given) != file.shape[2]:
        raise CaptureError(
            f"{file.path} has {file.shape[2]} bands, --wavelengths gives {len(given)} numbers; expected one a band"
        )
    return replace(file, bands=BandTable(given, "given with --wavelengths"))


def require_names(frames: Iterable[Frame], key: str) -> None:
    """Refuse frames that don't name a file.

    Raises:
        CaptureError: a frame lacks the key.
    """
    for frame in frames:
        if not frame.text(key):
            raise CaptureError(
                f"{frame.where} has no '{key}'; expected the path of its file: add it or drop the frame"
            )
