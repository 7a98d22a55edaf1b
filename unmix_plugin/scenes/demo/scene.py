"""The built-in demo scene as a folder: a ray-traced picnic table with true labels, abundances and endmembers.

It stands in front of nothing, on a ground that runs to the horizon under a sky, or in a room. The layout is that of any
scene of ours: transforms.json, cubes (radiance in [0, 1], black where nothing is), sRGB images with alpha, labels (255
unlabelled) and, for evaluation views, abundances. Writing it twice gives the same bytes.

Notation: `B` bands, `K` materials, `H`, `W` rows and columns, `N` views, `R` rays, `P` points.
"""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8

from unmix_plugin.engine.geometry.camera_paths import upright_cameras
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.runs.replacing import move_aside, move_files, refuse_foreign
from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.scenes.demo.shading import (
    LAMP,
    MATERIALS,
    THINGS,
    Blend,
    PerPoint,
    Sky,
    Surface,
    Thing,
    ViewCoefficients,
    band_centers_nm,
    lamp_power,
    plain,
    reflectances,
    render_view,
    smooth_step,
)
from unmix_plugin.scenes.demo.shapes import PlacedPrimitive, Points, Rays
from unmix_plugin.scenes.folder import lens_keys, matrix_entry, transforms_bytes
from unmix_plugin.scenes.kept import user_cache
from unmix_plugin.scenes.reading.faults import FILE_NAME
from unmix_plugin.scenes.reading.images import UNLABELLED
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

_VIEW_ANGLE_DEG = 38.0
_CAMERA_DISTANCE = 4.1
_LOOK_AT = (0.0, 0.0, 0.22)
_ELEVATIONS_DEG = (16.0, 68.0)
_GROUND_HEIGHT = -0.12
"""The table's underside."""
_GROUND_EDGE = 400.0
"""Half of the ground's edge, scene units: its end is a tenth of a pixel below the horizon."""
_SKY_BRIGHTNESS = 0.75
_PHONE_ANGLE_DEG = 62.0
DEFAULT_SIZE, DEFAULT_BANDS, DEFAULT_VIEWS = 96, 31, 32
SIZE_BOUNDS, _BANDS_BOUNDS, VIEWS_BOUNDS = (16, 1024), (3, 512), (4, 1000)
_FOLDERS = ("images", "cubes", "labels", "abundances")


def check_bounds(what: str, numbers: Mapping[str, tuple[int, tuple[int, int]]]) -> None:
    """Refuse numbers out of bounds: by name of the flag the value and its bounds, both allowed. Raises ConfigError."""
    for name, (value, (low, high)) in numbers.items():
        if not low <= value <= high:
            raise ConfigError(f"--{name} of {what} must be {low} to {high}; found {value}")


@contextmanager
def staging_for(directory: Path, what: str, overwrite: bool, last: str) -> Iterator[Path]:
    """A temporary folder in which to build what then moves to `directory`, which messages call `what`; `last` is the
    file of it without which it is none.

    Raises:
        ConfigError: a folder with something in it that is not to be overwritten, or no folder at all.
        RunError: the folder has a file of others that is called `last`.
        SceneError: the folder can't be written, or the disk is full.
    """
    if directory.exists() and not directory.is_dir():
        raise ConfigError(f"{directory} is a file; give a folder for {what}")
    if not overwrite and directory.is_dir() and any(directory.iterdir()):
        raise ConfigError(
            f"{directory} is not empty; choose another folder, or replace what is there with --overwrite"
        )
    try:
        refuse_foreign(
            [directory / last]
        )  # before minutes are spent; files of other names when they are moved
        with _staging_beside(directory) as staging:
            yield staging
    except OSError as error:  # NumPy's own has no strerror
        raise SceneError(
            f"can't write {what} to {directory}: {_why(error)}; make room there or choose another folder"
        ) from error


@contextmanager
def _staging_beside(directory: Path) -> Iterator[Path]:
    """A temporary folder on the same disk, so that what is built there can be renamed into place."""
    directory.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{directory.name}-", dir=directory.parent) as folder:
        yield Path(folder)


def written_once(
    target: Path,
    what: str,
    write: Callable[[Path], None],
    is_complete: Callable[[Path], bool],
    remedy: str = "set XDG_CACHE_HOME to a folder with room that can be written",
) -> Path:
    """A folder of a cache, written on first use and again if it is not complete; messages call it `what`. Raises
    SceneError: the cache can't be written."""
    if is_complete(target):
        return target
    try:
        with _staging_beside(target) as staging:
            write(staging / target.name)
            if target.exists() and not is_complete(target):
                move_aside(target, "incomplete")
            (staging / target.name).rename(target)
    except OSError as error:
        # Another process may have been quicker; what it wrote is as good.
        if not is_complete(target):
            raise SceneError(f"can't write {what} to {target}: {_why(error)}; {remedy}") from error
    return target


_DISK_FULL = re.compile(r"\d+ requested and \d+ written|encoder error")
"""What numpy and Pillow say of a full disk, without the system's own words."""


def _why(error: OSError) -> str:
    """What went wrong with a file."""
    return error.strerror or (f"the disk is full ({error})" if _DISK_FULL.search(str(error)) else str(error))


def demo_cameras(size: int, views: int, angle_deg: float = _VIEW_ANGLE_DEG) -> Cameras:
    """Cameras on a dome around the table, azimuths spread by the golden angle; pictures `angle_deg` wide."""
    i = np.arange(views)
    azimuths = i * np.pi * (3 - np.sqrt(5))
    # A second irrational stride decouples elevation from order, so that every 4th view samples the whole dome.
    shares = (i * np.sqrt(2) + 0.5 / views) % 1
    low, high = np.sin(np.deg2rad(_ELEVATIONS_DEG))
    heights = low + (high - low) * shares
    flat = np.sqrt(1 - heights**2)
    backward = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), heights], axis=1)
    positions = np.asarray(_LOOK_AT) + _CAMERA_DISTANCE * backward
    return upright_cameras(positions, backward, size, np.deg2rad(angle_deg))


def lens_entries(cameras: Cameras) -> dict[str, Any]:
    """What transforms.json says of the lens that all of the cameras have."""
    lens = (each[0].tolist() for each in (cameras.focal_px, cameras.center_px, cameras.distortion))
    return {"camera_model": "OPENCV", "w": cameras.width, "h": cameras.height, **lens_keys(*lens)}


def transform_matrix(cameras: Cameras, index: int) -> list[list[float]]:
    """Camera to world as the four rows that transforms.json has."""
    return matrix_entry(cameras.camera_to_world[index].double().numpy())


def frame_name(index: int) -> str:
    """`train_000`, `train_001`, `eval_002`, ...: every 4th view is for evaluation."""
    return f"{'eval' if index % 4 == 2 else 'train'}_{index:03d}"


def radiance_cube(
    view: ViewCoefficients, spectra: Float[np.ndarray, "K B"], lamp: Float[np.ndarray, " B"]
) -> Float[np.ndarray, "H W B"]:
    """Spectral radiance of every pixel in [0, 1]: what exceeds 1 saturates, as in a sensor."""
    return (reflected(view, spectra) * lamp.astype(np.float32)).clip(0, 1)


def reflected(view: ViewCoefficients, spectra: Float[np.ndarray, "K B"]) -> Float32[np.ndarray, "H W B"]:
    """What every pixel reflects of the lamp, highlights included; 1 is a white matt panel in irradiance 1."""
    return view.diffuse @ spectra.astype(np.float32) + view.specular[..., None]


def label_image(view: ViewCoefficients) -> UInt8[np.ndarray, "H W"]:
    """The material with the largest abundance where at least half a pixel is covered, otherwise 255."""
    return np.where(view.alpha >= 0.5, view.abundances.argmax(axis=-1), UNLABELLED).astype(np.uint8)


@dataclass(frozen=True)
class Place:
    """What there is to see, and from where."""

    things: Sequence[Thing]
    cameras: Callable[[int, int], Cameras]
    """From the pixels along an edge of a view and the number of views."""
    sky: Sky | None = None
    """What is behind all things; None leaves their pictures an alpha."""


def _open_sky(directions: Rays) -> Float[np.ndarray, "R K"]:
    """Cyan above, white at the horizon, with broad clouds."""
    x, y, z = directions.T
    haze = np.exp(-4.0 * z.clip(0))
    clouds = smooth_step(np.sin(4.0 * x + 1.0) * np.sin(5.0 * y) + np.sin(7.0 * (x - y)) / 2, 0.1, 0.9)
    white = np.maximum(haze, 0.7 * clouds * (1 - haze))
    found = np.zeros((len(directions), len(MATERIALS)), np.float32)
    found[:, MATERIALS.index("white")] = _SKY_BRIGHTNESS * white
    found[:, MATERIALS.index("cyan")] = _SKY_BRIGHTNESS * (1 - white)
    return found


def _patches(
    period: float, seed: float, fade: float = np.inf, half_sizes: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Blend:
    """Smooth patches of a surface, about `period` wide, which fade at distances around `fade`; both in units of the
    shape's own coordinates, or of the scene for a shape of these half sizes."""

    def blend(points: Points) -> PerPoint:
        points = points * np.asarray(half_sizes, np.float32)
        x, y = (points[:, :2] * (2 * np.pi / period)).T
        z = points[:, 2] * (2 * np.pi / period)
        waves = np.sin(x + seed) * np.sin(y + z) + np.sin(0.37 * x - 0.61 * y + z + seed)
        waves += np.sin(1.7 * y + 0.4 * x - 0.8 * z)
        contrast = np.exp(-(points[:, :2] ** 2).sum(axis=1) / fade**2)
        return (0.5 + contrast * (smooth_step(waves, -0.6, 0.6) - 0.5)).astype(points.dtype)

    return blend


def _ground() -> Thing:
    # A cylinder's or a box's own coordinates are over its half sizes.
    period, fade = 1.3 / _GROUND_EDGE, 9.0 / _GROUND_EDGE
    placement = PlacedPrimitive("box", (0.0, 0.0, _GROUND_HEIGHT - 0.5), (_GROUND_EDGE, _GROUND_EDGE, 0.5))
    return Thing(placement, Surface("green", "yellow", _patches(period, 0.7, fade)))


def _far_things(count: int = 14, seed: int = 5) -> list[Thing]:
    """Huts and trees around the table, 6 to 60 units away."""
    generator, found = np.random.default_rng(seed), []
    for index in range(count):
        angle = 2 * np.pi * (index + 0.6 * generator.random()) / count
        distance = 6.0 * 10.0 ** (index * 5 % count / count)
        size = distance * generator.uniform(0.06, 0.12)
        center = (distance * np.cos(angle), distance * np.sin(angle), _GROUND_HEIGHT + size)
        names = [str(name) for name in generator.choice(MATERIALS, 2, replace=False)]
        primitive = ("box", "sphere", "cylinder")[index % 3]
        placement = PlacedPrimitive(
            primitive, center, (size, size, size), turn_deg=float(generator.uniform(0, 90))
        )
        blend = plain if index % 2 else _patches(1.3, float(index))
        found.append(Thing(placement, Surface(names[0], names[1], blend)))
    return found


def _room() -> list[Thing]:
    """Floor, ceiling and walls around the table, one wall with two windows."""
    slabs = [
        ((0.0, 0.0, _GROUND_HEIGHT - 0.09), (3.6, 3.6, 0.1), "yellow", "red"),
        ((0.0, 0.0, 5.0), (3.6, 3.6, 0.1), "white", "white"),
        ((-3.6, 0.0, 2.4), (0.1, 3.6, 2.6), "cyan", "white"),
        ((3.6, 0.0, 2.4), (0.1, 3.6, 2.6), "white", "purple"),
        ((0.0, -3.6, 2.4), (3.6, 0.1, 2.6), "white", "green"),
        # The wall with windows: below, above, and the posts between.
        ((0.0, 3.6, 0.4), (3.6, 0.1, 0.6), "white", "green"),
        ((0.0, 3.6, 3.8), (3.6, 0.1, 1.2), "white", "green"),
        ((-3.0, 3.6, 1.8), (0.6, 0.1, 0.8), "white", "green"),
        ((0.0, 3.6, 1.8), (0.4, 0.1, 0.8), "white", "green"),
        ((3.0, 3.6, 1.8), (0.6, 0.1, 0.8), "white", "green"),
        ((-2.4, 2.4, 0.5), (0.6, 0.5, 0.7), "purple", "white"),
        ((1.9, 2.2, 0.9), (0.35, 0.35, 1.1), "green", "yellow"),
    ]
    return [
        Thing(
            PlacedPrimitive("box", center, half),
            Surface(first, second, _patches(0.9, 1.3 * index, half_sizes=half)),
        )
        for index, (center, half, first, second) in enumerate(slabs)
    ]


def _room_cameras(size: int, views: int, seed: int = 11) -> Cameras:
    """Cameras as of a hand-held phone on one side of the room, turned towards the table and the windows behind it."""
    generator = np.random.default_rng(seed)
    shifts = generator.uniform(-1, 1, (views, 3))
    positions = np.array([0.0, -2.3, 1.5]) + shifts * (1.2, 0.5, 0.6)
    targets = np.array([0.0, 1.2, 0.9]) + generator.uniform(-1, 1, (views, 3)) * (1.0, 0.3, 0.4)
    backward = positions - targets
    backward /= np.linalg.norm(backward, axis=1, keepdims=True)
    return upright_cameras(positions, backward, size, np.deg2rad(_PHONE_ANGLE_DEG))


_TABLE = Place(THINGS, demo_cameras)  # before nothing
_WORLD = Place((*THINGS, _ground(), *_far_things()), demo_cameras, _open_sky)
_ROOM = Place((*THINGS, *_room(), _ground(), *_far_things(20, seed=8)), _room_cameras, _open_sky)
PLACES: Mapping[str, Place] = {"table": _TABLE, "world": _WORLD, "room": _ROOM}


def demo_scene_path(cache_dir: Path | None = None) -> Path:
    """The folder of the default demo scene, in `user_cache` unless another is given, written on first use and again if
    a file of it is missing; a changed generator writes into a new one. Raises SceneError: it can't be written."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    target = (cache_dir or user_cache()) / f"demo-{digest.hexdigest()[:12]}" / "demo"
    return written_once(
        target,
        "the demo scene",
        lambda folder: _write_scene(folder, DEFAULT_SIZE, DEFAULT_BANDS, DEFAULT_VIEWS),
        is_complete,
        "set XDG_CACHE_HOME to a folder with room that can be written, or write the scene elsewhere with "
        "unmix-demo-scene DIR and train on that",
    )


def make_demo_scene(
    directory: Path,
    size: int = DEFAULT_SIZE,
    bands: int = DEFAULT_BANDS,
    views: int = DEFAULT_VIEWS,
    overwrite: bool = False,
    illuminant: str | Path = LAMP,
    place: Place = _TABLE,
) -> None:
    """Write a demo scene. It is built beside the folder and moved in when complete.

    Args:
        overwrite: Whether a folder with something in it is accepted: an older demo scene there is replaced, other
            files stay.
        illuminant: What the scene is lit by: the name of a known light, or a CSV file (wavelength,power).
    Raises:
        ConfigError: a number out of bounds; a folder with something in it, or no folder at all.
        SpectrumError: an unknown light, or one that is not known at all bands.
        RunError: a file of others has a name that the scene needs; nothing was moved.
        SceneError: the folder can't be written, or the disk is full.
    """
    check_bounds(
        "a demo scene",
        {"size": (size, SIZE_BOUNDS), "bands": (bands, _BANDS_BOUNDS), "views": (views, VIEWS_BOUNDS)},
    )
    with staging_for(directory, "the demo scene", overwrite, FILE_NAME) as staging:
        _write_scene(staging / "scene", size, bands, views, illuminant, place)
        move_files(staging / "scene", directory, FILE_NAME)


def is_complete(directory: Path) -> bool:
    """Whether a folder holds a demo scene with all of its files."""
    try:
        transforms = json.loads((directory / FILE_NAME).read_text(encoding="utf-8"))
        paths = [
            value for frame in transforms["frames"] for key, value in frame.items() if key.endswith("_path")
        ]
        paths += [transforms["illuminant_path"], transforms["endmembers_path"]]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return all((directory / path).is_file() for path in paths)


def _write_scene(
    folder: Path, size: int, bands: int, views: int, illuminant: str | Path = LAMP, place: Place = _TABLE
) -> None:
    sampling = Bands.of(band_centers_nm(bands))
    spectra, lamp = reflectances(sampling.centers_nm), lamp_power(sampling.centers_nm, illuminant)
    for name in _FOLDERS:
        (folder / name).mkdir(parents=True)
    to_rgb = rgb_matrix(sampling)
    write_spectra_csv(folder / "endmembers.csv", SpectraTable(sampling, MATERIALS, spectra))
    write_spectra_csv(folder / "illuminant.csv", SpectraTable(sampling, ("power",), lamp[None]))
    cameras = place.cameras(size, views)
    frames = []
    for index in range(views):
        view = render_view(cameras, index, things=place.things, sky=place.sky)
        cube = radiance_cube(view, spectra, lamp)
        frames.append(_write_view(folder, frame_name(index), view, cube, to_rgb, place.sky is None))
        frames[-1]["transform_matrix"] = transform_matrix(cameras, index)
    train, evaluation = (
        [frame["file_path"] for frame in frames if Path(frame["file_path"]).name.startswith(split)]
        for split in ("train", "eval")
    )
    content = {
        **lens_entries(cameras),
        "wavelengths": sampling.centers_nm.tolist(),
        "materials": list(MATERIALS),
        "illuminant_path": "illuminant.csv",
        "endmembers_path": "endmembers.csv",
        "train_filenames": train,
        "val_filenames": evaluation,
        "test_filenames": evaluation,
        "frames": frames,
    }
    (folder / FILE_NAME).write_bytes(transforms_bytes(content))


def _write_view(
    folder: Path,
    name: str,
    view: ViewCoefficients,
    cube: Float[np.ndarray, "H W B"],
    to_rgb: Float[torch.Tensor, "B 3"],
    with_alpha: bool,
) -> dict[str, Any]:
    """Write the files of one view; gives its entry in transforms.json, but for the pose."""
    from PIL import Image

    srgb = linear_to_srgb(torch.from_numpy(cube) @ to_rgb).clamp(0, 1).numpy()
    picture = np.concatenate([srgb, view.alpha[..., None]], axis=-1) if with_alpha else srgb
    entry: dict[str, Any] = {
        "file_path": f"images/{name}.png",
        "hyperspectral_file_path": f"cubes/{name}.npy",
        "seg_file_path": f"labels/{name}.png",
    }
    Image.fromarray((picture * 255).round().astype(np.uint8)).save(folder / entry["file_path"])
    np.save(folder / entry["hyperspectral_file_path"], cube.astype(np.float16))
    Image.fromarray(label_image(view)).save(folder / entry["seg_file_path"])
    if name.startswith("eval"):
        entry["abundance_file_path"] = f"abundances/{name}.npy"
        np.save(folder / entry["abundance_file_path"], view.abundances.astype(np.float16))
    return entry
