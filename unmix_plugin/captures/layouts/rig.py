"""Layout `rig`: band files of a multispectral camera, one TIFF for each lens and release of the shutter.

    IMG_0000_1.tif ... IMG_0000_5.tif                            MicaSense, in numbered folders
    IMG_170101_101010_0000_GRE.TIF, RED, REG, NIR (and RGB.JPG)  Parrot Sequoia
    DJI_20230101_0001_MS_G.TIF ... or DJI_0011.TIF ...           DJI

Every file is a view, with the lens as its sensor. Files of one release share an identifier in their XMP, otherwise
their name up to the band. Pictures in colour are left out, as nothing says what their channels measure; so are thermal
bands.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.camera_tags import exif_number, tag_text
from unmix_plugin.captures.capture import Capture, CaptureView
from unmix_plugin.captures.layouts.found_files import view_names
from unmix_plugin.captures.layouts.registry import LayoutOptions
from unmix_plugin.captures.layouts.rig_files import (
    BandFile,
    open_band_file,
    release_names,
    sensor_names,
    splits_of,
)
from unmix_plugin.captures.rigs.lens_tags import lens_of
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile
from unmix_plugin.errors import CaptureError, counted

TIFF_SUFFIXES = (".tif", ".tiff")
COLOUR_SUFFIXES = (".jpg", ".jpeg")
THERMAL_NM = 3000.0
"""Bands from here on measure heat."""


def find_rig(root: Path, options: LayoutOptions) -> Capture:
    """The views of a multispectral camera; see the module.

    Raises:
        CaptureError: no band files, one can't be read, two of one release are of the same lens, or files of one lens
            differ in size or band.
    """
    excluded = {path.resolve() for path in options.exclude}
    paths = [path for path in sorted(root.rglob("*")) if path.is_file() and path.resolve() not in excluded]
    paths = [path for path in paths if not any(part.startswith(".") for part in path.relative_to(root).parts)]
    opened = [open_band_file(path, root) for path in paths if path.suffix.lower() in TIFF_SUFFIXES]
    bands = [item for item in opened if item.file.shape[2] == 1 and not _is_thermal(item.file)]
    if not bands:
        raise CaptureError(
            f"{root} holds no TIFF files of single bands; expected IMG_0000_1.tif, IMG_..._GRE.TIF or "
            "DJI_..._MS_G.TIF: give the folder of the flight, or use the layout 'cubes' for other files"
        )
    sensors = sensor_names(bands)
    releases = release_names(bands, str(root))
    splits = splits_of(releases)
    names = view_names([str(item.file.path.relative_to(root)) for item in bands], str(root))
    notes = [*_left_out(opened, paths), *_odd(bands, releases)]
    views: list[CaptureView] = []
    lens_notes: Counter[tuple[str, str]] = Counter()
    for item, name, sensor, release in zip(bands, names, sensors, releases, strict=True):
        lens, said = lens_of(item.file)
        lens_notes.update((sensor, note) for note in said)
        views.append(CaptureView(name, item.file, sensor, lens=lens, release=release, split=splits[release]))
    _check_lenses(views)
    notes += [
        f"lens {sensor}: {note} ({counted(count, 'file')})" for (sensor, note), count in lens_notes.items()
    ]
    views = _with_given_bands(views, options)
    return Capture("rig", root, tuple(sorted(views, key=lambda view: view.name)), notes=tuple(notes))


def _is_thermal(file: SpectralFile) -> bool:
    wavelengths = file.bands.wavelengths_nm
    name = tag_text(file.metadata.get("xmp") or {}, "BandName") or ""
    return name.upper() == "LWIR" or (wavelengths is not None and float(wavelengths.min()) > THERMAL_NM)


def _check_lenses(views: Sequence[CaptureView]) -> None:
    """Refuse a lens twice in one release, and files of one lens that differ.

    Raises:
        CaptureError: that is so.
    """
    first: dict[str, CaptureView] = {}
    taken: dict[tuple[str, str], CaptureView] = {}
    for view in views:
        other = taken.setdefault((view.release, view.sensor), view)
        if other is not view:
            raise CaptureError(
                f"{other.cube.path} and {view.cube.path} are both the lens {view.sensor} of the release "
                f"{view.release}; expected one file: remove the copy"
            )
        same = first.setdefault(view.sensor, view)
        for what, expected, found in (
            ("pixels", same.cube.shape[:2], view.cube.shape[:2]),
            ("nm", _centre(same.cube), _centre(view.cube)),
        ):
            if expected != found:
                raise CaptureError(
                    f"{view.cube.path} has {found} {what}, {same.cube.path} of the same lens {view.sensor} {expected}; "
                    "expected files of one camera with one setting: process different flights apart"
                )


def _centre(file: SpectralFile) -> float | None:
    wavelengths = file.bands.wavelengths_nm
    return None if wavelengths is None else float(wavelengths[0])


def _with_given_bands(views: list[CaptureView], options: LayoutOptions) -> list[CaptureView]:
    """Wavelengths of a user, one a lens in the order of their names.

    Raises:
        CaptureError: another number of them than of lenses.
    """
    given = options.wavelengths_nm
    if given is None:
        return views
    sensors = sorted({view.sensor for view in views})
    if len(given) != len(sensors):
        raise CaptureError(
            f"--wavelengths gives {len(given)} numbers for {len(sensors)} lenses ({', '.join(sensors)}); expected one "
            "a lens, in this order"
        )
    tables = {
        sensor: BandTable(np.array([wavelength]), "given with --wavelengths")
        for sensor, wavelength in zip(sensors, given, strict=True)
    }
    return [replace(view, cube=replace(view.cube, bands=tables[view.sensor])) for view in views]


def _left_out(opened: Iterable[BandFile], paths: Iterable[Path]) -> list[str]:
    files = [item.file for item in opened]
    thermal = sum(file.shape[2] == 1 and _is_thermal(file) for file in files)
    colour = sum(file.shape[2] > 1 for file in files) + sum(
        path.suffix.lower() in COLOUR_SUFFIXES for path in paths
    )
    notes = [f"{counted(thermal, 'thermal image')} left out"] if thermal else []
    notes += (
        [f"{counted(colour, 'colour picture')} left out: nothing says what their channels measure"]
        if colour
        else []
    )
    return notes


def _odd(bands: Sequence[BandFile], releases: Sequence[str]) -> list[str]:
    turned = sum(
        (exif_number(item.file.metadata.get("exif") or {}, "Orientation") or 1) > 1 for item in bands
    )
    counts = Counter(releases)
    incomplete = [release for release, count in counts.items() if count < max(counts.values())]
    notes = (
        [
            f"EXIF's orientation of {counted(turned, 'file')} is ignored: poses and lenses refer to the stored raster"
        ]
        if turned
        else []
    )
    if incomplete:
        shown = ", ".join(incomplete[:3])
        notes.append(f"{len(incomplete)} of {len(counts)} releases lack a band: {shown}")
    return notes
