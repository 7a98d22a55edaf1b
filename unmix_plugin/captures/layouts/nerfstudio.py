"""Layout `nerfstudio`: RGB pictures with poses, each as a cube of three bands.

Files of other kinds than pictures are opened as what they are, such as the ENVI headers of HSI-Nerfstudio in `datadir`.
The frames are those of transforms.json, or of Blender's transforms_train.json and its like, whose paths have no suffix.
An alpha channel says what is matter. A picture has no wavelengths, only primaries; the user gives three numbers.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.layouts.found_files import FoundFiles, view_names
from unmix_plugin.captures.layouts.frames import (
    make_capture,
    read_frames,
    require_names,
)
from unmix_plugin.captures.layouts.registry import LayoutOptions
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import SpectralFile

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
