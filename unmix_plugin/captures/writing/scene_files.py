"""What is written once all views are there: cameras, light, points, the report in words, the record, and the contact
sheet, one picture of every view with its mask, of cameras and points from above, and of mean spectra.

Notation: `h x w` pixels of a small picture, `B` bands.
"""

from __future__ import annotations

import textwrap
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from unmix_plugin import __version__
from unmix_plugin.captures.calibration.bands import BandFault
from unmix_plugin.captures.checks import (
    SeenView,
    ViewSample,
    angles_between,
    check_files,
    check_values,
    check_views,
)
from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.match_checks import MatchedScene, check_matches
from unmix_plugin.captures.options import ProcessOptions, plain_options
from unmix_plugin.captures.plan import Plan, SensorPlan
from unmix_plugin.captures.poses.line_motion import averaged_lines, middle_of
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.posing import PosedViews
from unmix_plugin.captures.report import Kind, Remark, report_text, sentences
from unmix_plugin.captures.writing.view_files import FULL_SCALE, BackgroundRule, ViewRecord
from unmix_plugin.captures.writing.work_folder import RECORD_NAME, hashes
from unmix_plugin.engine.decisions import Decision
from unmix_plugin.engine.printing import plot_text, terminal_text
from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.errors import counted, name_some
from unmix_plugin.figures.pictures import Canvas, CanvasLayout, columns_for
from unmix_plugin.figures.plotting import FIGURE_DPI, figure_bytes, plain_axes
from unmix_plugin.formats.meshes import write_ply
from unmix_plugin.scenes.folder import lens_keys, matrix_entry, transforms_bytes
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

_SCENE_NAME, _SHEET_NAME, _REPORT_NAME = "transforms.json", "contact-sheet.png", "report.txt"
_ILLUMINANT_NAME, _FLAT_LIGHT_NAME, _POINTS_NAME = "illuminant.csv", "flat-light.csv", "points.ply"
_MOST_BANDS = 8
"""Bands left out for one reason that are named."""


def seen_views(
    folder: Path, plan: Plan, posed: PosedViews, records: Mapping[str, ViewRecord]
) -> list[SeenView]:
    """The views that have poses and are written, with the lenses of their pictures."""
    seen = []
    for view in posed.views:
        if view.name in records:
            record, camera = records[view.name], posed.poses.cameras[view.name]
            assert camera.lens is not None
            raster = plan.sensors[view.sensor].calibration.raster
            camera = replace(camera, lens=raster.lens(camera.lens))
            if camera.lines is not None:
                lines = averaged_lines(camera.lines, raster.top, raster.height, raster.binning)
                camera = replace(camera, camera_to_world=middle_of(lines), lines=lines)
            seen.append(SeenView(record, camera, folder / record.paths["file_path"]))
    return seen


def _greatest_sensor(seen: Sequence[SeenView]) -> str:
    """The sensor that took the most views."""
    ((greatest, _),) = Counter(view.record.sensor for view in seen).most_common(1)
    return greatest


def _matched(seen: Sequence[SeenView]) -> MatchedScene:
    """What the views share of the sensor that took the most; nothing is matched between pictures of line cameras, which
    no fundamental matrix explains."""
    if any(view.camera.lines is not None for view in seen):
        return MatchedScene((), None)
    greatest = _greatest_sensor(seen)
    return MatchedScene.of([(view.camera, view.picture) for view in seen if view.record.sensor == greatest])


def write_scene_files(
    folder: Path,
    plan: Plan,
    posed: PosedViews,
    records: dict[str, ViewRecord],
    *,
    options: ProcessOptions,
    left_out: Sequence[Remark] = (),
    decided: Sequence[Decision] = (),
) -> list[str]:
    """Write transforms.json, light, points, contact sheet, report and record.

    Args:
        records: Of the views that are written, with some that are left out.
        left_out: Why views are left out, one each.
        decided: For the report.
    Returns:
        What looks wrong, one sentence each.
    Raises:
        RunError: the folder can't be written.
    """
    keys = posed.keys | write_points(folder, posed.poses)
    # Reflectances are seen in a flat light. Where they were divided by a scale, a perfect white is stored as 1 over it,
    # which readers make the power of this light: whatever is divided by it is reflectance again. Where nobody says what
    # 1 is, values that had to be divided may be per cent, or anything.
    first, *others = sensors = list(plan.sensors.values())
    meanings, scale = [sensor.meaning for sensor in sensors], plan.scale.value
    if all(one.is_reflectance and (one.states_one or scale == 1.0) for one in meanings):
        if first.lamp is not None and all(np.array_equal(first.centers_nm, one.centers_nm) for one in others):
            lamp = SpectraTable(Bands(first.centers_nm), ("power",), first.lamp[None])
            write_spectra_csv(folder / _ILLUMINANT_NAME, lamp)
        bands = Bands(np.unique(np.concatenate([sensor.centers_nm for sensor in sensors])))
        flat = SpectraTable(bands, ("power",), np.ones((1, len(bands))))
        write_spectra_csv(folder / _FLAT_LIGHT_NAME, flat)
        keys["illuminant_path"] = _FLAT_LIGHT_NAME
        keys |= {} if scale == 1.0 else {"reflectance_of_1": scale}
    seen = seen_views(folder, plan, posed, records)
    # Views of sensors with other bands can't be compared with those of the one that took the most.
    bands_nm = plan.sensors[_greatest_sensor(seen)].centers_nm
    alike = {name for name, sensor in plan.sensors.items() if np.array_equal(sensor.centers_nm, bands_nm)}
    findings = sentences(left_out, Kind.WRONG)
    findings += dict.fromkeys((*sentences(plan.remarks, Kind.WRONG), *posed.poses.warnings))
    checked = check_views([v for v in seen if v.record.sensor in alike], posed.poses.points)
    checked += [*posed.remarks, *check_files(posed.views, options)]
    for name, sensor in plan.sensors.items():
        same = [view for view in seen if view.record.sensor == name]
        samples = [ViewSample.of(view.record, folder) for view in same]
        checked += check_values(samples, angles_between(same), sensor.centers_nm)
    findings += sentences(checked, Kind.WRONG)
    measured = [*sentences(checked, Kind.MEASURED), check_matches(_matched(seen), findings)]

    sizes = []
    for name, sensor in plan.sensors.items():
        raster, centers = sensor.calibration.raster, sensor.centers_nm
        bands = f"1 band at {centers[0]:g} nm" if len(centers) == 1 else str(Bands(centers))
        sizes.append(f"{name + ': ' if name else ''}{raster.height} x {raster.width} pixels, {bands}")
    title = f"{plan.capture.root}: {len(seen)} views, {'; '.join(sizes)}"
    done = sentences(left_out, Kind.DONE) + _what_was_done(plan, posed, [view.record for view in seen])
    report = report_text(title, findings, measured, done, decided)
    write_file(folder / _REPORT_NAME, terminal_text(report).encode())
    reasons = {remark.where[0]: remark for remark in left_out}
    spoilt = [record for name, record in records.items() if name in reasons]
    write_file(folder / _SHEET_NAME, contact_sheet(seen, plan.sensors, posed.poses, title, spoilt))
    views = [asdict(view.record) for view in seen]
    totals = ("num_pixels", "saturated_pixels", "missing_pixels", "clipped_values", "negative_values")
    record = {
        "made_by": f"unmix-process {__version__}",
        "options": plain_options(options),
        "decisions": plan.decisions,
        "decided": [decision.to_json() for decision in decided],
        "stored": {"type": "uint16", "value_scale": FULL_SCALE, "calibrated_value_of_1": plan.scale.value},
        "poses": {"source": posed.poses.source, "notes": sentences(posed.remarks, Kind.DONE), **posed.keys},
        "notes": sentences(plan.remarks, Kind.DONE),
        "what_looks_wrong": findings,
        "left_out": [remark.to_json() for remark in left_out],
        "measured": measured,
        "totals": {key: sum(view[key] for view in views) for key in totals},
        "references": hashes(plan.option_files),
        "views": views,
    }
    write_file(folder / RECORD_NAME, transforms_bytes(record))

    others = []
    for name, remark in reasons.items():
        reason = remark.code.name.lower().replace("_", " ").removeprefix("view ")
        paths = records[name].paths if name in records else {}
        others.append({"name": name, "reason": reason, **paths})
    keys |= {"left_out": others} if others else {}
    markers = {name: corners.tolist() for name, corners in posed.poses.markers.items()}
    keys |= {"markers": markers} if markers else {}
    write_file(folder / _SCENE_NAME, transforms_bytes(_transforms_json(plan, posed.views, seen, keys)))
    return findings


def write_points(folder: Path, poses: PoseSet) -> dict[str, str]:
    """Write the sparse points, in the scene's world, beside a scene's transforms.json; its key, if there are any."""
    if poses.points is None or len(poses.points) == 0:
        return {}
    columns = {axis: poses.points[:, index].astype(np.float32) for index, axis in enumerate("xyz")}
    if poses.colours is not None:
        columns |= {name: poses.colours[:, index] for index, name in enumerate(("red", "green", "blue"))}
    comment = "sparse points of structure from motion, scene coordinates"
    write_ply(folder / _POINTS_NAME, columns, comments=[comment])
    return {"ply_file_path": _POINTS_NAME}


def _transforms_json(
    plan: Plan, views: Sequence[CaptureView], seen: Sequence[SeenView], extra: dict[str, Any]
) -> dict[str, Any]:
    """Cameras, bands, scale and paths; what all views share is written above the frames.

    Views of different sensors have their own lens and size, `bands` as indices into the `wavelengths` of the scene, and
    the name of their sensor.
    """
    bands = np.unique(np.concatenate([plan.sensors[view.sensor].centers_nm for view in views]))
    facts = []  # keys of a frame that it may share with the others
    for view, written in zip(views, seen, strict=True):
        lens, centers_nm = written.camera.lens, plan.sensors[view.sensor].centers_nm
        assert lens is not None
        known: dict[str, Any] = {"w": lens.width, "h": lens.height}
        known |= lens_keys(lens.focal_px, lens.center_px, (*lens.distortion, *lens.higher_radial))
        known |= {key: text for key, text in (("sensor", view.sensor), ("capture", view.shot)) if text}
        if len(centers_nm) < len(bands):
            known["bands"] = np.searchsorted(bands, centers_nm).tolist()
        facts.append(known)
    shared = {
        key: value for key, value in facts[0].items() if all(of_frame.get(key) == value for of_frame in facts)
    }
    frames = []
    for written, known in zip(seen, facts, strict=True):
        of_frame = {key: value for key, value in known.items() if key not in shared}
        lines = written.camera.lines
        pose: dict[str, Any] = {"transform_matrix": matrix_entry(written.camera.camera_to_world)}
        if lines is not None:
            pose = {"row_poses": [matrix_entry(line) for line in lines]}
        frames.append({**written.record.paths, **of_frame, **pose})

    # Widths of all bands as the files tell them, if all are known and bands are not averaged.
    known_nm: dict[float, float] = {}
    for view in views:
        sensor, widths_nm = plan.sensors[view.sensor], view.cube.bands.fwhm_nm
        if widths_nm is not None and sensor.calibration.bin_bands == 1:
            of_kept = widths_nm[sensor.calibration.bands].tolist()
            known_nm |= zip(sensor.centers_nm.tolist(), of_kept, strict=True)
    widths = {"fwhm": [known_nm[band] for band in bands.tolist()]} if len(known_nm) == len(bands) else {}

    splits = {}
    if {"train", "eval"} <= {view.split for view in views}:  # others are in neither list
        names: dict[str, list[str]] = defaultdict(list)
        for view, written in zip(views, seen, strict=True):
            names[view.split or "neither"].append(written.record.paths["file_path"])
        splits = {"train_filenames": names["train"]}
        splits |= {"val_filenames": names["eval"], "test_filenames": names["eval"]}
    return {
        "camera_model": "OPENCV",
        **shared,
        "wavelengths": bands.tolist(),
        **widths,
        "value_scale": FULL_SCALE,
        "calibrated_value_of_1": plan.scale.value,
        **extra,
        **splits,
        "frames": frames,
    }


def _what_was_done(plan: Plan, posed: PosedViews, views: Sequence[ViewRecord]) -> list[str]:
    """Decisions and totals, one sentence each."""
    lines = []
    for name, sensor in plan.sensors.items():
        where, used = f"{name}: " if name else "", sensor.references_used
        lines.append(
            f"{where}values are {sensor.meaning.description}; wavelengths from {sensor.bands.source}"
        )
        for key, what in (("dark", "dark frame"), ("white", "white reference")):
            lines += [f"{where}{what}: {used[key]['use']}"] if key in used else []
        stored, reason = sensor.saturation.stored, sensor.saturation.reason
        lines.append(f"{where}saturation: {reason if stored is None else f'from {stored:g} ({reason})'}")
        dropped: dict[str, list[str]] = defaultdict(list)
        for index, band in sorted(sensor.bands.dropped.items()):
            reason = "noisy" if band.fault is BandFault.NOISY else band.reason
            dropped[reason].append(f"{sensor.bands.wavelengths_nm[index]:g} nm")
        lines += [
            f"{where}bands left out: {name_some(names, _MOST_BANDS)} ({reason})"
            for reason, names in dropped.items()
        ]
    lines.append(
        f"{plan.scale.value:g} is written as 1: {plan.scale.reason}; full scale of the cubes is {FULL_SCALE}"
    )

    def total(what: str) -> str:
        noun = what.rpartition("_")[2].removesuffix("s")
        return counted(sum(getattr(view, what) for view in views), noun)

    num_values = sum(view.num_pixels * len(plan.sensors[view.sensor].centers_nm) for view in views)
    negative = sum(view.negative_values for view in views) / max(num_values, 1)
    lines.append(
        f"{total('saturated_pixels')} with saturated bands, which are written as 1; {total('clipped_values')} above 1, "
        f"written as 1 too; {total('negative_values')} below 0 ({negative:.1%} of all), written as 0; "
        f"{total('missing_pixels')} masked, as nothing was measured there"
    )
    share = f"{np.mean([view.matter_share for view in views]):.0%} of the pixels are foreground"
    found = plan.backdrops_in_words
    changed = f"{total('specks')} removed, {total('holes')} filled"
    if found:
        whole = sum(view.matter_share == 1.0 for view in views)
        lines.append(
            f"backdrop found, {found}: {share}, the rest is cut out with soft "
            f"edges; {changed}" + (f"; {counted(whole, 'view')} without any of it" if whole else "")
        )
    elif plan.mask == "none":
        lines.append("no mask of the foreground: all of each image belongs to the scene")
    elif plan.mask == "files":
        lines.append(f"masks from files; {share}")
    else:
        rules = [r.background for r in plan.recipes.values() if isinstance(r.background, BackgroundRule)]
        levels = ", ".join(f"{rule.level:.3f} (threshold {rule.threshold:.3f})" for rule in rules)
        lines.append(f"{plan.mask} background at {levels}; {share}; {changed}")
    return [*lines, *(text for one in (posed, plan) for text in sentences(one.remarks, Kind.DONE))]


# The contact sheet.

_MOST_VIEWS = 96
"""Views that are shown; of more, as many evenly spaced."""
_SHEET_PX, _TILE_PX = 1300, (96, 300)
"""Width of all pictures beside each other; least and greatest longer side of one."""
OUTLINE, _IGNORED, _BEHIND = (255, 0, 200), (255, 60, 60), 60
"""Colours of the mask's outline and of pixels without a measurement; grey of the background."""
_RIM_PX = 4
"""Width of the frame around a view that is left out."""
_CHARTS_INCHES, _LEAST_WIDTH_INCHES = 3.6, 11.0
_LETTERS_AN_INCH = 10
"""Of the heading."""
_MOST_POINTS = 6000


def contact_sheet(
    views: Sequence[SeenView],
    sensors: Mapping[str, SensorPlan],
    poses: PoseSet,
    heading: str,
    left_out: Sequence[ViewRecord] = (),
) -> bytes:
    """The sheet as a PNG, with one group of spectra a sensor and the points in their sRGB; views that are left out
    stand last, framed in red."""
    from matplotlib.figure import Figure

    root = views[0].picture.parent.parent
    shown = [views[index] for index in evenly_spaced(len(views), _MOST_VIEWS)]
    side_px = int(np.clip(_SHEET_PX / columns_for(len(shown) + len(left_out)), *_TILE_PX))
    files = [(view.picture, view.record) for view in shown]
    files += [(root / record.paths["file_path"], record) for record in left_out]
    pictures = [_small_picture(picture, record, side_px) for picture, record in files]
    for picture in pictures[len(shown) :]:
        for rim in (picture[:_RIM_PX], picture[-_RIM_PX:], picture[:, :_RIM_PX], picture[:, -_RIM_PX:]):
            rim[:] = _IGNORED
    size = max(picture.shape[1] for picture in pictures), max(picture.shape[0] for picture in pictures)
    captions = [view.name for view in shown] + [f"{record.name} (left out)" for record in left_out]
    layout = CanvasLayout.of(size, captions)
    canvas = Canvas(layout, 3, captions)
    for index, picture in enumerate(pictures):
        row, column = layout.corner(index)
        canvas.pixels[row : row + picture.shape[0], column : column + picture.shape[1]] = picture

    tiles = canvas.pixels
    height, width = (length / FIGURE_DPI for length in tiles.shape[:2])
    page_width = max(width + 0.4, _LEAST_WIDTH_INCHES)
    lines = textwrap.wrap(heading, int(page_width * _LETTERS_AN_INCH))
    top = 0.27 + 0.18 * len(lines)
    page = (page_width, top + height + _CHARTS_INCHES + 0.55)
    figure = Figure(figsize=page, facecolor="white")
    figure.text(
        0.2 / page[0],
        1 - 0.15 / page[1],
        plot_text("\n".join(lines)),
        fontsize=11,
        fontweight="bold",
        va="top",
    )
    axes = figure.add_axes((0.2 / page[0], 1 - (top + height) / page[1], width / page[0], height / page[1]))
    axes.imshow(tiles, interpolation="none")
    axes.set_axis_off()
    third = (page_width - 0.4) / 3
    boxes = [(0.7 + index * third, 0.5, third - 0.75, _CHARTS_INCHES - 0.7) for index in range(3)]
    panels = [figure.add_axes((x / page[0], y / page[1], w / page[0], h / page[1])) for x, y, w, h in boxes]
    _draw_cameras(panels[0], views, poses, (0, 1), "cameras and points from above")
    _draw_cameras(panels[1], views, poses, (0, 2), "from the side")
    _draw_spectra(panels[2], views, sensors)
    return figure_bytes(figure)


def _small_picture(picture_file: Path, record: ViewRecord, side_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """The view on dark grey, with the outline of the foreground and with pixels that are ignored."""
    from PIL import Image
    from scipy import ndimage

    with Image.open(picture_file) as opened:
        scale = side_px / max(opened.size)
        size = max(1, round(opened.width * scale)), max(1, round(opened.height * scale))
        picture = np.asarray(opened.convert("RGBA").resize(size, Image.Resampling.BOX))
    opacity = picture[..., 3:] / 255.0
    pixels = np.rint(picture[..., :3] * opacity + _BEHIND * (1 - opacity)).astype(np.uint8)
    foreground = picture[..., 3] > 127
    pixels[foreground & np.logical_not(ndimage.binary_erosion(foreground, border_value=1))] = OUTLINE
    mask = record.paths.get("mask_path")
    if mask is not None:
        with Image.open(picture_file.parent.parent / mask) as opened:
            ignored = np.asarray(opened.convert("L").resize(size, Image.Resampling.BOX)) < 128
        pixels[ignored] = _IGNORED
    return pixels


def _draw_cameras(
    axes: Any, views: Sequence[SeenView], poses: PoseSet, plane: tuple[int, int], title: str
) -> None:
    """Cameras as arrows along their axes, on two axes of the world."""
    (across, up), points, colours = plane, poses.points, poses.colours
    places, looks = (np.stack([getattr(view, name) for view in views]) for name in ("position", "axis"))
    if points is not None and len(points):
        kept = evenly_spaced(len(points), _MOST_POINTS)
        tint = "0.5" if colours is None else np.clip(colours[kept] / 255.0 * 0.8, 0, 1)
        axes.scatter(points[kept, across], points[kept, up], s=1.0, c=tint, linewidths=0)
    arrows = (*places[:, [across, up]].T, *looks[:, [across, up]].T)
    axes.quiver(*arrows, color="#c03060", angles="xy", width=0.004, scale=12, pivot="tail")
    axes.scatter(places[:, across], places[:, up], s=9, c="#c03060", zorder=3)
    reach = 1.15 * float(np.abs(places[:, [across, up]]).max(initial=1e-9))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")
    axes.set_title(plot_text(title), fontsize=9)
    axes.set_xlabel("xyz"[across], fontsize=8)
    axes.set_ylabel("xyz"[up], fontsize=8, labelpad=0)
    axes.tick_params(labelsize=7)
    plain_axes(axes)


def _draw_spectra(axes: Any, views: Sequence[SeenView], sensors: Mapping[str, SensorPlan]) -> None:
    """Mean spectra of views as thin lines, their mean as a thick one, bands that were left out as ticks above."""
    from matplotlib import colormaps

    dropped = []
    for index, (name, sensor) in enumerate(sensors.items()):
        nm, colour = sensor.centers_nm, colormaps["tab10"](index % 10)
        means = np.array([view.record.mean_spectrum for view in views if view.record.sensor == name])
        style = {"color": colour, "marker": "." if len(nm) < 12 else None}
        axes.plot(nm, means.T, alpha=0.15, linewidth=0.6, **style)
        label = plot_text(f"{name}: mean") if name else "mean over views"
        axes.plot(nm, means.mean(axis=0), linewidth=1.8, label=label, **style)
        dropped += sensor.bands.wavelengths_nm[sorted(sensor.bands.dropped)].tolist()
    if dropped:
        style = {"color": "#d04040", "linewidth": 0.8, "alpha": 0.6, "label": "bands left out"}
        axes.vlines(dropped, 0.0, 1.0, transform=axes.get_xaxis_transform(), **style)
    axes.set_ylim(bottom=0.0)
    axes.set_title("mean spectra of the foreground", fontsize=9)
    axes.set_xlabel("wavelength in nm", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7, frameon=False, loc="lower right")  # "best" takes seconds where views are many
    plain_axes(axes)
