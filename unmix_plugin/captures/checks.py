"""What looks wrong with a scene that is written: places of cameras, pictures, exposure, moving light.

*Moving light* is measured on sparse points in pairs of near views. Under fixed lamps a matt point keeps its brightness
from view to view. Lamps that move along with the camera make a pattern that stands still in the picture, bright in the
middle or towards a lamp: points that cross it get brighter on one side and darker on the other. So the logarithm of the
ratio of brightness has a slope along the direction of movement, the same in all pairs. On a ball lit from the camera
the slope, per radius and radian of movement, is about 1; lamps on both sides make it negative. Strong vignetting that
nothing corrects has a slope too.

Notation: `H x W` pixels, `N` views, `P` points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.poses.pose_set import PosedCamera, angles_between_axes
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.writing.view_files import ViewRecord
from unmix_plugin.engine.geometry.camera_paths import meeting_point
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.sampling import evenly_spaced, robust_deviation
from unmix_plugin.scenes.doctor import check_lenses, check_masks, contradicted_share
from unmix_plugin.spectral.colour.srgb import decode_srgb

_FEW_VIEWS = 15
_NARROW_DEG = 12.0
"""Cameras that are all within this range of elevation see the object from one height only."""
_WIDE_RING_DEG = 180.0
"""Part of a circle from which a ring counts as one."""
_GAP_DEG = 75.0
_LINES_ASKED = 16
"""Of a scan, poses that stand for all of its lines."""
_LEAST_OVERLAP = 0.4
"""Share of a view that another one should see too."""
_FAR_NEIGHBOUR_DEG = 35.0
_SATURATED_SHARE, _MISSING_SHARE = 0.01, 0.05
_BLURRED = 0.6
"""Detail of a view against the median of all, below which it is blurred."""
_LEAST_VIEWS = 4
"""That blur and exposure are compared among."""
_JUMP, _JUMP_DEVIATIONS = 0.15, 4.0
"""Logarithm of a gain against the others that counts as a jump, also as a multiple of the usual deviation."""
_LEAST_SHARED_POINTS = 50
_NEIGHBOURS = 6
"""Views that one is compared with: the nearest."""
_PAIR_ANGLES_DEG = (4.0, 25.0)
"""Between the views of a pair in which moving light is measured."""
_LEAST_PAIR_POINTS, _LEAST_PAIRS, _MOST_PAIRS = 60, 6, 200
_MOST_CHANGE = 0.7
"""Logarithm of a ratio beyond which a pixel shows another surface."""
_LEAST_SLOPE, _CERTAINTY = 0.15, 4.0
"""Slopes below, up or down, count as none; standard errors of the slope that are beyond doubt."""

_Points = Float64[np.ndarray, "P 3"]


@dataclass(frozen=True)
class SeenView:
    """One view of a scene that is written."""

    record: ViewRecord
    camera: PosedCamera
    """With the lens of the picture."""
    picture: Path

    @property
    def name(self) -> str:
        """Of the view."""
        return self.record.name

    @property
    def position(self) -> Float64[np.ndarray, "3"]:
        """Of the camera."""
        return self.camera.camera_to_world[:, 3]

    @property
    def axis(self) -> Float64[np.ndarray, "3"]:
        """Unit vector along which the camera looks."""
        return -self.camera.camera_to_world[:, 2]

    @cached_property
    def _luminance(self) -> Float32[np.ndarray, "H W"]:
        """Linear luminance of the picture, smoothed over 3 x 3 pixels; NaN where the view shows nothing."""
        from PIL import Image
        from scipy import ndimage

        with Image.open(self.picture) as picture:
            pixels = np.asarray(picture.convert("RGBA"))
        light = decode_srgb(np.arange(256) / 255.0)[pixels[..., :3]] @ np.array([0.2126, 0.7152, 0.0722])
        smooth = ndimage.uniform_filter(light, 3)
        return np.where(pixels[..., 3] > 127, smooth, np.nan).astype(np.float32)

    def _pixels_of(self, points: _Points) -> Float64[np.ndarray, "P 2"]:
        """Where points are seen, x and y in pixels; NaN outside the picture or behind the camera."""
        assert self.camera.lens is not None
        found = self.camera.pixels_of(points)
        x, y = found.T
        inside = (x >= 0) & (x < self.camera.lens.width) & (y >= 0) & (y < self.camera.lens.height)
        found[~inside] = np.nan  # comparisons are false for NaN
        return found

    def _has_before_it(self, points: _Points) -> Bool[np.ndarray, " P"]:
        """Points nearer to the camera than the middle of all: those behind it are mostly hidden."""
        distances = np.linalg.norm(points - self.position, axis=1)
        return distances < np.linalg.norm(np.median(points, axis=0) - self.position)

    def _log_brightness_of(self, points: _Points) -> Float64[np.ndarray, " P"]:
        """Logarithm of the luminance at points; not finite where they are not seen."""
        pixels = self._pixels_of(points)
        found = np.full(len(pixels), np.nan)
        inside = np.isfinite(pixels).all(axis=1)
        columns, rows = np.floor(pixels[inside]).astype(int).T
        found[inside] = self._luminance[rows, columns]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(found)


def check_views(views: Sequence[SeenView], points: _Points | None) -> list[Remark]:
    """What looks wrong with the views of one sensor, and what was measured, with the sparse points, if there are
    any."""
    remarks = []
    if len(views) < _FEW_VIEWS:
        remarks.append(Remark.of(Code.FEW_VIEWS, views=len(views), enough=_FEW_VIEWS))
    remarks += _pixels(views)
    if (folding := check_lenses(_cameras(views, [1.0] * len(views)))) is not None:
        remarks.append(Remark.of(Code.CAPTURE_WARNING, text=folding.sentence()))
    for check in (_ring, _overlap, _blur, _exposure, _moving_light, _masks):
        remarks += check(views, points)
    return remarks


def _cameras(views: Sequence[SeenView], scales: Sequence[float]) -> Cameras:
    """Their cameras, of pictures scaled by these factors."""
    import torch

    poses, numbers, sizes = [], [], []
    for view, scale in zip(views, scales, strict=True):
        lens = view.camera.lens
        assert lens is not None
        size = (max(1, round(scale * lens.width)), max(1, round(scale * lens.height)))
        shrunk = np.array(size) / (lens.width, lens.height)
        focal, center = np.array(lens.focal_px) * shrunk, np.array(lens.center_px) * shrunk
        numbers.append([*focal, *center, *lens.distortion, *lens.higher_radial])
        poses.append(view.camera.camera_to_world)
        sizes.append(size)
    focal, center, distortion = torch.tensor(np.array(numbers), dtype=torch.float32).split((2, 2, 6), dim=1)
    keys = None
    if any(view.camera.lines is not None for view in views):
        parts = [view.camera.key_poses for view in views]
        keys = KeyPoses.join(
            [replace(part, heights=part.heights * scale) for part, scale in zip(parts, scales, strict=True)]
        )
        keys = KeyPoses(keys.poses.float(), keys.heights.float(), keys.counts)
    poses = torch.from_numpy(np.stack(poses)).float()
    return Cameras.of_sizes(poses, focal, center, distortion, sizes, keys)


def angles_between(views: Sequence[SeenView]) -> Float64[np.ndarray, "N N"]:
    """Angles between optical axes, degrees."""
    return np.degrees(angles_between_axes([view.camera for view in views]))


def _pixels(views: Sequence[SeenView]) -> list[Remark]:
    """Views with many saturated or missing pixels, or without foreground."""
    remarks = []
    for code, field, limit in (
        (Code.VIEWS_SATURATED, "saturated_pixels", _SATURATED_SHARE),
        (Code.VIEWS_MISSING, "missing_pixels", _MISSING_SHARE),
    ):
        shares = {view.name: getattr(view.record, field) / view.record.num_pixels for view in views}
        many = [f"{name} ({share:.0%})" for name, share in shares.items() if share > limit]
        remarks += _of_views(code, many, limit=f"{limit:.0%}")
    return remarks + _of_views(
        Code.VIEWS_EMPTY, [view.name for view in views if view.record.matter_share == 0.0]
    )


def _of_views(code: Code, names: Sequence[str], **values: str) -> list[Remark]:
    """A remark that names the views that it is about, if there are any."""
    return [Remark.of(code, views=len(names), named=[*names], **values)] if names else []


def _ring(views: Sequence[SeenView], _: _Points | None) -> list[Remark]:
    """From which sides the cameras look, line cameras at several lines, and what is missing."""
    poses = np.concatenate(
        [
            view.camera.camera_to_world[None]
            if view.camera.lines is None
            else view.camera.lines[evenly_spaced(len(view.camera.lines), _LINES_ASKED)]
            for view in views
        ]
    )
    focus = meeting_point(poses)
    if focus is None:
        return [Remark.of(Code.SIDES_UNJUDGED)]
    directions = poses[:, :, 3] - focus
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    elevation = np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    azimuth = np.sort(np.degrees(np.arctan2(directions[:, 1], directions[:, 0])))
    gap = float(np.diff(azimuth, append=azimuth[0] + 360.0).max())
    around, height = 360.0 - gap, float(np.ptp(elevation))
    ends = {"lowest": f"{elevation.min():.0f}", "highest": f"{elevation.max():.0f}"}
    remarks = [Remark.of(Code.SIDES, around=f"{around:.0f}", **ends)]
    if height < _NARROW_DEG and around > _WIDE_RING_DEG:
        remarks.append(Remark.of(Code.NARROW_RING, height=f"{height:.0f}"))
    if around > _WIDE_RING_DEG and gap > _GAP_DEG:
        remarks.append(Remark.of(Code.GAP_IN_RING, gap=f"{gap:.0f}"))
    return remarks


def _overlap(views: Sequence[SeenView], points: _Points | None) -> list[Remark]:
    """Whether each view shows something that another view shows from a similar side.

    A grid of rays of each view is followed to the depth of the middle of the scene: where the cameras look, or that of
    the sparse points if they look at no one place. What other cameras see of these places is the overlap, if they look
    from within 35 degrees. Of line cameras nothing is said.
    """
    if any(view.camera.lines is not None for view in views):
        return []
    poses = np.stack([view.camera.camera_to_world for view in views])
    focus = meeting_point(poses)
    if focus is None and points is not None and len(points):
        focus = np.median(points, axis=0)
    if focus is None or len(views) < 2:
        return [Remark.of(Code.OVERLAP_UNJUDGED)]
    between = angles_between(views)
    shares = np.zeros(len(views))
    nearest = np.zeros(len(views))
    for index, view in enumerate(views):
        lens = view.camera.lens
        assert lens is not None
        steps = (np.arange(8) + 0.5) / 8
        x, y = np.meshgrid(steps * lens.width, steps * lens.height)
        rays = view.camera.rays_of(np.column_stack([x.ravel(), y.ravel()]))
        rays = view.axis[None] if rays is None else rays
        depth = max(float((focus - view.position) @ view.axis), 1e-9)
        places = view.position + depth * rays / (rays @ view.axis)[:, None]
        angles = np.where(np.arange(len(views)) == index, np.inf, between[index])
        nearest[index] = angles.min()
        near = np.argsort(angles)[: min(6, len(views) - 1)]
        near = near[angles[near] <= _FAR_NEIGHBOUR_DEG]
        seen = [np.isfinite(views[other]._pixels_of(places)).all(axis=1).mean() for other in near]
        shares[index] = max(seen, default=0.0)
    alone = [index for index in range(len(views)) if shares[index] < _LEAST_OVERLAP]
    overlap = {"usual": f"{np.median(shares):.0%}", "least": f"{shares.min():.0%}"}
    angles_away = {"angle": f"{np.median(nearest):.0f}", "most": f"{nearest.max():.0f}"}
    names = [views[index].name for index in alone]
    best, angle = f"{shares[alone].max(initial=0):.0%}", f"{nearest[alone].min(initial=180):.0f}"
    return [
        Remark.of(Code.OVERLAP, **overlap, **angles_away),
        *_of_views(Code.VIEWS_ALONE, names, share=best, angle=angle),
    ]


def _blur(views: Sequence[SeenView], _: _Points | None) -> list[Remark]:
    """Views with less fine detail than the others."""
    details = np.array([view.record.detail for view in views])
    middle = float(np.median(details))
    if len(views) < _LEAST_VIEWS or middle <= 0:
        return [Remark.of(Code.BLUR_UNJUDGED)]
    blurred = [
        f"{view.name} ({detail / middle:.0%} of the usual detail)"
        for view, detail in zip(views, details, strict=True)
        if detail < _BLURRED * middle
    ]
    detail = Remark.of(Code.DETAIL, detail=f"{middle:.2f}")
    return [detail, *_of_views(Code.VIEWS_LESS_SHARP, blurred)]


def _exposure(views: Sequence[SeenView], points: _Points | None) -> list[Remark]:
    """Views whose sparse points are brighter or darker than the same points in the views nearest to them."""
    if points is None or len(points) < _LEAST_SHARED_POINTS or len(views) < _LEAST_VIEWS:
        return [Remark.of(Code.BRIGHTNESS_WITHOUT_POINTS)]
    angles = angles_between(views) + 360.0 * np.eye(len(views))
    before = [view._has_before_it(points) for view in views]
    gains = np.full(len(views), np.nan)  # logarithms, against the views around
    for index, view in enumerate(views):
        ratios = []
        for other in np.argsort(angles[index])[:_NEIGHBOURS]:
            shared = points[before[index] & before[other]]
            found = view._log_brightness_of(shared) - views[other]._log_brightness_of(shared)
            found = found[np.isfinite(found)]
            if len(found) >= _LEAST_SHARED_POINTS // 2:
                ratios.append(float(np.median(found)))
        if len(ratios) >= 2:
            gains[index] = np.median(ratios)
    if np.isnan(gains).any():
        return [Remark.of(Code.BRIGHTNESS_OF_FEW_POINTS)]
    usual = float(robust_deviation(gains))
    jumps = [
        f"{view.name} ({np.exp(gain):.2f} times as bright)"
        for view, gain in zip(views, gains, strict=True)
        if abs(gain) > max(_JUMP, _JUMP_DEVIATIONS * usual)
    ]
    deviation = Remark.of(Code.BRIGHTNESS, deviation=f"{np.expm1(usual):.0%}")
    return [deviation, *_of_views(Code.VIEWS_JUMP, jumps)]


def _moving_light(views: Sequence[SeenView], points: _Points | None) -> list[Remark]:
    """Whether the light moves with the camera, as on a turntable: by the median slope of all pairs of near views and
    its standard error."""
    if points is None or len(points) < _LEAST_PAIR_POINTS:
        return [Remark.of(Code.LIGHT_UNMEASURED)]
    angles, (low, high) = angles_between(views), _PAIR_ANGLES_DEG
    pairs = np.argwhere((angles >= low) & (angles <= high))
    pairs = pairs[:: max(1, len(pairs) // _MOST_PAIRS)]
    found = [_slope(views[first], views[second], points) for first, second in pairs.tolist()]
    slopes = np.array([slope for slope in found if slope is not None])
    if len(slopes) < _LEAST_PAIRS:
        return [Remark.of(Code.LIGHT_UNMEASURED)]
    slope = float(np.median(slopes))
    error = 1.2533 * float(robust_deviation(slopes)) / float(np.sqrt(len(slopes)))
    facts = {"slope": f"{slope:.2f}", "error": f"{error:.2f}", "pairs": len(slopes)}
    moves = abs(slope) > max(_LEAST_SLOPE, _CERTAINTY * error)
    return [Remark(code, facts) for code in (Code.LIGHT, *[Code.LIGHT_MOVES] * moves)]


def _slope(first: SeenView, second: SeenView, points: _Points) -> float | None:
    """Slope of log brightness along the direction in which the camera moves, per radius and radian."""
    points = points[first._has_before_it(points) & second._has_before_it(points)]
    before = first._pixels_of(points)
    ratio = second._log_brightness_of(points) - first._log_brightness_of(points)
    rotation = first.camera.camera_to_world[:, :3]
    turned = (second.position - first.position) @ rotation
    direction = np.array([turned[0], -turned[1]])
    length = float(np.linalg.norm(direction))
    good = np.isfinite(ratio) & (np.abs(ratio) < _MOST_CHANGE)
    if good.sum() < _LEAST_PAIR_POINTS or length == 0.0:
        return None
    along = before[good] @ (direction / length)
    middle = np.median(along)
    radius = float(np.percentile(np.abs(along - middle), 95))
    if radius == 0.0:
        return None
    angle = float(np.arccos(np.clip(first.axis @ second.axis, -1.0, 1.0)))
    slope = np.polyfit((along - middle) / radius, ratio[good], 1)[0]
    return float(slope / angle)


_LONGEST_MASK_PX, _MOST_MASKS = 160, 60
"""Pixels of a mask along its longer side, and masks, that are compared."""


def _masks(views: Sequence[SeenView], _: _Points | None) -> list[Remark]:
    """Whether what masks show is there for the other views: a wall that is cut out as backdrop in some views and not
    in others is not."""
    from PIL import Image

    some = [views[index] for index in evenly_spaced(len(views), _MOST_MASKS)]
    if len(some) < _LEAST_VIEWS or all(view.record.matter_share == 1.0 for view in some):
        return [Remark.of(Code.MASKS_UNCOMPARED)]
    scales = [
        min(1.0, _LONGEST_MASK_PX / max(lens.width, lens.height))
        for lens in (view.camera.lens for view in some)
        if lens is not None
    ]
    cameras = _cameras(some, scales)
    shown = []
    for index, view in enumerate(some):
        with Image.open(view.picture) as picture:
            opacity = (
                picture.convert("RGBA").getchannel("A").resize(cameras.size(index), Image.Resampling.BOX)
            )
        shown.append(np.asarray(opacity) > 127)
    share = contradicted_share(cameras, shown)[1]
    remarks = [Remark.of(Code.MASKS_COMPARED, share=f"{share:.1%}")]
    if (found := check_masks(share)) is not None:
        advice = (
            "Look at contact-sheet.png: walls or ground may be cut out as a backdrop in parts (--mask none keeps "
            "everything), or poses are off"
        )
        remarks.append(Remark.of(Code.CAPTURE_WARNING, text=found.sentence(advice)))
    return remarks
