"""Everything that is decided before the first view is written."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from unmix_plugin import __version__
from unmix_plugin.captures.calibration.calibration import is_srgb
from unmix_plugin.captures.calibration.sensor import References, Sensor, choose_scale, prepare_sensor
from unmix_plugin.captures.masks import BackgroundRule, background_rule, border_pixels, choose_mask
from unmix_plugin.captures.options import MaskKind, ProcessOptions, plain_options
from unmix_plugin.captures.spectral_file import Capture, CaptureView, SpectralFile
from unmix_plugin.captures.writing.view_files import Colours, ViewRecipe, stamps
from unmix_plugin.errors import name_some
from unmix_plugin.scenes.backdrops import Backdrop, judge_backdrop
from unmix_plugin.spectral.bands import Bands

_LOOKED_AT, _ROWS_LOOKED_AT = 12, 96
"""Views that a backdrop is looked for in, and rows of each."""


@dataclass(frozen=True)
class Plan:
    """How every view is written, and why."""

    capture: Capture
    views: tuple[CaptureView, ...]
    sensors: dict[str, Sensor]
    recipes: dict[str, ViewRecipe]
    """By sensor."""
    scale: float
    mask: MaskKind
    decisions: dict[str, Any]
    """With their evidence, as JSON-able values."""
    notes: tuple[str, ...]
    """What a user should know, one sentence each."""
    warnings: tuple[str, ...] = ()
    """What may make values, wavelengths or geometry wrong, one sentence each."""
    reference_files: tuple[Path, ...] = ()
    """Of dark frame and white reference."""

    def fingerprint(self, options: ProcessOptions) -> dict[str, Any]:
        """What must be the same for views to be gone on with: options, decisions and input files."""
        own = ["output_dir", "overwrite", "poses", "marker_size", "marker_family", "known_distance", "angles"]
        asked = {key: value for key, value in plain_options(options).items() if key not in own}
        files = [path for view in self.views for path in input_files(view)] + list(self.reference_files)
        return {"version": __version__, "options": asked, "decisions": self.decisions, "files": stamps(files)}


def make_plan(
    capture: Capture, views: Sequence[CaptureView], options: ProcessOptions, references: References
) -> Plan:
    """Look at some rows of every view and decide.

    Args:
        views: Those of the capture that become frames.
    Raises:
        CaptureError: views don't fit each other or the references, or a file can't be read.
        ConfigError: an option does not fit the files.
    """
    by_sensor: dict[str, list[CaptureView]] = defaultdict(list)
    for view in views:
        by_sensor[view.sensor].append(view)
    sensors: dict[str, Sensor] = {}
    for name, same in by_sensor.items():
        # Views of several sizes are several sensors, and one may show the panel of all.
        every = tuple(v for v in capture.views if v.sensor == name or not (name and v.release))
        sensors[name] = prepare_sensor(name, same, options, replace(references, views=every))
    scale, why = choose_scale(list(sensors.values()), options.scale)
    mask, said_of_mask = choose_mask(views, options.mask)
    samples = {name: sensor.sample / np.float32(scale) for name, sensor in sensors.items()}
    backdrops: dict[str, Backdrop | None] = {}
    if mask == "auto":
        backdrops = {n: _find_backdrop(s, by_sensor[n], scale, samples[n]) for n, s in sensors.items()}
        if not all(backdrops.values()):  # frames with alpha and without don't go together
            backdrops, mask = {}, "none"
    recipes: dict[str, ViewRecipe] = {}
    evidence: dict[str, dict[str, Any]] = {}
    for name, sensor in sensors.items():
        raster = sensor.calibration.raster
        colours = Colours.of(Bands(sensor.centers_nm), samples[name])
        rule: BackgroundRule | Backdrop | None = backdrops.get(name)
        if mask in ("white", "black"):
            rule = background_rule(mask, border_pixels(sensor, by_sensor[name], scale), samples[name])
        recipes[name] = ViewRecipe(sensor.calibration, scale, colours, rule, mask == "files")
        evidence[name or "all views"] = {
            "unit": sensor.unit,
            "bands": len(sensor.centers_nm),
            "size": [raster.height, raster.width],
            "colours": colours.description,
            **sensor.evidence,
            "background": None if rule is None else rule.evidence,
        }
    decisions = {"scale": {"calibrated": scale, "evidence": why}, "mask": mask, "sensors": evidence}
    said = [*(note for sensor in sensors.values() for note in sensor.notes), *said_of_mask]
    if found := [backdrop for backdrop in backdrops.values() if backdrop is not None]:
        said.append(
            f"a backdrop was found that all views share, {', '.join(each.in_words for each in found)}, and is cut out: "
            "look at contact-sheet.png; --mask none keeps it"
        )
    said += _notes_on_pictures([view.cube for view in views])
    said += dict.fromkeys(note for view in views for note in view.cube.notes)
    opened = [file for file in (references.dark, references.white) if file is not None]
    warned = [warning for sensor in sensors.values() for warning in sensor.warnings]
    if scale != 1.0 and options.scale is None and all(sensor.is_stated for sensor in sensors.values()):
        units = ", ".join(dict.fromkeys(sensor.unit for sensor in sensors.values()))
        warned.append(
            f"values ({units}) were divided by {scale:g}, as more than 1 % are above 1 or nearly all are small: "
            f"multiply exported spectra by {scale:g}, or keep values with --scale 1, which cuts off those above 1"
        )
    each = [(view.name, file) for view in views for file in (view.cube, view.dark, view.white)]
    each += [(file.path.name, file) for file in opened]
    return Plan(
        capture,
        tuple(views),
        sensors,
        recipes,
        scale,
        mask,
        decisions,
        (*capture.notes, *said),
        (*capture.warnings, *warned, *_warnings_of_files(each)),
        tuple(path for file in opened for path in file.files),
    )


def _find_backdrop(
    sensor: Sensor, views: Sequence[CaptureView], scale: float, sample: Float32[np.ndarray, "N B"]
) -> Backdrop | None:
    """The backdrop of a sensor's views, judged by some rows of some of them; the sample is of all, divided by scale."""
    raster = sensor.calibration.raster
    rows = np.unique(np.linspace(0, raster.height - 1, min(raster.height, _ROWS_LOOKED_AT)).astype(int))
    images, known = [], []
    for index in np.unique(np.linspace(0, len(views) - 1, min(len(views), _LOOKED_AT)).round().astype(int)):
        parts = [sensor.calibration.rows(views[index].cube, row, row + 1) for row in rows.tolist()]
        values = np.concatenate([np.where(x.saturated, np.float32(scale), x.values) for x in parts])
        images.append(np.clip(values / np.float32(scale), 0.0, 1.0))
        known.append(~np.concatenate([part.missing for part in parts]))
    return judge_backdrop(images, known, sample)


def input_files(view: CaptureView) -> list[Path]:
    """Every file that a view is made of."""
    more = [path for path in (view.picture, view.mask, view.labels) if path is not None]
    references = [file for file in (view.dark, view.white) if file is not None]
    return [*view.cube.files, *more, *(path for file in references for path in file.files)]


def _warnings_of_files(files: Sequence[tuple[str, SpectralFile | None]]) -> list[str]:
    """What files warn of; one sentence where several warn of the same."""
    names: dict[str, list[str]] = defaultdict(list)
    for name, file in files:
        for warning in () if file is None else file.warnings:
            names[warning].append(name)
    return [f"{name_some(where)}: {warning}" for warning, where in names.items()]


def _notes_on_pictures(files: Sequence[SpectralFile]) -> list[str]:
    """Notes on encoding, order of colours and orientation, one sentence each; none where there is no picture."""
    pictures = [file for file in files if file.reader == "picture"]
    notes = []
    if any(map(is_srgb, pictures)):
        notes.append("pictures are taken as sRGB and brought to linear light")
    for centres in (file.bands.wavelengths_nm for file in pictures):
        if centres is not None and len(centres) == 3 and centres[0] < centres[2]:
            red, green, blue = (f"{centre:g}" for centre in centres)
            notes.append(
                f"the channels of pictures are red, green and blue in this order: {red} nm is taken for red, "
                f"{green} nm for green, {blue} nm for blue. If this is wrong, give --wavelengths {blue},{green},{red}"
            )
            break
    turned = sum(file.metadata.get("orientation", 1) != 1 for file in files)
    if turned:
        notes.append(
            f"EXIF's orientation of {turned} of {len(files)} pictures is ignored, as poses and lenses refer to the "
            "stored pixels; if yours were made from turned pictures, store these turned"
        )
    return notes
