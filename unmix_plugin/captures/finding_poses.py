"""Poses that no file gives, found in the views of a capture: by structure from motion, by printed markers, or because
the object was turned by known angles.

Markers are sought in the light that was measured, before anything is cut out, since the paper that they are printed on
may be taken for background.

Notation: `H x W` pixels of the scene, `C` pictures of a view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from unmix_plugin.captures.calibration.calibration import Calibration
from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import ESTIMATE, TURNTABLE, ProcessOptions
from unmix_plugin.captures.plan import Plan
from unmix_plugin.captures.poses.estimation import contrast_picture, estimate_poses
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.marker_detection import (
    Sightings,
    count_markers,
    find_markers,
    parse_family,
)
from unmix_plugin.captures.poses.markers import metric_poses, poses_from_markers
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.poses.turntable import poses_from_turntable
from unmix_plugin.captures.poses.turntable_observations import parse_angles
from unmix_plugin.captures.posing import lens_of_view
from unmix_plugin.captures.writing.view_files import FULL_SCALE
from unmix_plugin.captures.writing.written_views import WrittenViews
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.cubes import map_array

_SAMPLE_VIEWS, _SAMPLE_BANDS = 6, 8
"""In which it is tried what shows the most markers."""
_BLOCK_VALUES = 1 << 22


def marked_poses(plan: Plan, options: ProcessOptions) -> PoseSet:
    """Poses by printed markers, by view, with lenses of the whole images as the capture has them. Raises CaptureError:
    there are too few markers, or they contradict each other."""
    sightings, notes = _sightings(plan, options)
    lenses: dict[str, Lens | tuple[int, int]] = {}
    for view in plan.views:
        raster = plan.recipes[view.sensor].calibration.raster
        if view.lens is None:
            lenses.setdefault(view.sensor, (raster.width, raster.height))
            continue
        lenses[view.sensor] = lens = raster.lens(lens_of_view(view.lens, view))
        if lens.resampled_from is not None:
            raise CaptureError(
                f"lens {view.sensor}: markers are not followed through it ({lens.note}); expected a lens of k1, k2, "
                "p1, p2: undistort the images first, or give poses with --poses FILE"
            )
    sensor_of = {view.name: view.sensor for view in plan.views}
    found = poses_from_markers(sightings, sensor_of, lenses, options.marker_size)
    return _in_files(plan, replace(found, notes=(*notes, *found.notes)))


def poses_of_written_views(written: WrittenViews, work: Path) -> PoseSet:
    """Poses by structure from motion, or of a turntable, on all views that are not left out.

    Args:
        work: Folder for files of the estimation.
    Returns:
        Poses as `marked_poses` has them; metric and upright where markers of a known size are in view.
    Raises:
        CaptureError: a library is not installed, or the pictures do not tell.
    """
    plan, options, scene, records = written.plan, written.options, written.folder, written.sound
    shown = {name: np.logical_and(*record.read_masks(scene)) for name, record in records.items()}
    pictures = {
        name: contrast_picture(
            map_array(scene / record.paths["hyperspectral_file_path"]), float(FULL_SCALE), shown[name]
        )
        for name, record in records.items()
    }
    masks = shown if plan.mask != "none" or any(view.alpha is not None for view in plan.views) else None
    if options.poses == ESTIMATE:
        poses = estimate_poses(pictures, work, {view.name: view.sensor for view in plan.views}, masks)
    elif len(plan.sensors) > 1:
        raise CaptureError(f"--poses {TURNTABLE} knows one camera; process the views of one lens alone")
    else:
        turns = parse_angles(options.angles or "", plan.capture.names)
        poses = poses_from_turntable(pictures, {name: turns[name] for name in pictures}, masks)
    if options.marker_size is not None:
        sightings, notes = _sightings(plan, options)
        poses = metric_poses(poses, sightings, options.marker_size)
        poses = replace(poses, notes=(*poses.notes, *notes))
    return _in_files(plan, poses)


def _in_files(plan: Plan, poses: PoseSet) -> PoseSet:
    """Poses with the lenses of whole files, from those of the scene's pictures."""
    cameras = {}
    for view in plan.views:
        camera = poses.cameras.get(view.name)
        if camera is not None and camera.lens is not None:
            raster = plan.recipes[view.sensor].calibration.raster
            whole = raster.lens_of_file(camera.lens, view.cube.shape[0], view.cube.shape[1])
            cameras[view.name] = replace(camera, lens=whole)
    return replace(poses, cameras=cameras)


def _sightings(plan: Plan, options: ProcessOptions) -> tuple[Sightings, list[str]]:
    """Markers of all views, in the pictures of each sensor that show the most, and how they were found."""
    family = parse_family(options.marker_family)
    sightings: Sightings = {}
    notes: list[str] = []
    for sensor in plan.sensors:
        chosen, band = _choose(plan, sensor, family)
        if chosen is None:
            continue
        calibration = plan.recipes[sensor].calibration
        views = [view for view in plan.views if view.sensor == sensor]
        found, more_notes = find_markers(
            {view.name: _light(view, calibration, [band])[0] for view in views}, chosen
        )
        sightings |= found
        where = (
            "the mean of all bands"
            if band is None
            else f"the band at {plan.sensors[sensor].centers_nm[band]:g} nm"
        )
        notes += [f"{sensor + ': ' if sensor else ''}markers of {chosen} found in {where}", *more_notes]
    if not sightings:
        asked, hint = "no markers", ""
        if family is not None:
            asked, tried = f"no markers of {family}", (_choose(plan, sensor, None) for sensor in plan.sensors)
            if other := next((found for found, _ in tried if found), None):
                hint = f", but some of {other} are: give --marker-family {other}"
        raise CaptureError(
            f"{asked} are in the pictures{hint}; expected sharp ones, with a white rim, at least 20 pixels wide"
        )
    return {view.name: sightings.get(view.name, {}) for view in plan.views}, notes


def _choose(plan: Plan, sensor: str, family: str | None) -> tuple[str | None, int | None]:
    """The family, and the band (None is the mean of all) in which some views of a sensor show the most markers."""
    views = [view for view in plan.views if view.sensor == sensor]
    calibration = plan.recipes[sensor].calibration
    bands: list[int | None] = [None]
    bands += _spread(calibration.num_bands, _SAMPLE_BANDS)
    sample = [_light(views[place], calibration, bands) for place in _spread(len(views), _SAMPLE_VIEWS)]
    for index in (0, len(bands) // 2):  # the mean of all bands, or, if there is nothing in it, the middle one
        if family is None:
            found = count_markers([pictures[index] for pictures in sample[::2]])
            most, count = max(found.items(), key=lambda each: each[1])
            family = most if count else None
    if family is None:
        return None, None
    counts = [count_markers([pictures[i] for pictures in sample], family)[family] for i in range(len(bands))]
    best = int(np.argmax(counts))
    return (family, bands[best]) if counts[best] else (None, None)


def _spread(count: int, most: int) -> list[int]:
    """Some numbers below `count`, evenly over all."""
    return list(dict.fromkeys(np.linspace(0, count - 1, min(most, count)).astype(int).tolist()))


def _light(
    view: CaptureView, calibration: Calibration, bands: Sequence[int | None]
) -> Float32[np.ndarray, "C H W"]:
    """Bands of a view as measured; None stands for the mean of all. Pixels without a measurement are 0."""
    raster = calibration.raster
    pictures = np.empty((len(bands), raster.height, raster.width), np.float32)
    for first, last in raster.blocks(len(calibration.bands), _BLOCK_VALUES):
        values = calibration.rows(view.cube, first, last).values
        for picture, band in zip(pictures, bands, strict=True):
            picture[first:last] = values.mean(axis=-1) if band is None else values[..., band]
    return pictures
