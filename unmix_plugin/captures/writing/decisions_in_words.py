"""What was decided and done, in sentences for the report."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from unmix_plugin.captures.calibration.sensor import Sensor
from unmix_plugin.captures.plan import Plan
from unmix_plugin.captures.posing import PosedViews
from unmix_plugin.captures.writing.view_files import FULL_SCALE, ViewRecord
from unmix_plugin.errors import counted
from unmix_plugin.spectral.bands import Bands

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
