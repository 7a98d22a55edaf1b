"""Layout `nespof`: rendered scenes of NeSpoF, one OpenEXR file for each view and wavelength.

    transforms_{train,val,test}.json   `camera_angle_x`, frames with `file_path` "./train/r_0" (no suffix)
    450/train/r_0.exr ... 650/...      Stokes components s0 to s3, maybe alpha; s0 is the radiance
    seg/r_0.png                        labels, if any

transforms_test.json lists the frames of the other two again; they are not views of their own.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.layouts.found_files import FoundFiles, view_names
from unmix_plugin.captures.layouts.frames import (
    make_capture,
    read_frames,
    require_names,
    with_wavelengths,
)
from unmix_plugin.captures.layouts.registry import LayoutOptions
from unmix_plugin.captures.layouts.stokes_exr import open_intensity, open_opacity
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile, stack_bands
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
