"""Mask files of views, under every name and in every place that programs give them.

| program | the mask of images/0001.jpg |
|---|---|
| COLMAP | masks/0001.jpg.png, or masks/0001.png |
| OpenSfM, OpenDroneMap | masks/0001.jpg.png; images/0001_mask.jpg |
| nerfstudio, trainers of splats | masks/0001.png, masks/0001.jpg; `mask_path` of transforms.json, which goes first |
| Metashape, RealityCapture | 0001_mask.png, 0001.mask.png, 0001.jpg.mask.png beside the image or in a folder |

Folders below images/ are the same below masks/. Sources: colmap 2599, 3611; OpenSfM 551; nv-tlabs/3dgrut 61.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from unmix_plugin.captures.cube import Capture, CaptureView
from unmix_plugin.captures.writing.view_files import alpha_picture
from unmix_plugin.errors import CaptureError, name_some

_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_MARKS = ("_mask", ".mask", "-mask")
MASK_FOLDERS = ("masks", "mask")


def with_mask_files(capture: Capture) -> Capture:
    """The capture with a mask for each view that has neither one nor an alpha channel. Raises CaptureError: a view has
    none, with where it was looked for."""
    views, folders = [], _Folders()
    for view in capture.views:
        if view.mask is None and view.alpha is None and alpha_picture(view) is None:
            images, candidates = {path.resolve() for path in _images(view)}, _candidates(view, capture.root)
            found = (folders.find(folder, name) for folder, name in candidates)
            mask = next((path for path in found if path is not None and path.resolve() not in images), None)
            if mask is None:
                places = [
                    folder for folder in dict.fromkeys(folder for folder, _ in candidates) if folder.is_dir()
                ]
                names = [*dict.fromkeys(name for _, name in candidates if name.endswith(".png"))]
                has_folder = any(folder.name in MASK_FOLDERS for folder in places)
                raise CaptureError(
                    f"--mask files: view {view.name} has no mask; expected an alpha channel, or a mask that is white "
                    f"where the foreground is, for every view. Looked for {name_some(names, 6)} in "
                    f"{name_some([str(folder) for folder in places], 6)}"
                    + ("" if has_folder else "; there is no folder masks/ beside the images")
                )
            view = replace(view, mask=mask)
        views.append(view)
    return replace(capture, views=tuple(views))


class _Folders:
    """Files of folders by name, whatever the capitals and the form of umlauts, each folder listed once."""

    def __init__(self) -> None:
        self._files: dict[Path, dict[str, Path]] = {}

    def find(self, folder: Path, name: str) -> Path | None:
        """The file of this name, in the folder or one that differs from it in capitals."""
        if folder not in self._files:
            alike = [folder] if folder.is_dir() else []
            if not alike and folder.parent.is_dir():
                others = sorted(folder.parent.iterdir())
                alike = [one for one in others if _key(one.name) == _key(folder.name) and one.is_dir()]
            entries = [path for one in alike for path in sorted(one.iterdir())]
            self._files[folder] = {_key(path.name): path for path in entries if path.is_file()}
        return self._files[folder].get(_key(name))


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def is_mask_of(path: Path, others: Iterable[Path]) -> bool:
    """Whether a picture is by its name the mask of another file of its folder."""
    files = {other.name for other in others} | {other.stem for other in others if other != path}
    marked = [path.stem.removesuffix(mark) for mark in _MARKS if path.stem.endswith(mark)]
    return any(name in files for name in marked) or (Path(path.stem).suffix != "" and path.stem in files)


def _images(view: CaptureView) -> list[Path]:
    """Files that a mask may be named after: the cube's, and the picture of a view."""
    return [*dict.fromkeys([*([view.picture] if view.picture else []), view.cube.path, *view.cube.files])]


def _candidates(view: CaptureView, root: Path) -> list[tuple[Path, str]]:
    """Folders and names, the plainest first."""
    found = []
    for image in _images(view):
        stems = dict.fromkeys([image.name, image.stem, Path(image.stem).stem, view.name])
        marked = [f"{stem}{mark}{suffix}" for stem in stems for mark in _MARKS for suffix in _SUFFIXES]
        marked += [f"mask_{stem}{suffix}" for stem in stems for suffix in _SUFFIXES]
        inside = [f"{stem}{suffix}" for stem in stems for suffix in _SUFFIXES]
        # masks/ in and beside the folder of the image and those above it, with the folders that lie between.
        tops = [image.parent]
        while tops[-1] != root and root in tops[-1].parents:
            tops.append(tops[-1].parent)
        for top in [*tops, tops[-1].parent]:
            between = image.parent.relative_to(top).parts
            places = [
                top.joinpath(name, *inner) for name in MASK_FOLDERS for inner in (between[1:], between, ())
            ]
            found += [(place, name) for place in dict.fromkeys(places) for name in [*inside, *marked]]
        beside = [f"{image.name}{suffix}" for suffix in _SUFFIXES]
        found += [(image.parent, name) for name in [*beside, *marked]]
    return [*dict.fromkeys(found)]
