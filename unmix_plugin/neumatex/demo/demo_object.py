"""Built-in objects as folders: pictures of a procedural mesh with layered materials, by our own path tracer.

The folder holds transforms.json, mesh.glb, environment.exr and images/ under one light; relit/<light>/ holds the same
under lights that training never sees, and truth/base_colour/ the base colour of evaluation views. Pictures are linear
OpenEXR with straight alpha. Every 8th view is for evaluation.

Notation: `H x W` pixels, `N` views.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.formats.exr import write_exr
from unmix_plugin.formats.glb import write_glb
from unmix_plugin.neumatex.demo.layered_surface import LayeredSurface
from unmix_plugin.neumatex.demo.shapes import demo_mesh
from unmix_plugin.neumatex.demo.viewpoints import viewpoints
from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.built_in import NAMES, built_in_environment
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.surface import Surface
from unmix_plugin.neumatex.tracing.primary_hits import pixel_hits
from unmix_plugin.neumatex.tracing.render_view import render_view
from unmix_plugin.scenes.demo.scene import (
    check_bounds,
    lens_entries,
    staging_for,
    transform_matrix,
    user_cache,
    written_once,
)

DEFAULT_SIZE, DEFAULT_VIEWS, DEFAULT_LIGHTS = 96, 24, 4
SIZE_BOUNDS, VIEWS_BOUNDS, LIGHTS_BOUNDS = (16, 1024), (2, 1000), (0, len(NAMES) - 1)
VIEWS_A_LIGHT = 3
"""Pictures under each light that training never sees."""
EVALUATION_INTERVAL = 8
"""Every so many views one is for evaluation, from the first on."""

_TRAINING_LIGHTS = ("studio", "softbox-strips", "clear-sky", "window-room", "overcast")
"""Lights that show all colours of a material; an object is captured under one of them."""

_SAMPLES, _EVALUATION_SAMPLES = 64, 384
"""Paths a pixel."""
_BOUNCES = 2
_SUBPIXELS = 2
_MEAN_RADIANCE = 0.3
"""Of the object, which its environments are scaled to."""

Say = Callable[[str], None]
"""What to do with a line about the progress."""


@dataclass(frozen=True)
class Subject:
    """What pictures are taken of."""

    ray_mesh: RayMesh
    surface: Surface
    generator: torch.Generator
    size: int

    def cameras(self, views: int, first: int) -> Cameras:
        radius = float(self.ray_mesh.mesh.vertices.norm(dim=-1).max())
        return viewpoints(views, self.size, radius, first)

    def picture(
        self, light: Environment, cameras: Cameras, index: int, samples: int
    ) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
        """Radiance multiplied by alpha, and alpha."""
        return render_view(
            self.surface,
            self.ray_mesh,
            light,
            cameras,
            index,
            samples=samples,
            bounces=_BOUNCES,
            subpixels=_SUBPIXELS,
            generator=self.generator,
        )

    def exposed(self, light: Environment) -> Environment:
        """A light scaled so that the object's mean radiance is `_MEAN_RADIANCE`."""
        return Environment(light.image * self.exposure(light, _MEAN_RADIANCE))

    def exposure(self, light: Environment, mean_radiance: float) -> Float[Tensor, ""]:
        """Factor of a light that gives the object a mean radiance."""
        cameras = self.cameras(4, 0).resized(24, 24)
        pictures = [self.picture(light, cameras, index, 16) for index in range(len(cameras))]
        radiance, alpha = (torch.stack(parts).sum() for parts in zip(*pictures, strict=True))
        return mean_radiance * light.num_colours * alpha / radiance


def demo_object(
    folder: Path,
    seed: int = 0,
    size: int = DEFAULT_SIZE,
    views: int = DEFAULT_VIEWS,
    lights: int = DEFAULT_LIGHTS,
    say: Say | None = None,
) -> None:
    """Write an object. It is built beside the folder and moved in when complete.

    Args:
        folder: Made if absent, parents too.
        seed: Shape, materials and lights follow from it; shapes take turns.
        size: Rows and columns of the pictures.
        views: Pictures under the light of training.
        lights: Other lights, each with `VIEWS_A_LIGHT` pictures.
        say: Gets a line for each light.
    Raises:
        ConfigError: a number out of bounds; a folder with something in it, or no folder at all.
        SceneError: the folder can't be written, or the disk is full.
    """
    check_bounds(
        "a demo object",
        {
            "size": (size, SIZE_BOUNDS),
            "views": (views, VIEWS_BOUNDS),
            "lights": (lights, LIGHTS_BOUNDS),
        },
    )
    with staging_for(folder, "the demo object", overwrite=False) as staging:
        _write_object(staging / "object", seed, size, views, lights, say)
        if folder.exists():
            folder.rmdir()
        (staging / "object").rename(folder)


def demo_object_path(cache_dir: Path | None = None, say: Say | None = None) -> Path:
    """The folder of the default demo object, written on first use, which takes a minute or two.

    Args:
        cache_dir: Where to keep it; None is `unmix-nerf` in XDG_CACHE_HOME or ~/.cache. A changed generator writes
            into a new folder.
        say: Gets a line for each light.
    Raises:
        SceneError: the cache can't be written.
    """
    return cached_object(
        "demo-object",
        lambda folder: _write_object(folder, 0, DEFAULT_SIZE, DEFAULT_VIEWS, DEFAULT_LIGHTS, say),
        cache_dir,
    )


def cached_object(name: str, write: Callable[[Path], None], cache_dir: Path | None) -> Path:
    """The folder of an object that is written once for each version of the generator; see `demo_object_path`.

    Args:
        name: Of its folder in the cache.
        write: Writes it into a folder.
    """
    target = (cache_dir or user_cache()) / f"{name}-{_generator_hash()}" / "object"
    return written_once(target, f"the {name.replace('-', ' ')}", write, _is_complete)


def _write_object(folder: Path, seed: int, size: int, views: int, lights: int, say: Say | None) -> None:
    names = light_names(seed, lights)
    surface = LayeredSurface(seed)
    subject = Subject(RayMesh(demo_mesh(seed)), surface, torch.Generator().manual_seed(seed), size)
    colours = surface.family.base_colour(surface.parameters(subject.ray_mesh.mesh.vertices))
    write_mesh(folder / "mesh.glb", subject.ray_mesh.mesh, colours, surface.kinds)
    for number, name in enumerate(names):
        if say is not None:
            say(f"demo object: rendering light {number + 1} of {len(names)} ({name})")
        light = subject.exposed(built_in_environment(name, seed))
        if number == 0:
            cameras = subject.cameras(views, 0)
            _write_pictures(folder, subject, light, cameras, EVALUATION_INTERVAL)
            _write_base_colours(folder / "truth" / "base_colour", subject, cameras)
        else:
            cameras = subject.cameras(VIEWS_A_LIGHT, 1000 + VIEWS_A_LIGHT * number)
            _write_pictures(folder / "relit" / name, subject, light, cameras, 1)


def light_names(seed: int, lights: int) -> list[str]:
    """The light of training, one of `_TRAINING_LIGHTS`, and others after it."""
    rng = np.random.default_rng([3, seed])
    chosen = str(rng.choice(_TRAINING_LIGHTS))
    return [chosen, *(str(name) for name in rng.permutation(NAMES) if name != chosen)][: lights + 1]


def _write_pictures(
    folder: Path, subject: Subject, light: Environment, cameras: Cameras, evaluation_interval: int
) -> None:
    """Pictures under one light with transforms.json and the light itself."""
    frames: list[dict[str, Any]] = []
    for index in range(len(cameras)):
        path = f"images/{_name(index)}"
        samples = _SAMPLES if index % evaluation_interval else _EVALUATION_SAMPLES
        radiance, alpha = subject.picture(light, cameras, index, samples)
        _write_straight(folder / path, radiance, alpha)
        frames.append({"file_path": path, "transform_matrix": transform_matrix(cameras, index)})
    write_channels(folder / "environment.exr", light.image)
    content = {
        **lens_entries(cameras),
        "environment_path": "environment.exr",
        "tone_mapping": "linear",
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _write_base_colours(folder: Path, subject: Subject, cameras: Cameras) -> None:
    """Base colours of evaluation views."""
    for index in range(0, len(cameras), EVALUATION_INTERVAL):
        hits = pixel_hits(subject.ray_mesh, cameras, index, _SUBPIXELS)
        parameters = subject.surface.parameters(hits.points.positions)
        colours = hits.image(subject.surface.family.base_colour(parameters))
        _write_straight(folder / _name(index), colours, hits.alpha())


def _write_straight(path: Path, premultiplied: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"]) -> None:
    """RGBA whose colours are not multiplied by alpha; 0 where it is 0."""
    straight = premultiplied / alpha.clamp(min=1e-6)[..., None]
    write_channels(path, torch.cat([straight, alpha[..., None]], dim=-1))


def write_channels(path: Path, image: Float[Tensor, "H W c"]) -> None:
    """Channels R, G, B, A as far as there are."""
    names = "RGBA"[: image.shape[-1]]
    write_exr(path, {name: image[..., index].numpy() for index, name in enumerate(names)}, {})


def write_mesh(path: Path, mesh: Mesh, colours: Float[Tensor, "V 3"], kinds: Sequence[str]) -> None:
    """A glTF mesh with linear colours at its vertices, and the names of its materials."""
    parts = (mesh.vertices.numpy(), mesh.normals.numpy(), colours.numpy(), mesh.faces.numpy())
    write_glb(path, *parts, {}, {"materials": list(kinds)})


def _name(index: int) -> str:
    return f"{index:03d}.exr"


def _is_complete(folder: Path) -> bool:
    """Whether a folder holds an object with all pictures of the light of training."""
    try:
        frames = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["frames"]
        paths = [folder / frame["file_path"] for frame in frames]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return all(path.is_file() for path in (*paths, folder / "mesh.glb", folder / "environment.exr"))


def _generator_hash() -> str:
    """Changes with the generator's code, so that a cached object is never one of another version."""
    digest = hashlib.sha256()
    rooms = Path(__file__).parent.parent
    for room in ("demo", "geometry", "lighting", "materials", "tracing"):
        for path in sorted((rooms / room).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
