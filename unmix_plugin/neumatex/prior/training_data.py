"""Objects with known materials, and what some views of them show at surface points, for the training of priors.

Notation: `B` objects, `N` points, `V` views, `K` lobes of light, `P` parameters of `LayeredFamily`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save
from torch import Tensor
from torch.nn import functional

from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.neumatex.demo.layered_surface import LayeredSurface
from unmix_plugin.neumatex.demo.shapes import demo_mesh
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh, SurfacePoints
from unmix_plugin.neumatex.lighting.built_in import NAMES, built_in_environment
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.prior.small_network import Observations
from unmix_plugin.neumatex.prior.surface_samples import KnownLight, known_light, sample_surface
from unmix_plugin.neumatex.prior.training_materials import PatchedSurface
from unmix_plugin.neumatex.prior.training_shapes import random_eyes, random_mesh
from unmix_plugin.neumatex.surface import Surface
from unmix_plugin.neumatex.tracing.path_tracer import reflected_radiance

_FIRST_DEMO_SEED = 10_000_000
"""Of the built-in objects that training objects are like; those of smaller seeds are never seen in training."""


@dataclass(frozen=True)
class TrainingObjects:
    """Observations of objects and the truth, light in float16."""

    observations: Observations
    materials: Float[Tensor, "B N P"]
    """Parameters of `LayeredFamily`."""

    def __len__(self) -> int:
        return len(self.materials)

    def select(self, rows: slice | list[int]) -> TrainingObjects:
        """Some of the objects, in float32."""
        return TrainingObjects(
            Observations(**{name: _widened(part[rows]) for name, part in _parts(self.observations).items()}),
            self.materials[rows].float(),
        )


def training_object(
    seed: int,
    num_points: int = 640,
    num_views: int = 12,
    samples: int = 24,
    demo_share: float = 0.75,
) -> TrainingObjects:
    """One object under one light, its views path-traced with one indirect bounce.

    Args:
        seed: What is drawn; the same seed gives the same object.
        samples: Paths a point and view.
        demo_share: Chance of materials like those of the built-in objects, and two thirds of it for their shapes;
            everything else varies more widely. No built-in object of a seed below `_FIRST_DEMO_SEED` is among them.
    """
    generator = torch.Generator().manual_seed(seed)
    kind = float(torch.rand((), generator=torch.Generator().manual_seed(_FIRST_DEMO_SEED + seed)))
    ray_mesh = RayMesh(
        demo_mesh(_FIRST_DEMO_SEED + seed, resolution=40)
        if kind < demo_share * 2 / 3
        else random_mesh(generator)
    )
    surface = LayeredSurface(_FIRST_DEMO_SEED + seed) if kind < demo_share else PatchedSurface.draw(generator)
    environment = random_environment(generator)
    points = sample_surface(ray_mesh.mesh, num_points, generator)
    eyes = random_eyes(num_views, generator)
    known = known_light(points, eyes, ray_mesh, environment, generator)
    colours = traced_colours(surface, ray_mesh, environment, points, eyes, known, samples, generator)
    parts = {name: part[None] for name, part in _parts(known).items()}
    observations = Observations(positions=points.positions[None], colours=colours[None], **parts)
    return TrainingObjects(observations, surface.parameters(points.positions)[None])


def random_environment(generator: torch.Generator) -> Environment:
    """A built-in light, turned, or the mixture of two."""
    which = torch.randint(len(NAMES), (2,), generator=generator).tolist()
    seeds = torch.randint(1 << 20, (2,), generator=generator).tolist()
    turn, share, mixed = (float(value) for value in torch.rand(3, generator=generator))
    first, second = (
        built_in_environment(NAMES[name], seed, 64) for name, seed in zip(which, seeds, strict=True)
    )
    image = first.image if mixed < 0.5 else share * first.image + (1 - share) * second.image
    return Environment(image, 360 * turn)


def traced_colours(
    surface: Surface,
    ray_mesh: RayMesh,
    environment: Environment,
    points: SurfacePoints,
    eyes: Float[Tensor, "V 3"],
    known: KnownLight,
    samples: int,
    generator: torch.Generator,
) -> Float[Tensor, "N V 3"]:
    """What the views see, divided by the environment's mean radiance; 0 where they see nothing."""
    rows = known.visible.nonzero()
    to_eye = functional.normalize(eyes[rows[:, 1]] - points.positions[rows[:, 0]], dim=-1)
    with torch.no_grad():
        radiance = reflected_radiance(
            surface,
            ray_mesh,
            environment,
            points.select(rows[:, 0]),
            to_eye,
            samples=samples,
            bounces=1,
            generator=generator,
        )
    colours = torch.zeros(*known.visible.shape, 3)
    colours[known.visible] = radiance / environment.mean_radiance().mean().clamp(min=1e-12)
    return colours


def write_objects(path: Path, objects: list[TrainingObjects]) -> None:
    """Put objects of the same size into one file."""
    parts = [{**_parts(one.observations), "materials": one.materials} for one in objects]
    joined = {name: torch.cat([_narrowed(part[name]) for part in parts]).contiguous() for name in parts[0]}
    write_file(path, save(joined))


def read_objects(paths: list[Path]) -> TrainingObjects:
    """The objects of files, light still in float16."""
    tables = [load_file(path) for path in paths]
    joined = {name: torch.cat([table[name] for table in tables]) for name in tables[0]}
    materials = joined.pop("materials")
    return TrainingObjects(Observations(**joined), materials)


def _parts(values: Observations | KnownLight) -> dict[str, Tensor]:
    return {part.name: getattr(values, part.name) for part in fields(values)}


def _narrowed(values: Tensor) -> Tensor:
    return values if values.dtype == torch.bool else values.clamp(max=6e4).half()


def _widened(values: Tensor) -> Tensor:
    return values if values.dtype == torch.bool else values.float()
