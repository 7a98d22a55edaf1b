"""What is written once all views are there: cameras, light, points, and the record of how the scene was made.

What was decided and done, in sentences for the report.

transforms.json of the scene: cameras, bands, scale, paths.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from unmix_plugin import __version__
from unmix_plugin.captures.calibration.calibration import Calibration
from unmix_plugin.captures.calibration.sensor import Sensor
from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.captures.checks import Checked, SeenView, check_views, report_text
from unmix_plugin.captures.contact_sheet import Spectra, contact_sheet
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.plan import Plan
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.posing import PosedViews, write_points
from unmix_plugin.captures.writing.view_files import FULL_SCALE, ViewRecord
from unmix_plugin.captures.writing.work_folder import RECORD_NAME, SCENE_NAME, hashes
from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.errors import counted
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

ILLUMINANT_NAME, FLAT_LIGHT_NAME = "illuminant.csv", "flat-light.csv"
SHEET_NAME, REPORT_NAME = "contact-sheet.png", "report.txt"


def write_scene_files(
    folder: Path, plan: Plan, posed: PosedViews, records: dict[str, ViewRecord], options: ProcessOptions
) -> list[str]:
    """Write transforms.json, light, points, contact sheet, report and record.

    Returns:
        What looks wrong, one sentence each.
    Raises:
        RunError: the folder can't be written.
    """
    keys: dict[str, Any] = dict(posed.keys)
    points = write_points(folder, posed.poses)
    if points is not None:
        keys["ply_file_path"] = points
    keys |= _write_light(folder, plan)
    written = [
        WrittenView(
            paths=records[view.name].paths,
            camera_to_world=posed.cameras[view.name].camera_to_world,
            lens=plan.sensors[view.sensor].calibration.raster.lens(posed.lens(view.name)),
            sensor=view.sensor,
            wavelengths_nm=plan.sensors[view.sensor].centers_nm,
            split=view.split,
            release=view.release,
            fwhm_nm=_widths(view, plan.sensors[view.sensor].calibration),
        )
        for view in posed.views
    ]
    seen = _seen_views(folder, posed, records, written)
    checked = check_views(_of_greatest_sensor(seen), posed.poses.points)
    done = what_was_done(plan, posed, records)
    title = f"{plan.capture.root}: {len(written)} views, {sizes_in_words(plan)}"
    write_file(folder / REPORT_NAME, report_text(title, checked, done).encode())
    sheet = contact_sheet(
        seen, _spectra(plan, posed, records), posed.poses.points, posed.poses.colours, title
    )
    write_file(folder / SHEET_NAME, sheet)
    record = _record(plan, posed, records, options, checked)
    _write_json(folder / RECORD_NAME, record)
    _write_json(folder / SCENE_NAME, transforms_json(written, keys))
    return list(checked.findings)


def _seen_views(
    folder: Path, posed: PosedViews, records: dict[str, ViewRecord], written: Sequence[WrittenView]
) -> list[SeenView]:
    return [
        SeenView(
            records[view.name],
            replace(posed.cameras[view.name], lens=frame.lens),
            folder / frame.paths["file_path"],
        )
        for view, frame in zip(posed.views, written, strict=True)
    ]


def _of_greatest_sensor(views: Sequence[SeenView]) -> list[SeenView]:
    """Views of the sensor that took the most: those of different ones can't be compared."""
    (sensor, _), *_ = Counter(view.record.sensor for view in views).most_common(1)
    return [view for view in views if view.record.sensor == sensor]


def _spectra(plan: Plan, posed: PosedViews, records: dict[str, ViewRecord]) -> list[Spectra]:
    return [
        Spectra(
            name,
            sensor.centers_nm,
            np.array([records[view.name].mean_spectrum for view in posed.views if view.sensor == name]),
            sensor.bands.wavelengths_nm[sorted(sensor.bands.dropped)],
        )
        for name, sensor in plan.sensors.items()
    ]


def _widths(view: CaptureView, calibration: Calibration) -> Float64[np.ndarray, " B"] | None:
    """Widths of a view's bands as the file tells them; None where it doesn't or bands are averaged."""
    widths = view.cube.bands.fwhm_nm
    return None if widths is None or calibration.bin_bands > 1 else widths[calibration.bands]


def _write_light(folder: Path, plan: Plan) -> dict[str, str]:
    """The light on the white panel, for people, and the flat one in which reflectances are seen; keys of the scene."""
    sensor = next(iter(plan.sensors.values()))
    if sensor.lamp is None or len(plan.sensors) > 1:
        return {}
    bands = Bands(sensor.centers_nm)
    write_spectra_csv(folder / ILLUMINANT_NAME, SpectraTable(bands, ("power",), sensor.lamp[None]))
    write_spectra_csv(folder / FLAT_LIGHT_NAME, SpectraTable(bands, ("power",), np.ones((1, len(bands)))))
    return {"illuminant_path": FLAT_LIGHT_NAME}


def _record(
    plan: Plan,
    posed: PosedViews,
    records: dict[str, ViewRecord],
    options: ProcessOptions,
    checked: Checked,
) -> dict[str, Any]:
    views = [records[view.name].to_json() for view in posed.views]
    return {
        "made_by": f"unmix-process {__version__}",
        "options": {
            key: str(value) if isinstance(value, Path) else value for key, value in asdict(options).items()
        },
        "decisions": plan.decisions,
        "stored": {"type": "uint16", "value_scale": FULL_SCALE, "calibrated_value_of_1": plan.scale},
        "poses": {"source": posed.poses.source, "notes": list(posed.notes), **posed.keys},
        "notes": list(plan.notes),
        "what_looks_wrong": list(checked.findings),
        "measured": list(checked.measured),
        "totals": {
            key: sum(view[key] for view in views)
            for key in (
                "num_pixels",
                "saturated_pixels",
                "missing_pixels",
                "clipped_values",
                "negative_values",
            )
        },
        "references": hashes(plan.reference_files),
        "views": views,
    }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_file(path, (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode())


REFERENCES = {"dark": "dark frame", "white": "white reference"}
"""Entries of a sensor's evidence."""
MOST_BANDS = 8
"""Bands left out for one reason that are named."""


def sizes_in_words(plan: Plan) -> str:
    """Pixels and bands of each sensor."""
    found = [
        f"{name + ': ' if name else ''}{raster.height} x {raster.width} pixels, {_bands_in_words(sensor)}"
        for name, sensor in plan.sensors.items()
        for raster in [sensor.calibration.raster]
    ]
    return "; ".join(found)


def _bands_in_words(sensor: Sensor) -> str:
    centers = sensor.centers_nm
    return f"1 band at {centers[0]:g} nm" if len(centers) == 1 else str(Bands(centers))


def what_was_done(plan: Plan, posed: PosedViews, records: dict[str, ViewRecord]) -> list[str]:
    """Decisions and totals, one sentence each."""
    lines = []
    for name, sensor in plan.sensors.items():
        where = f"{name}: " if name else ""
        facts = sensor.evidence
        lines.append(f"{where}values are {sensor.unit}; wavelengths from {facts['wavelengths']}")
        lines += [f"{where}{what}: {facts[key]['use']}" for key, what in REFERENCES.items() if key in facts]
        stored, evidence = facts["saturation"]["stored"], facts["saturation"]["evidence"]
        lines.append(f"{where}saturation: {evidence if stored is None else f'from {stored:g} ({evidence})'}")
        lines += [f"{where}bands left out: {bands} ({reason})" for reason, bands in _left_out(sensor).items()]
    scale = plan.decisions["scale"]
    lines.append(
        f"{scale['calibrated']:g} is written as 1: {scale['evidence']}; full scale of the cubes is {FULL_SCALE}"
    )
    views = [records[view.name] for view in posed.views]
    lines.append(
        f"{counted(_sum(views, 'saturated_pixels'), 'pixel')} with saturated bands, which are written as 1; "
        f"{counted(_sum(views, 'clipped_values'), 'value')} above 1, written as 1 too; "
        f"{_sum(views, 'negative_values')} below 0, written as 0; "
        f"{counted(_sum(views, 'missing_pixels'), 'pixel')} masked, as nothing was measured there"
    )
    lines.append(_masks_in_words(plan, views))
    return [*lines, *posed.notes, *plan.notes]


def _left_out(sensor: Sensor) -> dict[str, str]:
    """Wavelengths of the bands that were left out, by reason; the first few of many."""
    found: dict[str, list[str]] = defaultdict(list)
    for band, reason in sorted(sensor.bands.dropped.items()):
        wavelength = f"{sensor.bands.wavelengths_nm[band]:g} nm"
        found["noisy" if reason.startswith("noise") else reason].append(wavelength)
    return {
        reason: ", ".join(names[:MOST_BANDS])
        + (f" and {len(names) - MOST_BANDS} more" if len(names) > MOST_BANDS else "")
        for reason, names in found.items()
    }


def _sum(views: Sequence[ViewRecord], what: str) -> int:
    return sum(getattr(view, what) for view in views)


def _masks_in_words(plan: Plan, views: Sequence[ViewRecord]) -> str:
    if plan.mask == "none":
        return "no mask of matter"
    share = np.mean([view.matter_share for view in views])
    if plan.mask == "files":
        return f"masks from files; {share:.0%} of the pixels are matter"
    rules = [recipe.background for recipe in plan.recipes.values() if recipe.background is not None]
    levels = ", ".join(f"{rule.level:.3f} (threshold {rule.threshold:.3f})" for rule in rules)
    return (
        f"{plan.mask} background at {levels}; {share:.0%} of the pixels are matter; {_sum(views, 'specks')} specks "
        f"removed, {_sum(views, 'holes')} holes filled"
    )


@dataclass(frozen=True)
class WrittenView:
    """One frame of the scene."""

    paths: dict[str, str]
    """Files by the keys of transforms.json."""
    camera_to_world: Float64[np.ndarray, "3 4"]
    lens: Lens
    """Of the pixels as they are written."""
    sensor: str
    wavelengths_nm: Float64[np.ndarray, " B"]
    split: Literal["train", "eval"] | None
    release: str = ""
    """Of the shutter; frames of one were taken at one moment."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Widths of the bands, where the files tell them."""


def transforms_json(views: Sequence[WrittenView], extra: dict[str, Any]) -> dict[str, Any]:
    """The content of the file.

    What all views share is written above the frames. Views of different sensors have their own lens and size, `bands`
    as indices into the `wavelengths` of the scene, and the name of their sensor.

    Args:
        views: At least one, in order.
        extra: More keys of the scene.
    """
    bands = np.unique(np.concatenate([view.wavelengths_nm for view in views]))
    facts = [_facts(view, bands) for view in views]
    shared = {key: value for key, value in facts[0].items() if all(own.get(key) == value for own in facts)}
    frames = []
    for view, known in zip(views, facts, strict=True):
        own = {key: value for key, value in known.items() if key not in shared}
        pose = [*view.camera_to_world.tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({**view.paths, **own, "transform_matrix": pose})
    return {
        "camera_model": "OPENCV",
        **shared,
        "wavelengths": bands.tolist(),
        **_widths_transforms(views, bands),
        "value_scale": FULL_SCALE,
        **extra,
        **_split_lists(views),
        "frames": frames,
    }


def _widths_transforms(views: Sequence[WrittenView], bands: Float64[np.ndarray, " B"]) -> dict[str, Any]:
    """Widths of all bands, if all are known."""
    known = {
        float(band): float(width)
        for view in views
        if view.fwhm_nm is not None
        for band, width in zip(view.wavelengths_nm, view.fwhm_nm, strict=True)
    }
    return {"fwhm": [known[band] for band in bands.tolist()]} if len(known) == len(bands) else {}


def _facts(view: WrittenView, bands: Float64[np.ndarray, " B"]) -> dict[str, Any]:
    lens = view.lens
    facts: dict[str, Any] = {"w": lens.width, "h": lens.height}
    facts |= dict(zip(("fl_x", "fl_y"), map(float, lens.focal_px), strict=True))
    facts |= dict(zip(("cx", "cy"), map(float, lens.center_px), strict=True))
    bends = zip(("k1", "k2", "p1", "p2", "k3", "k4"), (*lens.distortion, *lens.higher_radial), strict=True)
    facts |= {key: float(value) for key, value in bends}
    if view.sensor:
        facts["sensor"] = view.sensor
    if view.release:
        facts["capture"] = view.release
    if len(view.wavelengths_nm) < len(bands):
        facts["bands"] = np.searchsorted(bands, view.wavelengths_nm).tolist()
    return facts


def _split_lists(views: Sequence[WrittenView]) -> dict[str, list[str]]:
    """Lists of file paths, where every view is said to be for training or evaluation."""
    if not all(view.split for view in views):
        return {}
    train, evaluation = (
        [view.paths["file_path"] for view in views if view.split == split] for split in ("train", "eval")
    )
    return (
        {"train_filenames": train, "val_filenames": evaluation, "test_filenames": evaluation}
        if evaluation
        else {}
    )
