"""Frames of transforms.json, and the files that they name: what the layouts with such a file have in common."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.json_files import load_json
from unmix_plugin.captures.layouts.registry import LayoutOptions
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile
from unmix_plugin.errors import CaptureError, counted
from unmix_plugin.scenes.reading.faults import describe

Split: TypeAlias = Literal["train", "eval"]
SPLIT_OF_FILE: dict[str, Split] = {"train": "train", "val": "eval", "eval": "eval", "test": "eval"}
"""What transforms_<name>.json is for."""
NAME_KEYS = ("file_path", "hyperspectral_file_path")
"""Of a frame: the first that is there names it in lists and among poses."""


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
    """All frames of a folder, and what is given for all of them."""

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
        content = load_json(path)
        top = {**(content if isinstance(content, dict) else {}), **top}
        listed = content.get("frames") if isinstance(content, dict) else content
        for index, values in enumerate(_checked(listed, path)):
            frame = Frame(f"{path.name}: frames[{index}]", values, split)
            if frames.setdefault(frame.name or frame.where, frame) is not frame:
                repeated[path.name] += 1
    notes = [
        f"{counted(count, 'frame')} of {name} listed before: left out" for name, count in repeated.items()
    ]
    source = whole if whole in files else root
    return FrameList(source, _split_by_lists(tuple(frames.values()), top), top, tuple(notes))


def _checked(listed: Any, path: Path) -> list[dict[str, Any]]:
    if not isinstance(listed, list) or not all(isinstance(values, dict) for values in listed):
        found = "absent" if listed is None else describe(listed)
        raise CaptureError(f"{path}: 'frames' is {found}; expected a list with one object a view")
    return listed


def _split_by_lists(frames: tuple[Frame, ...], top: dict[str, Any]) -> tuple[Frame, ...]:
    """Splits from `train_filenames` and the like: evaluation is test if there is any, otherwise validation."""
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
