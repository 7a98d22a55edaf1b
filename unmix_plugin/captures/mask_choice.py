"""Where the opacity of views comes from: files, a background that is white or black, or nowhere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from unmix_plugin.captures.calibration.sampling import sampled_rows
from unmix_plugin.captures.calibration.sensor import Sensor
from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.captures.masks import Background, BackgroundRule, background_brightness, find_background
from unmix_plugin.captures.options import MaskKind
from unmix_plugin.captures.poses.rigid import name_some
from unmix_plugin.captures.view_masks import has_opacity
from unmix_plugin.errors import CaptureError

BORDER_SHARE = 0.02
"""Width of the border that a background is judged by, as a share of the view's."""
MOST_BORDER_PIXELS = 20000
BRIGHT_PERCENTILE = 99.0
LOOKED_AT = 12
"""Views whose border is looked at for a white background that nobody has named."""
ALMOST_WHITE = 0.9
"""Brightness of such a background, as a share of full reflectance or, where none is known, of the brightest pixels."""
WHITE_BORDER = 0.75
"""Share of the border that such a background covers."""


def choose_mask(views: Sequence[CaptureView], asked: MaskKind | None) -> tuple[MaskKind, list[str]]:
    """What tells matter from background, and what a user should know of it.

    Raises:
        CaptureError: opacity is asked of files that some views don't have.
    """
    if asked not in (None, "files"):
        return asked, []
    found = [has_opacity(view, alpha_only=asked is None) for view in views]
    missing = [view.name for view, has_it in zip(views, found, strict=True) if not has_it]
    if not missing:
        return "files", []
    if asked == "files":
        raise CaptureError(
            f"--mask files: view {missing[0]} has no mask; expected a picture with an alpha channel, or a mask that is "
            "white where matter is, for every view"
        )
    if len(missing) == len(views):
        return "none", []
    has = "has" if len(missing) == 1 else "have"
    note = (
        f"{len(missing)} of {len(views)} views {has} no alpha channel ({name_some(missing)}), so that of the others is "
        "not used: give all views one, or choose --mask"
    )
    return "none", [note]


def background_rule(
    sensor: Sensor,
    views: Sequence[CaptureView],
    scale: float,
    kind: Background,
    sample: Float32[np.ndarray, "N c"],
) -> BackgroundRule:
    """The rule that fits the border of the views.

    Args:
        scale: Calibrated values are divided by it.
        sample: Pixels of all views, divided already.
    Raises:
        CaptureError: most of the border is not of this kind.
    """
    pixels = _border(sensor, views, scale)
    return find_background(kind, pixels, _brightest(kind, sample, pixels))


def white_background_note(
    sensor: Sensor, views: Sequence[CaptureView], scale: float, sample: Float32[np.ndarray, "N c"]
) -> list[str]:
    """A hint at `--mask white` if the border of most views is almost white; arguments as `background_rule` has them."""
    pixels = _border(sensor, views[:: max(1, -(-len(views) // LOOKED_AT))], scale)
    least = ALMOST_WHITE * (1.0 if sensor.is_absolute else _brightest("white", sample, pixels))
    share = float(np.mean(background_brightness("white", pixels) >= least)) if len(pixels) else 0.0
    if least <= 0 or share < WHITE_BORDER:
        return []
    note = (
        f"{share:.0%} of the border of the views is almost white, and no view has a mask: if this is background, "
        "--mask white leaves it out"
    )
    return [note]


def _brightest(
    kind: Background, sample: Float32[np.ndarray, "N c"], border: Float32[np.ndarray, "M c"]
) -> float:
    everywhere = np.concatenate([background_brightness(kind, sample), background_brightness(kind, border)])
    return float(np.percentile(np.clip(everywhere, 0.0, 1.0), BRIGHT_PERCENTILE)) if len(everywhere) else 0.0


def _border(sensor: Sensor, views: Sequence[CaptureView], scale: float) -> Float32[np.ndarray, "M c"]:
    """Pixels at the border of the views, in [0, 1]; saturated ones are 1, missing ones are left out."""
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
    return np.clip(np.concatenate(border) / np.float32(scale), 0.0, 1.0)
