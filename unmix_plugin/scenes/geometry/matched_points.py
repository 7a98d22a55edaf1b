"""Places that views agree on, before any training: features matched between views, seen along rays of given poses.

Nothing is assumed of where the scene is. A match counts if its two rays pass each other closer than a pixel and a
half, before both cameras, and at an angle that tells how far away they do. With poses that are right nearly all do.

Notation: `N` cameras, `M` matches, `P` places, `F` features of a view.

Source: features and their matches as in Lowe 2004, Distinctive Image Features from Scale-Invariant Keypoints.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.scenes.geometry.lighting import local_log_brightness
from unmix_plugin.scenes.geometry.views import ThinnedViews, Views

LONGEST_SIDE_PX = 320
"""Of the views that are compared."""
_MOST_REFERENCES = 8
"""Views, spread over all, that are each compared with views beside them."""
_NEIGHBOUR_RANKS = (0, 1, 3, 7)
"""Those beside a view, by their rank in distance: the nearest show most of what it does, farther ones tell depths
better."""
_MOST_AMBIGUOUS = 0.85
"""Of a match, its difference over that of the second best."""
_MOST_APART_PX = 1.5
"""Of the rays of a match, in pixels of the thinned-out view."""
_SMALLEST_ANGLE_DEG = 1.0
"""Between the rays of a match."""
_LEAST_POINTS = 60
"""Fewer may be chance."""
_MOST_DEPTH_RATIO = 2.0
"""Of far to near places that are about as far away."""
_ENDS = torch.tensor([0.05, 0.95])
_NEAR = 0.25
_BRIGHT = 0.99
"""Quantile of a view's brightness that is taken for white."""
_REACH = 7.5
"""Half the edge of what a descriptor looks at, in the width of its feature."""
_MOST_KEPT = 64
"""Views whose features are kept: reading a scene and judging its light look for those of the same views."""
_SPECK_PX = 3
"""Along an edge of the thinned-out view; smaller parts that are not valid, such as dead pixels, spoil no descriptor."""


@dataclass(frozen=True)
class MatchedPoints:
    """Places that two views show."""

    places: Float[Tensor, "P 3"]
    """In the cameras' space."""
    pairs: Int[Tensor, "P 2"]
    """The two cameras that see each."""
    log_brightness: Float[Tensor, "P 2"]
    """What each of them sees: the logarithm of the mean around; NaN where it sees nothing or no light."""
    depths: Float[Tensor, " P"]
    """How far before the first of them, along its optical axis."""

    @property
    def views(self) -> Int[Tensor, " P"]:
        """A camera that sees each: the one that depths are of."""
        return self.pairs[:, 0]

    @property
    def are_equally_far(self) -> bool:
        """Whether all are about as far away, as ground is below an aircraft: views end there."""
        near, far = self.depths.quantile(_ENDS)
        return bool(far < _MOST_DEPTH_RATIO * near)

    def seen_by(self, num_cameras: int) -> Float[Tensor, "P N"]:
        """`log_brightness` in each of so many cameras; NaN in all but two."""
        unseen = self.log_brightness.new_full((len(self.places), num_cameras), torch.nan)
        return unseen.scatter_(1, self.pairs, self.log_brightness)

    @property
    def nearer(self) -> MatchedPoints:
        """Those before a distant background: at most twice as deep as the nearest quarter."""
        kept = self.depths <= _MOST_DEPTH_RATIO * self.depths.quantile(_NEAR)
        return MatchedPoints(*(values[kept] for values in vars(self).values()))


def find_matched_points(views: Views) -> MatchedPoints | None:
    """Places that views of one size agree on; None if those are too few to say anything.

    Line cameras may be among them. Pixels that don't count have no feature and no brightness.
    """
    cameras, thinned = views.cameras, ThinnedViews(views, LONGEST_SIDE_PX)
    # Some views and others beside them, each pair once; views at one place tell no distance.
    positions, pairs = cameras.camera_to_world[:, :, 3].double(), set()
    away = torch.cdist(positions, positions)
    for view in evenly_spaced(len(positions), _MOST_REFERENCES):
        others = [other for other in away[view].argsort().tolist() if away[view, other] > 1e-6 * away.max()]
        near = [others[rank] for rank in _NEIGHBOUR_RANKS if rank < len(others)]
        pairs |= {(min(view, other), max(view, other)) for other in near}
    features = {view: _features_of(thinned, view) for view in sorted({*sum(pairs, ())})}
    found = [
        _triangulate(cameras, thinned.stride, pair, features[pair[0]], features[pair[1]])
        for pair in sorted(pairs)
    ]
    if sum(len(points.depths) for points in found) < _LEAST_POINTS:
        return None
    return MatchedPoints(*map(torch.cat, zip(*(vars(points).values() for points in found), strict=True)))


@dataclass(frozen=True)
class _Features:
    """What stands out in a view."""

    coords: Float[Tensor, "F 2"]
    """Pixels."""
    descriptors: Float32[np.ndarray, "F 128"]
    log_brightness: Float[Tensor, " F"]


def _features_of(thinned: ThinnedViews, view: int) -> _Features:
    brightness = thinned.read(view).mean(dim=-1).nan_to_num(0.0, 0.0, 0.0)
    share = thinned.valid_share(view)
    counts = torch.ones_like(brightness, dtype=torch.bool) if share is None else share == 1
    found = _features_in(brightness.numpy().tobytes(), counts.numpy().tobytes(), tuple(brightness.shape))
    return replace(found, coords=thinned.whole(found.coords))


@lru_cache(maxsize=_MOST_KEPT)
def _features_in(brightness_bytes: bytes, counts_bytes: bytes, shape: tuple[int, ...]) -> _Features:
    """In a view thinned out, with coordinates in it, by the values of float32 pixels and which of these count."""
    from scipy import ndimage  # slow to import
    from skimage.feature import SIFT

    brightness, counts = (
        torch.from_numpy(np.frombuffer(values, dtype=dtype).reshape(shape).copy())
        for values, dtype in ((brightness_bytes, np.float32), (counts_bytes, np.bool_))
    )
    sift = SIFT(upsampling=1)
    try:
        dark, bright = brightness[counts].quantile(torch.tensor([1 - _BRIGHT, _BRIGHT]))
        sift.detect_and_extract(((brightness - dark) / (bright - dark).clamp(min=1e-9)).clamp(0, 1).numpy())
    except (RuntimeError, ValueError, IndexError):  # nothing counts or stands out, or the view is too small
        return _Features(torch.zeros(0, 2), np.zeros((0, 128), dtype=np.float32), torch.zeros(0))
    coords = torch.from_numpy(np.array(sift.keypoints, dtype=np.float32)[:, ::-1].copy()) + 0.5
    descriptors = np.array(sift.descriptors, dtype=np.float32)
    columns, rows = coords.long().unbind(-1)
    if not bool(counts.all()):
        # No descriptor may reach into a part, larger than a speck, that does not count.
        parts = ndimage.binary_opening(~counts.numpy(), np.ones((_SPECK_PX, _SPECK_PX)))
        if parts.any():
            away = torch.from_numpy(ndimage.distance_transform_edt(np.logical_not(parts))).float()
            kept = away[rows, columns] > _REACH * torch.from_numpy(np.array(sift.sigmas, dtype=np.float32))
            coords, rows, columns = (values[kept] for values in (coords, rows, columns))
            descriptors = descriptors[kept.numpy()]
    seen = local_log_brightness(torch.where(counts, brightness, 0.0))
    return _Features(coords, descriptors, torch.from_numpy(seen).float()[rows, columns])


def _triangulate(
    cameras: Cameras, stride: int, pair: tuple[int, int], one: _Features, other: _Features
) -> MatchedPoints:
    """Of each match whose rays meet, the place where they pass each other; in views thinned out by `stride`."""
    from skimage.feature import match_descriptors

    chosen = torch.zeros(0, 2, dtype=torch.int64)
    if min(len(one.coords), len(other.coords)) > 1:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of descriptors that differ by nothing
            matches = match_descriptors(one.descriptors, other.descriptors, max_ratio=_MOST_AMBIGUOUS)
        chosen = torch.from_numpy(np.array(matches, dtype=np.int64))
    first_of, second_of = chosen.unbind(-1)
    ends = zip(pair, (one.coords[first_of], other.coords[second_of]), strict=True)
    seen = torch.stack([one.log_brightness[first_of], other.log_brightness[second_of]], dim=-1)
    rays = [cameras.generate_rays(torch.full((len(chosen),), view), coords) for view, coords in ends]
    along, across = (ray.directions.double() for ray in rays)
    between = (rays[1].origins - rays[0].origins).double()
    cosine = (along * across).sum(dim=-1)
    sine = (1 - cosine.square()).clamp(min=1e-12)
    # Where two lines pass each other: each distance is least squares, given the other.
    first = ((between * along).sum(dim=-1) - cosine * (between * across).sum(dim=-1)) / sine
    second = (cosine * (between * along).sum(dim=-1) - (between * across).sum(dim=-1)) / sine
    gaps = (first[:, None] * along - between - second[:, None] * across).norm(dim=-1)
    pixel = stride / cameras.focal_px[pair[0]].min().double()
    meets = (first > 0) & (second > 0) & (gaps < _MOST_APART_PX * pixel * torch.minimum(first, second))
    meets &= sine.sqrt() > np.sin(np.radians(_SMALLEST_ANGLE_DEG))
    reached = (first[:, None] * along)[meets].float()
    assert rays[0].axes is not None
    depths = (reached * rays[0].axes[meets]).sum(dim=-1)
    pairs = torch.tensor(pair).expand(len(depths), 2)
    return MatchedPoints(rays[0].origins[meets] + reached, pairs, seen[meets], depths)
