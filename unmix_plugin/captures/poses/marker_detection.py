"""Printed square markers in pictures: the families that OpenCV knows, and corners to a few hundredths of a pixel.

A marker is a black square with a code of white cells, on white. Detection is OpenCV's, in a stretched picture. Corners
are found anew in the picture as it was measured, since stretching moves edges: lines are fitted to the four sides,
where brightness is half way between black and white, and intersected.

Notation: `H x W` pixels, the middle of the first at (0.5, 0.5). Corners of a marker go clockwise from its upper left.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from unmix_plugin.errors import CaptureError, ConfigError, did_you_mean, install_hint

Corners: TypeAlias = Float64[np.ndarray, "4 2"]
Sightings: TypeAlias = dict[str, dict[int, Corners]]
"""Markers by view and number."""

_SIZES = ("50", "100", "250", "1000")
_APRILTAGS = ("16H5", "25H9", "36H10", "36H11")
FAMILIES = (
    *(f"DICT_{bits}X{bits}_{size}" for bits in (4, 5, 6, 7) for size in _SIZES),
    *(f"DICT_APRILTAG_{name}" for name in _APRILTAGS),
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36H12",
)
"""OpenCV's names. The smaller ones of a kind are the beginning of the larger."""
_TRIED = tuple(name for name in FAMILIES if not name.endswith(("X4_50", "_50", "_100", "_250")))
"""Without a name given: the largest of each kind."""
_ENLARGED_PX = 1200
"""Pictures with a shorter longer side are doubled, as the cells of small markers span two pixels or less."""
_PERCENTILES = (1.0, 99.5)
_STEPS = 21
"""Samples across a side."""
_LARGEST_MOVE_PX = 4.0
"""By which a corner of OpenCV may be off; beyond, something else than the side was followed."""
_LEAST_STEP = 0.3
"""Of the median step between black and white along a side; places with less are hidden or in a shadow."""


def parse_family(name: str | None) -> str | None:
    """OpenCV's name of a family, as a user writes it. Raises ConfigError: there is no such family.

    >>> parse_family("apriltag_36h11")
    'DICT_APRILTAG_36H11'
    """
    if name is None:
        return None
    wanted = f"DICT_{name.strip().upper().replace('-', '_').removeprefix('DICT_')}"
    if wanted not in FAMILIES:
        raise ConfigError(
            f"--marker-family {name}: there is no such family; expected one of OpenCV, such as DICT_4X4_50 or "
            f"DICT_APRILTAG_36H11{did_you_mean(wanted, FAMILIES, form='; {}')}"
        )
    return wanted


def require_opencv() -> Any:
    """OpenCV. Raises CaptureError: it is not installed."""
    try:
        import cv2
    except ImportError as error:
        raise CaptureError(
            f"OpenCV, which finds markers, is not installed: {install_hint('sfm')}, or give other poses"
        ) from error
    return cv2


def count_markers(
    pictures: Sequence[Float32[np.ndarray, "H W"]], family: str | None = None
) -> dict[str, int]:
    """How many markers of each family, or of a given one, are in pictures. Of families whose codes are short, some are
    found in any texture: a number counts that is in two pictures."""
    cv2 = require_opencv()
    families = _TRIED if family is None else (family,)
    detector = _detector(cv2, families)
    seen: Counter[tuple[int, int]] = Counter()
    for picture in pictures:
        _, numbers, _, which = detector.detectMarkersMultiDict(_stretched(cv2, picture)[0])
        if numbers is not None:
            seen.update(set(zip(np.ravel(which).tolist(), np.ravel(numbers).tolist(), strict=True)))
    counts = dict.fromkeys(families, 0)
    for (index, _), count in seen.items():
        counts[families[index]] += count if count > 1 or len(pictures) == 1 else 0
    return counts


def find_markers(
    pictures: Mapping[str, Float32[np.ndarray, "H W"]], family: str
) -> tuple[Sightings, list[str]]:
    """The markers of a family in the light of each view (linear, in any unit); and a sentence on those that were left
    out because a picture shows two of a number."""
    cv2 = require_opencv()
    detector = _detector(cv2, [family])
    cells = detector.getDictionary().markerSize + 2
    found: Sightings = {}
    doubled: Counter[int] = Counter()
    for name, picture in pictures.items():
        stretched, factor = _stretched(cv2, picture)
        corners, numbers, _ = detector.detectMarkers(stretched)
        listed = [] if numbers is None else np.ravel(numbers).tolist()
        counts = Counter(listed)
        doubled.update(number for number, count in counts.items() if count > 1)
        found[name] = {}
        for number, quad in zip(listed, corners, strict=True):
            if counts[number] == 1:
                first = (np.asarray(quad, np.float64).reshape(4, 2) + 0.5) / factor
                refined = _refine(picture, first, cells)
                found[name] |= {} if refined is None else {number: refined}
    if not doubled:
        return found, []
    numbers = ", ".join(map(str, sorted(doubled)))
    return found, [f"markers of one number twice in a picture, left out there: {numbers}"]


def _detector(cv2: Any, families: Sequence[str]) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    known = [cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family)) for family in families]
    detector = cv2.aruco.ArucoDetector(known[0], parameters)
    detector.setDictionaries(known)
    return detector


def _stretched(cv2: Any, picture: Float32[np.ndarray, "H W"]) -> tuple[UInt8[np.ndarray, "h w"], int]:
    """The picture in 8 bits, and how many times larger it is."""
    low, high = np.percentile(picture, _PERCENTILES)
    level = np.clip((picture - low) / max(high - low, 1e-12), 0.0, 1.0) ** 0.5
    factor = 2 if max(picture.shape) < _ENLARGED_PX else 1
    grey = np.round(255.0 * level).astype(np.uint8)
    if factor > 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    return grey, factor


def _refine(picture: Float32[np.ndarray, "H W"], first: Corners, cells: int) -> Corners | None:
    """The corners where lines along the sides meet; None where no side is to be followed. `cells` are those along a
    side, with the black border."""
    corners = first
    for _ in range(4):
        lines = list(_side_lines(picture, corners, cells))
        if len(lines) < 4:
            return None
        meeting = np.cross(np.roll(lines, 1, axis=0), lines)
        with np.errstate(all="ignore"):
            corners = meeting[:, :2] / meeting[:, 2:]
        if not np.abs(corners - first).max() < _LARGEST_MOVE_PX:
            return None
    return corners


def _side_lines(
    picture: Float32[np.ndarray, "H W"], corners: Corners, cells: int
) -> Iterator[Float64[np.ndarray, "3"]]:
    """Each side as a homogeneous line, as far as sides can be followed."""
    from scipy.ndimage import map_coordinates

    for side in range(4):
        start, end = corners[side], corners[(side + 1) % 4]
        length = float(np.linalg.norm(end - start))
        along = (end - start) / max(length, 1e-9)
        outward = np.array([along[1], -along[0]])
        opposite = (corners[(side + 2) % 4] + corners[(side + 3) % 4] - start - end) / 2
        # A profile stays within the black border on one side, and within as much of the white on the other.
        reach = float(np.clip(0.75 * abs(opposite @ outward) / cells, 1.0, 3.5))
        places = np.linspace(0.1, 0.9, max(int(1.6 * length), 8))
        across = np.linspace(-reach, reach, _STEPS)
        x, y = (start + places[:, None, None] * (end - start) + across[:, None] * outward).transpose(2, 0, 1)
        profiles = map_coordinates(picture, [y - 0.5, x - 0.5], order=1, mode="nearest")
        black, white = profiles[:, :3].mean(axis=1), profiles[:, -3:].mean(axis=1)
        step = white - black
        good = step > _LEAST_STEP * np.median(step)
        share = (profiles.mean(axis=1) - black) / np.where(good, step, 1.0)
        offsets = reach * (1.0 - 2.0 * share)  # where a sharp edge would stand that leaves as much white
        good &= np.abs(offsets) < reach
        if good.sum() < 4 or not np.median(step) > 0:
            return
        table = np.column_stack([np.ones_like(places), places])
        weights, fitted = good.astype(np.float64), np.zeros(2)
        for _ in range(4):
            fitted = np.linalg.lstsq(table * weights[:, None], offsets * weights, rcond=None)[0]
            away = np.abs(offsets - table @ fitted)
            weights = good / np.sqrt(1.0 + (away / (1.5 * np.median(away[good]) + 1e-3)) ** 2)
        moved = (start + outward * fitted[0], end + outward * fitted.sum())
        yield np.cross(np.append(moved[0], 1.0), np.append(moved[1], 1.0))
