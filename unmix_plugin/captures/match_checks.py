"""Whether pictures fit their poses and lens, by features matched between near views.

A view is compared with several around it. Matches are accepted by what two views alone tell: neither view shows the
like of a feature elsewhere, and a fundamental matrix explains them. A feature found in three views or more is a point
of space, whose place follows from poses and lens; how far from its pixels this place is seen is hardly more than the
accuracy of features if all is right. A lens that is off, as one of another model read as ours, leaves more, and another
lens explains the matches better: one with a focal length and two radial terms of its own is sought. Where none does,
poses are off.

Notation: `T` points of one star, which is a view and those around it; `V` its views; ideal coordinates as in the
lens's module. Points that a view does not show are NaN there.

Source: features as in Lowe 2004, Distinctive image features from scale-invariant keypoints.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64, Int

from unmix_plugin.captures.poses.lens import Lens, Points
from unmix_plugin.captures.poses.pose_set import FLIP, PosedCamera, angles_between_axes
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.engine.sampling import evenly_spaced

_LONGEST_SIDE_PX = 320
"""Of pictures in which features are found."""
_MOST_FEATURES = 500
_STARS, _AROUND = 40, 5
"""Views that are compared with others, and how many around each."""
_ANGLES_DEG = (3.0, 30.0)
"""Between the axes of a view and those around it."""
_MOST_AMBIGUOUS = 0.8
"""Of a match, its difference over that of the second best."""
_MOST_REPEATED, _SAME_PLACE_PX = 0.6, 3.0
"""Of a match, its difference over that of either feature from the one most like it at another place of its own view:
squares of a cloth match each other between views as well as they match themselves, and fit poses nobody has."""
_LEAST_MATCHES, _LEAST_SHARE = 12, 0.4
"""That a fundamental matrix explains, and their share of all, with which two views count."""
_RANSAC_PX, _RANSAC_TRIALS = 1.5, 150
"""In pixels of the picture in which features are found."""
_LEAST_VIEWS, _LEAST_POINTS, _LEAST_FOR_LENS = 3, 30, 100
"""That show a point; points of all stars that poses are judged by, and lenses."""
_PERCENTILE = 85
"""Of distances that are compared: a lens is off towards the corners most."""
_BOUNDS = np.array([0.7, 1.0, 1.0])
"""Of another lens: logarithm of the focal length, radial terms. One that is found there means nothing."""
_BETTER = 0.75
"""Distance left with another lens over that with the given one, from which the lens is said to be wrong."""
_LEAST_OFF_PX = 0.7
"""More than the accuracy of features, in pixels of the picture in which they are found."""
_LEAST_MOVED_PX = 2.0
"""What another lens must move the corners of the picture by, the same pixels."""
_POSES_OFF_PX = 4.0
"""Distance left with any lens, from which poses are said to be wrong."""
_FITS_PX, _MOST_FITTING = 1.5, 0.35
"""Distance at which a point fits, and their share with which poses can't be wrong, whatever the others do."""


MatchedView: TypeAlias = tuple[PosedCamera, Path]
"""A camera, with the lens of its picture, and where this lies."""
_Features: TypeAlias = tuple[Float64[np.ndarray, "_ 2"], np.ndarray]
"""Places in pixels of the picture, and descriptors."""
_Pairs: TypeAlias = dict[tuple[int, int], tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]]
"""Indices of features that match, by the indices of two views."""


@dataclass(frozen=True)
class _Star:
    """Points that a view and some around it show."""

    ideal: Float64[np.ndarray, "T V 2"]
    rotations: Float64[np.ndarray, "V 3 3"]
    """Camera to world, OpenCV axes."""
    positions: Float64[np.ndarray, "V 3"]
    focal_px: float
    """Pixels of the picture in which features are found."""

    def places(self, ideal: Float64[np.ndarray, "T V 2"]) -> Float64[np.ndarray, "T 3"]:
        """Where the rays of points meet."""
        rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
        rays = np.einsum("vij,tvj->tvi", self.rotations, rays / np.linalg.norm(rays, axis=-1, keepdims=True))
        seen = np.isfinite(rays[..., :1, None])
        across = np.where(seen, np.eye(3) - rays[..., :, None] * rays[..., None, :], 0.0)  # off each ray
        total = across.sum(axis=1) + 1e-9 * np.eye(3)
        return np.linalg.solve(total, np.einsum("tvij,vj->ti", across, self.positions)[..., None])[..., 0]

    def misses_px(self, lens: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "T V 2"]:
        """From where each point is seen to where its place in space would be, with a lens that has been changed."""
        ideal = _changed(self.ideal.reshape(-1, 2), lens).reshape(self.ideal.shape)
        places = self.places(ideal)
        before = np.einsum("vji,tvj->tvi", self.rotations, places[:, None] - self.positions)
        found = before[..., :2] / np.maximum(before[..., 2:], 1e-6)
        return self.focal_px * np.exp(lens[0]) * np.clip(found - ideal, -1.0, 1.0)


@dataclass(frozen=True)
class MatchedScene:
    """Points that views share, found once."""

    stars: tuple[_Star, ...]
    lens: Lens | None
    """Of the first view."""

    @staticmethod
    def of(views: Sequence[MatchedView]) -> MatchedScene:
        """Match the features of near views of one sensor."""
        cameras = [camera for camera, _ in views]
        angles_deg = np.degrees(angles_between_axes(cameras))
        chosen = []  # views spread over all, each with those that are turned least against it, but enough
        for view in evenly_spaced(len(views), _STARS):
            low, high = _ANGLES_DEG
            order = np.argsort(angles_deg[view]).tolist()
            near = [other for other in order if other != view and low <= angles_deg[view, other] <= high]
            if len(near) >= _LEAST_VIEWS - 1:
                chosen.append([view, *near[:_AROUND]])
        features = {
            index: _features_of(views[index][1])
            for index in sorted({view for star in chosen for view in star})
        }
        pairs: _Pairs = {}
        found = [_find_star(star, cameras, features, pairs) for star in chosen]
        stars = tuple(star for star in found if star is not None)
        return MatchedScene(stars, cameras[0].lens)


def check_matches(scene: MatchedScene) -> list[Remark]:
    """What was measured in the views of one sensor, and what does not fit."""
    from scipy.optimize import least_squares

    stars, lens, count = scene.stars, scene.lens, sum(len(star.ideal) for star in scene.stars)
    if lens is None:
        return [Remark.of(Code.LINES_NOT_MATCHED)]
    if count < _LEAST_POINTS:
        return [Remark.of(Code.TOO_FEW_MATCHED)]

    def misses(values: np.ndarray) -> np.ndarray:
        found = np.concatenate([star.misses_px(values).reshape(-1, 2) for star in stars])
        return found[np.isfinite(found).all(axis=1)]

    def most(values: np.ndarray) -> float:
        return float(np.percentile(np.linalg.norm(misses(values), axis=1), _PERCENTILE))

    given = np.zeros(3)
    best = least_squares(
        lambda values: misses(values).ravel(),
        given,
        loss="soft_l1",
        x_scale=(0.1, 0.05, 0.05),
        bounds=(-_BOUNDS, _BOUNDS),
    ).x
    before, after, shrunk = most(given), most(best), _shrunk(lens)
    fitting = float(np.mean(np.linalg.norm(misses(best), axis=1) < _FITS_PX))
    corner, moved = lens.ideal_of(np.array([[0.5, 0.5]])), 0.0
    if corner is not None:
        moved = float(np.linalg.norm(lens.pixels_of(_changed(corner, best)) - lens.pixels_of(corner)))
    missed = {"points": count, "missed": f"{before / shrunk:.2f}", "percentile": _PERCENTILE}
    left = f"{after / shrunk:.2f}"
    remarks = [Remark.of(Code.POINTS_MATCHED, **missed)]
    is_better = after < min(_BETTER * before, _POSES_OFF_PX) and np.all(np.abs(best) < 0.99 * _BOUNDS)
    if before > _LEAST_OFF_PX and is_better and moved * shrunk > _LEAST_MOVED_PX and count > _LEAST_FOR_LENS:
        other = {"left": left, "focal": f"{np.exp(best[0]):.0%}", "moved": f"{moved:.0f}"}
        remarks.append(Remark.of(Code.LENS_MISFITS, **missed, **other))
    elif after > _POSES_OFF_PX and fitting < _MOST_FITTING:
        remarks.append(Remark.of(Code.POSES_MISFIT, **missed, left=left))
    return remarks


def _shrunk(lens: Lens | None) -> float:
    """Scale of the picture in which features are found."""
    return 1.0 if lens is None else min(1.0, _LONGEST_SIDE_PX / max(lens.width, lens.height))


def _changed(ideal: Points, lens: Float64[np.ndarray, "3"]) -> Points:
    """Ideal coordinates that another lens gives to the same pixels: logarithm of a focal length, two radial terms."""
    squared = (ideal**2).sum(axis=1, keepdims=True)
    return ideal * (np.exp(-lens[0]) * (1.0 + lens[1] * squared + lens[2] * squared**2))


def _features_of(picture: Path) -> tuple[Points, np.ndarray] | None:
    """Places in pixels of the picture, and descriptors; None where nothing stands out."""
    from PIL import Image
    from skimage.feature import SIFT

    with Image.open(picture) as opened:
        shrunk = min(1.0, _LONGEST_SIDE_PX / max(opened.size))
        size = (max(1, round(opened.width * shrunk)), max(1, round(opened.height * shrunk)))
        whole, opacity = opened.convert("L"), opened.convert("RGBA").getchannel("A")
        grey = np.asarray(whole.resize(size, Image.Resampling.BOX), np.float64) / 255
        foreground = np.asarray(opacity.resize(size, Image.Resampling.BOX)) > 127
    sift = SIFT(upsampling=2 if max(size) < _LONGEST_SIDE_PX else 1)
    try:
        sift.detect_and_extract(np.where(foreground, grey, 0.0))
    except (RuntimeError, ValueError, IndexError):  # nothing stands out, or the view is too small
        return None
    places = np.asarray(sift.keypoints, np.float64)[:, ::-1]
    some = np.unique(np.linspace(0, len(places) - 1, _MOST_FEATURES).round().astype(int))
    scale = np.array(opened.size) / size
    return (places[some] + 0.5) * scale, np.asarray(sift.descriptors)[some]


def _find_star(
    views: Sequence[int],
    all_cameras: Sequence[PosedCamera],
    features: Mapping[int, _Features | None],
    pairs: _Pairs,
) -> _Star | None:
    """Points of the first view that enough of the others show; None without any. Matches are remembered in `pairs`."""
    cameras = [all_cameras[index] for index in views]
    first, lenses = features[views[0]], [camera.lens for camera in cameras]
    if first is None or lenses[0] is None:
        return None
    pixels = np.full((len(first[0]), len(cameras), 2), np.nan)
    pixels[:, 0] = first[0]
    for index, view in enumerate(views[1:], start=1):
        other = features[view]
        if other is not None:
            low, high = sorted((views[0], view))
            if (low, high) not in pairs:
                one, two = features[low], features[high]
                assert one is not None
                assert two is not None
                pairs[low, high] = _matches(one, two, _shrunk(lenses[0]))
            mine, theirs = pairs[low, high] if low == views[0] else pairs[low, high][::-1]
            pixels[mine, index] = other[0][theirs]
    pixels = pixels[np.isfinite(pixels[..., 0]).sum(axis=1) >= _LEAST_VIEWS]
    ideal = np.full_like(pixels, np.nan)
    for index, lens in enumerate(lenses):
        seen = np.isfinite(pixels[:, index, 0])
        if lens is not None and seen.any():
            undone = lens.ideal_of(pixels[seen, index])
            if undone is None:
                return None
            ideal[seen, index] = undone
    if not len(ideal):
        return None
    poses = np.stack([camera.camera_to_world for camera in cameras])
    focal_px = _shrunk(lenses[0]) * float(np.mean(lenses[0].focal_px))
    return _Star(ideal, poses[:, :, :3] @ FLIP, poses[:, :, 3], focal_px)


def _matches(
    one: _Features, other: _Features, shrunk: float
) -> tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """Indices of features of two views that match and that a fundamental matrix explains; none if those are few."""
    from skimage.feature import match_descriptors
    from skimage.measure import ransac
    from skimage.transform import FundamentalMatrixTransform

    none = np.zeros(0, int)
    if min(len(one[0]), len(other[0])) < _LEAST_MATCHES:
        return none, none
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of descriptors that differ by nothing, samples that tell nothing
        found = match_descriptors(one[1], other[1], max_ratio=_MOST_AMBIGUOUS, cross_check=True)
        alone = []  # difference of each feature from the one most like it at another place of its own view
        for places, descriptors in (one, other):
            precise = descriptors.astype(np.float64)
            squares = (precise**2).sum(axis=1)
            differences = squares[:, None] + squares - 2 * precise @ precise.T
            same = np.linalg.norm(places[:, None] - places, axis=-1) < _SAME_PLACE_PX
            alone.append(np.sqrt(np.where(same, np.inf, np.maximum(differences, 0)).min(axis=1)))
        apart = np.linalg.norm(one[1][found[:, 0]].astype(float) - other[1][found[:, 1]], axis=1)
        repeated = np.minimum(alone[0][found[:, 0]], alone[1][found[:, 1]])
        found = found[apart < _MOST_REPEATED * repeated]
        if len(found) < _LEAST_MATCHES:
            return none, none
        _, explained = ransac(
            (one[0][found[:, 0]] * shrunk, other[0][found[:, 1]] * shrunk),
            FundamentalMatrixTransform,
            min_samples=8,
            residual_threshold=_RANSAC_PX,
            max_trials=_RANSAC_TRIALS,
            rng=0,
        )
    inliers = np.zeros(len(found), bool) if explained is None else np.asarray(explained, bool)
    if inliers.sum() < max(_LEAST_MATCHES, _LEAST_SHARE * len(found)):
        return none, none
    return found[inliers, 0], found[inliers, 1]
