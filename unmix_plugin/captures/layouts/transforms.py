"""Layouts with a transforms.json of nerfstudio's form: `nerfstudio`, `unmix-nerf`, `nespof`; and
NeSpoF's captures, `nespof-real`.

The frames are those of transforms.json, or of Blender's transforms_train.json and its like, whose paths have no suffix.

`nerfstudio`: RGB pictures, each as a cube of three bands without wavelengths; an alpha channel says what is foreground.
Files of other kinds are opened as what they are, such as the ENVI headers of HSI-Nerfstudio in `datadir`.

`unmix-nerf`: frames have `hyperspectral_file_path`. UnMix-NeRF names .npy cubes, wavelengths and labels. Splits are
lists in the file, otherwise the folder of a frame's file:
`train` against `eval`, `val` or `test`. Paths with `val` whose files lie in `eval`, as UnMix-NeRF's converter leaves
them, are followed there. Keys of scene folders are followed, too: `value_scale`, `fwhm`, and `bands`, `sensor` and
`capture` of a frame.

`nespof`, `nespof-real`: one OpenEXR file for each view and wavelength, with the Stokes components s0 to s3 and maybe
alpha, in this order; or Mitsuba's 16 channels, with the intensity in the fifth. Frames of a rendered scene are
"./train/r_0" with the files 450/train/r_0.exr ... 650/train/r_0.exr, and maybe labels in seg/r_0.png. A capture has
exr/<view>/450.exr, and poses_bounds.npy with one row a view, in the order of the names of views.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TypeAlias

import numpy as np

from unmix_plugin.captures.cube import (
    BandTable,
    Capture,
    CaptureView,
    Cube,
    ReadOptions,
    linear_values,
)
from unmix_plugin.captures.names import FoundFiles, natural_order, path_text, view_names
from unmix_plugin.captures.poses.pose_set import load_json
from unmix_plugin.captures.poses.reading import read_poses, read_transforms
from unmix_plugin.captures.readers.band_files import stack_bands
from unmix_plugin.captures.readers.exr import channel_names
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.report import AXES_IN_DOUBT
from unmix_plugin.errors import CaptureError, counted
from unmix_plugin.formats.json_values import describe, read_numbers
from unmix_plugin.scenes.folder import CUBE_KEY, parse_transforms, read_frame_keys, read_scene_keys
from unmix_plugin.scenes.reading.entries import read_widths, split_lists
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.splits import split_by_lists

Split: TypeAlias = Literal["train", "eval"]
_SPLIT_OF_FILE: dict[str, Split] = {"train": "train", "val": "eval", "eval": "eval", "test": "eval"}
"""What transforms_<name>.json is for."""
_TRUTH_KEYS = ("materials", "endmembers_path", "illuminant_path", "abundance_file_path")
"""Of a scene folder, for people and evaluation: processing does not change them."""
_NAME_KEYS = ("file_path", CUBE_KEY)
"""Of a frame: the first that is there names it in lists and among poses."""
_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")
_NO_WAVELENGTHS = (
    "none: RGB pictures have no wavelengths: --wavelengths 610,550,465 stands for the red, green and blue of a usual "
    "camera"
)


@dataclass(frozen=True)
class _Frame:
    """One element of `frames`."""

    where: str
    """How messages call it."""
    values: dict[str, Any]
    split: Split | None = None

    @property
    def name(self) -> str:
        """The path that names it, without a leading `./`; empty where there is none."""
        return next((self.text(key) for key in _NAME_KEYS if self.text(key)), "")

    def text(self, key: str) -> str:
        """A path in it, see `path_text`; empty where it is absent or no text."""
        value = self.values.get(key)
        return path_text(value) if isinstance(value, str) else ""


@dataclass(frozen=True)
class _FrameList:
    """All frames of a folder, and what is given for all of them."""

    contents: dict[Path, Any]
    """Of transforms.json, or of one for each split."""
    frames: tuple[_Frame, ...]
    top: dict[str, Any]
    notes: tuple[str, ...]


def _read_frames(root: Path, key: str) -> _FrameList:
    """Frames of transforms.json, or of transforms_train.json and its like; repeated ones are left out and noted. Raises
    CaptureError: none of these is there, or one has no frames, or a frame lacks the key of its file."""
    whole = root / "transforms.json"
    files: dict[Path, Split | None] = {whole: None}
    if not whole.is_file():
        files = {root / f"transforms_{name}.json": split for name, split in _SPLIT_OF_FILE.items()}
        files = {path: split for path, split in files.items() if path.is_file()}
    if not files:
        raise CaptureError(
            f"{root} holds no transforms.json and no transforms_train.json; give another folder with --data, or name "
            "another layout"
        )
    contents = {path: load_json(path) for path in files}
    top: dict[str, Any] = {}
    frames: dict[str, _Frame] = {}
    repeated: dict[str, int] = defaultdict(int)
    for path, split in files.items():
        faults = Faults(path)
        transforms = parse_transforms(contents[path], faults)
        faults.raise_if_any(CaptureError)
        top = {**transforms.scene, **top}
        for where, values in transforms.frames:
            frame = _Frame(f"{path.name}: {where}", values, split)
            if frames.setdefault(frame.name or frame.where, frame) is not frame:
                repeated[path.name] += 1
    for frame in frames.values():
        if not frame.text(key):
            raise CaptureError(f"{frame.where} has no '{key}', the path of its file: add it")
        for other in ("mask_path", "seg_file_path"):
            if not isinstance(value := frame.values.get(other), str | None):
                raise CaptureError(f"{frame.where}: '{other}' is {describe(value)}; expected a path")
    notes = [f"{counted(n, 'frame')} of {name} listed before: left out" for name, n in repeated.items()]
    return _FrameList(contents, _split_by_lists(tuple(frames.values()), top, root), top, tuple(notes))


def _split_by_lists(frames: tuple[_Frame, ...], top: dict[str, Any], root: Path) -> tuple[_Frame, ...]:
    """Splits from `train_filenames` and the like, where there are some that are not empty."""
    faults = Faults(root)
    lists = {name: listed for name, listed in split_lists(read_scene_keys(top, faults)).items() if listed}
    names = [[text for key in _NAME_KEYS if (text := frame.text(key))] for frame in frames]
    train, evaluation = split_by_lists(names, lists, faults)
    faults.raise_if_any(CaptureError)
    if not lists:
        return frames
    splits: list[Split | None] = [
        "eval" if index in evaluation else "train" if index in train else None for index in range(len(frames))
    ]
    return tuple(replace(frame, split=split) for frame, split in zip(frames, splits, strict=True))


def _make_capture(
    layout: str,
    root: Path,
    listed: _FrameList,
    views: Sequence[CaptureView],
    notes: Iterable[str] = (),
    warnings: Iterable[str] = (),
) -> Capture:
    """Views, one a frame, in the order of their names; poses that can't be used are noted, as others may be given."""
    posed = dict(zip((frame.name for frame in listed.frames), views, strict=True))
    sizes = {name: (view.cube.shape[1], view.cube.shape[0]) for name, view in posed.items()}
    poses, no_poses = None, ""
    try:
        poses = read_transforms(listed.contents, sizes)
        cameras = {view.name: poses.cameras[name] for name, view in posed.items() if name in poses.cameras}
        poses = replace(poses, cameras=cameras)
    except CaptureError as error:
        no_poses = f"the poses of the capture can't be used: {error}"
    all_notes = (*listed.notes, *notes, *filter(None, [no_poses]))
    ordered = sorted(views, key=lambda view: natural_order(view.name))
    return Capture(layout, root, tuple(ordered), poses, all_notes, tuple(warnings), no_poses=no_poses)


def find_nerfstudio(root: Path, options: ReadOptions) -> Capture:
    """The views of a scene of pictures. EXIF's orientation is ignored: poses refer to the stored raster. Raises
    CaptureError: no frames, pictures are missing or can't be read, or a path leaves the folder."""
    listed = _read_frames(root, "file_path")
    names = view_names([frame.name for frame in listed.frames], str(root))
    found, folder = FoundFiles(root), listed.top.get("datadir")
    views = []
    for frame, name in zip(listed.frames, names, strict=True):
        has_suffix = PurePosixPath(frame.name).suffix in _SUFFIXES
        others = [] if has_suffix else [f"{frame.name}{suffix}" for suffix in _SUFFIXES]
        others += [f"{folder}/{frame.name}"] if isinstance(folder, str) else []
        path, text = found.find(frame.where, frame.name, *others), frame.text("mask_path")
        mask = found.find(frame.where, text, least_parts=2) if text else None
        if path is None:
            continue
        file = open_spectral_file(path, options)
        if file.bands.wavelengths_nm is None:
            file = replace(file, bands=replace(file.bands, source=_NO_WAVELENGTHS))
        picture = path if path.suffix in _SUFFIXES else None
        views.append(CaptureView(name, file, picture=picture, mask=mask, split=frame.split))
    found.refuse_missing("copy them into the folder, or drop the frames")
    return _make_capture("nerfstudio", root, listed, views)


def find_unmix_nerf(root: Path, options: ReadOptions) -> Capture:
    """The views of a scene of UnMix-NeRF, whose frames name cubes. Raises CaptureError: files are missing or outside of
    the folder."""
    listed = _read_frames(root, CUBE_KEY)
    names = view_names([frame.text(CUBE_KEY) for frame in listed.frames], str(root))
    folders = [PurePosixPath(frame.name).parent.name for frame in listed.frames]
    by_folder: list[Split | None] = [_SPLIT_OF_FILE.get(folder) for folder in folders]
    if None in by_folder or len(set(by_folder)) != 2:
        by_folder = [None] * len(by_folder)
    stated, warnings = _state_cubes(root, listed, options)
    views = []
    found, moved, unlabelled = FoundFiles(root), 0, 0
    for frame, name, split, stated_cube in zip(listed.frames, names, by_folder, stated, strict=True):
        text = frame.text(CUBE_KEY)
        cube = found.find(frame.where, text, _in_eval(text))
        if cube is None:
            continue
        moved += "val" in PurePosixPath(text).parts and not (root / text).is_file()
        picture, mask, labels = (
            look(frame.where, frame.text(key), _in_eval(frame.text(key)), least_parts=least_parts)
            if frame.text(key)
            else None
            for key, look, least_parts in (
                ("file_path", found.look, 1),
                ("mask_path", found.find, 2),
                ("seg_file_path", found.look, 2),
            )
        )
        unlabelled += labels is None and frame.text("seg_file_path") != ""
        file, split, shot = (
            _open_cube(cube, stated_cube, options),
            frame.split or split,
            frame.text("capture"),
        )
        view = CaptureView(name, file, stated_cube.sensor, picture, mask, labels, shot=shot, split=split)
        views.append(view)
    found.refuse_missing(
        "copy them into the folder; if there are RGB pictures alone, take the layout 'nerfstudio'"
    )
    notes = [f"{moved} paths name a folder 'val' whose files lie in 'eval'; they were followed"] * (moved > 0)
    if unlabelled:
        notes.append(
            f"{counted(unlabelled, 'view')} without the labels that transforms.json names: no such files"
        )
    given = {*listed.top, *(key for frame in listed.frames for key in frame.values)}
    if not_copied := [key for key in _TRUTH_KEYS if key in given]:
        notes.append(
            f"not taken over from transforms.json: {', '.join(not_copied)}; copy what still fits yourself"
        )
    return _make_capture("unmix-nerf", root, listed, views, notes, warnings)


def _in_eval(text: str) -> str:
    """The path with a folder `val` replaced by `eval`."""
    path = PurePosixPath(text)
    return str(PurePosixPath(*("eval" if part == "val" else part for part in path.parent.parts), path.name))


@dataclass(frozen=True)
class _StatedCube:
    """What transforms.json says of a frame's cube; None where it says nothing."""

    sensor: str
    bands: BandTable | None
    value_scale: float | None
    """Stored number that stands for 1."""
    has_bands: bool
    """Whether the frame lists its bands, among those of the whole scene."""


def _state_cubes(root: Path, listed: _FrameList, options: ReadOptions) -> tuple[list[_StatedCube], list[str]]:
    """What is said of each frame's cube, and warnings. Raises CaptureError: a key of a scene folder is wrong, or can't
    be followed here."""
    values, faults, warnings, centres = listed.top.get("wavelengths"), Faults(root), [], None
    if isinstance(values, list) and values and options.wavelengths_nm is None:
        centres = read_numbers(values, len(values))
    keys = read_scene_keys(listed.top, faults)
    widths = read_widths(keys, faults)
    if widths is not None and (unknown := int(np.isnan(widths).sum())):
        counts = f"{unknown} of {len(widths)} bands"
        warnings, widths = [f"'fwhm' has 0 or null for {counts}: the widths of all count as unknown"], None
    entries = []
    for frame in listed.frames:
        keys_of_frame = read_frame_keys(frame.values, frame.where, faults)
        own_bands = None if keys_of_frame.bands is None else tuple(keys_of_frame.bands)
        for message in _not_followed(frame, own_bands, None if centres is None else len(centres)):
            faults.add(frame.where, message)
        entries.append((keys_of_frame.sensor, own_bands))
    faults.raise_if_any(CaptureError)
    # Frames without a name are of one sensor if their bands are the same.
    unnamed = list(dict.fromkeys(own_bands for sensor, own_bands in entries if sensor is None))
    stated = []
    for sensor, own_bands in entries:
        number = f"bands {unnamed.index(own_bands) + 1}" if sensor is None and len(unnamed) > 1 else ""
        indices = slice(None) if own_bands is None else list(own_bands)
        bands = None
        if centres is not None:
            own_widths = None if widths is None else widths[indices]
            bands = BandTable(centres[indices], "'wavelengths' of transforms.json, nm", own_widths)
        stated.append(_StatedCube(sensor or number, bands, keys.value_scale, own_bands is not None))
    return stated, warnings


def _not_followed(frame: _Frame, bands: tuple[int, ...] | None, num_wavelengths: int | None) -> Iterator[str]:
    """Faults of a frame: keys of scene folders that cubes of captures can't have, and bands that are not there."""
    for key in ("row_poses", "key_poses"):
        if frame.values.get(key):
            yield f"'{key}' is set: a line camera, while views get one pose each; train on the folder as it is"
    if frame.values.get("responses_path"):
        yield "'responses_path' is set: channels of many bands each, which can't be calibrated; leave the frame out"
    if bands is None or num_wavelengths is None:
        return
    if min(bands, default=0) < 0 or max(bands, default=0) >= num_wavelengths:
        yield f"'bands' is {list(bands)}; expected indices of the {num_wavelengths} 'wavelengths', from 0"


def _open_cube(path: Path, stated: _StatedCube, options: ReadOptions) -> Cube:
    """A cube; numbers of 8 bits stand for fractions of 255, unless another number is said to stand for 1."""
    file, bands = open_spectral_file(path, options), stated.bands
    count = 0 if bands is None or bands.wavelengths_nm is None else len(bands.wavelengths_nm)
    if count == file.shape[2] and any(one.code in AXES_IN_DOUBT for one in file.remarks):
        # transforms.json settles which axis is that of bands, which the array alone leaves in doubt.
        sure = open_spectral_file(path, replace(options, axes="yxb"))
        file = sure if sure.shape == file.shape and options.axes is None else file
    scale, why = stated.value_scale, "'value_scale' of transforms.json"
    if scale is not None and file.linear is not None:
        raise CaptureError(
            f"{path} has gains of its own ({file.linear.source}), transforms.json a 'value_scale'; take one of them "
            "out, as it is unclear which the numbers need"
        )
    if scale is None and file.dtype == np.uint8:
        scale, why = 255.0, "numbers of 8 bits"
    if scale is not None and file.linear is None:
        file = replace(file, linear=linear_values(path, file.shape[2], gains=[1 / scale], source=why))
    if file.bands.wavelengths_nm is not None or bands is None:
        return file
    if count == file.shape[2]:
        return replace(file, bands=bands)
    if stated.has_bands:
        raise CaptureError(
            f"{path} has {file.shape[2]} bands, 'bands' of its frame {count} indices; expected one a band"
        )
    return file


# NeSpoF.

_WAVELENGTH_NAME = re.compile(r"(\d+(?:\.\d+)?)(?:\s*nm)?", re.IGNORECASE)
_POSES = "poses_bounds.npy"


def find_nespof(root: Path, options: ReadOptions) -> Capture:
    """The views of a rendered scene. Raises CaptureError: no wavelength folders, no frames, files are missing, or a
    path leaves the folder."""
    folders = _wavelength_entries(root, is_file=False)
    listed = _read_frames(root, "file_path")
    names = view_names([frame.name for frame in listed.frames], str(root))
    found = FoundFiles(root)
    views: list[CaptureView] = []
    for frame, name in zip(listed.frames, names, strict=True):
        text = frame.name.removesuffix(".exr")
        files = [found.find(frame.where, f"{folder.name}/{text}.exr") for folder in folders.values()]
        there = [file for file in files if file is not None]
        if len(there) < len(files):
            continue
        # The folder may be left out.
        labels = [root / "seg" / f"{stem}.png" for stem in (text, Path(text).name)]
        views.append(
            CaptureView(
                name,
                _stack_intensities(dict(zip(folders, there, strict=True)), options),
                alpha=open_opacity(there[0]),
                labels=next((path for path in labels if path.is_file()), None),
                split=frame.split,
            )
        )
    found.refuse_missing("there is one OpenEXR file for every view and wavelength: drop the frames")
    return _make_capture("nespof", root, listed, views)


def find_nespof_real(root: Path, options: ReadOptions) -> Capture:
    """The views of a real capture. Raises CaptureError: no views, a file that can't be read, views of different bands,
    or more or fewer poses than views."""
    parent, path = root / "exr", root / _POSES
    folders = sorted(entry for entry in parent.iterdir() if entry.is_dir()) if parent.is_dir() else []
    if not folders:
        raise CaptureError(f"{root} holds no folder exr with one folder a view, as exr/<view>/450.exr")
    views: list[CaptureView] = []
    first: dict[float, Path] = {}
    for folder, name in zip(folders, view_names([entry.name for entry in folders], str(parent)), strict=True):
        files = _wavelength_entries(folder, is_file=True)
        first = first or files
        if list(files) != list(first):
            differing = ", ".join(f"{wavelength:g}" for wavelength in sorted(set(first) ^ set(files)))
            both = f"{folder} and {folders[0].name} differ"
            raise CaptureError(f"{both}: {differing} nm in one of them alone; expected in every view")
        views.append(CaptureView(name, _stack_intensities(files, options)))
    if not path.is_file():
        missing = f"{_POSES} is not there: the layout has no poses"
        return Capture("nespof-real", root, tuple(views), notes=(missing,), no_poses=missing)
    poses = read_poses(path, {view.name: (view.cube.shape[1], view.cube.shape[0]) for view in views})
    if len(poses.cameras) != len(views):
        raise CaptureError(
            f"{path} holds {len(poses.cameras)} poses, {parent} {len(views)} views; expected as many"
        )
    in_order = dict(zip((view.name for view in views), poses.cameras.values(), strict=True))
    return Capture("nespof-real", root, tuple(views), replace(poses, cameras=in_order))


def _wavelength_entries(folder: Path, *, is_file: bool) -> dict[float, Path]:
    """Files or folders whose name is a wavelength in nm, by it, increasing."""
    entries: dict[float, Path] = {}
    for path in sorted(folder.iterdir()):
        matched = _WAVELENGTH_NAME.fullmatch(path.stem if is_file else path.name)
        is_right = path.is_file() and path.suffix.lower() == ".exr" if is_file else path.is_dir()
        if matched is None or not is_right:
            continue
        other = entries.setdefault(float(matched[1]), path)
        if other is not path:
            raise CaptureError(f"{other} and {path.name} are both {matched[1]} nm; remove one of them")
    if not entries:
        kind = "files such as 450.exr" if is_file else "folders such as 450, 460, ..."
        raise CaptureError(f"{folder} holds no {kind}, named by a wavelength; is this the right layout?")
    return dict(sorted(entries.items()))


def _stack_intensities(files: dict[float, Path], options: ReadOptions) -> Cube:
    """Files of one view by their wavelength, as one cube."""
    parts = [open_intensity(file) for file in files.values()]
    stack, given = stack_bands(parts, parts[0].path), options.bands
    if given is None:
        bands = BandTable(np.array(list(files), dtype=np.float64), "names of the folders or files, nm")
    elif given.num_known == len(files):
        bands = given
    else:
        numbers = f"--wavelengths gives {given.num_known} numbers"
        raise CaptureError(f"{stack.path} has {len(files)} bands, {numbers}; expected one a band")
    return replace(stack, bands=bands)


def open_intensity(path: Path) -> Cube:
    """The first Stokes component, (H, W, 1): by its name, otherwise by the number of channels. Raises CaptureError: the
    file can't be read, or which channel is s0 can't be told."""
    names = channel_names(path)
    named = [name for name in names if "s0" in name.lower().split(".")]
    if not named and len(names) == 16:
        named = [names[4]]
    if not named and len(names) in (4, 5) and _opacity_channel(names) != names[0]:
        named = [names[0]]
    if not named:
        raise CaptureError(
            f"{path} has the channels {', '.join(names)}; expected s0 to s3 and maybe alpha, or Mitsuba's 16 channels"
        )
    return open_spectral_file(path, ReadOptions(named[0]))


def open_opacity(path: Path) -> Cube | None:
    """The alpha channel, (H, W, 1), in [0, 1]; None where there is none."""
    channel = _opacity_channel(channel_names(path))
    return None if channel is None else open_spectral_file(path, ReadOptions(channel))


def _opacity_channel(names: list[str]) -> str | None:
    """The alpha channel: by its name, otherwise the fifth of five."""
    named = [name for name in names if name.lower().split(".")[-1] in ("a", "alpha")]
    if named:
        return named[0]
    return names[-1] if len(names) == 5 else None
