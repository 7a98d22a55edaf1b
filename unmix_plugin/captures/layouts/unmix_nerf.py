"""Layouts `unmix-nerf` and `hs-nerf`: transforms.json of nerfstudio's form with `hyperspectral_file_path`.

UnMix-NeRF names .npy cubes, wavelengths and labels, HS-NeRF .pt tensors of 8 bits without wavelengths. Splits are
lists in the file, otherwise the folder of a frame's file: `train` against `eval`, `val` or `test`. Paths with `val`
whose files lie in `eval`, as UnMix-NeRF's converter leaves them, are followed there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.layouts.found_files import FoundFiles, view_names
from unmix_plugin.captures.layouts.frames import (
    SPLIT_OF_FILE,
    Frame,
    FrameList,
    Split,
    make_capture,
    read_frames,
    require_names,
)
from unmix_plugin.captures.layouts.registry import LayoutOptions
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile
from unmix_plugin.scenes.reading.faults import read_number

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
            cube=_open(cube, wavelengths, options),
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


def _open(path: Path, wavelengths: np.ndarray | None, options: LayoutOptions) -> SpectralFile:
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
