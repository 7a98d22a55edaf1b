"""Layout `rig`: band files of a multispectral camera, one TIFF for each lens and shot.

    IMG_0000_1.tif ... IMG_0000_5.tif                            MicaSense, in numbered folders
    IMG_170101_101010_0000_GRE.TIF, RED, REG, NIR (and RGB.JPG)  Parrot Sequoia
    DJI_20230101_0001_MS_G.TIF ... or DJI_0011.TIF ...           DJI

Every file is a view, with the lens as its sensor. Files of one shot share an identifier in their XMP, otherwise
their name up to the band. Pictures in colour are left out, as nothing says what their channels measure; so are thermal
bands.

Lenses are those that the camera writes into its files (tags of Pix4D's namespace, and DJI's). Their pixels have 0 at
the centre of the first pixel, ours 0.5: principal points are moved by half a pixel.
"""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import XmpTags, exif_number, tag_numbers, tag_text
from unmix_plugin.captures.cube import Capture, CaptureView, Cube, ReadOptions
from unmix_plugin.captures.layouts.transforms import Split
from unmix_plugin.captures.names import natural_order, view_names
from unmix_plugin.captures.poses.lens import Lens, Points, fit_lens, require_possible
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.errors import CaptureError, counted, name_some

_TIFF_SUFFIXES = (".tif", ".tiff")
_COLOUR_SUFFIXES = (".jpg", ".jpeg")
_THERMAL_NM = 3000.0
"""Bands from here on measure heat."""
_BAND_ENDING = re.compile(r"(?:_MS)?[_-](\d{1,2}|GRE|GREEN|RED|REG|REDEDGE|RE|NIR|BLUE|RGB|G|R|B|D|W)$", re.I)
"""Of a file's stem."""
_DJI_NUMBER = re.compile(r"(DJI_\d+)(\d)$", re.I)
"""Of a Phantom 4 Multispectral: the last digit is the band, 0 the colour picture."""
_EVAL_INTERVAL = 8
"""Every so many shots, one is for evaluation."""
_UNIQUE_TAGS = ("MicaSense:CaptureId", "CaptureUUID", "CaptureId")
_MM_OF_UNIT: dict[float, float] = {2.0: 25.4, 3.0: 10.0, 4.0: 1.0, 5.0: 1e-3}
"""Millimetres in EXIF's FocalPlaneResolutionUnit: inch, cm, mm, micrometre."""
_TAGS = "lens in the XMP"
_LONGEST_MM = 50.0
"""Focal length without a unit from which it is in pixels; these cameras have about 5 mm."""


def find_rig(root: Path, options: ReadOptions) -> Capture:
    """The views of a multispectral camera; see the module. Raises CaptureError: no band files, one can't be read, two
    of one shot are of the same lens, or files of one lens differ in size or band."""
    excluded = {path.resolve() for path in options.exclude}
    paths = [path for path in sorted(root.rglob("*")) if path.is_file() and path.resolve() not in excluded]
    paths = [path for path in paths if not any(part.startswith(".") for part in path.relative_to(root).parts)]
    kinds: dict[str, list[_BandFile]] = defaultdict(list)
    for path in paths:
        if path.suffix.lower() in _TIFF_SUFFIXES:
            item = _open_band_file(path, root)
            kinds[_kind_of(item.file, options)].append(item)
    bands = kinds["band"]
    if not bands:
        raise CaptureError(
            f"{root} holds no TIFF files of single bands, such as IMG_0000_1.tif, IMG_..._GRE.TIF or DJI_..._MS_G.TIF: "
            "give the folder of the flight, or use the layout 'cubes'"
        )
    sensors, shots = _sensor_names(bands), _shot_names(bands, str(root))
    splits = split_shots(shots)
    names = view_names([str(item.file.path.relative_to(root)) for item in bands], str(root))
    notes = []
    if kinds["thermal"]:
        notes.append(f"{counted(len(kinds['thermal']), 'thermal image')} left out")
    if kinds["broad"]:
        broad = sorted({tag_text(item.tags, "BandName") or item.ending for item in kinds["broad"]})
        images = f"{counted(len(kinds['broad']), 'image')} of bands too broad for one wavelength left out"
        notes.append(f"{images}: {', '.join(broad)}")
    if colour := len(kinds["colour"]) + sum(path.suffix.lower() in _COLOUR_SUFFIXES for path in paths):
        pictures = f"{counted(colour, 'colour picture')} left out"
        notes.append(f"{pictures}: nothing says what their channels measure")
    counts = Counter(shots)
    if incomplete := [shot for shot, count in counts.items() if count < max(counts.values())]:
        notes.append(f"{len(incomplete)} of {len(counts)} shots lack a band: {name_some(incomplete)}")
    views: list[CaptureView] = []
    missing: Counter[tuple[str, str]] = Counter()
    for item, name, sensor, shot in zip(bands, names, sensors, shots, strict=True):
        lens, why_not = lens_of(item.file)
        missing.update([(sensor, why_not)] if lens is None else [])
        views.append(CaptureView(name, item.file, sensor, lens=lens, shot=shot, split=splits[shot]))
    _check_lenses(views)
    notes += [f"lens {sensor}: {why} ({counted(n, 'file')})" for (sensor, why), n in missing.items()]
    if (given := options.bands) is not None:  # of a user, one a lens in the order of their names
        lenses = sorted({view.sensor for view in views})
        if given.num_known != len(lenses):
            named = f"{len(lenses)} lenses ({', '.join(lenses)})"
            raise CaptureError(
                f"--wavelengths gives {given.num_known} numbers for {named}; expected one a lens"
            )
        tables = {lens: given[index : index + 1] for index, lens in enumerate(lenses)}
        views = [replace(view, cube=replace(view.cube, bands=tables[view.sensor])) for view in views]
    ordered = sorted(views, key=lambda view: natural_order(view.name))
    return Capture("rig", root, tuple(ordered), notes=tuple(notes))


def _kind_of(file: Cube, options: ReadOptions) -> str:
    """`band`, or why a file is no view: `colour`, `thermal`, or `broad` where no user gives wavelengths."""
    wavelengths = file.bands.wavelengths_nm
    name = tag_text(file.camera.xmp, "BandName") or ""
    if file.shape[2] > 1:
        return "colour"
    if name.upper() == "LWIR" or (wavelengths is not None and float(wavelengths.min()) > _THERMAL_NM):
        return "thermal"
    return "broad" if options.wavelengths_nm is None and file.bands.is_broad.any() else "band"


def _check_lenses(views: Sequence[CaptureView]) -> None:
    """Refuse a lens twice in one shot, and files of one lens that differ."""
    first: dict[str, CaptureView] = {}
    taken: dict[tuple[str, str], CaptureView] = {}
    for view in views:
        other = taken.setdefault((view.shot, view.sensor), view)
        if other is not view:
            both = f"{other.cube.path} and {view.cube.path} are both the lens {view.sensor}"
            raise CaptureError(f"{both} of the shot {view.shot}; remove the copy")
        same = first.setdefault(view.sensor, view)
        tables = (same.cube.bands.wavelengths_nm, view.cube.bands.wavelengths_nm)
        centres = [None if table is None else float(table[0]) for table in tables]
        for what, expected, found in (("pixels", same.cube.shape[:2], view.cube.shape[:2]), ("nm", *centres)):
            if expected != found:
                raise CaptureError(
                    f"{view.cube.path} has {found} {what}, {same.cube.path} of the same lens {view.sensor} {expected}: "
                    "process different flights apart"
                )


@dataclass(frozen=True)
class _BandFile:
    """One file before it is a view."""

    file: Cube
    base: str
    """Name up to the band, with its folder."""
    ending: str
    """What tells the band in the name."""

    @property
    def tags(self) -> XmpTags:
        return self.file.camera.xmp


def _open_band_file(path: Path, root: Path) -> _BandFile:
    file = open_spectral_file(path)
    number = _DJI_NUMBER.fullmatch(path.stem)
    found = _BAND_ENDING.search(path.stem)
    base, ending = path.stem, ""
    if number is not None:
        base, ending = number[1], number[2]
    elif found is not None:
        base, ending = path.stem[: found.start()], found[1]
    folder = path.parent.relative_to(root)
    return _BandFile(file, str(folder / base) if folder.parts else base, ending.lower())


def _sensor_names(bands: Sequence[_BandFile]) -> list[str]:
    """Names of the lenses: the band's, with the index in the rig where several share it; or the file's ending."""
    titles = [tag_text(item.tags, "BandName") or item.ending or "band" for item in bands]
    slugs = [re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "band" for title in titles]
    indices = [tag_text(item.tags, "RigCameraIndex") or item.ending for item in bands]
    owners: dict[str, set[str]] = defaultdict(set)
    for slug, index in zip(slugs, indices, strict=True):
        owners[slug].add(index)
    return [
        slug if len(owners[slug]) == 1 else f"{slug}-{index or '0'}"
        for slug, index in zip(slugs, indices, strict=True)
    ]


def _shot_names(bands: Sequence[_BandFile], where: str) -> list[str]:
    """Names up to the band of the first file of each shot, with its folder where names repeat. Identifiers count
    where they join files; cameras that write another one into every file are grouped by name."""
    identifiers = [tag_text(item.tags, *_UNIQUE_TAGS) or "" for item in bands]
    counts = Counter(identifier for identifier in identifiers if identifier)
    keys = [
        identifier if counts[identifier] > 1 else f"name {item.base}"
        for item, identifier in zip(bands, identifiers, strict=True)
    ]
    titles = {key: item.base for key, item in reversed(list(zip(keys, bands, strict=True)))}
    repeated = {title for title, count in Counter(titles.values()).items() if count > 1}
    texts = [f"{title} {key}" if title in repeated else title for key, title in titles.items()]
    names = dict(zip(titles, view_names([f"{text}.tif" for text in texts], where), strict=True))
    return [names[key] for key in keys]


def split_shots(shots: Iterable[str]) -> dict[str, Split]:
    """One of every eight shots is for evaluation, with all its lenses: in their middle, since what the first and
    the last of a flight show no other does."""
    names = sorted(set(shots), key=natural_order)
    evaluated = names[min(_EVAL_INTERVAL, len(names)) // 2 :: _EVAL_INTERVAL]
    return {shot: "eval" if shot in evaluated else "train" for shot in names}


def lens_of(file: Cube) -> tuple[Lens | None, str]:
    """The lens of a file; None where its tags don't tell one, and why. Raises CaptureError: its model differs from
    every OPENCV lens by too much, or folds the image over."""
    tags = file.camera.xmp
    try:
        if tag_numbers(tags, "DewarpData") is not None:
            lens = _dji_lens(file, tags)
        else:
            lens = _pix4d_lens(file, tags, file.camera.exif)
        if not lens.is_possible:
            raise _NoLensError("its numbers make no sense")
    except _NoLensError as why:
        return None, f"no lens in the file's tags: {why}"
    require_possible(lens, f"{file.path}, {_TAGS}")
    return lens, ""


class _NoLensError(Exception):
    """Tags tell no lens; the text says why."""


def _pix4d_lens(file: Cube, tags: XmpTags, exif: Mapping[str, Any]) -> Lens:
    height, width = file.shape[:2]
    unit = _MM_OF_UNIT.get(exif_number(exif, "FocalPlaneResolutionUnit") or 4.0, 1.0)
    across = (exif_number(exif, "FocalPlaneXResolution") or 0.0) / unit  # pixels a millimetre
    down = (exif_number(exif, "FocalPlaneYResolution") or 0.0) / unit or across
    centre_mm = tag_numbers(tags, "Camera:PrincipalPoint")
    if across <= 0.0 or centre_mm is None or len(centre_mm) != 2:
        raise _NoLensError("principal point or focal plane resolution is absent")
    centre = (centre_mm[0] * across + 0.5, centre_mm[1] * down + 0.5)
    fisheye = tag_numbers(tags, "FisheyePolynomial")
    if fisheye is not None and (tag_text(tags, "Camera:ModelType") or "fisheye").lower() == "fisheye":
        matrix = tag_numbers(tags, "FisheyeAffineMatrix")
        if matrix is None or len(matrix) != 4:
            raise _NoLensError("FisheyeAffineMatrix is absent")
        try:
            return _fit_fisheye((width, height), tuple(fisheye), tuple(matrix), centre)
        except CaptureError as error:
            raise CaptureError(f"{file.path}, {error}") from error
    focal = tag_numbers(tags, "PerspectiveFocalLength")
    if focal is None or focal[0] <= 0.0:
        raise _NoLensError("PerspectiveFocalLength is absent")
    unit = tag_text(tags, "PerspectiveFocalLengthUnits") or ("mm" if focal[0] < _LONGEST_MM else "px")
    focal_px = (focal[0] * across, focal[0] * down) if unit == "mm" else (focal[0], focal[0])
    distortion = tag_numbers(tags, "PerspectiveDistortion") or []
    k1, k2, k3, p1, p2 = distortion if len(distortion) == 5 else [0.0] * 5
    return Lens(width, height, focal_px, centre, (k1, k2, p1, p2), (k3, 0.0))


def _dji_lens(file: Cube, tags: XmpTags) -> Lens:
    """`DewarpData`: a date; fx, fy, cx, cy, k1, k2, p1, p2, k3, where cx, cy count from the optical centre. Where
    `DewarpFlag` is not 0, the camera has taken the distortion out of its picture already."""
    height, width = file.shape[:2]
    text = (tag_text(tags, "DewarpData") or "").rpartition(";")[2]
    numbers = tag_numbers({"DewarpData": text}, "DewarpData") or []
    middle = [(tag_numbers(tags, f"CalibratedOpticalCenter{axis}") or [math.nan])[0] for axis in "XY"]
    if len(numbers) != 9 or not np.isfinite(middle).all():
        raise _NoLensError("DewarpData or CalibratedOpticalCenter is incomplete")
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    plain = Lens(width, height, (fx, fy), (middle[0] + cx + 0.5, middle[1] + cy + 0.5))
    if flag := (tag_numbers(tags, "DewarpFlag") or [0.0])[0]:
        note = f"the camera took out the distortion (DewarpFlag {flag:g}), so the lens has none"
        return replace(plain, note=note)
    return replace(plain, distortion=(k1, k2, p1, p2), higher_radial=(k3, 0.0))


@lru_cache
def _fit_fisheye(
    size: tuple[int, int],
    polynomial: tuple[float, ...],
    matrix: tuple[float, ...],
    centre: tuple[float, float],
) -> Lens:
    """Radius p0 + p1 t + p2 t^2 + p3 t^3 with t = 2/pi times the angle, then the matrix C, D; E, F. Remembered, as all
    files of a lens have the same."""
    affine, at_axis = np.array(matrix).reshape(2, 2), 2.0 / math.pi * polynomial[1]

    def project(ideal: Points) -> Points:
        radius = np.hypot(*ideal.T)
        distorted = np.polynomial.polynomial.polyval(2.0 / math.pi * np.arctan(radius), polynomial)
        ratio = np.divide(distorted, radius, out=np.full_like(radius, at_axis), where=radius > 1e-9)
        return (ideal * ratio[:, None]) @ affine.T + np.array(centre)

    focal = at_axis * np.diag(affine)
    start = Lens(*size, (float(focal[0]), float(focal[1])), centre)
    return fit_lens(project, start, "fisheye of Pix4D", _TAGS)
