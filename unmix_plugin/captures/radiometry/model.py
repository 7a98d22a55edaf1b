"""The calibration that a multispectral camera writes into each file, as one linear form.

Notation: `H` rows, `W` columns, `p` stored number, `x` column, `y` row, both counted from 0. All makers' formulas are

    L(x, y) = (p(x, y) - black level) * factor(x, y)

with a factor for exposure, gain, vignetting and, where rows are read one after the other, the row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Float64, Int

from unmix_plugin.captures.camera_tags import exif_number
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

FactorOf = Callable[[Int[np.ndarray, "h 1"], Int[np.ndarray, "1 W"]], Float64[np.ndarray, "h W"]]
"""Factor at rows y and columns x."""


@dataclass(frozen=True)
class RadiometricModel:
    """How the stored numbers of one file become radiance."""

    maker: str
    """`MicaSense`, `Parrot Sequoia`, `DJI`."""
    unit: Literal["W/m2/sr/nm", "relative"]
    """Relative radiance is comparable between the bands and exposures of one camera."""
    black_level: float
    """Stored number of no light."""
    saturated: float
    """Stored numbers from here on are saturated."""
    factor_of: FactorOf = field(repr=False)
    irradiance: float | None = None
    """What the sunshine sensor measured, as the file gives it; not used."""

    @property
    def description(self) -> str:
        """What was done, in one line, for the record."""
        unit = "relative radiance" if self.unit == "relative" else f"radiance in {self.unit}"
        return f"{unit} by {self.maker}'s calibration in the file, black level {self.black_level:g}"

    def apply(
        self,
        values: Float[np.ndarray, "h W b"],
        rows: slice = slice(None),
        columns: slice = slice(None),
    ) -> Float32[np.ndarray, "h W b"]:
        """Radiance of some rows; a little below 0 where noise goes below the black level.

        Args:
            values: Stored numbers of these rows and columns; every band is treated alike.
            rows, columns: Which ones of the file they are.
        """
        y, x = _positions(rows, values.shape[0]), _positions(columns, values.shape[1])
        factor = self.factor_of(y[:, None], x[None, :])
        return ((values - self.black_level) * factor[..., None]).astype(np.float32)


def radiometric_model(file: SpectralFile) -> RadiometricModel | None:
    """The calibration that a file carries in `metadata["xmp"]` and `metadata["exif"]`; None where there is none.

    Raises:
        CaptureError: the file has a calibration that lacks a number, or one that can't be.
    """
    from unmix_plugin.captures.radiometry import dji, micasense, sequoia

    tags, exif = file.metadata.get("xmp") or {}, file.metadata.get("exif") or {}
    for maker in (micasense, sequoia, dji):
        if maker.is_maker(tags):
            model = maker.read_model(file, tags, exif)
            probe = model.factor_of(np.array([[0], [file.shape[0] - 1]]), np.arange(file.shape[1])[None, :])
            if not (np.isfinite(probe).all() and (probe > 0.0).all()):
                raise CaptureError(
                    f"{file.path}: the calibration in its XMP gives factors from {probe.min():g} to {probe.max():g} "
                    "in the first and last row; expected positive numbers: the tags of exposure, gain or vignetting "
                    "are damaged"
                )
            return model
    return None


def _positions(part: slice, count: int) -> Int[np.ndarray, " count"]:
    first, step = part.start or 0, part.step or 1
    return np.arange(first, first + count * step, step)


def require_numbers(
    file: SpectralFile, name: str, numbers: list[float] | None, count: int, *, positive: bool = False
) -> list[float]:
    """The numbers of a tag.

    Raises:
        CaptureError: there are not `count` of them, or one is not above 0 where it must be.
    """
    if numbers is None or len(numbers) != count or (positive and min(numbers) <= 0.0):
        kind = "positive number" if positive else "number"
        found = "it is absent" if numbers is None else f"found {numbers}"
        raise CaptureError(
            f"{file.path}: the tag {name} should hold {count} {kind}{'s' if count > 1 else ''}; {found}. "
            "Without it the stored numbers can't become radiance: export the image with its metadata"
        )
    return numbers


def require_exif(file: SpectralFile, exif: Mapping[str, Any], *names: str) -> float:
    """The first of some EXIF tags.

    Raises:
        CaptureError: it is absent, no number, or not above 0.
    """
    number = exif_number(exif, *names)
    return require_numbers(file, f"EXIF {names[0]}", None if number is None else [number], 1, positive=True)[
        0
    ]


def stored_range(exif: Mapping[str, Any]) -> float:
    """Stored numbers go up to this, less one."""
    return 2.0 ** min(32.0, exif_number(exif, "BitsPerSample") or 16.0)


def radial_polynomial(
    coefficients: list[float], centre: list[float], y: np.ndarray, x: np.ndarray
) -> Float64[np.ndarray, "h W"]:
    """1 + k0 r + k1 r^2 + ... at a distance of r pixels from a centre (x, y)."""
    radius = np.hypot(x - centre[0], y - centre[1])
    return np.polynomial.polynomial.polyval(radius, np.array([1.0, *coefficients]))
