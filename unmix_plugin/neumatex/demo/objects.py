"""Built-in objects as folders: pictures of a procedural mesh by our own path tracer, in colours or in many bands.

A folder holds transforms.json, mesh.glb, environment.exr and pictures under one light; relit/<light>/ holds the same
under lights that training never sees. Every 8th view is for evaluation.

Objects in colours have layered materials; pictures in images/ are linear OpenEXR with straight alpha, and
truth/base_colour/ has the base colour of evaluation views. Spectral objects are of measured materials, and a spectral
scene like any other here, which `unmix-nerf` can be trained on, too: cubes with pictures for their alpha, wavelengths,
the lamp's spectrum, true endmembers, and true abundances of evaluation views. Of their environment, which is in
colours, luminance counts; elsewhere they have another lamp.

Notation: `H x W` pixels, `N` views, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine import Cameras, upright_cameras
from unmix_plugin.formats.exr import write_exr
from unmix_plugin.formats.files import rgba_png_bytes, write_file
from unmix_plugin.formats.meshes import write_glb
from unmix_plugin.neumatex.demo.surfaces import LayeredSurface, SpectralSurface, demo_mesh, demo_surface
from unmix_plugin.neumatex.tracing.built_in_lights import built_in_environment
from unmix_plugin.neumatex.tracing.environment import Environment, MovingFrame
from unmix_plugin.neumatex.tracing.light_files import of_lamp, read_lamp
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh, pixel_hits
from unmix_plugin.neumatex.tracing.surface import Surface
from unmix_plugin.scenes.demo.scene import lens_entries, transform_matrix, written_once
from unmix_plugin.scenes.demo.shading import band_centers_nm
from unmix_plugin.scenes.folder import transforms_bytes
from unmix_plugin.scenes.kept import user_cache
from unmix_plugin.scenes.reading.faults import FILE_NAME
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

DEFAULT_SIZE, DEFAULT_VIEWS, DEFAULT_BANDS = 96, 24, 16
DEFAULT_LIGHTS = ("overcast", "lantern", "window-room", "studio", "ring-light")
"""Of the object in colours, the light of training first: one that shows all colours of a material."""
DEFAULT_SPECTRAL_LIGHTS = ("clear-sky", "overcast", "lantern")
"""Of the spectral object; the sun of the first casts shadows."""
_VIEWS_A_LIGHT = 3
"""Pictures under each light that training never sees."""
_EVALUATION_INTERVAL = 8
"""Every so many views one is for evaluation, from the first on."""
_LAMPS = ("D50", "A")
"""That light a spectral object in training, and elsewhere."""
_SAMPLES, _EVALUATION_SAMPLES, _SPECTRAL_EVALUATION_SAMPLES = 64, 384, 160
"""Paths a pixel."""
_BOUNCES = 2
_SUBPIXELS = 2
_MEAN_RADIANCE, _SPECTRAL_MEAN_RADIANCE = 0.3, 0.2
"""Of the object, which its environments are scaled to; low enough for highlights of spectral pictures to stay below 1
nearly everywhere."""
_DISTANCE = 4.2
_ELEVATIONS_DEG = (-40.0, 70.0)
_MARGIN = 1.12
"""Half of a picture, as a multiple of the object's radius."""

Say = Callable[[str], object]
"""What to do with a line about the progress."""


def demo_object_path(name: str, say: Say) -> Path:
    """The folder of a default demo object, written on first use, which takes a minute or two; kept in the user's cache,
    where a changed generator writes into a new folder. Raises SceneError: the cache can't be written."""
    digest = hashlib.sha256()
    for room in ("demo", "tracing"):
        for path in sorted((Path(__file__).parent.parent / room).glob("*.py")):
            digest.update(path.read_bytes())

    def write(folder: Path) -> None:
        if name == "demo-object":
            mesh, surface = demo_mesh(), demo_surface()
            write_object(folder, mesh, surface, DEFAULT_LIGHTS, DEFAULT_SIZE, DEFAULT_VIEWS, say=say)
        else:
            numbers = DEFAULT_SIZE, DEFAULT_VIEWS, DEFAULT_BANDS
            write_spectral_object(folder, demo_mesh(), DEFAULT_SPECTRAL_LIGHTS, *numbers, say=say)

    target = user_cache() / f"{name}-{digest.hexdigest()[:12]}" / "object"
    return written_once(target, f"the {name.replace('-', ' ')}", write, _is_complete)


def viewpoints(views: int, size: int, radius: float, first: int = 0) -> Cameras:
    """Square pinhole cameras that look at the origin, azimuths spread by the golden angle.

    Args:
        views: N.
        size: Rows and columns.
        radius: Of a ball about the origin that each picture shows whole, below 3.
        first: Number of the first view; other numbers are other places.
    """
    i = first + np.arange(views)
    azimuths = i * np.pi * (3 - np.sqrt(5))
    # A second irrational stride decouples elevation from order, so that any few views see all sides.
    shares = (i * np.sqrt(2) + 0.5) % 1
    low, high = np.sin(np.deg2rad(_ELEVATIONS_DEG))
    z = low + (high - low) * shares
    flat = np.sqrt(1 - z**2)
    backward = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), z], axis=1)
    half_angle = np.arcsin(min(_MARGIN * radius / _DISTANCE, 0.95))
    return upright_cameras(_DISTANCE * backward, backward, size, 2 * half_angle)


@dataclass(frozen=True)
class _Subject:
    """What pictures are taken of."""

    ray_mesh: RayMesh
    surface: Surface
    generator: torch.Generator
    size: int

    def cameras(self, views: int, first: int = 0) -> Cameras:
        return viewpoints(views, self.size, float(self.ray_mesh.mesh.vertices.norm(dim=-1).max()), first)

    def picture(
        self, light: Environment, cameras: Cameras, index: int, samples: int
    ) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
        """Radiance multiplied by alpha, and alpha."""
        traced = TracedObject(self.ray_mesh, light, self.surface)
        return traced.picture(cameras, index, samples, _BOUNCES, _SUBPIXELS, self.generator)

    def shown(
        self, cameras: Cameras, index: int, of_parameters: Callable[[Tensor], Tensor]
    ) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
        """Means over what is seen in each pixel of a function of the material, 0 where nothing is; and alpha."""
        hits = pixel_hits(self.ray_mesh, cameras, index, _SUBPIXELS)
        values = of_parameters(self.surface.parameters(hits.points.positions))
        return hits.image(values) / hits.alpha().clamp(min=1e-6)[..., None], hits.alpha()

    def in_each_light(
        self, folder: Path, lights: Sequence[str], views: int, seed: int, say: Say
    ) -> Iterator[tuple[Path, Environment, Cameras]]:
        """Where what is seen in each light is written, the light, and from where it is seen; that of training first."""
        for number, name in enumerate(lights):
            say(f"demo object: rendering light {number + 1} of {len(lights)} ({name})")
            light = built_in_environment(name, seed)
            if number:
                cameras = self.cameras(_VIEWS_A_LIGHT, 1000 + _VIEWS_A_LIGHT * number)
                yield folder / "relit" / name, light, cameras
            else:
                yield folder, light, self.cameras(views)

    def exposure(self, light: Environment, mean_radiance: float) -> Float[Tensor, ""]:
        """Factor of a light that gives the object a mean radiance."""
        cameras = self.cameras(4).resized(24, 24)
        pictures = [self.picture(light, cameras, index, 16) for index in range(len(cameras))]
        radiance, alpha = (torch.stack(parts).sum() for parts in zip(*pictures, strict=True))
        return mean_radiance * light.num_colours * alpha / radiance

    def write_mesh(self, path: Path, kinds: Sequence[str], to_rgb: Tensor | None = None) -> None:
        """A glTF mesh with linear colours at its vertices, and the names of its materials."""
        mesh = self.ray_mesh.mesh
        colours = self.surface.family.base_colour(self.surface.parameters(mesh.vertices))
        colours = colours if to_rgb is None else (colours @ to_rgb).clamp(0, 1)
        parts = (mesh.vertices.numpy(), mesh.normals.numpy(), colours.numpy(), mesh.faces.numpy())
        write_glb(path, *parts, {}, {"materials": list(kinds)})


def write_object(
    folder: Path,
    mesh: Mesh,
    surface: LayeredSurface,
    lights: Sequence[str],
    size: int,
    views: int,
    seed: int = 0,
    say: Say = lambda _: None,
) -> None:
    """Write an object in colours.

    Args:
        lights: Built-in ones; the first is that of training.
        size: Rows and columns of the pictures.
        views: Pictures under the light of training.
        seed: Of the lights, and of the paths that are traced.
    """
    subject = _Subject(RayMesh(mesh), surface, torch.Generator().manual_seed(seed), size)
    subject.write_mesh(folder / "mesh.glb", surface.kinds)
    for place, light, cameras in subject.in_each_light(folder, lights, views, seed, say):
        light = Environment(light.image * subject.exposure(light, _MEAN_RADIANCE))
        frames: list[dict[str, Any]] = []
        for index in range(len(cameras)):
            path = f"images/{index:03d}.exr"
            is_training = place == folder and index % _EVALUATION_INTERVAL
            samples = _SAMPLES if is_training else _EVALUATION_SAMPLES
            radiance, alpha = subject.picture(light, cameras, index, samples)
            _write_picture(place / path, radiance / alpha.clamp(min=1e-6)[..., None], alpha)
            frames.append({"file_path": path, "transform_matrix": transform_matrix(cameras, index)})
        keys = {"environment_path": "environment.exr", "tone_mapping": "linear", "frames": frames}
        _write_picture(place / "environment.exr", light.image)
        _write_json(place, {**lens_entries(cameras), **keys})
    cameras = subject.cameras(views)
    for index in range(0, views, _EVALUATION_INTERVAL):
        colours = subject.shown(cameras, index, surface.family.base_colour)
        _write_picture(folder / "truth" / "base_colour" / f"{index:03d}.exr", *colours)


def write_spectral_object(
    folder: Path,
    mesh: Mesh,
    lights: Sequence[str],
    size: int,
    views: int,
    num_bands: int,
    seed: int = 0,
    say: Say = lambda _: None,
    moves: MovingFrame | None = None,
) -> None:
    """Write a spectral object as `write_object` does one in colours; bands lie evenly between 400 and 700 nm, and the
    seed says of what materials it is. `moves`: the frame in which the light of training stands still, where it turns
    with the camera."""
    bands, ray_mesh = Bands.of(band_centers_nm(num_bands)), RayMesh(mesh)
    surface = SpectralSurface(seed, bands.centers_nm, ray_mesh.mesh.vertices)
    subject = _Subject(ray_mesh, surface, torch.Generator().manual_seed(seed), size)
    subject.write_mesh(folder / "mesh.glb", surface.names, rgb_matrix(bands))
    table = SpectraTable(bands, surface.names, surface.family.endmembers.double().numpy())
    write_spectra_csv(folder / "endmembers.csv", table)
    places = subject.in_each_light(folder, lights, views, seed, say)
    for number, (place, light, cameras) in enumerate(places):
        light = light if number else replace(light, moves=moves)
        truth = None if number else surface
        _write_cubes(place, subject, light, cameras, bands, _LAMPS[number % 2], truth)


def _write_cubes(
    folder: Path,
    subject: _Subject,
    colours: Environment,
    cameras: Cameras,
    bands: Bands,
    lamp_name: str,
    truth: SpectralSurface | None,
) -> None:
    """Cubes under one light with transforms.json, the light and the lamp; with truth, abundances too."""
    lamp, to_rgb = read_lamp(lamp_name, bands), rgb_matrix(bands)
    light = of_lamp(colours, torch.from_numpy(lamp))
    factor = subject.exposure(light, _SPECTRAL_MEAN_RADIANCE)
    light, frames = replace(light, image=light.image * factor), list[dict[str, Any]]()
    splits: dict[str, list[str]] = {"train_filenames": [], "val_filenames": []}
    for index in range(len(cameras)):
        is_training = truth is not None and index % _EVALUATION_INTERVAL
        samples = _SAMPLES if is_training else _SPECTRAL_EVALUATION_SAMPLES
        radiance, alpha = subject.picture(light, cameras, index, samples)
        frame = _write_view(folder, f"{index:03d}", radiance, alpha, to_rgb)
        splits["train_filenames" if is_training else "val_filenames"].append(frame["file_path"])
        if truth is not None and not is_training:
            frame["abundance_file_path"] = f"abundances/{index:03d}.npy"
            shares, _ = subject.shown(cameras, index, truth.family.abundances)
            _save(folder / frame["abundance_file_path"], shares)
        frames.append({**frame, "transform_matrix": transform_matrix(cameras, index)})
    _write_picture(folder / "environment.exr", colours.image * factor)
    write_spectra_csv(folder / "illuminant.csv", SpectraTable(bands, ("power",), lamp[None]))
    content = {
        **lens_entries(cameras),
        "wavelengths": bands.centers_nm.tolist(),
        "illuminant_path": "illuminant.csv",
        "environment_path": "environment.exr",
        "tone_mapping": "linear",
        "value_scale": 1.0,
    }
    if light.moves is not None:
        kind, middle, axis = light.moves.kind, light.moves.middle, light.moves.axis
        content["environment_moves"] = {"kind": kind, "middle": list(middle), "axis": list(axis)}
    if truth is not None:
        content |= {
            "mesh_path": "mesh.glb",
            "materials": list(truth.names),
            "endmembers_path": "endmembers.csv",
        }
        content |= {**splits, "test_filenames": splits["val_filenames"]}
    _write_json(folder, {**content, "frames": frames})


def _write_view(
    folder: Path,
    name: str,
    radiance: Float[Tensor, "H W B"],
    alpha: Float[Tensor, "H W"],
    to_rgb: Float[Tensor, "B 3"],
) -> dict[str, Any]:
    """A cube, multiplied by alpha, and a picture with alpha; gives their entry, but for the pose."""
    frame = {"file_path": f"images/{name}.png", "hyperspectral_file_path": f"cubes/{name}.npy"}
    _save(folder / frame["hyperspectral_file_path"], radiance)
    straight = (radiance @ to_rgb).clamp(min=0) / alpha.clamp(min=1e-6)[..., None]
    picture = torch.cat([linear_to_srgb(straight).clamp(0, 1), alpha[..., None]], dim=-1)
    write_file(folder / frame["file_path"], rgba_png_bytes((picture * 255).round().byte().numpy()))
    return frame


def _write_picture(path: Path, colours: Float[Tensor, "H W 3"], alpha: Tensor | None = None) -> None:
    """Colours, not multiplied by alpha."""
    channels = dict(zip("RGB", colours.unbind(dim=-1), strict=True)) | ({} if alpha is None else {"A": alpha})
    write_exr(path, {name: channel.numpy() for name, channel in channels.items()}, {})


def _write_json(folder: Path, content: dict[str, Any]) -> None:
    (folder / FILE_NAME).write_bytes(transforms_bytes(content))


def _save(path: Path, numbers: Tensor) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, numbers.numpy().astype(np.float16))


def _is_complete(folder: Path) -> bool:
    """Whether a folder holds an object with all pictures of the light of training."""
    try:
        frames = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["frames"]
        paths = [folder / frame["file_path"] for frame in frames]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return all(path.is_file() for path in (*paths, folder / "mesh.glb", folder / "environment.exr"))
