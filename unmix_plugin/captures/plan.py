"""Everything that is decided before the first view is written."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from unmix_plugin import __version__
from unmix_plugin.captures.calibration.linear import is_srgb
from unmix_plugin.captures.calibration.sampling import sampled_rows
from unmix_plugin.captures.calibration.scale import choose_scale
from unmix_plugin.captures.calibration.sensor import References, Sensor, prepare_sensor
from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.masks import Background, BackgroundRule, background_brightness, find_background
from unmix_plugin.captures.options import MaskKind, ProcessOptions
from unmix_plugin.captures.pictures import Colours
from unmix_plugin.captures.view_masks import has_opacity
from unmix_plugin.captures.writing.sources import stamps
from unmix_plugin.captures.writing.view_files import ViewRecipe
from unmix_plugin.errors import CaptureError
from unmix_plugin.spectral.bands import Bands

BORDER_SHARE = 0.02
"""Width of the border that a background is judged by, as a share of the view's."""
MOST_BORDER_PIXELS = 20000
BRIGHT_PERCENTILE = 99.0


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
    reference_files: tuple[Path, ...] = ()
    """Of dark frame and white reference."""

    def fingerprint(self, options: ProcessOptions) -> dict[str, Any]:
        """What must be the same for views to be gone on with: options, decisions and input files."""
        asked = {key: _plain(value) for key, value in asdict(options).items()}
        files = [path for view in self.views for path in input_files(view)]
        files += self.reference_files
        left_out = ("output_dir", "overwrite", "poses")
        return {
            "version": __version__,
            "options": {key: value for key, value in asked.items() if key not in left_out},
            "decisions": self.decisions,
            "files": stamps(files),
        }


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
    sensors = {
        name: prepare_sensor(name, same, options, replace(references, views=_of_sensor(capture, name)))
        for name, same in by_sensor.items()
    }
    scale, why = choose_scale(list(sensors.values()), options.scale)
    mask = _choose_mask(views, options.mask)
    recipes = {name: _recipe(sensor, by_sensor[name], scale, mask) for name, sensor in sensors.items()}
    decisions = {
        "scale": {"calibrated": scale, "evidence": why},
        "mask": mask,
        "sensors": {
            name or "all views": _evidence(sensor, recipes[name]) for name, sensor in sensors.items()
        },
    }
    said = [note for sensor in sensors.values() for note in sensor.notes]
    if any(is_srgb(view.cube) for view in views):
        said.append("pictures are taken as sRGB and brought to linear light")
    said += [note for view in views[:1] for note in view.cube.notes]
    opened = [file for file in (references.dark, references.white) if file is not None]
    return Plan(
        capture,
        tuple(views),
        sensors,
        recipes,
        scale,
        mask,
        decisions,
        (*capture.notes, *said),
        tuple(path for file in opened for path in file.files),
    )


def _evidence(sensor: Sensor, recipe: ViewRecipe) -> dict[str, Any]:
    """What was decided on a sensor, for the record."""
    raster, background = recipe.calibration.raster, recipe.background
    return {
        "unit": sensor.unit,
        "bands": len(sensor.centers_nm),
        "size": [raster.height, raster.width],
        "colours": recipe.colours.description,
        **sensor.evidence,
        "background": None if background is None else asdict(background),
    }


def _of_sensor(capture: Capture, name: str) -> tuple[CaptureView, ...]:
    return tuple(view for view in capture.views if view.sensor == name)


def input_files(view: CaptureView) -> list[Path]:
    """Every file that a view is made of."""
    more = [path for path in (view.picture, view.mask, view.labels) if path is not None]
    return [*view.cube.files, *more]


def _choose_mask(views: Sequence[CaptureView], asked: MaskKind | None) -> MaskKind:
    if asked not in (None, "files"):
        return asked
    found = [has_opacity(view) for view in views]
    if asked == "files" and not all(found):
        missing = views[found.index(False)].name
        raise CaptureError(
            f"--mask files: view {missing} has no mask; expected a picture with an alpha channel, or a mask that is "
            "white where matter is, for every view"
        )
    if asked is None:
        found = [has_opacity(view, alpha_only=True) for view in views]
    return "files" if all(found) else "none"


def _recipe(sensor: Sensor, views: Sequence[CaptureView], scale: float, mask: MaskKind) -> ViewRecipe:
    sample = sensor.sample / np.float32(scale)
    colours = Colours.of(Bands(sensor.centers_nm), sample)
    rule = _background(sensor, views, scale, mask, sample) if mask in ("white", "black") else None
    return ViewRecipe(sensor.calibration, scale, colours, rule, mask == "files")


def _background(
    sensor: Sensor,
    views: Sequence[CaptureView],
    scale: float,
    kind: Background,
    sample: Float32[np.ndarray, "N c"],
) -> BackgroundRule:
    raster = sensor.calibration.raster
    width = max(1, round(BORDER_SHARE * raster.width))
    columns = np.r_[0:width, raster.width - width : raster.width]
    rows = sorted({0, raster.height - 1, *sampled_rows(raster.height)})
    step = max(1, len(views) * (2 * raster.width + 2 * width * len(rows)) // MOST_BORDER_PIXELS)
    border = []
    for view in views:
        for row in rows:
            part = sensor.calibration.rows(view.cube, row, row + 1)
            shown = np.arange(raster.width) if row in (0, raster.height - 1) else columns
            shown = shown[row % step :: step]
            values = np.where(part.saturated[0, shown], np.float32(scale), part.values[0, shown])
            border.append(values[~part.missing[0, shown]])
    pixels = np.clip(np.concatenate(border) / np.float32(scale), 0.0, 1.0)
    everywhere = np.concatenate([background_brightness(kind, sample), background_brightness(kind, pixels)])
    return find_background(
        kind, pixels, float(np.percentile(np.clip(everywhere, 0.0, 1.0), BRIGHT_PERCENTILE))
    )


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value
