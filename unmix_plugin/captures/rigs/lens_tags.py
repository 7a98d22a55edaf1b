"""The lens that a multispectral camera writes into its files (tags of Pix4D's namespace, and DJI's).

Their pixels have 0 at the centre of the first pixel, ours 0.5: principal points are moved by half a pixel.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import XmpTags, exif_number, tag_numbers, tag_text
from unmix_plugin.captures.poses.lens_fit import Points, fit_lens, require_unfolded
from unmix_plugin.captures.poses.pose_set import Lens
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

MM_OF_UNIT: dict[float, float] = {2.0: 25.4, 3.0: 10.0, 4.0: 1.0, 5.0: 1e-3}
"""Millimetres in EXIF's FocalPlaneResolutionUnit: inch, cm, mm, micrometre."""
TAGS = "lens in the XMP"
LONGEST_MM = 50.0
"""Focal length without a unit from which it is in pixels; these cameras have about 5 mm."""
HALF_PIXEL = 0.5
LIMIT_PX = 10.0
"""By how much the lens with k1, k2, p1, p2 may differ from the camera's; poses usually bring a better one."""


def lens_of(file: SpectralFile) -> tuple[Lens | None, tuple[str, ...]]:
    """The lens of a file, and what there is to say of it; no lens where its tags don't tell one.

    Raises:
        CaptureError: its model differs from every OPENCV lens by too much, or folds the image over.
    """
    lens, notes = _stated_lens(file, file.metadata.get("xmp") or {}, file.metadata.get("exif") or {})
    if lens is None:
        return None, notes
    numbers = (*lens.focal_px, *lens.center_px, *lens.distortion)
    if not np.isfinite(numbers).all() or min(lens.focal_px) <= 0.0:
        return None, ("no lens in the file's tags: its numbers make no sense",)
    return lens, notes


def _stated_lens(
    file: SpectralFile, tags: XmpTags, exif: dict[str, Any]
) -> tuple[Lens | None, tuple[str, ...]]:
    if tag_numbers(tags, "DewarpData") is not None:
        return _dji_lens(file, tags)
    resolution = _resolution(exif)
    centre_mm = tag_numbers(tags, "Camera:PrincipalPoint")
    if resolution is None or centre_mm is None or len(centre_mm) != 2:
        return None, ("no lens in the file's tags: principal point or focal plane resolution is absent",)
    centre = (centre_mm[0] * resolution[0] + HALF_PIXEL, centre_mm[1] * resolution[1] + HALF_PIXEL)
    fisheye = tag_numbers(tags, "FisheyePolynomial")
    if fisheye is not None and (tag_text(tags, "Camera:ModelType") or "fisheye").lower() == "fisheye":
        return _fisheye_lens(file, tags, fisheye, centre)
    return _perspective_lens(file, tags, resolution, centre)


def _resolution(exif: dict[str, Any]) -> tuple[float, float] | None:
    """Pixels a millimetre along x and y."""
    unit = MM_OF_UNIT.get(exif_number(exif, "FocalPlaneResolutionUnit") or 4.0, 1.0)
    across = (exif_number(exif, "FocalPlaneXResolution") or 0.0) / unit
    down = (exif_number(exif, "FocalPlaneYResolution") or 0.0) / unit
    return (across, down or across) if across > 0.0 else None


def _perspective_lens(
    file: SpectralFile, tags: XmpTags, resolution: tuple[float, float], centre: tuple[float, float]
) -> tuple[Lens | None, tuple[str, ...]]:
    focal = tag_numbers(tags, "PerspectiveFocalLength")
    if focal is None or focal[0] <= 0.0:
        return None, ("no lens in the file's tags: PerspectiveFocalLength is absent",)
    unit = tag_text(tags, "PerspectiveFocalLengthUnits") or ("mm" if focal[0] < LONGEST_MM else "px")
    focal_px = (focal[0] * resolution[0], focal[0] * resolution[1]) if unit == "mm" else (focal[0], focal[0])
    distortion = tag_numbers(tags, "PerspectiveDistortion") or []
    k1, k2, k3, p1, p2 = distortion if len(distortion) == 5 else [0.0] * 5
    return _lens(file, focal_px, centre, (k1, k2, k3), (p1, p2)), ()


def _dji_lens(file: SpectralFile, tags: XmpTags) -> tuple[Lens | None, tuple[str, ...]]:
    """`DewarpData`: a date; fx, fy, cx, cy, k1, k2, p1, p2, k3, where cx, cy count from the optical centre."""
    text = (tag_text(tags, "DewarpData") or "").rpartition(";")[2]
    numbers = tag_numbers({"DewarpData": text}, "DewarpData") or []
    middle = [(tag_numbers(tags, f"CalibratedOpticalCenter{axis}") or [math.nan])[0] for axis in "XY"]
    if len(numbers) != 9 or not np.isfinite(middle).all():
        return None, ("no lens in the file's tags: DewarpData or CalibratedOpticalCenter is incomplete",)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    centre = (middle[0] + cx + HALF_PIXEL, middle[1] + cy + HALF_PIXEL)
    return _lens(file, (fx, fy), centre, (k1, k2, k3), (p1, p2)), ()


def _lens(
    file: SpectralFile,
    focal_px: tuple[float, float],
    centre: tuple[float, float],
    radial: tuple[float, float, float],
    tangential: tuple[float, float],
) -> Lens:
    """A lens of the file's size.

    Raises:
        CaptureError: its distortion folds the image over.
    """
    height, width = file.shape[:2]
    lens = Lens(width, height, focal_px, centre, (*radial[:2], *tangential), (radial[2], 0.0))
    if lens.higher_radial[0]:
        require_unfolded(lens, f"{file.path}, {TAGS}")
    return lens


def _fisheye_lens(
    file: SpectralFile, tags: XmpTags, polynomial: list[float], centre: tuple[float, float]
) -> tuple[Lens | None, tuple[str, ...]]:
    """Pix4D's fisheye: radius p0 + p1 t + p2 t^2 + p3 t^3 with t = 2/pi times the angle, then the matrix C, D; E, F."""
    numbers = tag_numbers(tags, "FisheyeAffineMatrix")
    if numbers is None or len(numbers) != 4:
        return None, ("no lens in the file's tags: FisheyeAffineMatrix is absent",)
    height, width = file.shape[:2]
    try:
        lens, note = _fit_fisheye((width, height), tuple(polynomial), tuple(numbers), centre)
    except CaptureError as error:
        raise CaptureError(f"{file.path}, {error}") from error
    return lens, (note,)


@lru_cache
def _fit_fisheye(
    size: tuple[int, int],
    polynomial: tuple[float, ...],
    matrix: tuple[float, ...],
    centre: tuple[float, float],
) -> tuple[Lens, str]:
    """The lens nearest to a fisheye; all files of a lens have the same."""
    affine = np.array(matrix).reshape(2, 2)

    def project(ideal: Points) -> Points:
        radius = np.hypot(*ideal.T)
        bent = np.polynomial.polynomial.polyval(2.0 / math.pi * np.arctan(radius), polynomial)
        ratio = np.divide(
            bent, radius, out=np.full_like(radius, 2.0 / math.pi * polynomial[1]), where=radius > 1e-9
        )
        return (ideal * ratio[:, None]) @ affine.T + np.array(centre)

    focal = 2.0 / math.pi * polynomial[1] * np.diag(affine)
    start = Lens(*size, (float(focal[0]), float(focal[1])), centre)
    return fit_lens(project, start, "fisheye of Pix4D", TAGS, LIMIT_PX)
