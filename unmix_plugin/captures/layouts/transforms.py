"""Frames of transforms.json, and the files that they name: what the layouts with such a file have in common.

Layout `nerfstudio`: RGB pictures with poses, each as a cube of three bands.

Files of other kinds than pictures are opened as what they are, such as the ENVI headers of HSI-Nerfstudio in `datadir`.
The frames are those of transforms.json, or of Blender's transforms_train.json and its like, whose paths have no suffix.
An alpha channel says what is matter. A picture has no wavelengths, only primaries; the user gives three numbers.

Layouts `unmix-nerf` and `hs-nerf`: transforms.json of nerfstudio's form with `hyperspectral_file_path`.

UnMix-NeRF names .npy cubes, wavelengths and labels, HS-NeRF .pt tensors of 8 bits without wavelengths. Splits are
lists in the file, otherwise the folder of a frame's file: `train` against `eval`, `val` or `test`. Paths with `val`
whose files lie in `eval`, as UnMix-NeRF's converter leaves them, are followed there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TypeAlias

import numpy as np

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.layouts.registry import FoundFiles, LayoutOptions, view_names
from unmix_plugin.captures.poses.files import load_json
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile
from unmix_plugin.errors import CaptureError, counted
from unmix_plugin.scenes.reading.faults import describe, read_number

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


SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")
PRIMARIES_NM = (610, 550, 465)
"""About where the red, green and blue of sRGB lie."""
ADVICE = (
    "RGB pictures have no wavelengths: --wavelengths "
    f"{','.join(map(str, PRIMARIES_NM))} stands for the red, green and blue of a usual camera"
)


def find_nerfstudio(root: Path, options: LayoutOptions) -> Capture:
    """The views of a scene; see the module.

    Raises:
        CaptureError: no frames, pictures are missing or can't be read, or a path leaves the folder.
    """
    listed = read_frames(root)
    require_names(listed.frames, "file_path")
    names = view_names([frame.name for frame in listed.frames], str(root))
    found, folder = FoundFiles(root), listed.top.get("datadir")
    pictures: list[Path] = []
    masks: list[Path | None] = []
    for frame in listed.frames:
        has_suffix = PurePosixPath(frame.name).suffix in SUFFIXES
        others = [] if has_suffix else [f"{frame.name}{suffix}" for suffix in SUFFIXES]
        others += [f"{folder}/{frame.name}"] if isinstance(folder, str) else []
        path = found.find(frame.where, frame.name, *others)
        pictures += [] if path is None else [path]
        text = frame.text("mask_path")
        masks.append(found.find(frame.where, text) if text else None)
    found.refuse_missing("copy them into the folder, or drop the frames")
    views = tuple(
        CaptureView(
            name,
            _open(path, options),
            picture=path if path.suffix in SUFFIXES else None,
            mask=mask,
            split=frame.split,
        )
        for frame, name, path, mask in zip(listed.frames, names, pictures, masks, strict=True)
    )
    return make_capture("nerfstudio", root, listed, views)


def _open(path: Path, options: LayoutOptions) -> SpectralFile:
    """The red, green and blue of a picture.

    EXIF's orientation is ignored: poses refer to the stored raster.
    """
    file = open_spectral_file(path, options.read)
    if file.bands.wavelengths_nm is not None:
        return file
    return replace(file, bands=replace(file.bands, evidence=f"none: {ADVICE}"))


CUBE_KEY = "hyperspectral_file_path"
SCALE_8_BITS = 255.0


def find_unmix_nerf(root: Path, options: LayoutOptions) -> Capture:
    """The views of a scene of UnMix-NeRF; see the module.

    Raises:
        CaptureError: no frames, files are missing or can't be read, or a path leaves the folder.
    """
    return _find("unmix-nerf", root, options)


def find_hs_nerf(root: Path, options: LayoutOptions) -> Capture:
    """The views of a scene of HS-NeRF; see the module.

    Raises:
        CaptureError: no frames, files are missing or can't be read, or a path leaves the folder.
    """
    return _find("hs-nerf", root, options)


def _find(layout: str, root: Path, options: LayoutOptions) -> Capture:
    listed = read_frames(root)
    require_names(listed.frames, CUBE_KEY)
    names = view_names([frame.text(CUBE_KEY) for frame in listed.frames], str(root))
    found, moved = FoundFiles(root), 0
    cubes: list[Path] = []
    for frame in listed.frames:
        text = frame.text(CUBE_KEY)
        path = found.find(frame.where, text, in_eval(text))
        cubes += [] if path is None else [path]
        moved += path is not None and not (root / text).is_file()
    found.refuse_missing(
        "copy them into the folder; if there are RGB pictures alone, the layout 'nerfstudio' takes those"
    )
    by_folder = _splits_of_folders(listed.frames)
    wavelengths = _wavelengths(listed)
    views = [
        CaptureView(
            name=name,
            cube=_open_unmix_nerf(cube, wavelengths, options),
            picture=_optional(found, frame, "file_path"),
            mask=_optional(found, frame, "mask_path"),
            labels=_optional(found, frame, "seg_file_path"),
            split=frame.split or split,
        )
        for frame, name, cube, split in zip(listed.frames, names, cubes, by_folder, strict=True)
    ]
    notes = (
        (f"{moved} paths name a folder 'val' whose files lie in 'eval'; they were followed",) if moved else ()
    )
    return make_capture(layout, root, listed, views, notes)


def in_eval(text: str) -> str:
    """The path with a folder `val` replaced by `eval`.

    >>> in_eval("val/cubes/a.npy")
    'eval/cubes/a.npy'
    """
    path = PurePosixPath(text)
    return str(PurePosixPath(*("eval" if part == "val" else part for part in path.parent.parts), path.name))


def _optional(found: FoundFiles, frame: Frame, key: str) -> Path | None:
    """A file beside the cube; None where the frame names none or it is not there."""
    text = frame.text(key)
    return found.look(frame.where, text, in_eval(text)) if text else None


def _open_unmix_nerf(path: Path, wavelengths: np.ndarray | None, options: LayoutOptions) -> SpectralFile:
    """A cube; numbers of 8 bits stand for fractions of 255."""
    file = open_spectral_file(path, options.read)
    if file.dtype == np.uint8 and file.scale is None:
        file = replace(file, scale=SCALE_8_BITS)
    if wavelengths is not None and len(wavelengths) == file.shape[2] and file.bands.wavelengths_nm is None:
        file = replace(file, bands=BandTable(wavelengths, "'wavelengths' of transforms.json, nm"))
    return file


def _wavelengths(listed: FrameList) -> np.ndarray | None:
    """Top-level `wavelengths`, if they are numbers."""
    values = listed.top.get("wavelengths")
    numbers = [read_number(value) for value in values] if isinstance(values, list) else []
    return None if not numbers or None in numbers else np.array(numbers, dtype=np.float64)


def _splits_of_folders(frames: tuple[Frame, ...]) -> list[Split | None]:
    """Splits by the folder of each frame's file; None for all unless both training and evaluation are there."""
    splits: list[Split | None] = [
        SPLIT_OF_FILE.get(PurePosixPath(frame.name).parent.name) for frame in frames
    ]
    return splits if None not in splits and len(set(splits)) == 2 else [None for _ in frames]
