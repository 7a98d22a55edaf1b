"""Layout `nespof`: rendered scenes of NeSpoF, one OpenEXR file for each view and wavelength.

    transforms_{train,val,test}.json   `camera_angle_x`, frames with `file_path` "./train/r_0" (no suffix)
    450/train/r_0.exr ... 650/...      Stokes components s0 to s3, maybe alpha; s0 is the radiance
    seg/r_0.png                        labels, if any

transforms_test.json lists the frames of the other two again; they are not views of their own.

Layout `nespof-real`: captures of NeSpoF.

poses_bounds.npy       LLFF poses, one row a view, in the order of the names of views
exr/<view>/450.exr     Stokes components s0 to s3 of one wavelength, one folder a view

One channel of an OpenEXR file that holds Stokes vectors: intensity and opacity of one wavelength.

NeSpoF's files have s0, s1, s2, s3 and maybe alpha, in this order; files of Mitsuba's Stokes integrator have 16 channels
with the intensity in the fifth.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.layouts.registry import FoundFiles, LayoutOptions, view_names
from unmix_plugin.captures.layouts.transforms import (
    make_capture,
    read_frames,
    require_names,
    with_wavelengths,
)
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import BandTable, ReadOptions, SpectralFile, stack_bands
from unmix_plugin.errors import CaptureError

WAVELENGTH_NAME = re.compile(r"(\d+(?:\.\d+)?)(?:\s*nm)?", re.IGNORECASE)


def find_nespof(root: Path, options: LayoutOptions) -> Capture:
    """The views of a scene; see the module.

    Raises:
        CaptureError: no wavelength folders, no frames, files are missing, or a path leaves the folder.
    """
    folders = wavelength_entries(root, is_file=False)
    listed = read_frames(root)
    require_names(listed.frames, "file_path")
    names = view_names([frame.name for frame in listed.frames], str(root))
    found = FoundFiles(root)
    views: list[CaptureView] = []
    for frame, name in zip(listed.frames, names, strict=True):
        text = frame.name.removesuffix(".exr")
        files = [found.find(frame.where, f"{folder.name}/{text}.exr") for folder in folders.values()]
        there = [file for file in files if file is not None]
        if len(there) < len(files):
            continue
        views.append(
            CaptureView(
                name=name,
                cube=with_wavelengths(stack_intensities(dict(zip(folders, there, strict=True))), options),
                alpha=open_opacity(there[0]),
                labels=_labels(root, text),
                split=frame.split,
            )
        )
    found.refuse_missing(
        "expected one OpenEXR file for every view and wavelength: copy them, or drop the frames"
    )
    return make_capture("nespof", root, listed, views)


def wavelength_entries(folder: Path, *, is_file: bool) -> dict[float, Path]:
    """Files or folders whose name is a wavelength in nm, by it, increasing.

    Raises:
        CaptureError: there is none, or two name the same wavelength.
    """
    entries: dict[float, Path] = {}
    for path in sorted(folder.iterdir()):
        matched = WAVELENGTH_NAME.fullmatch(path.stem if is_file else path.name)
        is_right = path.is_file() and path.suffix.lower() == ".exr" if is_file else path.is_dir()
        if matched is None or not is_right:
            continue
        other = entries.setdefault(float(matched[1]), path)
        if other is not path:
            raise CaptureError(f"{other} and {path.name} are both {matched[1]} nm; remove one of them")
    if not entries:
        kind = "files such as 450.exr" if is_file else "folders such as 450, 460, ..."
        raise CaptureError(
            f"{folder} holds no {kind}, named by a wavelength in nm; is this the right folder and layout?"
        )
    return dict(sorted(entries.items()))


def stack_intensities(files: dict[float, Path]) -> SpectralFile:
    """Files of one view by their wavelength, as one cube.

    Raises:
        CaptureError: one can't be read, or their sizes differ.
    """
    parts = [open_intensity(file) for file in files.values()]
    evidence = "names of the folders or files, nm"
    bands = BandTable(np.array(list(files), dtype=np.float64), evidence)
    return replace(stack_bands(parts, parts[0].path), bands=bands)


def _labels(root: Path, text: str) -> Path | None:
    """Labels of a view in `seg`, with or without the folder of its split."""
    candidates = (root / "seg" / f"{text}.png", root / "seg" / f"{Path(text).name}.png")
    return next((path for path in candidates if path.is_file()), None)


POSES_NAME = "poses_bounds.npy"


def find_nespof_real(root: Path, options: LayoutOptions) -> Capture:
    """The views of a capture; see the module.

    Raises:
        CaptureError: no views, a file that can't be read, views of different bands, or more or fewer poses than views.
    """
    parent = root / "exr"
    folders = sorted(path for path in parent.iterdir() if path.is_dir()) if parent.is_dir() else []
    if not folders:
        raise CaptureError(
            f"{root} holds no folder exr with one folder a view; expected exr/<view>/450.exr and so on"
        )
    names = view_names([folder.name for folder in folders], str(parent))
    views: list[CaptureView] = []
    first: dict[float, Path] = {}
    for folder, name in zip(folders, names, strict=True):
        files = wavelength_entries(folder, is_file=True)
        first = first or files
        if list(files) != list(first):
            differing = ", ".join(f"{wavelength:g}" for wavelength in sorted(set(first) ^ set(files)))
            raise CaptureError(
                f"{folder} and {folders[0].name} differ: {differing} nm in one of them alone; expected one file a "
                "wavelength in every view"
            )
        cube = stack_intensities(files)
        views.append(CaptureView(name, with_wavelengths(cube, options)))
    poses, notes = _poses(root, views)
    return Capture("nespof-real", root, tuple(views), poses, notes)


def _poses(root: Path, views: list[CaptureView]) -> tuple[PoseSet | None, tuple[str, ...]]:
    """Poses by view, both in the order of names.

    Raises:
        CaptureError: more or fewer poses than views.
    """
    path = root / POSES_NAME
    if not path.is_file():
        return None, (f"{POSES_NAME} is not there: the layout has no poses",)
    poses = read_poses(path, {view.name: (view.cube.shape[1], view.cube.shape[0]) for view in views})
    if len(poses.cameras) != len(views):
        raise CaptureError(
            f"{path} holds {len(poses.cameras)} poses, {root / 'exr'} {len(views)} views; expected as many: views are "
            "matched to poses in the order of their names"
        )
    cameras = poses.cameras.values()  # in the order of the file
    return replace(
        poses, cameras={view.name: camera for view, camera in zip(views, cameras, strict=True)}
    ), ()


RAW_CHANNELS, RAW_INTENSITY = 16, 4


def open_intensity(path: Path) -> SpectralFile:
    """The first Stokes component, (H, W, 1).

    Raises:
        CaptureError: the file can't be read, or which channel is s0 can't be told.
    """
    names = _channels(path)
    channel = intensity_channel(names)
    if channel is None:
        raise CaptureError(
            f"{path} has the channels {', '.join(names)}; expected s0 to s3 and maybe alpha, or Mitsuba's 16 channels"
        )
    return open_spectral_file(path, ReadOptions(channel))


def open_opacity(path: Path) -> SpectralFile | None:
    """The alpha channel, (H, W, 1), in [0, 1]; None where there is none."""
    names = _channels(path)
    channel = opacity_channel(names)
    return None if channel is None else open_spectral_file(path, ReadOptions(channel))


def intensity_channel(names: Sequence[str]) -> str | None:
    """The channel with s0, by its name, otherwise by the number of channels.

    >>> intensity_channel(["A", "s0", "s1", "s2", "s3"])
    's0'
    """
    named = [name for name in names if "s0" in name.lower().split(".")]
    if named:
        return named[0]
    if len(names) == RAW_CHANNELS:
        return names[RAW_INTENSITY]
    return names[0] if len(names) in (4, 5) and opacity_channel(names) != names[0] else None


def opacity_channel(names: Sequence[str]) -> str | None:
    """The alpha channel: by its name, otherwise the fifth of five.

    >>> opacity_channel(["s0", "s1", "s2", "s3", "w"])
    'w'
    """
    named = [
        name for name in names if name.lower() in ("a", "alpha") or name.lower().endswith((".a", ".alpha"))
    ]
    if named:
        return named[0]
    return names[-1] if len(names) == 5 else None


def _channels(path: Path) -> list[str]:
    """Names of the channels in the order of the file."""
    import OpenEXR

    try:
        return list(OpenEXR.InputFile(str(path)).header()["channels"])
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise CaptureError(f"{path} can't be read as OpenEXR ({error}); copy it again") from error
