"""Built-in objects as spectral pictures: a procedural mesh of measured materials, by our own path tracer.

The folder is a spectral scene like any other here, which `unmix-nerf` can be trained on, too: cubes with pictures for
their alpha, wavelengths, the lamp's spectrum, true endmembers, and true abundances of evaluation views. Beside that it
has a mesh, an environment in colours, whose luminance counts, and relit/<light>/ with the same object under other
environments and another lamp.

Notation: `H x W` pixels, `B` bands.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.neumatex.demo.demo_object import (
    DEFAULT_SIZE,
    DEFAULT_VIEWS,
    EVALUATION_INTERVAL,
    LIGHTS_BOUNDS,
    SIZE_BOUNDS,
    VIEWS_A_LIGHT,
    VIEWS_BOUNDS,
    Say,
    Subject,
    cached_object,
    light_names,
    write_channels,
    write_mesh,
)
from unmix_plugin.neumatex.demo.shapes import demo_mesh
from unmix_plugin.neumatex.demo.spectral_surface import SpectralSurface
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.built_in import NAMES, built_in_environment
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.lighting.lamp import of_lamp, read_lamp
from unmix_plugin.neumatex.tracing.primary_hits import pixel_hits
from unmix_plugin.scenes.demo.scene import check_bounds, lens_entries, staging_for, transform_matrix
from unmix_plugin.scenes.demo.shading import band_centers_nm
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

DEFAULT_BANDS, DEFAULT_LIGHTS = 16, 2
BANDS_BOUNDS = (4, 512)
LAMP, OTHER_LAMP = "D50", "A"
"""That light the object in training, and elsewhere."""

TRAINING_LIGHT = "clear-sky"
"""Environment of training, whose sun casts shadows."""

_SAMPLES, _EVALUATION_SAMPLES = 64, 160
_SUBPIXELS = 2
_MEAN_RADIANCE = 0.2
"""Of the object; low enough for highlights to stay below 1 nearly everywhere."""


def demo_spectral_object(
    folder: Path,
    seed: int = 0,
    size: int = DEFAULT_SIZE,
    views: int = DEFAULT_VIEWS,
    bands: int = DEFAULT_BANDS,
    lights: int = DEFAULT_LIGHTS,
    say: Say | None = None,
    light: str = TRAINING_LIGHT,
) -> None:
    """Write an object. It is built beside the folder and moved in when complete.

    Args:
        folder: Made if absent, parents too.
        seed: Shape, materials and lights follow from it.
        size: Rows and columns of the pictures.
        views: Pictures under the light of training, every 8th for evaluation.
        bands: Evenly spaced over 400 to 700 nm.
        lights: Other lights, each with `VIEWS_A_LIGHT` pictures.
        say: Gets a line for each light.
        light: Built-in environment of training.
    Raises:
        ConfigError: a number out of bounds; no such light; a folder with something in it, or no folder at all.
        SceneError: the folder can't be written, or the disk is full.
    """
    bounds = {
        "size": (size, SIZE_BOUNDS),
        "views": (views, VIEWS_BOUNDS),
        "bands": (bands, BANDS_BOUNDS),
        "lights": (lights, LIGHTS_BOUNDS),
    }
    check_bounds("a demo object", bounds)
    with staging_for(folder, "the demo object", overwrite=False) as staging:
        _write_object(staging / "object", seed, (size, views, bands, lights), light, say)
        if folder.exists():
            folder.rmdir()
        (staging / "object").rename(folder)


def demo_spectral_object_path(cache_dir: Path | None = None, say: Say | None = None) -> Path:
    """The folder of the default spectral demo object, written on first use; see `demo_object_path`."""

    def write(folder: Path) -> None:
        numbers = (DEFAULT_SIZE, DEFAULT_VIEWS, DEFAULT_BANDS, DEFAULT_LIGHTS)
        _write_object(folder, 0, numbers, TRAINING_LIGHT, say)

    return cached_object("demo-spectral-object", write, cache_dir)


def _write_object(
    folder: Path, seed: int, numbers: tuple[int, int, int, int], light_name: str, say: Say | None
) -> None:
    size, views, num_bands, lights = numbers
    others = [name for name in light_names(seed, len(NAMES) - 1) if name != light_name]
    bands, names = Bands.of(band_centers_nm(num_bands)), [light_name, *others[:lights]]
    ray_mesh = RayMesh(demo_mesh(seed))
    surface = SpectralSurface(seed, bands.centers_nm, ray_mesh.mesh.vertices)
    subject = Subject(ray_mesh, surface, torch.Generator().manual_seed(seed), size)
    mesh, to_rgb = ray_mesh.mesh, rgb_matrix(bands)
    colours = surface.family.base_colour(surface.parameters(mesh.vertices)) @ to_rgb
    write_mesh(folder / "mesh.glb", mesh, colours.clamp(0, 1), surface.names)
    table = SpectraTable(bands, surface.names, surface.family.endmembers.double().numpy())
    write_spectra_csv(folder / "endmembers.csv", table)
    for number, name in enumerate(names):
        if say is not None:
            say(f"demo object: rendering light {number + 1} of {len(names)} ({name})")
        light = built_in_environment(name, seed)
        if number == 0:
            cameras = subject.cameras(views, 0)
            truth = {"materials": list(surface.names), "endmembers_path": "endmembers.csv"}
            _write_pictures(folder, subject, light, cameras, bands, LAMP, truth)
        else:
            cameras = subject.cameras(VIEWS_A_LIGHT, 1000 + VIEWS_A_LIGHT * number)
            lamp = OTHER_LAMP if number % 2 else LAMP
            _write_pictures(folder / "relit" / name, subject, light, cameras, bands, lamp, {})


def _write_pictures(
    folder: Path,
    subject: Subject,
    colours: Environment,
    cameras: Cameras,
    bands: Bands,
    lamp_name: str,
    truth: dict[str, Any],
) -> None:
    """Pictures under one light with transforms.json, the light and the lamp; with truth, abundances too."""
    lamp = read_lamp(lamp_name, bands)
    light = of_lamp(colours, torch.from_numpy(lamp))
    factor = subject.exposure(light, _MEAN_RADIANCE)
    light, frames = Environment(light.image * factor), list[dict[str, Any]]()
    for index in range(len(cameras)):
        is_evaluation = bool(truth) and index % EVALUATION_INTERVAL == 0
        samples = _EVALUATION_SAMPLES if is_evaluation or not truth else _SAMPLES
        radiance, alpha = subject.picture(light, cameras, index, samples)
        frame = _write_view(folder, f"{index:03d}", radiance, alpha, rgb_matrix(bands))
        if is_evaluation:
            frame["abundance_file_path"] = f"abundances/{index:03d}.npy"
            _save(folder / frame["abundance_file_path"], _abundances(subject, cameras, index))
        frames.append({**frame, "transform_matrix": transform_matrix(cameras, index)})
    write_channels(folder / "environment.exr", colours.image * factor)
    write_spectra_csv(folder / "illuminant.csv", SpectraTable(bands, ("power",), lamp[None]))
    content = {
        **lens_entries(cameras),
        "wavelengths": bands.centers_nm.tolist(),
        "illuminant_path": "illuminant.csv",
        "environment_path": "environment.exr",
        "tone_mapping": "linear",
        "value_scale": 1.0,
        **({"mesh_path": "mesh.glb", **truth, **_splits(frames)} if truth else {}),
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _splits(frames: list[dict[str, Any]]) -> dict[str, list[str]]:
    evaluation = [frame["file_path"] for frame in frames if "abundance_file_path" in frame]
    train = [frame["file_path"] for frame in frames if "abundance_file_path" not in frame]
    return {"train_filenames": train, "val_filenames": evaluation, "test_filenames": evaluation}


def _write_view(
    folder: Path,
    name: str,
    radiance: Float[Tensor, "H W B"],
    alpha: Float[Tensor, "H W"],
    to_rgb: Float[Tensor, "B 3"],
) -> dict[str, Any]:
    """A cube, multiplied by alpha, and a picture with alpha; gives their entry, but for the pose."""
    from PIL import Image

    frame = {"file_path": f"images/{name}.png", "hyperspectral_file_path": f"cubes/{name}.npy"}
    _save(folder / frame["hyperspectral_file_path"], radiance)
    straight = (radiance @ to_rgb).clamp(min=0) / alpha.clamp(min=1e-6)[..., None]
    picture = torch.cat([linear_to_srgb(straight).clamp(0, 1), alpha[..., None]], dim=-1)
    path = folder / frame["file_path"]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((picture * 255).round().byte().numpy()).save(path)
    return frame


def _abundances(subject: Subject, cameras: Cameras, index: int) -> Float[Tensor, "H W K"]:
    """Means of what is seen in each pixel; 0 where nothing is."""
    surface = subject.surface
    assert isinstance(surface, SpectralSurface)
    hits = pixel_hits(subject.ray_mesh, cameras, index, _SUBPIXELS)
    found = hits.image(surface.family.abundances(surface.parameters(hits.points.positions)))
    return found / hits.alpha().clamp(min=1e-6)[..., None]


def _save(path: Path, numbers: Tensor) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, numbers.numpy().astype(np.float16))
