"""Layouts of NeSpoF: one OpenEXR file for each view and wavelength, which holds Stokes components s0 to s3.

`nespof`, rendered scenes; transforms_test.json lists the frames of the other two again:

    transforms_{train,val,test}.json   `camera_angle_x`, frames with `file_path` "./train/r_0" (no suffix)
    450/train/r_0.exr ... 650/...      s0 is the radiance; maybe alpha
    seg/r_0.png                        labels, if any

`nespof-real`, captures:

    poses_bounds.npy                   LLFF poses, one row a view, in the order of the names of views
    exr/<view>/450.exr                 one folder a view

NeSpoF's files have s0, s1, s2, s3 and maybe alpha, in this order; files of Mitsuba's Stokes integrator have 16 channels
with the intensity in the fifth.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.layouts.registry import FoundFiles, view_names
from unmix_plugin.captures.layouts.transforms import make_capture, read_frames
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.readers.exr import channel_names
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import (
    BandTable,
    Capture,
    CaptureView,
    ReadOptions,
    SpectralFile,
    stack_bands,
)
from unmix_plugin.errors import CaptureError

_WAVELENGTH_NAME = re.compile(r"(\d+(?:\.\d+)?)(?:\s*nm)?", re.IGNORECASE)
_POSES = "poses_bounds.npy"


def find_nespof(root: Path, options: ReadOptions) -> Capture:
    """The views of a rendered scene. Raises CaptureError: no wavelength folders, no frames, files are missing, or a
    path leaves the folder."""
    folders = _wavelength_entries(root, is_file=False)
    listed = read_frames(root, "file_path")
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
                alpha=_open_opacity(there[0]),
                labels=next((path for path in labels if path.is_file()), None),
                split=frame.split,
            )
        )
    found.refuse_missing("there is one OpenEXR file for every view and wavelength: drop the frames")
    return make_capture("nespof", root, listed, views)


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
        return Capture("nespof-real", root, tuple(views), notes=(missing,))
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


def _stack_intensities(files: dict[float, Path], options: ReadOptions) -> SpectralFile:
    """Files of one view by their wavelength, as one cube."""
    parts = [_open_intensity(file) for file in files.values()]
    stack, given = stack_bands(parts, parts[0].path), options.wavelengths_nm
    if given is None:
        bands = BandTable(np.array(list(files), dtype=np.float64), "names of the folders or files, nm")
    elif len(given) == len(files):
        bands = BandTable(given, "given with --wavelengths")
    else:
        numbers = f"--wavelengths gives {len(given)} numbers"
        raise CaptureError(f"{stack.path} has {len(files)} bands, {numbers}; expected one a band")
    return replace(stack, bands=bands)


def _open_intensity(path: Path) -> SpectralFile:
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


def _open_opacity(path: Path) -> SpectralFile | None:
    """The alpha channel, (H, W, 1), in [0, 1]; None where there is none."""
    channel = _opacity_channel(channel_names(path))
    return None if channel is None else open_spectral_file(path, ReadOptions(channel))


def _opacity_channel(names: list[str]) -> str | None:
    """The alpha channel: by its name, otherwise the fifth of five.

    >>> _opacity_channel(["s0", "s1", "s2", "s3", "w"])
    'w'
    """
    named = [name for name in names if name.lower().split(".")[-1] in ("a", "alpha")]
    if named:
        return named[0]
    return names[-1] if len(names) == 5 else None
