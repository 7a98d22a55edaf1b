"""What a scene's transforms.json says, checked: typed entries of the scene and its frames, and where their files are.

No file is opened but transforms.json. A wrong value becomes a noted fault and None.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.json_values import describe, read_number, read_numbers
from unmix_plugin.scenes.folder import (
    CUBE_KEY,
    SceneKeys,
    load_transforms,
    read_frame_keys,
    read_scene_keys,
    unfollowed_keys,
)
from unmix_plugin.scenes.frame_cameras import FrameCamera, make_cameras
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.placement import Normalisation, Placement, read_placement
from unmix_plugin.scenes.reading.faults import FILE_NAME, Faults, resolve_path
from unmix_plugin.spectral.bands import require_nanometres

Shape = tuple[int, int]
"""Rows and columns of an image, as arrays have them; widths come first where cameras are made."""


@dataclass(frozen=True)
class FrameEntry:
    """One element of `frames`; None where a value is absent or faulty."""

    where: str
    """How messages call it."""
    paths: dict[str, str]
    """Paths of its files by their key, with slashes."""
    camera: FrameCamera = FrameCamera()
    """Its lens, and where it was taken from."""
    sensor: str | None = None
    """Name of what it was taken with."""
    bands: tuple[int, ...] | None = None
    """Bands of the scene, one a channel, in the order of the channels."""
    shot: str | None = None
    """Name of the shot; the lenses of a rig take one together."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """Where `paths` lead, as far as they were followed."""

    def name_of(self, key: str) -> str:
        """One of its files, for messages."""
        return f"{self.where} {self.paths[key]}" if key in self.paths else self.where


@dataclass(frozen=True)
class SceneEntry:
    """The content of transforms.json; None where a value is absent or faulty."""

    keys: SceneKeys
    """What holds for all frames, as it is written; some of it is checked further below."""
    wavelengths_nm: Float64[np.ndarray, " B"] | None
    materials: tuple[str, ...] | None
    split_lists: dict[str, tuple[str, ...]]
    """Paths of `train`, `val` and `test`, where there are lists of them."""
    frames: tuple[FrameEntry, ...]
    placement: Placement = field(default_factory=Placement)
    """How the poses were moved from where they come from."""
    metres_per_unit: float | None = None
    """Metres in a unit of the world that the poses come from."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Widths of the instrument's bands, NaN where one is unknown."""
    warnings: tuple[str, ...] = ()
    """Keys that stand for something and are not followed, or that nobody knows."""

    def cameras(self, sizes: Sequence[Shape], normalisation: Normalisation) -> Cameras:
        """Cameras of all frames, of images of these sizes, where there are no faults; `normalisation` leads from the
        space of transforms.json to that of the cameras."""
        cameras = [frame.camera for frame in self.frames]
        return make_cameras(cameras, [(width, height) for height, width in sizes], normalisation.moved)


def read_entries(root: Path, faults: Faults, needs_cubes: bool = True) -> SceneEntry:
    """Read transforms.json, noting every fault in it.

    Args:
        root: Folder that holds it.
        faults: Where faults are noted.
        needs_cubes: Whether frames must have cubes of spectra, and the scene wavelengths; without, pictures will do.
    Raises:
        SceneError: the file is absent, is no JSON object, or has no list of frames: there is nothing to go on with.
    """
    transforms = load_transforms(root, faults)
    scene, keys = transforms.scene, read_scene_keys(transforms.scene, faults)
    warned, noted = unfollowed_keys(scene, [frame for _, frame in transforms.frames])
    has_bands = needs_cubes or keys.wavelengths is not None
    wavelengths_nm = _read_wavelengths(keys, faults) if has_bands else None
    materials = keys.materials
    if materials is not None:
        names = materials if isinstance(materials, list) else [None]
        are_names = names and all(isinstance(v, str) and v.strip() and v.isprintable() for v in names)
        if not are_names or len(set(materials)) != len(materials):
            materials = faults.note(FILE_NAME, Message.NO_MATERIALS, found=describe(materials))
    fwhm_nm = read_widths(keys, faults)

    frames = []
    for where, frame in transforms.frames:
        own = read_frame_keys(frame, where, faults)
        if needs_cubes and frame.get(CUBE_KEY) is None:
            faults.note(where, Message.NO_CUBE)
        elif frame.get(CUBE_KEY) is None and frame.get("file_path") is None:
            faults.note(where, Message.NO_PICTURE)
        entry = FrameEntry(
            where=where,
            paths=own.paths,
            camera=FrameCamera.read(scene, frame, where, faults),
            sensor=own.sensor,
            bands=None if own.bands is None else tuple(own.bands),
            shot=own.shot,
        )
        frames.append(entry)
    placement, metres_per_unit = read_placement(scene, FILE_NAME, faults)
    return SceneEntry(
        keys=keys,
        wavelengths_nm=wavelengths_nm,
        materials=None if materials is None else tuple(materials),
        split_lists=split_lists(keys),
        frames=tuple(frames),
        placement=placement,
        metres_per_unit=metres_per_unit,
        fwhm_nm=fwhm_nm,
        warnings=tuple(f"{FILE_NAME}: {text}" for text in (*warned, *noted)),
    )


def _read_wavelengths(keys: SceneKeys, faults: Faults) -> Float64[np.ndarray, " B"] | None:
    values = keys.wavelengths
    if not isinstance(values, list) or not values:
        found = "is absent" if values is None else f"is {describe(values)}"
        return faults.note(FILE_NAME, Message.NO_WAVELENGTHS, found=found)
    numbers = [read_number(value) or -1.0 for value in values]
    if min(numbers) <= 0:
        band = next(band for band, number in enumerate(numbers) if number <= 0)
        return faults.note(FILE_NAME, Message.WAVELENGTH_NO_NUMBER, found=describe(values[band]), band=band)
    wavelengths = np.array(numbers, dtype=np.float64)
    drops = np.flatnonzero(np.diff(wavelengths) <= 0.0)
    if drops.size:
        before, after = wavelengths[drops[0] : drops[0] + 2]
        values = {"before": before, "after": after, "band": drops[0] + 1}
        return faults.note(FILE_NAME, Message.WAVELENGTHS_FALL, **values)
    try:
        require_nanometres(wavelengths)
    except SpectrumError as error:
        return faults.note(FILE_NAME, Message.WAVELENGTHS_NO_NM, reason=error)
    return wavelengths


def read_widths(keys: SceneKeys, faults: Faults) -> Float64[np.ndarray, " B"] | None:
    """The key `fwhm`, NaN where a width is unknown; None if it is absent, and with a noted fault if it is wrong."""
    values, centers = keys.fwhm, keys.wavelengths
    if values is None or not isinstance(centers, list):
        return None
    known = [0.0 if value is None else value for value in values] if isinstance(values, list) else None
    widths = read_numbers(known, len(centers))
    if widths is None or (widths < 0).any():
        return faults.note(FILE_NAME, Message.WRONG_WIDTHS)
    return np.where(widths == 0, np.nan, widths)


def split_lists(keys: SceneKeys) -> dict[str, tuple[str, ...]]:
    """Paths of `train`, `val` and `test`, with slashes, where there are lists of them."""
    lists = {"train": keys.train_filenames, "val": keys.val_filenames, "test": keys.test_filenames}
    return {
        name: tuple(path.replace("\\", "/") for path in paths)
        for name, paths in lists.items()
        if paths is not None
    }


def locate_files(root: Path, entry: SceneEntry, allow_outside: bool, faults: Faults) -> SceneEntry:
    """The entry whose frames know where their files are; a file that two frames share as their cube is a fault."""
    frames: list[FrameEntry] = []
    owner: dict[Path, str] = {}
    for frame in entry.frames:
        files: dict[str, Path] = {}
        for key, text in frame.paths.items():
            least_parts = 1 if key in ("file_path", CUBE_KEY) else 2
            path = resolve_path(root, text, allow_outside, frame.where, faults, least_parts=least_parts)
            if path is not None:
                files[key] = path
        if CUBE_KEY in files:
            first = owner.setdefault(files[CUBE_KEY].resolve(), frame.where)
            if first != frame.where:
                faults.note(frame.where, Message.CUBE_TWICE, path=frame.paths[CUBE_KEY], other=first)
        frames.append(replace(frame, files=files))
    return replace(entry, frames=tuple(frames))


def at_sizes(entry: SceneEntry, sizes: Sequence[Shape], faults: Faults) -> SceneEntry:
    """The entry with one pose for each line camera, too; notes a fault where poses of lines don't fit the image.

    Args:
        sizes: Of each frame's image.
    """
    frames = [
        replace(frame, camera=frame.camera.at_size(num_rows, frame.where, faults))
        for frame, (num_rows, _) in zip(entry.frames, sizes, strict=True)
    ]
    return replace(entry, frames=tuple(frames))
