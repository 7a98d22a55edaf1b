"""From a capture to a scene: look at it, decide, write view after view, and name the folder when all is there."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from unmix_plugin.captures.calibration.references import GivenReferences, require_comparable
from unmix_plugin.captures.cube import Capture, CaptureView, Cube, ReadOptions
from unmix_plugin.captures.finding_poses import marked_poses, poses_of_written_views
from unmix_plugin.captures.layouts.masks import with_mask_files
from unmix_plugin.captures.options import (
    ESTIMATE,
    FROM_PICTURES,
    MARKERS,
    TURNTABLE,
    ProcessOptions,
    check_options,
    check_pose_options,
    find_views,
    parse_mosaic,
)
from unmix_plugin.captures.plan import Plan, make_plan
from unmix_plugin.captures.pose_agreement import views_of_other_poses
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.posing import PosedViews, asked_distance, given_poses, pose_views
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.report import Code, Kind, Remark, sentences
from unmix_plugin.captures.spoilt import UnreadableViews, judge_sharpness
from unmix_plugin.captures.wavelengths import parse_bands
from unmix_plugin.captures.writing.resampling import Resampling
from unmix_plugin.captures.writing.scene_files import write_scene_files
from unmix_plugin.captures.writing.view_files import ViewRecord, write_view
from unmix_plugin.captures.writing.work_folder import (
    WorkFolder,
    fingerprint,
    hashes,
    input_files,
    refuse_output,
)
from unmix_plugin.captures.writing.written_views import WrittenViews, decisions_of, examine
from unmix_plugin.engine.decisions import decision_table
from unmix_plugin.engine.runs.replacing import require_apart
from unmix_plugin.errors import CaptureError, ConfigError, did_you_mean, name_some

_Say = Callable[[str], None]
"""Tells the user something, one line."""
_Follow = Callable[[str, Sequence[CaptureView]], Iterable[CaptureView]]
"""Goes through views and shows how far it is."""


def process_capture(options: ProcessOptions, say: _Say, follow: _Follow) -> list[str]:
    """Make the scene that the options ask for.

    A start that was interrupted is resumed where inputs and options are the same.

    Returns:
        What is to be told at the end: what looks wrong, one sentence each.
    Raises:
        CaptureError: files are missing, damaged or don't fit each other.
        ConfigError: an option is wrong or does not fit the files.
        RunError: the folder can't be written.
    """
    # Load: what the options name, and which files are views.
    check_options(options)
    refuse_output(options.output_dir, options.overwrite)
    folder = WorkFolder(options.output_dir)
    folder.refuse_foreign()
    require_apart((folder.output, folder.path), options.paths_read)
    references, capture = _open_capture(options)
    say(f"{capture.root}: {len(capture.views)} views of the layout {capture.layout}")
    check_pose_options(options, capture.names)
    distance = asked_distance(options, capture.views)
    wanted, left_out = _wanted_views(capture, options)

    # Decide: from samples of the views, beside their cameras where these are known already.
    posed = None
    if options.poses not in FROM_PICTURES:
        posed = pose_views(wanted, given_poses(capture, options), distance)
    cameras = None if posed is None else posed.poses.cameras
    chosen = wanted if posed is None else posed.views
    plan = make_plan(capture, chosen, options, given=references, cameras=cameras)
    for note in sentences(plan.remarks, Kind.DONE):
        say(f"note: {note}")
    left_out |= plan.left_out
    if options.poses == MARKERS:
        say("looking for markers ...")
        seeing = [view for view in plan.views if view.name not in left_out]
        posed = pose_views(seeing, marked_poses(plan, options), distance)
    require_apart(
        (folder.output, folder.path),
        [("the capture's", path) for view in capture.views for path in input_files(view)],
    )

    # Write: view after view, into a folder that an interrupted start may have left; where scenes don't have the lens of
    # a view, its pixels are brought into another one.
    lenses = {} if posed is None else _resampled_lenses(plan, posed)
    if folder.begin(fingerprint(plan, options, lenses)):
        say(f"resuming {folder.path}")
    records: dict[str, ViewRecord] = {}
    unreadable = UnreadableViews(len(plan.views))
    for view in follow("writing views", plan.views if posed is None else posed.views):
        record = folder.done(view.name)
        if record is None:
            into = Resampling.into(lenses[view.name]) if view.name in lenses else None
            with unreadable.noted(view.name):
                record = write_view(view, plan.recipes[view.sensor], folder.path, into)
                record = replace(record, sources=hashes(input_files(view)))
                folder.note(record)
        if record is not None:
            records[view.name] = record
    written = WrittenViews(folder.path, plan, options, records, left_out | unreadable.remarks)

    # Examine: views that don't belong are left out of the scene.
    for sensor in plan.sensors:
        judged = [one for one in records.values() if one.sensor == sensor and one.name not in plan.left_out]
        sharpness = {record.name: record.sharpness for record in judged}
        written = written.without(judge_sharpness(sharpness, cameras))
    if all(record.matter_share == 0.0 for record in written.sound.values()):
        raise CaptureError(
            f"{capture.root}: no view shows anything but background, by its mask ({plan.mask}); look at "
            f"{folder.path / 'images'} and choose another --mask, or none"
        )
    if posed is None:
        say("estimating poses ...")
        found = poses_of_written_views(written, folder.poses)
        posed = pose_views(written.remaining(plan.views), found, distance)
        refuse_late_lenses(_resampled_lenses(plan, posed))
    for note in sentences(posed.remarks, Kind.DONE):
        say(f"poses: {note}")
    posed = replace(posed, views=written.remaining(posed.views))
    if options.poses not in (ESTIMATE, TURNTABLE):  # which the pictures themselves decide
        seen = [view for view in written.seen(posed) if view.camera.lines is None]
        for sensor in plan.sensors:
            same = [view for view in seen if view.record.sensor == sensor]
            written = written.without(views_of_other_poses(same))
        posed = replace(posed, views=written.remaining(posed.views))
    decided = decisions_of(written, posed)
    for line in decision_table(decided):
        say(line)
    findings = examine(written, posed)
    write_scene_files(written, posed, decided, findings)
    return [*findings.wrong, *folder.finish(options.overwrite)]


def _wanted_views(capture: Capture, options: ProcessOptions) -> tuple[list[CaptureView], dict[str, Remark]]:
    """The views that can be read and that the user does not leave out, and why others are left out. Raises ConfigError:
    the user names one that is not there. Raises CaptureError: too many can't be read."""
    names = capture.names
    for flag, asked in (("--leave-out", options.leave_out), ("--keep-view", options.keep_view)):
        for name in asked:
            if name not in names:
                hint = did_you_mean(name, names, form="; {}")
                raise ConfigError(
                    f"{flag} {name}: no view of this name; there are {name_some(names, 5)}{hint}"
                )
    unreadable = UnreadableViews(len(names))
    wanted = [view for view in capture.views if view.name not in options.leave_out]
    for view in wanted:
        with unreadable.noted(view.name):
            for row in sorted({0, view.cube.shape[0] // 2, view.cube.shape[0] - 1}):
                view.cube.read(slice(row, row + 1))
    left_out = {**capture.unreadable, **unreadable.remarks}
    left_out |= {name: Remark.of(Code.VIEW_NOT_WANTED, [name]) for name in options.leave_out}
    return [view for view in wanted if view.name not in left_out], left_out


def _resampled_lenses(plan: Plan, posed: PosedViews) -> dict[str, Lens]:
    """Lenses of the views whose pixels are brought into another lens, as the scene has them, by name."""
    lenses = {}
    for view in posed.views:
        lens = posed.poses.cameras[view.name].lens
        if lens is not None and lens.resampled_from is not None:
            lenses[view.name] = plan.recipes[view.sensor].calibration.raster.lens(lens)
    return lenses


def refuse_late_lenses(lenses: Collection[str]) -> None:
    """Refuse lenses, by the names of views, that pictures would have to be brought into, as they are written already.
    Raises CaptureError: there is one."""
    if lenses:
        raise CaptureError(
            f"the lens of {name_some([*lenses])} is not found in the pictures, and its own is not one that scenes "
            "have; give poses with --poses FILE, or leave these views out"
        )


def _open_capture(options: ProcessOptions) -> tuple[GivenReferences, Capture]:
    """The references that the user names, and the views, of which those of one sensor have the same size, bands, unit
    and type of numbers. Raises CaptureError: they don't, or a file can't be read."""
    mosaic, opened = parse_mosaic(options.mosaic), {}
    for path, kind in ((options.dark, "dark"), (options.white, "white")):
        if path is not None:
            if not path.exists():
                raise CaptureError(f"--{kind} {path}: no such file; give the image of the reference")
            asked = ReadOptions(options.dataset, None, options.axes, mosaic=mosaic)
            opened[kind] = open_spectral_file(path, asked)
    references = GivenReferences(**opened)
    bands = None if options.wavelengths is None else parse_bands(options.wavelengths)
    named = tuple(path for file in references.files for path in file.files)
    if options.poses is not None:  # an array, perhaps
        named += (Path(options.poses), options.data / options.poses)
    asked = ReadOptions(options.dataset, bands, options.axes, mosaic=mosaic, exclude=named)
    capture = find_views(options.layout, options.data, asked)

    # Views of one camera in several sizes, upright and across, are views of several sensors.
    sizes: dict[tuple[str, int], set[tuple[int, int]]] = defaultdict(set)
    for view in capture.views:
        sizes[view.sensor, view.cube.shape[2]].add(view.cube.shape[:2])
    if any(len(of_camera) > 1 for of_camera in sizes.values()):
        views = [
            replace(view, sensor=f"{view.sensor} {view.cube.shape[1]}x{view.cube.shape[0]}".strip())
            if len(sizes[view.sensor, view.cube.shape[2]]) > 1
            else view
            for view in capture.views
        ]
        listed = sorted({f"{view.cube.shape[1]} x {view.cube.shape[0]}" for view in capture.views})
        note = (
            f"views have {len(listed)} sizes ({name_some(listed)}, width x height), each a sensor of its own"
        )
        capture = replace(capture, views=tuple(views), notes=(*capture.notes, note))

    if options.mask == "files":
        capture = with_mask_files(capture)
    first: dict[str, Cube] = {}
    for view in capture.views:
        cube, other = view.cube, first.setdefault(view.sensor, view.cube)
        if cube.shape != other.shape:
            found, expected = (" x ".join(map(str, file.shape)) for file in (cube, other))
            raise CaptureError(
                f"{cube.path} has {found} rows, columns and bands; expected {expected}, as {other.path} has: crop it, "
                "or remove it"
            )
        if (cube.bands.wavelengths_nm is None) != (other.bands.wavelengths_nm is None):
            raise CaptureError(
                f"only one of {cube.path} and {other.path} gives wavelengths; give --wavelengths"
            )
        require_comparable(cube, other)
        if cube.dtype.newbyteorder("=") != other.dtype.newbyteorder("="):
            raise CaptureError(
                f"{cube.path} holds {cube.dtype.name}; expected {other.dtype.name}, as {other.path} holds"
            )
    return references, capture
