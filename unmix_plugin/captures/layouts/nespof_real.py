"""Layout `nespof-real`: captures of NeSpoF.

poses_bounds.npy       LLFF poses, one row a view, in the order of the names of views
exr/<view>/450.exr     Stokes components s0 to s3 of one wavelength, one folder a view
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.layouts.found_files import view_names
from unmix_plugin.captures.layouts.frames import with_wavelengths
from unmix_plugin.captures.layouts.nespof import stack_intensities, wavelength_entries
from unmix_plugin.captures.layouts.registry import LayoutOptions
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import CaptureError

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
