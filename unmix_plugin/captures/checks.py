"""What looks wrong with a scene that is written: places of cameras, pictures, moving light, and what contradicts itself
in its values, whatever went wrong before.

*Moving light* is measured on sparse points in pairs of near views. Under fixed lamps a matt point keeps its brightness
from view to view. Lamps that move along with the camera make a pattern that stands still in the picture, bright in the
middle or towards a lamp: points that cross it get brighter on one side and darker on the other. So the logarithm of the
ratio of brightness has a slope along the direction of movement, the same in all pairs. On a ball lit from the camera
the slope, per radius and radian of movement, is about 1; lamps on both sides make it negative. Strong vignetting that
nothing corrects has a slope too.

*Exposure.* Two views from near by show about the same things. If one is brighter than the other by the same factor in
all bands, from its dark to its bright pixels, this is no shading: their exposures differ.

*Dark level.* Light adds: shading scales the spectrum of a surface, so that spectra of a scene lie in a cone from the
origin, and the flat in which they vary contains the origin. If a level is added to them all, it does not.

*Bands.* A band that differs from its neighbours by the same factor in dark and bright pixels of all materials has a
gain of its own; what a material does to one band, it does to its own pixels only.

*Masks.* If what the masks call foreground is black and what they call background has light and texture, they are the
wrong way round. A mask that covers far more or less than those of near views is suspect.

Notation: `H x W` pixels, `N` views, `P` points or pixels of one view, `B` bands; values in [0, 1] as they are written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses.pose_set import PosedCamera, angles_between_axes
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.writing.view_files import FULL_SCALE, ViewRecord
from unmix_plugin.engine.geometry.camera_paths import meeting_point
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.sampling import evenly_spaced, robust_deviation
from unmix_plugin.formats.files import hash_of
from unmix_plugin.scenes.doctor import check_copies, check_lenses, check_masks, contradicted_share
from unmix_plugin.scenes.folder import CUBE_KEY
from unmix_plugin.scenes.reading.cubes import map_array
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
    for code, counted, limit in (
        (Code.VIEWS_SATURATED, "saturated_pixels", _SATURATED_SHARE),
        (Code.VIEWS_MISSING, "missing_pixels", _MISSING_SHARE),
    ):
        shares = {view.name: getattr(view.record, counted) / view.record.num_pixels for view in views}
        many = [f"{name} ({share:.0%})" for name, share in shares.items() if share > limit]
        remarks += _of_views(code, many, limit=f"{limit:.0%}")
    remarks += _of_views(Code.VIEWS_EMPTY, [view.name for view in views if view.record.matter_share == 0.0])
    if (folding := check_lenses(_cameras(views, [1.0] * len(views)))) is not None:
        remarks.append(Remark.of(Code.CAPTURE_WARNING, text=folding.sentence()))
    remarks += [*_ring(views), *_overlap(views, points)]

    detail = {view.name: view.record.detail for view in views}
    usual = float(np.median([*detail.values()]))
    if len(views) < _LEAST_VIEWS or usual <= 0:
        remarks.append(Remark.of(Code.BLUR_UNJUDGED))
    else:
        less = {name: own / usual for name, own in detail.items() if own < _BLURRED * usual}
        blurred = [f"{name} ({share:.0%} of the usual detail)" for name, share in less.items()]
        remarks += [
            Remark.of(Code.DETAIL, detail=f"{usual:.2f}"),
            *_of_views(Code.VIEWS_LESS_SHARP, blurred),
        ]
    return [*remarks, *_brightness_of_points(views, points), *_masks(views)]


def find_copies(views: Sequence[SeenView], scene: Path) -> list[Remark]:
    """Views with the values of another one as they are written, of those that show anything; hashed are those alone
    that their records can't tell apart.

    Args:
        scene: Folder of the scene.
    """
    views = [view for view in views if view.record.matter_share > 0.0]
    measured = [(view.record.mean_spectrum, view.record.brightness, view.record.detail) for view in views]
    contents = [
        hash_of(scene / view.record.paths[CUBE_KEY]) if measured.count(own) > 1 else view.name
        for view, own in zip(views, measured, strict=True)
    ]
    poses = np.array([view.camera.camera_to_world for view in views], np.float64).reshape(-1, 3, 4)
    found = check_copies([view.name for view in views], contents, poses)
    return [Remark.of(Code.CAPTURE_WARNING, text=one.sentence()) for one in found]


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


def _of_views(code: Code, names: Sequence[str], **values: str) -> list[Remark]:
    """A remark that names the views that it is about, if there are any."""
    return [Remark.of(code, views=len(names), named=[*names], **values)] if names else []


def angles_between(views: Sequence[SeenView]) -> Float64[np.ndarray, "N N"]:
    """Angles between optical axes, degrees."""
    return np.degrees(angles_between_axes([view.camera for view in views]))


def _ring(views: Sequence[SeenView]) -> list[Remark]:
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


def _brightness_of_points(views: Sequence[SeenView], points: _Points | None) -> list[Remark]:
    """Views whose sparse points are brighter or darker than the same points in the views nearest to them; and whether
    the light moves with the camera, as on a turntable: by the median slope of all pairs of near views and its standard
    error."""
    count = 0 if points is None else len(points)
    exposure, light = Remark.of(Code.BRIGHTNESS_WITHOUT_POINTS), Remark.of(Code.LIGHT_UNMEASURED)
    if points is None or count < _LEAST_SHARED_POINTS:
        return [exposure, light]
    angles, remarks = angles_between(views), [exposure]
    if len(views) >= _LEAST_VIEWS:
        before = [view._has_before_it(points) for view in views]
        gains = np.full(len(views), np.nan)  # logarithms, against the views around
        for index, view in enumerate(views):
            ratios = []
            for other in np.argsort(angles[index] + 360.0 * (np.arange(len(views)) == index))[:_NEIGHBOURS]:
                shared = points[before[index] & before[other]]
                found = view._log_brightness_of(shared) - views[other]._log_brightness_of(shared)
                found = found[np.isfinite(found)]
                if len(found) >= _LEAST_SHARED_POINTS // 2:
                    ratios.append(float(np.median(found)))
            if len(ratios) >= 2:
                gains[index] = np.median(ratios)
        remarks = [Remark.of(Code.BRIGHTNESS_OF_FEW_POINTS)]
        if not np.isnan(gains).any():
            usual = float(robust_deviation(gains))
            jumps = [
                f"{view.name} ({np.exp(gain):.2f} times as bright)"
                for view, gain in zip(views, gains, strict=True)
                if abs(gain) > max(_JUMP, _JUMP_DEVIATIONS * usual)
            ]
            deviation = Remark.of(Code.BRIGHTNESS, deviation=f"{np.expm1(usual):.0%}")
            remarks = [deviation, *_of_views(Code.VIEWS_JUMP, jumps)]

    low, high = _PAIR_ANGLES_DEG
    pairs = (
        np.argwhere((angles >= low) & (angles <= high)) if count >= _LEAST_PAIR_POINTS else np.zeros((0, 2))
    )
    pairs = pairs[:: max(1, len(pairs) // _MOST_PAIRS)].tolist()
    found = [_slope(views[int(first)], views[int(second)], points) for first, second in pairs]
    slopes = np.array([slope for slope in found if slope is not None])
    if len(slopes) < _LEAST_PAIRS:
        return [*remarks, light]
    slope = float(np.median(slopes))
    error = 1.2533 * float(robust_deviation(slopes)) / float(np.sqrt(len(slopes)))
    facts = {"slope": f"{slope:.2f}", "error": f"{error:.2f}", "pairs": len(slopes)}
    moves = abs(slope) > max(_LEAST_SLOPE, _CERTAINTY * error)
    return [*remarks, *(Remark(code, facts) for code in (Code.LIGHT, *[Code.LIGHT_MOVES] * moves))]


def _slope(first: SeenView, second: SeenView, points: _Points) -> float | None:
    """Slope of log brightness along the direction in which the camera moves, per radius and radian."""
    points = points[first._has_before_it(points) & second._has_before_it(points)]
    before = first._pixels_of(points)
    ratio = second._log_brightness_of(points) - first._log_brightness_of(points)
    turned = (second.position - first.position) @ first.camera.camera_to_world[:, :3]
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
    return float(np.polyfit((along - middle) / radius, ratio[good], 1)[0] / angle)


_LONGEST_MASK_PX, _MOST_MASKS = 160, 60
"""Pixels of a mask along its longer side, and masks, that are compared."""


def _masks(views: Sequence[SeenView]) -> list[Remark]:
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


# Values.

_MOST_UNREAD, _HEADER_BYTES = 2.5, 20_000
"""Bytes of a file over those of the numbers taken from it, and beyond them, that leave nothing of weight unread."""
_CHOOSING_LAYOUTS = ("nespof", "nespof-real")
"""Layouts that take one channel of several on purpose."""
_WIDE_NM = 200.0
"""Of a band, full width at half maximum; panchromatic ones have 400 and more."""
_SIDE = 48
"""Of the grid of pixels that are looked at."""
_LEAST_PIXELS = 200
_PERCENTILES = (10, 25, 50, 75, 90)
_NEAR = 4
_STEP, _UNLIKE = 0.1, 0.2
"""Logarithm of a ratio of brightness that counts, and how much it may vary over bands and percentiles, as a share of
itself. Views of rendered scenes from near by vary by 0.37 and more where they differ by so much."""
_BLACK = 1e-3
"""Median of a view's values below which it shows nothing."""
_LEAST_BANDS = 5
_MOST_WAYS, _UNEXPLAINED = 8, 0.02
"""In which spectra vary: dimensions of the flat, and the share of their variance that it may leave."""
_OFF_FLAT = 3.0
"""Distance of the origin from the flat, in standard deviations of a spectrum from it; right scenes have 1.8 at most."""
_LEAST_LEVEL = 0.002
"""The same, as a share of the mean spectrum."""
_BAND_GAIN, _BAND_DEVIATIONS, _PIXEL_DEVIATIONS = 0.15, 5.0, 2.5
"""Logarithm of a band over what its neighbours say, also in standard deviations over bands and over pixels."""
_GAP = 3.0
"""Step between bands, over the usual one, beyond which nothing follows from neighbours."""
_MOST_ODD = 5
"""Bands of which each may have a gain of its own."""
_BLACK_SHARE, _TEXTURE = 0.1, 0.3
"""Brightness of the foreground over that of the background, and spread of the background, from which masks are
inverted."""
_FILLED = 0.9
"""Share of the border that is foreground, and of the middle that is none, from which they may be."""
_OTHER_COVER = 0.3
"""Share of a view by which its mask may differ from those of near views."""


def check_files(views: Sequence[CaptureView], options: ProcessOptions) -> list[Remark]:
    """Files of which most was not read, and bands that are too wide for one wavelength."""
    unread: list[str] = []
    wide: dict[float, float] = {}
    for view in views:
        cube, bands = view.cube, view.cube.bands
        size = sum(path.stat().st_size for path in cube.files if path.is_file())
        if size > _MOST_UNREAD * np.prod(cube.shape) * cube.dtype.itemsize + _HEADER_BYTES:
            unread.append(f"{cube.path.name} ({cube.shape[2]} bands of {size / 1e6:.1f} MB)")
        if bands.wavelengths_nm is not None and bands.fwhm_nm is not None:
            pairs = zip(bands.wavelengths_nm, bands.fwhm_nm, strict=True)
            wide |= {nm: width for nm, width in pairs if width > _WIDE_NM}
    remarks = []
    if unread and options.dataset is None and options.layout not in _CHOOSING_LAYOUTS:
        remarks.append(Remark.of(Code.FILES_PARTLY_READ, files_read=len(unread), named=", ".join(unread[:3])))
    if wide:
        named = [f"{nm:g} nm ({width:.0f} nm wide)" for nm, width in wide.items()]
        remarks.append(Remark.of(Code.BANDS_WIDE, bands=len(wide), named=named))
    return remarks


@dataclass(frozen=True)
class ViewSample:
    """Some pixels of a view that show foreground and are measured."""

    record: ViewRecord
    spectra: Float32[np.ndarray, "P B"]
    is_hollow: bool = False
    """Whether the foreground fills the border of the picture and leaves out its middle."""

    @staticmethod
    def of(record: ViewRecord, scene: Path) -> ViewSample:
        """Pixels on a grid; saturated ones are left out."""
        cube = map_array(scene / record.paths["hyperspectral_file_path"])
        rows, columns = (np.unique(np.linspace(0, side - 1, _SIDE).astype(int)) for side in cube.shape[:2])
        grid = np.ix_(rows, columns)
        stored = np.stack([cube[row][columns] for row in rows])
        foreground, measured = (mask[grid] for mask in record.read_masks(scene))
        border = np.concatenate([foreground[0], foreground[-1], foreground[:, 0], foreground[:, -1]])
        third = [slice(side // 3, side - side // 3) for side in foreground.shape]
        is_hollow = bool(border.mean() > _FILLED and foreground[third[0], third[1]].mean() < 1.0 - _FILLED)
        kept = foreground & measured & np.all(stored < FULL_SCALE, axis=-1)
        return ViewSample(record, stored[kept].astype(np.float32) / FULL_SCALE, is_hollow)


def check_values(
    samples: Sequence[ViewSample],
    angles_deg: Float64[np.ndarray, "N N"],
    wavelengths_nm: Float64[np.ndarray, " B"],
) -> list[Remark]:
    """What contradicts itself in the views of one sensor.

    Args:
        angles_deg: Between their axes.
    """
    spectra = np.concatenate([sample.spectra for sample in samples]).astype(np.float64)
    remarks = _exposure_steps(samples, angles_deg)
    if spectra.shape[1] >= _LEAST_BANDS and len(spectra) >= _LEAST_PIXELS:
        remarks += _dark_level(spectra)
        if odd := _odd_bands(spectra, wavelengths_nm):
            named = [f"{wavelengths_nm[band]:g} nm ({np.exp(gain):.2f} times)" for band, gain in odd.items()]
            remarks.append(Remark.of(Code.BANDS_ODD, bands=len(odd), named=", ".join(named)))

    records = [sample.record for sample in samples]
    inverted = [
        record.name
        for record in records
        if record.matter_share > 0
        and record.background_brightness > 0
        and record.brightness < _BLACK_SHARE * record.background_brightness
        and record.background_spread > _TEXTURE
    ]
    hollow = [sample.record.name for sample in samples if sample.is_hollow]
    if not inverted and 2 * len(hollow) > len(samples):
        remarks += _of_views(Code.MASKS_HOLLOW, hollow)
    remarks += _of_views(Code.MASKS_INVERTED, inverted)
    shares, off = np.array([record.matter_share for record in records]), []
    if len(shares) > _NEAR and np.ptp(shares) > 0:
        for view, share in enumerate(shares):
            near = [other for other in np.argsort(angles_deg[view]) if other != view][:_NEAR]
            if abs(share - np.median(shares[near])) > max(_OTHER_COVER, 2 * float(np.ptp(shares[near]))):
                off.append(f"{records[view].name} ({share:.0%}, near ones {np.median(shares[near]):.0%})")
    return [*remarks, *_of_views(Code.MASKS_UNLIKE, off)]


def _exposure_steps(samples: Sequence[ViewSample], angles_deg: Float64[np.ndarray, "N N"]) -> list[Remark]:
    """Pairs of near views of which one is brighter by the same factor everywhere."""
    usable = [
        index
        for index, sample in enumerate(samples)
        if len(sample.spectra) >= _LEAST_PIXELS and np.median(sample.spectra) > _BLACK
    ]
    if len(usable) < 2 or samples[usable[0]].spectra.shape[1] < 3:
        return []
    percentiles = {index: np.percentile(samples[index].spectra, _PERCENTILES, axis=0) for index in usable}
    levels = {index: np.log(np.maximum(numbers, 1e-5)) for index, numbers in percentiles.items()}
    steps: dict[tuple[int, int], float] = {}
    for view in usable:
        others = sorted((other for other in usable if other != view), key=lambda at: angles_deg[view, at])
        for other in others[:_NEAR]:
            ratios = levels[other] - levels[view]
            step = float(np.median(ratios))
            spread = float(robust_deviation(ratios))
            if step > _STEP and spread < _UNLIKE * step:
                steps[view, other] = step
    if not steps:
        return []
    names = [
        f"{samples[second].record.name} is {np.exp(step):.2f} times as bright as {samples[first].record.name}"
        for (first, second), step in sorted(steps.items(), key=lambda item: -item[1])
    ]
    concerned = {view for pair in steps for view in pair}
    return [Remark.of(Code.EXPOSURE_STEPS, views=len(concerned), pairs="; ".join(names[:3]))]


def _dark_level(spectra: Float64[np.ndarray, "P B"]) -> list[Remark]:
    """Whether a level is added to all spectra."""
    mean = spectra.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov(spectra.T))
    variances, axes = np.clip(variances[::-1], 0.0, None), axes[:, ::-1]
    size = float(np.linalg.norm(mean))
    worst, off, rank = 0.0, 0.0, 0
    # How many ways the spectra vary in is not known: a level is outside of all flats that explain nearly everything.
    for count in range(1, min(_MOST_WAYS, len(mean) - 3) + 1):
        flat, rest = axes[:, :count], float(variances[count:].sum())
        if rest > _UNEXPLAINED * variances.sum() or rest <= 0 or size <= 0:
            continue
        away = float(np.linalg.norm(mean - flat @ (flat.T @ mean)))
        usual = float(np.sqrt(len(mean) * rest / (len(mean) - count)))
        if away / usual > worst:
            worst, off, rank = away / usual, away / size, count
    if worst < _OFF_FLAT or off < _LEAST_LEVEL:
        return []
    return [Remark.of(Code.LEVEL_ADDED, rank=rank, share=f"{off:.1%}", times=f"{worst:.0f}")]


def _odd_bands(
    spectra: Float64[np.ndarray, "P B"], wavelengths_nm: Float64[np.ndarray, " B"]
) -> dict[int, float]:
    """Bands with a gain of their own, and the logarithm of it: that by which a band stands out from a smooth course
    through those around it.

    A gain of one band shows as +1 there and as -1/2 at both neighbours. It is 0 at the two bands of either end and
    beside a gap, of which not all neighbours are known.
    """
    grey = spectra.mean(axis=1)
    logs = np.log(np.maximum(spectra[grey > np.median(grey)], 1e-5))
    low, middle, high = wavelengths_nm[:-2], wavelengths_nm[1:-1], wavelengths_nm[2:]
    part, steps = (middle - low) / (high - low), np.diff(wavelengths_nm)
    found: dict[int, float] = {}
    for _ in range(_MOST_ODD):
        curvatures, excess = np.zeros_like(logs), np.zeros_like(logs)
        curvatures[:, 1:-1] = logs[:, 1:-1] - logs[:, :-2] * (1 - part) - logs[:, 2:] * part
        excess[:, 2:-2] = (curvatures[:, 2:-2] - 0.5 * (curvatures[:, 1:-3] + curvatures[:, 3:-1])) / 1.5
        for step in np.flatnonzero(steps > _GAP * np.median(steps)):
            excess[:, max(0, step - 1) : step + 3] = 0.0
        gains = np.median(excess, axis=0)
        spreads = robust_deviation(excess, axis=0)
        usual = float(robust_deviation(gains))
        band = int(np.argmax(np.abs(gains)))
        limit = max(_BAND_GAIN, _BAND_DEVIATIONS * usual, _PIXEL_DEVIATIONS * float(spreads[band]))
        if band in found or abs(gains[band]) < limit:
            break
        found[band] = float(gains[band])
        logs[:, band] -= gains[band]  # it disturbs what its neighbours are compared with
    return found
