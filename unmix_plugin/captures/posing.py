"""The cameras of a capture's views, from wherever the user says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.poses.matching import match_poses
from unmix_plugin.captures.poses.placement import place_poses
from unmix_plugin.captures.poses.pose_set import Lens, PosedCamera, PoseSet
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.rigs.completing import complete_rigs
from unmix_plugin.errors import CaptureError

ESTIMATE = "estimate"
LEAST_VIEWS = 2
"""One to train on and one for evaluation."""
MOST_STRETCH = 0.01
"""By which the shapes of a lens's image and of a cube may differ, as a share."""


@dataclass(frozen=True)
class PosedViews:
    """Views with their cameras, in the scene's world."""

    views: tuple[CaptureView, ...]
    cameras: dict[str, PosedCamera]
    """By view, each with the lens of the whole image in its file."""
    poses: PoseSet
    """In the scene's world, with the sparse points."""
    keys: dict[str, Any]
    """What transforms.json records of the way from the source's world to the scene's; nothing where the poses were
    estimated: the scene's world, which stands upright, is then the one that exports return to."""
    notes: tuple[str, ...]

    def lens(self, view: str) -> Lens:
        """The lens of a view's whole image."""
        lens = self.cameras[view].lens
        assert lens is not None
        return lens


def given_poses(capture: Capture, where: str | None) -> PoseSet:
    """The poses of a file, or those of the layout.

    Args:
        capture: Its folder is where a path is looked for that is not in the working directory.
        where: As the user gives it; None for the layout's.
    Raises:
        CaptureError: there are none, or they can't be read.
    """
    if where is None:
        if capture.poses is None:
            why = "".join(f" ({note})" for note in capture.notes if "poses" in note)
            raise CaptureError(
                f"{capture.root}: the layout '{capture.layout}' has no poses{why}; give --poses with transforms.json, "
                f"a COLMAP model or another file, or '--poses {ESTIMATE}' to find them from the images"
            )
        return capture.poses
    path = Path(where)
    if not path.exists() and (capture.root / where).exists():
        path = capture.root / where
    sizes = {view.name: (view.cube.shape[1], view.cube.shape[0]) for view in capture.views}
    return read_poses(path, sizes)


def pose_views(views: Sequence[CaptureView], poses: PoseSet) -> PosedViews:
    """Give each view its camera, lenses of a rig that of others of their release; views without one are left out.

    Raises:
        CaptureError: fewer than two views have a camera, or a lens does not fit its view.
    """
    matches = match_poses(poses, [(view.name, _files_of(view)) for view in views])
    cameras, completed = complete_rigs(views, matches.cameras)
    matched = [note for note in matches.notes if not (completed and "without pose" in note)]
    posed = tuple(view for view in views if view.name in cameras)
    if len(posed) < LEAST_VIEWS:
        raise CaptureError(
            f"{poses.source}: {len(posed)} of {len(views)} views has a pose; a scene needs {LEAST_VIEWS} or more. "
            + "; ".join(matches.notes)
        )
    fitted = {
        view.name: replace(cameras[view.name], lens=fit_lens(cameras[view.name].lens or view.lens, view))
        for view in posed
    }
    has_many_lenses = len({view.sensor for view in posed if view.release}) > 1
    placed = place_poses(replace(poses, cameras=fitted), is_flight=has_many_lenses)
    return PosedViews(
        posed,
        placed.poses.cameras,
        placed.poses,
        placed.placement.to_json() if poses.has_world else {},
        (*poses.notes, *matched, *completed, *placed.notes),
    )


def fit_lens(lens: Lens | None, view: CaptureView) -> Lens:
    """The lens in pixels of the view's file, of which it may be given at another resolution.

    Raises:
        CaptureError: there is none, or its image has another shape than the cube.
    """
    height, width, _ = view.cube.shape
    if lens is None:
        raise CaptureError(
            f"view {view.name} has a pose but no lens; expected a focal length ('fl_x' or 'camera_angle_x') beside the "
            "pose"
        )
    if (lens.width, lens.height) == (width, height):
        return lens
    across, down = width / lens.width, height / lens.height
    if abs(across / down - 1.0) > MOST_STRETCH:
        raise CaptureError(
            f"view {view.name} has {width} x {height} pixels (width x height), its lens is given for {lens.width} x "
            f"{lens.height}; expected the same shape: give the poses of these images"
            + (
                ", or store them turned as EXIF's orientation says"
                if "orientation" in view.cube.metadata
                else ""
            )
        )
    return replace(
        lens,
        width=width,
        height=height,
        focal_px=(lens.focal_px[0] * across, lens.focal_px[1] * down),
        center_px=(lens.center_px[0] * across, lens.center_px[1] * down),
    )


def _files_of(view: CaptureView) -> list[Path]:
    picture = [] if view.picture is None else [view.picture]
    return [*view.cube.files, *picture]
