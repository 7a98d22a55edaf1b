"""What is written once all views are there: cameras, light, points, and the record of how the scene was made."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin import __version__
from unmix_plugin.captures.calibration.calibration import Calibration
from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.captures.checks.report import Checked, check_views, report_text
from unmix_plugin.captures.checks.seen_view import SeenView
from unmix_plugin.captures.contact_sheet import Spectra, contact_sheet
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.plan import Plan
from unmix_plugin.captures.poses.placement import write_points
from unmix_plugin.captures.posing import PosedViews
from unmix_plugin.captures.writing.decisions_in_words import sizes_in_words, what_was_done
from unmix_plugin.captures.writing.sources import hashes
from unmix_plugin.captures.writing.transforms import WrittenView, transforms_json
from unmix_plugin.captures.writing.view_files import FULL_SCALE, ViewRecord
from unmix_plugin.captures.writing.work_folder import RECORD_NAME, SCENE_NAME
from unmix_plugin.engine.runs.atomic_files import write_file
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
