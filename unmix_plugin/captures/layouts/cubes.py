"""Layout `cubes`: a folder with one spectral file a view, or one folder of band files a view.

Files with the name of a cube and a suffix of a picture are its RGB picture. Where there are pictures alone, they are
the views: three bands, gamma-encoded.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import Capture, CaptureView, ReadOptions, SpectralFile
from unmix_plugin.errors import CaptureError

_CUBE_SUFFIXES = frozenset(
    {".hdr", ".npy", ".npz", ".tif", ".tiff", ".exr", ".mat", ".h5", ".hdf5", ".nc", ".pt"}
)
_PICTURE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
_REFERENCE_NAME = re.compile(
    r"(white|dark|flat)[ _-]*(ref(erence)?|frame|field|current)?[ _-]*\d*", re.IGNORECASE
)
"""Names of files that hold no view."""


def find_cubes(root: Path, options: ReadOptions) -> Capture:
    """The views of a folder.

    Raises:
        CaptureError: no file in it can be a view, one can't be opened, two views share a name, or the number of
            wavelengths given is not the number of bands.
    """
    excluded = {path.resolve() for path in options.exclude}
    files = [path for path in _visible_files(root) if path.resolve() not in excluded]
    references = [path for path in files if _REFERENCE_NAME.fullmatch(path.stem)]
    files = [path for path in files if path not in references]
    cubes = [path for path in files if path.suffix.lower() in _CUBE_SUFFIXES]
    pictures = {path.stem: path for path in files if path.suffix.lower() in _PICTURE_SUFFIXES}
    folders = [] if cubes else _band_folders(root, excluded)
    found = cubes or folders or list(pictures.values())
    if not found:
        kinds = ", ".join(sorted(_CUBE_SUFFIXES | _PICTURE_SUFFIXES))
        raise CaptureError(
            f"{root} holds no cubes; expected one file a view ({kinds}), or one folder of band files a view"
        )
    owners: dict[str, Path] = {}
    for path in found:
        other = owners.setdefault(_name(path).casefold(), path)
        if other is not path:
            raise CaptureError(
                f"{other} and {path} would both be the view '{_name(other)}'; expected one file a view: rename or move "
                "one of them"
            )
    views = []
    for path in sorted(found, key=_name):
        picture = pictures.get(_name(path)) if cubes or folders else None
        views.append(CaptureView(_name(path), _open(path, options), picture=picture))
    notes = (
        f"{path.name} was left out, as its name is that of a reference; use it with --white or --dark"
        for path in references
        if path.suffix.lower() in _CUBE_SUFFIXES
    )
    return Capture("cubes", root, tuple(views), notes=tuple(notes))


def _open(path: Path, options: ReadOptions) -> SpectralFile:
    file = open_spectral_file(path, options)
    is_picture = path.suffix.lower() in _PICTURE_SUFFIXES and file.dtype.itemsize == 1
    if is_picture and "encoding" not in file.metadata:
        file = replace(file, metadata={**file.metadata, "encoding": "sRGB"})
    return file


def _visible_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))


def _band_folders(root: Path, excluded: set[Path]) -> list[Path]:
    """Folders that hold more than one file, each a view of band files."""
    folders = [path for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")]
    folders = [path for path in folders if path.resolve() not in excluded]
    folders = [path for path in folders if not _REFERENCE_NAME.fullmatch(path.name)]
    kinds = _CUBE_SUFFIXES | _PICTURE_SUFFIXES
    counts = [sum(file.suffix.lower() in kinds for file in _visible_files(path)) for path in folders]
    return sorted(path for path, count in zip(folders, counts, strict=True) if count > 1)


def _name(path: Path) -> str:
    """The stem, with only what is fit for any file system."""
    stem = path.name if path.is_dir() else path.stem
    return re.sub(r"[^\w.+-]+", "_", stem).strip(".") or "view"
