"""The calibrated value that is written as 1, the same for all views and bands of a scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unmix_plugin.captures.calibration.sensor import Sensor
from unmix_plugin.errors import CaptureError, ConfigError

BRIGHT_PERCENTILE = 99.9
MOST_ABOVE_ONE = 0.01
"""Share of reflectances above 1 that is still taken for highlights."""
LEAST_BRIGHT = 0.05
"""Bright values below this would lose digits if they were kept."""


def choose_scale(sensors: Sequence[Sensor], given: float | None) -> tuple[float, str]:
    """The scale and why.

    Reflectances, and values of files that say what stands for 1, are kept unless many are above 1 or all are small;
    others are divided by a high percentile.

    Raises:
        CaptureError: nothing in the sampled pixels is above 0.
        ConfigError: the given scale is not above 0.
    """
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise ConfigError(
                f"--scale {given:g}: expected a number above 0, the calibrated value written as 1"
            )
        return given, "given with --scale"
    values = np.concatenate([sensor.sample.ravel() for sensor in sensors])
    bright = float(np.percentile(values, BRIGHT_PERCENTILE)) if len(values) else 0.0
    if not bright > 0:
        raise CaptureError(
            f"{BRIGHT_PERCENTILE:g} % of the calibrated values are not above 0 (up to {values.max(initial=0):g}); "
            "check the dark frame: is it as bright as the views?"
        )
    above = float((values > 1.0).mean())
    if all(sensor.is_absolute for sensor in sensors) and above <= MOST_ABOVE_ONE and bright >= LEAST_BRIGHT:
        return 1.0, f"values are kept ({sensors[0].unit}); {above:.2%} of the sampled ones are above 1"
    scale = float(f"{bright:.4g}")
    return scale, f"the {BRIGHT_PERCENTILE:g}th percentile of the sampled values"
