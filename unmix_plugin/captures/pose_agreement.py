"""Views whose pictures do not belong to their poses, by how little they agree with the views around them.

A point of the scene looks alike in all views that see it. Along the rays of some pixels the place is sought at which
the views around agree best with what the pixel shows; how far they still differ there tells whether the pose is right.
What would refute it is measured as well: how far pictures differ under poses that are surely not theirs. Where true
and false poses differ alike, as before plain or repeated surfaces, nothing is said.

Notation: `N` views, `P` pixels of one, `D` places along a ray, `h x w` pixels of a thumbnail with `F` features.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from unmix_plugin.captures.checks import SeenView
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.spoilt import distances_between
from unmix_plugin.engine.sampling import evenly_spaced

_LONGEST_SIDE_PX = 128
"""Of thumbnails."""
_COARSE_PX = 4.0
"""Radius of what is smoothed much."""
_NEIGHBOURS, _AGREEING = 6, 3
"""Views that each is compared with, and how many of them must agree: others are hidden by something."""
_LEAST_VIEWS = 6
_LEAST_MOVED = 0.05
"""Of a neighbour's camera, over the usual distance of two: views from one place agree about any distance."""
_PIXELS, _BUSIEST_SHARE = 150, 0.3
"""Of each view, drawn from those where it changes most."""
_PLACES = 192
_DISTANCES = (0.4, 60.0)
"""Nearest and farthest place along a ray, in median distances to the neighbours."""
_LEAST_SEEN = 0.3
"""Share of a view's pixels that enough neighbours must see."""
_FALSE_POSES = 12
"""Views that are tried with the pose of another one."""
_FALSE_POSES_OF_ONE = 6
"""Other poses that a view is tried with before it is named."""
_MOST_USUAL = 0.5
"""Of what is left with the poses given, over what is left with false ones, where these can be told apart."""
_MOST_OTHER = 0.25
"""Share of views that can have other poses; if more seem to, poses are judged as a whole."""


@dataclass(frozen=True)
class _Thumbnail:
    """A view in few pixels."""

    camera: PosedCamera
    """With the lens of the thumbnail."""
    shown: Float64[np.ndarray, "h w F"]
    """Of each pixel what looks alike however the camera is turned: sRGB from 0 to 1 times opacity, smoothed a little
    and smoothed much, and how much it changes."""
    rows: np.ndarray
    columns: np.ndarray
    """Of the pixels that are compared."""

    @staticmethod
    def of(camera: PosedCamera, picture: Path) -> _Thumbnail:
        """Of a view's picture."""
        from PIL import Image

        with Image.open(picture) as opened:
            shrunk = min(1.0, _LONGEST_SIDE_PX / max(opened.size))
            width, height = (max(1, round(side * shrunk)) for side in opened.size)
            thumbnail = opened.convert("RGBA").resize((width, height), Image.Resampling.BOX)
        rgba = np.asarray(thumbnail, np.float64) / 255
        fine = rgba[..., :3] * rgba[..., 3:]
        for axis in (0, 1):
            fine = ndimage.uniform_filter1d(fine, 3, axis)
        coarse = ndimage.gaussian_filter(fine, (_COARSE_PX, _COARSE_PX, 0))
        slopes = np.stack([ndimage.sobel(fine, axis) for axis in (0, 1)])
        change = np.linalg.norm(slopes, axis=(0, 3)) / 8
        shown = np.dstack([fine, coarse, ndimage.gaussian_filter(change, _COARSE_PX / 2)])
        change[[0, -1]] = change[:, [0, -1]] = 0.0
        order = np.argsort(change, axis=None)[::-1]
        busy = order[: max(_PIXELS, int(_BUSIEST_SHARE * np.count_nonzero(change)))]
        chosen = np.random.default_rng(0).permutation(busy)[:_PIXELS]
        rows, columns = np.unravel_index(chosen, change.shape)
        assert camera.lens is not None
        scale = (width / camera.lens.width, height / camera.lens.height)
        lens = camera.lens.seen_as(width, height, (0.0, 0.0), scale)
        return _Thumbnail(PosedCamera(camera.camera_to_world, lens), shown, rows, columns)

    def seen_at(self, points: Float64[np.ndarray, "_ 3"]) -> Float64[np.ndarray, "_ F"]:
        """What the view shows of points; NaN where it does not see them."""
        height, width, num_features = self.shown.shape
        x, y = self.camera.pixels_of(points).T
        with np.errstate(invalid="ignore"):
            inside = (x > 0.5) & (x < width - 0.5) & (y > 0.5) & (y < height - 0.5)
        found = np.full((len(points), num_features), np.nan)
        at = np.stack([y[inside] - 0.5, x[inside] - 0.5])
        for feature in range(num_features):
            found[inside, feature] = ndimage.map_coordinates(self.shown[..., feature], at, order=1)
        return found


def views_of_other_poses(views: Sequence[SeenView]) -> dict[str, Remark]:
    """Views of one sensor's frame cameras that differ from those around them as pictures with false poses do, the worst
    first."""
    if len(views) < _LEAST_VIEWS:
        return {}
    compared = _Compared.of(views)
    differences = {view: compared.difference(view, view, ()) for view in range(len(views))}
    false = [compared.with_false_poses(view, 1) for view in evenly_spaced(len(views), _FALSE_POSES)]
    unrelated = float(np.nanmedian(false)) if np.isfinite(false).any() else 0.0
    without: list[int] = []
    while True:
        sound = {
            view: value for view, value in differences.items() if view not in without and np.isfinite(value)
        }
        if len(sound) < _LEAST_VIEWS - 1 or len(without) > _MOST_OTHER * len(views):
            return {}
        usual, worst = float(np.median([*sound.values()])), max(sound, key=lambda view: sound[view])
        most = float(np.sqrt(usual * unrelated))
        if usual > _MOST_USUAL * unrelated or sound[worst] < most:
            break
        touched = [view for view in differences if worst in compared.around(view, without)]
        without.append(worst)
        differences |= {view: compared.difference(view, view, without) for view in touched}
    found = {}
    for view in without:
        # One that was taken out early may fit those that are left; and one that agrees little with any pose, as before
        # plain surfaces, says nothing against its own.
        own, other = differences[view], compared.with_false_poses(view, _FALSE_POSES_OF_ONE, without)
        if own > max(most, np.sqrt(usual * other)):
            shares = {"off": f"{own / other:.0%}", "usual": f"{usual / unrelated:.0%}"}
            found[views[view].name] = Remark.of(Code.VIEW_OF_OTHER_POSE, [views[view].name], **shares)
    return found


@dataclass(frozen=True)
class _Compared:
    """Views that can be looked at from each other's poses."""

    thumbnails: Sequence[_Thumbnail]
    order: Sequence[Sequence[int]]
    """Of each view, the others whose cameras have moved against it, the nearest first."""

    @staticmethod
    def of(views: Sequence[SeenView]) -> _Compared:
        """Views of one sensor."""
        places = np.stack([view.position for view in views])
        moved = np.linalg.norm(places[:, None] - places, axis=-1)
        apart = distances_between([view.name for view in views], {view.name: view.camera for view in views})
        apart[moved < _LEAST_MOVED * np.median(moved)] = np.inf
        order = [
            [
                int(other)
                for other in np.argsort(row, kind="stable")
                if other != view and np.isfinite(row[other])
            ]
            for view, row in enumerate(apart)
        ]
        return _Compared([_Thumbnail.of(view.camera, view.picture) for view in views], order)

    def around(self, view: int, without: Collection[int]) -> list[int]:
        """The views that one is compared with."""
        return [other for other in self.order[view] if other not in without][:_NEIGHBOURS]

    def with_false_poses(self, view: int, count: int, without: Collection[int] = ()) -> float:
        """What is left of a view with poses of so many others, the median."""
        kept = [other for other in range(len(self.thumbnails)) if other != view and other not in without]
        drawn = np.random.default_rng(view).permutation(kept)[:count].tolist()
        return float(np.median([self.difference(view, other, without) for other in drawn]))

    def difference(self, view: int, posed_as: int, without: Collection[int]) -> float:
        """Median over a view's pixels of how far the others differ from it where they agree with it best, with the pose
        of `posed_as`; NaN where too few see what it shows."""
        own, posed = self.thumbnails[view], self.thumbnails[posed_as].camera
        others = [self.thumbnails[other] for other in self.around(posed_as, {view, *without})]
        pixels = np.column_stack([own.columns, own.rows]) + 0.5
        rays = PosedCamera(posed.camera_to_world, own.camera.lens).rays_of(pixels)
        if rays is None or len(others) < _AGREEING or not len(pixels):
            return float("nan")
        eye = posed.camera_to_world[:, 3]
        apart = [np.linalg.norm(other.camera.camera_to_world[:, 3] - eye) for other in others]
        nearest, farthest = _DISTANCES
        distances = float(np.median(apart)) / np.linspace(1 / nearest, 1 / farthest, _PLACES)
        points = eye + rays[:, None] * distances[:, None]
        shown = own.shown[own.rows, own.columns]
        seen = np.stack(
            [other.seen_at(points.reshape(-1, 3)).reshape(*points.shape[:2], -1) for other in others]
        )
        differences = np.nan_to_num(np.linalg.norm(seen - shown[:, None], axis=-1), nan=np.inf)
        best = np.sort(differences, axis=0)[:_AGREEING].mean(axis=0).min(axis=1)
        is_seen = np.isfinite(best)
        return float(np.median(best[is_seen])) if is_seen.mean() >= _LEAST_SEEN else float("nan")
