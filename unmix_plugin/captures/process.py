"""From a capture to a scene: look at it, decide, write view after view, and name the folder when all is there."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from unmix_plugin.captures.calibration.sensor import References
from unmix_plugin.captures.finding_poses import check_pose_options, marked_poses, poses_of_written_views
from unmix_plugin.captures.known_distance import asked_distance
from unmix_plugin.captures.layouts.registry import LAYOUTS, find_views
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.plan import Plan, input_files, make_plan
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.posing import FROM_PICTURES, MARKERS, PosedViews, given_poses, pose_views
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import (
    Capture,
    CaptureView,
    ReadOptions,
    SpectralFile,
    require_comparable,
)
from unmix_plugin.captures.wavelengths import parse_wavelengths
from unmix_plugin.captures.writing.resampling import Resampling
from unmix_plugin.captures.writing.scene_files import write_scene_files
from unmix_plugin.captures.writing.view_files import ViewRecord, WorkFolder, hashes, refuse_output, write_view
from unmix_plugin.errors import CaptureError, ConfigError, did_you_mean, name_some

_Say = Callable[[str], None]
"""Tells the user something, one line."""
_Follow = Callable[[str, Sequence[CaptureView]], Iterable[CaptureView]]
"""Goes through views and shows how far it is."""


def process_capture(options: ProcessOptions, say: _Say, follow: _Follow) -> list[str]:
    """Make the scene that the options ask for.

    A start that was interrupted is gone on with where inputs and options are the same.

    Returns:
        What is to be told at the end: what looks wrong, one sentence each.
    Raises:
        CaptureError: files are missing, damaged or don't fit each other.
        ConfigError: an option is wrong or does not fit the files.
        RunError: the folder can't be written.
    """
    _check(options)
    refuse_output(options.output_dir, options.overwrite)
    capture = _open_capture(options)
    say(f"{capture.root}: {len(capture.views)} views of the layout {capture.layout}")
    check_pose_options(options, capture)
    known = asked_distance(options, capture.views)
    posed = None
    if options.poses not in FROM_PICTURES:
        posed = pose_views(capture.views, given_poses(capture, options.poses), known)
    views = capture.views if posed is None else posed.views
    plan = make_plan(capture, views, options, _open_references(options))
    for note in plan.notes:
        say(f"note: {note}")
    if options.poses == MARKERS:
        say("looking for markers ...")
        posed = pose_views(plan.views, marked_poses(plan, options), known)
    folder = WorkFolder(options.output_dir)
    resampled = {} if posed is None else _resampled_lenses(plan, posed)
    if folder.begin({**plan.fingerprint(options), "lenses": sorted(map(_numbers_of, resampled.values()))}):
        say(f"going on with {folder.path}")
    records: dict[str, ViewRecord] = {}
    for view in follow("writing views", plan.views if posed is None else posed.views):
        record = folder.done(view.name)
        if record is None:
            lens = resampled.get(view.name)
            into = None if lens is None else Resampling.into(lens)
            record = write_view(view, plan.recipes[view.sensor], folder.path, into)
            record = replace(record, sources=hashes(input_files(view)))
            folder.note(record)
        records[view.name] = record
    if all(record.matter_share == 0.0 for record in records.values()):
        raise CaptureError(
            f"{capture.root}: no view shows anything but background, by its mask ({plan.mask}); look at "
            f"{folder.path / 'images'} and choose another --mask, or none"
        )
    if posed is None:
        say("estimating poses ...")
        found = poses_of_written_views(plan, records, folder.path, folder.poses, options)
        posed = pose_views(plan.views, found, known)
        _refuse_late(_resampled_lenses(plan, posed))
    for note in posed.notes:
        say(f"poses: {note}")
    findings = write_scene_files(folder.path, plan, posed, records, options)
    folder.finish(options.overwrite)
    return findings


def _resampled_lenses(plan: Plan, posed: PosedViews) -> dict[str, Lens]:
    """Lenses of the views whose pixels are brought into another lens, as the scene has them."""
    found = {}
    for view in posed.views:
        lens = posed.poses.cameras[view.name].lens
        if lens is not None and lens.resampled_from is not None:
            found[view.name] = plan.recipes[view.sensor].calibration.raster.lens(lens)
    return found


def _refuse_late(lenses: dict[str, Lens]) -> None:
    """Refuse lenses that pictures would have to be brought into, as they are written already."""
    if lenses:
        raise CaptureError(
            f"the lens of {name_some(list(lenses))} is not found in the pictures, and its own is not one that scenes "
            "have; give poses with --poses FILE, or leave these views out"
        )


def _numbers_of(lens: Lens) -> list[float]:
    """What tells a resampled lens from others."""
    assert lens.resampled_from is not None
    probe = np.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.3], [-0.3, 0.2]])
    seen = lens.resampled_from.project(probe).ravel().tolist()
    return [*lens.focal_px, *lens.center_px, *lens.distortion, *lens.higher_radial, *seen]


def _check(options: ProcessOptions) -> None:
    if options.layout not in LAYOUTS:
        raise ConfigError(
            f"'{options.layout}' is not a layout; expected one of {', '.join(LAYOUTS)}"
            + did_you_mean(options.layout, LAYOUTS, form="; {}")
        )
    if options.white is not None and options.white_rectangle is not None:
        raise ConfigError("--white and --white-rectangle both name a white reference; give one of them")
    if options.white_reflectance != "1" and options.white is None and options.white_rectangle is None:
        raise ConfigError("--white-reflectance needs a white reference: --white or --white-rectangle")
    for name, number in (("--bin-pixels", options.bin_pixels), ("--bin-bands", options.bin_bands)):
        if number < 1:
            raise ConfigError(f"{name} {number}: expected 1 or more")
    if options.saturation is not None and not 0 < options.saturation < float("inf"):
        raise ConfigError(f"--saturation {options.saturation:g}: expected a stored number above 0")
    if not options.max_noise > 0:
        raise ConfigError(f"--max-noise {options.max_noise:g}: expected a share above 0")


def _open_capture(options: ProcessOptions) -> Capture:
    wavelengths = None if options.wavelengths is None else parse_wavelengths(options.wavelengths)
    references = tuple(path for path in (options.dark, options.white) if path is not None)
    asked = ReadOptions(options.dataset, wavelengths, options.axes, exclude=references)
    capture = _by_size(find_views(options.layout, options.data, asked))
    first: dict[str, SpectralFile] = {}
    for view in capture.views:
        _refuse_unlike(view.cube, first.setdefault(view.sensor, view.cube))
    output = options.output_dir.resolve()
    for view in capture.views:
        if any(path.resolve().is_relative_to(output) for path in input_files(view)):
            raise ConfigError(f"--output-dir {options.output_dir} holds files of the capture")
    return capture


def _by_size(capture: Capture) -> Capture:
    """Views of one camera in several sizes, upright and across, as views of several sensors."""
    sizes: dict[tuple[str, int], set[tuple[int, int]]] = defaultdict(set)
    for view in capture.views:
        sizes[view.sensor, view.cube.shape[2]].add(view.cube.shape[:2])
    if all(len(found) == 1 for found in sizes.values()):
        return capture
    views = [
        replace(view, sensor=f"{view.sensor} {view.cube.shape[1]}x{view.cube.shape[0]}".strip())
        if len(sizes[view.sensor, view.cube.shape[2]]) > 1
        else view
        for view in capture.views
    ]
    listed = sorted({f"{view.cube.shape[1]} x {view.cube.shape[0]}" for view in capture.views})
    note = f"views have {len(listed)} sizes ({name_some(listed)}, width x height), each a sensor of its own"
    return replace(capture, views=tuple(views), notes=(*capture.notes, note))


def _open_references(options: ProcessOptions) -> References:
    opened = []
    for path, flag in ((options.dark, "--dark"), (options.white, "--white")):
        if path is not None and not path.exists():
            raise CaptureError(f"{flag} {path}: no such file; give the image of the reference")
        read = ReadOptions(options.dataset, None, options.axes)
        opened.append(None if path is None else open_spectral_file(path, read))
    return References(*opened)


def _refuse_unlike(cube: SpectralFile, first: SpectralFile) -> None:
    """Views of one sensor have the same size, bands, unit and type of numbers."""
    if cube.shape != first.shape:
        found, expected = (" x ".join(map(str, file.shape)) for file in (cube, first))
        raise CaptureError(
            f"{cube.path} has {found} rows, columns and bands; expected {expected}, as {first.path} has: crop it, or "
            "remove it"
        )
    if (cube.bands.wavelengths_nm is None) != (first.bands.wavelengths_nm is None):
        raise CaptureError(f"only one of {cube.path} and {first.path} gives wavelengths; give --wavelengths")
    require_comparable(cube, first)
    if cube.dtype.newbyteorder("=") != first.dtype.newbyteorder("="):
        raise CaptureError(
            f"{cube.path} holds {cube.dtype.name}; expected {first.dtype.name}, as {first.path} holds"
        )
