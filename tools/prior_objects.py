"""Objects with known materials, and what some views of them show at surface points, for the training of the prior.

Notation: `B` objects, `N` points, `V` views, `K` lobes of light, `M` materials of an object or noises, `P` parameters
of `LayeredFamily`, `W` waves of all noises.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from safetensors.torch import load_file, save
from torch import Tensor
from torch.nn import functional

from tools.procedural_objects import seeded_mesh, seeded_surface
from unmix_plugin.formats.files import write_file
from unmix_plugin.neumatex.prior.observations import Observations, known_light, sample_surface
from unmix_plugin.neumatex.tracing.built_in_lights import NAMES, built_in_environment
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import LayeredFamily
from unmix_plugin.neumatex.tracing.mesh import Mesh, mesh_of
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh, SurfacePoints
from unmix_plugin.neumatex.tracing.surface import Surface

_WAVES = 12
_INDEX = {name: index for index, name in enumerate(LayeredFamily.PARAMETERS)}
_FIRST_DEMO_SEED = 10_000_000
"""Of the built-in objects that training objects are like; those of smaller seeds are never seen in training."""


def random_materials(count: int, generator: torch.Generator) -> Float[Tensor, "M P"]:
    """Layered materials: plain ones, metals, lacquer, cloth, haze and dust, and mixtures of these."""

    def uniform(low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    def sometimes(chance: float, values: Tensor) -> Tensor:
        return torch.where(uniform() < chance, values, torch.zeros(()))

    parameters = torch.zeros(count, LayeredFamily.num_parameters)
    brightness = uniform(0.02, 0.95)[:, None]
    hue = torch.rand(count, 3, generator=generator)
    saturation = uniform()[:, None]
    parameters[:, :3] = (brightness * (1 - saturation * hue)).clamp(0.01, 0.98)
    drawn = {
        "metallicity": sometimes(0.3, torch.where(uniform() < 0.7, 1.0, uniform())),
        "roughness": uniform(0.05, 1.0),
        "specular level": torch.where(uniform() < 0.5, 0.5, uniform()),
        "coat weight": sometimes(0.3, uniform(0.3, 1.0)),
        "coat roughness": uniform(0.0, 0.6),
        "sheen weight": sometimes(0.25, uniform(0.2, 1.0)),
        "sheen roughness": uniform(0.1, 1.0),
        "sheen tint": uniform(),
        "haze weight": sometimes(0.25, uniform(0.2, 1.0)),
        "haze spread": uniform(),
        "dust": sometimes(0.2, uniform(0.1, 1.0)),
    }
    for name, values in drawn.items():
        parameters[:, _INDEX[name]] = values
    return parameters


@dataclass(frozen=True)
class SmoothNoise:
    """Sums of random waves: values of mean 0 and variance 1 at any point."""

    vectors: Float[Tensor, "3 W"]
    phases: Float[Tensor, " W"]

    @staticmethod
    def draw(count: int, scale: float, generator: torch.Generator) -> SmoothNoise:
        """M = `count` independent noises.

        Args:
            scale: Standard deviation of the wave vectors, radians a model unit.
        """
        waves = _WAVES * count
        vectors = torch.randn(3, waves, generator=generator) * scale / math.sqrt(3)
        return SmoothNoise(vectors, 2 * math.pi * torch.rand(waves, generator=generator))

    def __call__(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N M"]:
        """Values at points."""
        values = torch.sin(positions @ self.vectors + self.phases).unflatten(1, (-1, _WAVES))
        return values.sum(dim=-1) * math.sqrt(2 / _WAVES)


@dataclass(frozen=True)
class PatchedSurface:
    """Layered materials in patches, with colours and roughness that vary within each; a `Surface`."""

    family: LayeredFamily
    materials: Float[Tensor, "M P"]
    patches: SmoothNoise
    sharpness: float
    """How abrupt the edges of patches are."""
    detail: SmoothNoise
    strength: float
    """How much colours and roughness vary."""

    @staticmethod
    def draw(generator: torch.Generator) -> PatchedSurface:
        """One object's materials: one to four of them."""
        count = 1 + int(torch.randint(4, (), generator=generator))
        scale, sharpness, strength = (float(value) for value in torch.rand(3, generator=generator))
        scale = 1 + 5 * scale
        return PatchedSurface(
            LayeredFamily(),
            random_materials(count, generator),
            SmoothNoise.draw(count, scale, generator),
            2 + 38 * sharpness,
            SmoothNoise.draw(2, 3 * scale, generator),
            0.4 * strength**2,
        )

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters of `LayeredFamily` at points."""
        shares = torch.softmax(self.sharpness * self.patches(positions), dim=-1)
        parameters = shares @ self.materials
        detail = self.detail(positions) * self.strength
        parameters[:, :3] = (parameters[:, :3] * torch.exp(2 * detail[:, :1])).clamp(0.01, 0.98)
        roughness = _INDEX["roughness"]
        parameters[:, roughness] = (parameters[:, roughness] + detail[:, 1]).clamp(0.03, 1.0)
        return parameters


def random_mesh(generator: torch.Generator) -> Mesh:
    """One object in model space: one to three parts of different kinds, which may run into each other."""
    count = 1 + int(torch.multinomial(torch.tensor([0.6, 0.25, 0.15]), 1, generator=generator))
    vertices, faces, first = [], [], 0
    for _ in range(count):
        part = _random_part(generator)
        points = torch.from_numpy(np.asarray(part.vertices, dtype=np.float32))
        turned = _deformed(points, generator) @ _random_rotation(generator).T
        shift = torch.zeros(3) if count == 1 else 0.9 * (torch.rand(3, generator=generator) - 0.5)
        vertices.append(turned + shift)
        faces.append(torch.from_numpy(np.asarray(part.faces, dtype=np.int32)) + first)
        first += len(points)
    mesh = mesh_of(torch.cat(vertices), torch.cat(faces).int())
    return mesh.transformed(*mesh.to_model_space())


def random_eyes(count: int, generator: torch.Generator) -> Float[Tensor, "V 3"]:
    """Cameras around an object, more at middle heights than at the poles."""
    turn = 2 * math.pi * torch.rand((), generator=generator)
    azimuth = (
        turn + 2 * math.pi * (torch.arange(count) + 0.6 * torch.rand(count, generator=generator)) / count
    )
    height = -0.5 + 1.4 * torch.rand(count, generator=generator)
    flat = (1 - height.square()).sqrt()
    distance = 3.0 + 2.0 * torch.rand((), generator=generator)
    return distance * torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), height], dim=-1)


def _random_part(generator: torch.Generator) -> trimesh.Trimesh:
    kind = int(torch.randint(6, (), generator=generator))
    a, b = (float(value) for value in torch.rand(2, generator=generator))
    if kind == 0:
        return trimesh.creation.torus(1.0, 0.2 + 0.4 * a, major_sections=64, minor_sections=32)
    if kind == 1:
        return _subdivided(trimesh.creation.box((1.0, 0.4 + a, 0.4 + b)))
    if kind == 2:
        return _subdivided(trimesh.creation.cylinder(0.3 + 0.7 * a, 0.3 + 1.7 * b, sections=32))
    if kind == 3:
        return trimesh.creation.capsule(0.3 + 1.7 * a, 0.4 + 0.4 * b, count=[32, 24])
    return trimesh.creation.icosphere(subdivisions=4)


def _subdivided(part: trimesh.Trimesh) -> trimesh.Trimesh:
    """Corners of a part are split first, so that each side keeps its own normal."""
    split = trimesh.Trimesh(part.vertices[part.faces.reshape(-1)], _triples(len(part.faces)), process=False)
    points, faces, *_ = trimesh.remesh.subdivide_to_size(split.vertices, split.faces, 0.25)
    return trimesh.Trimesh(points, faces, process=False)


def _triples(count: int) -> Int[np.ndarray, "F 3"]:
    return np.arange(3 * count).reshape(-1, 3)


def _deformed(points: Tensor, generator: torch.Generator) -> Tensor:
    """Waves pushed through a part and unequal stretching, each more or less strong."""
    strength = 0.35 * float(torch.rand((), generator=generator)) ** 2
    scale = 1.0 + 3.0 * float(torch.rand((), generator=generator))
    waved = points + strength * SmoothNoise.draw(3, scale, generator)(points)
    return waved * (0.5 + torch.rand(3, generator=generator))


def _random_rotation(generator: torch.Generator) -> Tensor:
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
    return rotation * torch.linalg.det(rotation)


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
            Observations(**{name: _widened(part[rows]) for name, part in vars(self.observations).items()}),
            self.materials[rows].float(),
        )


def training_object(
    seed: int, num_points: int = 640, num_views: int = 12, samples: int = 24, demo_share: float = 0.75
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
        seeded_mesh(_FIRST_DEMO_SEED + seed, resolution=40)
        if kind < demo_share * 2 / 3
        else random_mesh(generator)
    )
    surface = seeded_surface(_FIRST_DEMO_SEED + seed) if kind < demo_share else PatchedSurface.draw(generator)
    environment = random_environment(generator)
    points = sample_surface(ray_mesh.mesh, num_points, generator)
    eyes = random_eyes(num_views, generator)
    known = known_light(points, eyes, ray_mesh, environment, generator)
    colours = traced_colours(surface, ray_mesh, environment, points, eyes, known, samples, generator)
    observations = replace(known, colours=colours).alone()
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
    known: Observations,
    samples: int,
    generator: torch.Generator,
) -> Float[Tensor, "N V 3"]:
    """What the views see, divided by the environment's mean radiance; 0 where they see nothing."""
    rows = known.visible.nonzero()
    to_eye = functional.normalize(eyes[rows[:, 1]] - points.positions[rows[:, 0]], dim=-1)
    with torch.no_grad():
        traced = TracedObject(ray_mesh, environment, surface)
        seen = replace(points.select(rows[:, 0]), to_eye=to_eye)
        radiance = traced.light(seen, samples, generator=generator)
    colours = torch.zeros(*known.visible.shape, 3)
    colours[known.visible] = radiance / environment.mean_radiance().mean().clamp(min=1e-12)
    return colours


def write_objects(path: Path, objects: list[TrainingObjects]) -> None:
    """Put objects of the same size into one file."""
    parts = [{**vars(one.observations), "materials": one.materials} for one in objects]
    joined = {name: torch.cat([_narrowed(part[name]) for part in parts]).contiguous() for name in parts[0]}
    write_file(path, save(joined))


def read_objects(paths: list[Path]) -> TrainingObjects:
    """The objects of files, light still in float16."""
    tables = [load_file(path) for path in paths]
    joined = {name: torch.cat([table[name] for table in tables]) for name in tables[0]}
    materials = joined.pop("materials")
    return TrainingObjects(Observations(**joined), materials)


def _narrowed(values: Tensor) -> Tensor:
    return values if values.dtype == torch.bool else values.clamp(max=6e4).half()


def _widened(values: Tensor) -> Tensor:
    return values if values.dtype == torch.bool else values.float()
