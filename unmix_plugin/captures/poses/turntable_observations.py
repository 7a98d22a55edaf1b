"""What pictures of a turned object tell of the cameras: matched points, and convex hulls of silhouettes; and the angles
that users give.

Notation: `N` views, `V` corners of a hull, `Q` pairs of views, `F` matches, `H x W` pixels.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int, UInt8

from unmix_plugin.engine.tables import decode_text, named_rows
from unmix_plugin.errors import ConfigError, name_some

_MOST_MATCHED_DEG, _MOST_TOUCHED_DEG = 30.0, 130.0
"""Between views whose points, and whose outlines, are compared."""
_LEAST_APART_DEG = 1.0
"""Views of one place that differ by less tell nothing."""
_RIM_PX = 4
"""Beside the edge of a mask, where features are those of the silhouette and not of the surface."""
_RATIO = 0.8
"""Of the nearest to the second nearest descriptor (Lowe 2004)."""
_MOST_FEATURES, _ENLARGED_PX = 2000, 600
"""Of a picture; ones with a shorter longer side are doubled first."""
_STILL_PX = 2.0
"""Matches of views that moved less stand still as the object turns: stains, noise, the background."""
_LEAST_PART = 0.02
"""Of the foreground of a view: smaller parts of its mask are specks."""


@dataclass(frozen=True)
class Turn:
    """How a view was taken."""

    angle_deg: float
    """By which the object was turned."""
    camera: int = 0
    """Which of the places of the camera it was taken from."""


def parse_angles(text: str, names: Sequence[str]) -> dict[str, Turn]:
    """Angles of views as a user gives them.

    Args:
        text: START:STOP:STEP in degrees without the end, one for each place of the camera, with commas between; or a
            CSV file with columns view, angle and, if there are several places, camera.
        names: Of the views, in their order.
    Raises:
        ConfigError: it is neither, or there are not as many angles as views.

    >>> parse_angles("0:360:120", ["a", "b", "c"])["b"]
    Turn(angle_deg=120.0, camera=0)
    """
    if Path(text).suffix.lower() == ".csv" or Path(text).is_file():
        return _read_angles(Path(text), names)
    turns: list[Turn] = []
    total = 0
    for camera, part in enumerate(text.split(",")):
        try:
            start, stop, step = (float(number) for number in part.split(":"))
            count = int(np.ceil((stop - start) / step - 1e-9))
        except (ValueError, ZeroDivisionError, OverflowError) as error:
            raise ConfigError(
                f"--angles {text}: expected START:STOP:STEP in degrees, or a CSV file with the columns view and angle"
            ) from error
        total += max(count, 0)
        turns += [Turn(start + index * step, camera) for index in range(min(count, len(names)))]
    if total != len(names):
        raise ConfigError(
            f"--angles {text} gives {total} angles (the end of a range is none of them) for {len(names)} views; "
            "expected one a view: give other steps, or a CSV file"
        )
    return dict(zip(names, turns, strict=True))


def _read_angles(path: Path, names: Sequence[str]) -> dict[str, Turn]:
    try:
        table = named_rows(decode_text(path.read_bytes()), ("view", "angle"))
    except (OSError, csv.Error) as error:
        raise ConfigError(f"--angles {path}: it can't be read ({error}); give a CSV file") from error
    expected = "expected the columns view and angle (degrees), and perhaps camera"
    if table is None:
        raise ConfigError(f"--angles {path}: no line names its columns; {expected}")
    dialect, rows = table
    found: dict[str, Turn] = {}
    places: dict[str, int] = {}
    for line, row in rows:
        name, text = row["view"], row.get("angle", "")
        angle = dialect.number(text)
        if angle is None or not np.isfinite(angle):
            raise ConfigError(f"--angles {path}, line {line}: {text!r} is no angle ({dialect}); {expected}")
        key = name if name in names else Path(name).stem
        if key in found:
            raise ConfigError(f"--angles {path}, line {line}: the view {key} has an angle already")
        found[key] = Turn(angle, places.setdefault(row.get("camera", ""), len(places)))
    missing, unknown = [n for n in names if n not in found], [n for n in found if n not in names]
    if missing or unknown:
        lacking = f"no angle for {name_some(missing)}; " if missing else ""
        other = f"no view is called {name_some(unknown)}; " if unknown else ""
        raise ConfigError(
            f"--angles {path} has {len(found)} angles for {len(names)} views: {lacking}{other}expected one a view"
        )
    return found


@dataclass(frozen=True)
class Observations:
    """What pictures tell of the cameras."""

    angle: Float64[np.ndarray, " N"]
    """Radians."""
    camera: Int[np.ndarray, " N"]
    """Which place it stood in."""
    size: tuple[int, int]
    """Width, height."""
    first: Int[np.ndarray, " F"]
    second: Int[np.ndarray, " F"]
    """Views of each match."""
    points: Float64[np.ndarray, "F 2 2"]
    """In both, pixels."""
    hulls: Float64[np.ndarray, "N V 2"]
    """Corners, the last one repeated; no corners where masks are not known."""
    touched: Int[np.ndarray, "Q 2"]
    """Pairs of views whose outlines are compared."""
    likeness: float
    """Mean overlap of silhouettes with what most views of their place show, intersection over union."""

    def part(self, views: Bool[np.ndarray, " N"]) -> Observations:
        """That between some views alone; the numbers of views stay."""
        keep = views[self.first] & views[self.second]
        return self._kept(keep, np.asarray(views[self.touched].all(axis=1)))

    def thinned(self, most: tuple[int, int]) -> Observations:
        """At most so many matches and pairs of outlines, drawn at random."""
        generator = np.random.default_rng(0)
        keep, pairs = (
            np.sort(generator.permutation(count)[:limit])
            for count, limit in zip((len(self.first), len(self.touched)), most, strict=True)
        )
        return self._kept(keep, pairs)

    def _kept(self, matches: np.ndarray, pairs: np.ndarray) -> Observations:
        found = {name: getattr(self, name)[matches] for name in ("first", "second", "points")}
        return replace(self, **found, touched=self.touched[pairs])


def gather(
    cv2: Any,
    pictures: Sequence[UInt8[np.ndarray, "H W"]],
    turns: Sequence[Turn],
    masks: Sequence[Bool[np.ndarray, "H W"]] | None,
) -> Observations:
    """What views of one size tell, with masks that are True on the object."""
    height, width = pictures[0].shape
    angle = np.radians([turn.angle_deg for turn in turns])
    camera = np.array([turn.camera for turn in turns])
    shown = [None] * len(pictures) if masks is None else masks
    features = [_features(cv2, picture, mask) for picture, mask in zip(pictures, shown, strict=True)]
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    first, second, touched = [], [], []
    points = [np.zeros((0, 2, 2))]
    for i, j in combinations(range(len(pictures)), 2):
        apart = np.degrees(abs(np.angle(np.exp(1j * (angle[i] - angle[j])))))
        if camera[i] == camera[j] and apart < _LEAST_APART_DEG:
            continue
        if masks is not None and apart <= _MOST_TOUCHED_DEG:
            touched.append((i, j))
        if apart <= _MOST_MATCHED_DEG:
            points.append(_matches(matcher, features[i], features[j]))
            first += [i] * len(points[-1])
            second += [j] * len(points[-1])
    return Observations(
        angle,
        camera,
        (width, height),
        np.array(first, np.int64),
        np.array(second, np.int64),
        np.concatenate(points),
        np.zeros((len(pictures), 0, 2)) if masks is None else _hulls(cv2, masks),
        np.array(touched, np.int64).reshape(-1, 2),
        1.0 if masks is None else _likeness(np.stack(masks), camera),
    )


def _features(
    cv2: Any, picture: UInt8[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"] | None
) -> tuple[Float64[np.ndarray, "K 2"], Any]:
    """Where a picture has features, and their descriptors."""
    from scipy.ndimage import binary_erosion

    factor = 2 if max(picture.shape) < _ENLARGED_PX else 1
    enlarged = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    shown = None
    if mask is not None:
        inner = 255 * binary_erosion(mask, iterations=_RIM_PX).astype(np.uint8)
        shown = inner.repeat(factor, axis=0).repeat(factor, axis=1)
    found, descriptors = cv2.SIFT_create(nfeatures=_MOST_FEATURES).detectAndCompute(enlarged, shown)
    return (np.array([key.pt for key in found]).reshape(-1, 2) + 0.5) / factor, descriptors


def _matches(
    matcher: Any, one: tuple[np.ndarray, Any], other: tuple[np.ndarray, Any]
) -> Float64[np.ndarray, "F 2 2"]:
    """Points that are each other's nearest, by far, and that moved."""
    if one[1] is None or other[1] is None or min(len(one[0]), len(other[0])) < 2:
        return np.zeros((0, 2, 2))
    near = [a for a, b in matcher.knnMatch(one[1], other[1], k=2) if a.distance < _RATIO * b.distance]
    back = {found.queryIdx: found.trainIdx for found in matcher.match(other[1], one[1])}
    mutual = [(a.queryIdx, a.trainIdx) for a in near if back.get(a.trainIdx) == a.queryIdx]
    pairs = np.array([(one[0][i], other[0][j]) for i, j in mutual]).reshape(-1, 2, 2)
    return pairs[np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1) > _STILL_PX]


def _hulls(cv2: Any, masks: Sequence[Bool[np.ndarray, "H W"]]) -> Float64[np.ndarray, "N V 2"]:
    """Convex hulls of silhouettes without specks."""
    from scipy.ndimage import label

    found = []
    around = np.array([[np.cos(turn), np.sin(turn)] for turn in np.arange(8) * np.pi / 4], np.float32)
    for mask in masks:
        parts, count = label(mask)  # type: ignore[misc]
        sizes = np.bincount(parts.ravel(), minlength=count + 1)
        sizes[0] = 0
        rows, columns = np.nonzero((sizes > _LEAST_PART * sizes.sum())[parts])
        middles = np.column_stack([columns, rows]).astype(np.float32) + 0.5
        if not len(middles):
            middles = np.array([mask.shape[::-1]], np.float32) / 2
        # Outlines run half a pixel outside the middles of the outermost pixels.
        hull = (cv2.convexHull(middles)[:, 0][:, None] + 0.5 * around).reshape(-1, 2)
        found.append(cv2.convexHull(hull)[:, 0].astype(np.float64))
    longest = max(map(len, found))
    return np.stack([np.pad(hull, ((0, longest - len(hull)), (0, 0)), mode="edge") for hull in found])


def _likeness(masks: Bool[np.ndarray, "N H W"], camera: Int[np.ndarray, " N"]) -> float:
    overlaps = []
    for place in np.unique(camera):
        of_place = masks[camera == place]
        usual = of_place.mean(axis=0) >= 0.5
        both, either = (of_place & usual).sum(axis=(1, 2)), (of_place | usual).sum(axis=(1, 2))
        overlaps.append(both / np.maximum(either, 1))
    return float(np.concatenate(overlaps).mean())
