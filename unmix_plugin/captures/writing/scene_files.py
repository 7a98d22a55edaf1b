"""What is written beside the views: cameras, light, points, the report in words, the record, and the contact sheet, one
picture of every view with its mask, of cameras and points from above, and of mean spectra.

Notation: `h x w` pixels of a small picture, `B` bands.
"""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from unmix_plugin import __version__
from unmix_plugin.captures.checks import (
    SeenView,
)
from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import plain_options
from unmix_plugin.captures.plan import Plan, SensorPlan
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.posing import PosedViews
from unmix_plugin.captures.report import Kind, report_text, sentences
from unmix_plugin.captures.writing.view_files import FULL_SCALE, ViewRecord
from unmix_plugin.captures.writing.work_folder import RECORD_NAME, hashes
from unmix_plugin.captures.writing.written_views import Findings, WrittenViews, what_was_done
from unmix_plugin.engine.decisions import Decision
from unmix_plugin.engine.printing import plot_text, terminal_text
from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.figures.pictures import Canvas, CanvasLayout, columns_for
from unmix_plugin.figures.plotting import FIGURE_DPI, figure_bytes, plain_axes
from unmix_plugin.formats.meshes import write_ply
from unmix_plugin.scenes.folder import lens_keys, matrix_entry, transforms_bytes
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

_SCENE_NAME, _SHEET_NAME, _REPORT_NAME = "transforms.json", "contact-sheet.png", "report.txt"
_ILLUMINANT_NAME, _FLAT_LIGHT_NAME, _POINTS_NAME = "illuminant.csv", "flat-light.csv", "points.ply"


def write_scene_files(
    written: WrittenViews, posed: PosedViews, decided: Sequence[Decision], found: Findings
) -> None:
    """Write transforms.json, light, points, contact sheet, report and record beside the views. Raises RunError: the
    folder can't be written."""
    folder, plan, left_out = written.folder, written.plan, written.left_out
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

    # For people: the report and the contact sheet.
    seen, sizes = written.seen(posed), []
    for name, sensor in plan.sensors.items():
        raster, centers = sensor.calibration.raster, sensor.centers_nm
        bands = f"1 band at {centers[0]:g} nm" if len(centers) == 1 else str(Bands(centers))
        sizes.append(f"{name + ': ' if name else ''}{raster.height} x {raster.width} pixels, {bands}")
    title = f"{plan.capture.root}: {len(seen)} views, {'; '.join(sizes)}"
    done = sentences(left_out.values(), Kind.DONE) + what_was_done(written, posed)
    report = report_text(title, found.wrong, found.measured, done, decided)
    write_file(folder / _REPORT_NAME, terminal_text(report).encode())
    spoilt = [record for name, record in written.records.items() if name in left_out]
    write_file(folder / _SHEET_NAME, contact_sheet(seen, plan.sensors, posed.poses, title, spoilt))

    # For programs: how the scene was made, and the scene.
    views = [asdict(view.record) for view in seen]
    totals = ("num_pixels", "saturated_pixels", "missing_pixels", "clipped_values", "negative_values")
    record = {
        "made_by": f"unmix-process {__version__}",
        "options": plain_options(written.options),
        "plan": plan.numbers,
        "decisions": [decision.to_json() for decision in decided],
        "stored": {"type": "uint16", "value_scale": FULL_SCALE, "calibrated_value_of_1": scale},
        "poses": {"source": posed.poses.source, "notes": sentences(posed.remarks, Kind.DONE), **posed.keys},
        "notes": sentences(plan.remarks, Kind.DONE),
        "what_looks_wrong": found.wrong,
        "left_out": [remark.to_json() for remark in left_out.values()],
        "measured": found.measured,
        "totals": {key: sum(view[key] for view in views) for key in totals},
        "references": hashes(plan.option_files),
        "views": views,
    }
    write_file(folder / RECORD_NAME, transforms_bytes(record))
    others = []
    for name, remark in left_out.items():
        reason = remark.code.name.lower().replace("_", " ").removeprefix("view ")
        paths = written.records[name].paths if name in written.records else {}
        others.append({"name": name, "reason": reason, **paths})
    keys |= {"left_out": others} if others else {}
    markers = {name: corners.tolist() for name, corners in posed.poses.markers.items()}
    keys |= {"markers": markers} if markers else {}
    write_file(folder / _SCENE_NAME, transforms_bytes(_transforms_json(plan, posed.views, seen, keys)))


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
