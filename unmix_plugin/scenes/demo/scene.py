"""The built-in demo scene as a folder: a ray-traced picnic table with true labels, abundances and endmembers.

The layout is that of any scene of ours: transforms.json, cubes (radiance in [0, 1], black where nothing is), sRGB
images with alpha, labels (255 = unlabelled) and, for evaluation views, abundances. Writing it twice gives the same
bytes.

Notation: `B` bands, `K` materials, `H`, `W` rows and columns, `N` views.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.scenes.demo.folders import check_bounds, staging_for, written_once
from unmix_plugin.scenes.demo.materials import LAMP, MATERIALS, band_centers_nm, lamp_power, reflectances
from unmix_plugin.scenes.demo.places import TABLE, Place
from unmix_plugin.scenes.demo.shading import ViewCoefficients, render_view
from unmix_plugin.scenes.demo.views import (
    frame_name,
    label_image,
    lens_entries,
    radiance_cube,
    transform_matrix,
)
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

DEFAULT_SIZE, DEFAULT_BANDS, DEFAULT_VIEWS = 96, 31, 32
SIZE_BOUNDS, BANDS_BOUNDS, VIEWS_BOUNDS = (16, 1024), (3, 512), (4, 1000)

_FOLDERS = ("images", "cubes", "labels", "abundances")
_TRANSFORMS = "transforms.json"


def demo_scene_path(cache_dir: Path | None = None) -> Path:
    """The folder of the default demo scene, written on first use and again if a file of it is missing.

    Args:
        cache_dir: Where to keep it; None is `unmix-nerf` in XDG_CACHE_HOME or ~/.cache. A changed generator writes
            into a new folder.
    Raises:
        SceneError: the cache can't be written.
    """
    target = (cache_dir or user_cache()) / f"demo-{_generator_hash()}" / "demo"
    return written_once(
        target,
        "the demo scene",
        lambda folder: _write_scene(folder, DEFAULT_SIZE, DEFAULT_BANDS, DEFAULT_VIEWS),
        is_complete,
        "set XDG_CACHE_HOME to a folder that can be written, or write the scene elsewhere with unmix-demo-scene DIR "
        "and train on that",
    )


def make_demo_scene(
    directory: Path,
    size: int = DEFAULT_SIZE,
    bands: int = DEFAULT_BANDS,
    views: int = DEFAULT_VIEWS,
    overwrite: bool = False,
    illuminant: str | Path = LAMP,
    place: Place = TABLE,
) -> None:
    """Write a demo scene. It is built beside the folder and moved in when complete.

    Args:
        directory: Made if absent, parents too.
        overwrite: Whether a folder with something in it is accepted: an older demo scene there is replaced, other
            files stay.
        illuminant: What the scene is lit by: the name of a known light, or a CSV file (wavelength,power).
        place: What there is to see, and from where.
    Raises:
        ConfigError: a number out of bounds; a folder with something in it, or no folder at all.
        SpectrumError: an unknown light, or one that is not known at all bands.
        SceneError: the folder can't be written, or the disk is full.
    """
    check_bounds(
        "a demo scene",
        {"size": (size, SIZE_BOUNDS), "bands": (bands, BANDS_BOUNDS), "views": (views, VIEWS_BOUNDS)},
    )
    with staging_for(directory, "the demo scene", overwrite) as staging:
        _write_scene(staging / "scene", size, bands, views, illuminant, place)
        _move_files(staging / "scene", directory)


def is_complete(directory: Path) -> bool:
    """Whether a folder holds a demo scene with all of its files."""
    try:
        transforms = json.loads((directory / _TRANSFORMS).read_text(encoding="utf-8"))
        paths = [
            value for frame in transforms["frames"] for key, value in frame.items() if key.endswith("_path")
        ]
        paths += [transforms["illuminant_path"], transforms["endmembers_path"]]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return all((directory / path).is_file() for path in paths)


def _write_scene(
    folder: Path, size: int, bands: int, views: int, illuminant: str | Path = LAMP, place: Place = TABLE
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
    content = _header(cameras, sampling) | _splits(views) | {"frames": frames}
    (folder / _TRANSFORMS).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


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


def _header(cameras: Cameras, bands: Bands) -> dict[str, Any]:
    return {
        **lens_entries(cameras),
        "wavelengths": bands.centers_nm.tolist(),
        "materials": list(MATERIALS),
        "illuminant_path": "illuminant.csv",
        "endmembers_path": "endmembers.csv",
    }


def _splits(views: int) -> dict[str, list[str]]:
    names = [frame_name(index) for index in range(views)]
    train, evaluation = (
        [f"images/{name}.png" for name in names if name.startswith(s)] for s in ("train", "eval")
    )
    return {"train_filenames": train, "val_filenames": evaluation, "test_filenames": evaluation}


def _move_files(built: Path, directory: Path) -> None:
    """Put a scene into a folder in place of an older one, transforms.json last: a scene is whole or not there."""
    directory.mkdir(exist_ok=True)
    (directory / _TRANSFORMS).unlink(missing_ok=True)
    for folder in _FOLDERS:
        (directory / folder).mkdir(exist_ok=True)
        for stale in (*(directory / folder).glob("train_*"), *(directory / folder).glob("eval_*")):
            stale.unlink()
    for path in sorted(built.rglob("*")):
        if path.is_file() and path.name != _TRANSFORMS:
            path.replace(directory / path.relative_to(built))
    (built / _TRANSFORMS).replace(directory / _TRANSFORMS)


def user_cache() -> Path:
    """Where generated data is kept, by the XDG base directory specification: XDG_CACHE_HOME counts only if absolute."""
    configured = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (configured if configured.is_absolute() else Path.home() / ".cache") / "unmix-nerf"


def _generator_hash() -> str:
    """Changes with the generator's code, so that a cached scene is never one of another version."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
