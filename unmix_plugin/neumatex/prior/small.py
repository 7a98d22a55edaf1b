"""The shipped prior: from what views show of surface points to the material there, and to planes that hold it.

It was trained on procedural objects (tools/train_prior.py) and is small enough to run on a processor in a second or
two. Its interface is that of the published one (views in; planes, and networks that read them, out), but it knows the
mesh and the light, which the published one has to guess from the pictures. It works on the CPU.

Notation: `B` objects, `N` points, `V` views, `P` parameters of a material, `W` numbers of an embedding, `C` channels
and `R` texels of a plane.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import safetensors.torch
import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError
from torch import Tensor, nn
from torch.nn import functional

from unmix_plugin.errors import RunError, SceneError
from unmix_plugin.neumatex.prior.observations import (
    NUM_POINT_FEATURES,
    NUM_VIEW_FEATURES,
    Observations,
    PosedViews,
    known_light,
    point_features,
    sample_surface,
    view_features,
    well_spread,
)
from unmix_plugin.neumatex.tracing import neural
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.neumatex.tracing.surface import (
    NUM_CHANNELS,
    Readers,
    Triplane,
    bounded_log_variance,
    plane_features,
)

MaterialName = Literal["neural", "pbr"]
"""What an object's planes can be read as in a fit."""
TaskName = Literal["neural", "pbr", "layers"]
"""What the embeddings are trained to tell; the layers are there for the training alone."""
NUM_PARAMETERS: dict[TaskName, int] = {"neural": 9, "pbr": 5, "layers": 14}
SHIPPED = Path(__file__).parent.parent / "weights"
"""Folder of a safetensors file and of a JSON record of how it was made."""
WEIGHTS, RECORD = "small.safetensors", "small.json"
RESOLUTION = 32
"""R of fitted planes: cells that hold several points each, whose errors average out."""
_VIEW_WIDTH, _POINT_WIDTH, _NUM_HEADS, _NUM_EXCHANGES = 64, 128, 4, 3
_MOST_ASKED = 640
"""Points of an object that the others learn from: the first ones, which are as random as all."""
_RATE, _SHRINKAGE = 0.05, 1e-4
"""Of the fit of planes; shrinkage pulls texels that hardly a point reads to 0."""
_MOST_VIEWS = 12
"""Views that are used; of more, those whose directions are farthest apart."""
_NUM_POINTS = 3072


class SmallPrior(nn.Module):
    """Encoder of observations, what it says of each point, and the readers of planes that are fitted to that."""

    def __init__(self) -> None:
        super().__init__()
        self.view_encoder = _perceptron(NUM_VIEW_FEATURES, _VIEW_WIDTH)
        self.point_encoder = _perceptron(3 * _VIEW_WIDTH + NUM_POINT_FEATURES, _POINT_WIDTH)
        self.exchanges = nn.ModuleList([_PointExchange(_POINT_WIDTH) for _ in range(_NUM_EXCHANGES)])
        self.last_norm = nn.LayerNorm(_POINT_WIDTH)
        heads = {name: nn.Linear(_POINT_WIDTH, 2 * p) for name, p in NUM_PARAMETERS.items()}
        self.heads = nn.ModuleDict(heads)
        self.neural_readers = Readers(NUM_PARAMETERS["neural"])
        self.pbr_readers = Readers(NUM_PARAMETERS["pbr"])

    def readers_of(self, material: MaterialName) -> Readers:
        """The networks that read a material from planes."""
        return self.neural_readers if material == "neural" else self.pbr_readers

    def forward(self, o: Observations) -> Float[Tensor, "B N W"]:
        """Embeddings of points: what their views show, in any order, and what other points of the object are like."""
        encoded = self.view_encoder(view_features(o))
        seen = o.visible.any(dim=-1)
        mask = o.visible[..., None].float()
        total = mask.sum(dim=-2).clamp(min=1)
        mean = (encoded * mask).sum(dim=-2) / total
        spread = ((encoded - mean[..., None, :]).square() * mask).sum(dim=-2) / total
        largest = torch.where(o.visible[..., None], encoded, -1e4).amax(dim=-2)
        largest = torch.where(seen[..., None], largest, 0.0)
        shown = [mean, (spread + 1e-6).sqrt(), largest, point_features(o)]
        points = self.point_encoder(torch.cat(shown, dim=-1))
        for exchange in self.exchanges:
            points = exchange(points, seen)
        return self.last_norm(points)

    def estimate(
        self, embeddings: Float[Tensor, "B N W"], task: TaskName
    ) -> tuple[Float[Tensor, "B N P"], Float[Tensor, "B N P"]]:
        """Parameters in (0, 1) and their log-variances."""
        raw, raw_variance = self.heads[task](embeddings).chunk(2, dim=-1)
        return torch.sigmoid(raw), bounded_log_variance(raw_variance)


class _PointExchange(nn.Module):
    """Attention of points to others of the same object, then a perceptron for each.

    One point is seen under one light from a few sides; others of the same material show it under more.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first_norm, self.second_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries, self.keys_and_values = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.joined = nn.Linear(width, width)
        self.perceptron = nn.Sequential(nn.Linear(width, 3 * width), nn.SiLU(), nn.Linear(3 * width, width))

    def forward(self, points: Float[Tensor, "B N W"], seen: Bool[Tensor, "B N"]) -> Float[Tensor, "B N W"]:
        """Points after one exchange; those that no view sees ask, but are not asked."""
        normed = self.first_norm(points)
        asked, known = normed[:, :_MOST_ASKED], seen[:, :_MOST_ASKED]
        known = known | ~known.any(dim=-1, keepdim=True)
        keys, values = self.keys_and_values(asked).chunk(2, dim=-1)
        heads = [
            part.unflatten(-1, (_NUM_HEADS, -1)).transpose(1, 2)
            for part in (self.queries(normed), keys, values)
        ]
        found = functional.scaled_dot_product_attention(*heads, attn_mask=known[:, None, None])
        points = points + self.joined(found.transpose(1, 2).flatten(2))
        return points + self.perceptron(self.second_norm(points))


def _perceptron(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())


@dataclass(frozen=True)
class Estimates:
    """What is said of points of objects."""

    positions: Float[Tensor, "B N 3"]
    parameters: Float[Tensor, "B N P"]
    log_variance: Float[Tensor, "B N P"]


def fit_loss(readers: Readers, planes: Float[Tensor, "B 3 C R R"], estimates: Estimates) -> Float[Tensor, ""]:
    """How far the planes are from what is said of points: errors count by how sure it is, and log-variances too."""
    features = torch.stack([plane_features(*pair) for pair in zip(planes, estimates.positions, strict=True)])
    features, log_variance = features.flatten(0, 1), estimates.log_variance.flatten(0, 1)
    error = readers.material(features) - estimates.parameters.flatten(0, 1)
    # Parameters that are known to 0.02 or better count the same: beyond that a few points would decide all.
    certain = torch.exp(-0.5 * log_variance.clamp(min=-8.0))
    unsure = readers.log_variance(features) - log_variance
    loss = (error.square() * certain).mean() + 0.02 * unsure.square().mean()
    return loss + _SHRINKAGE * planes.square().mean()


def fit_planes(readers: Readers, estimates: Estimates, steps: int = 120) -> Float[Tensor, "B 3 C R R"]:
    """Planes of objects that the readers read back best, fitted from 0; the readers stay as they are."""
    with torch.enable_grad():
        count = len(estimates.positions)
        planes = torch.zeros(count, 3, NUM_CHANNELS, RESOLUTION, RESOLUTION, requires_grad=True)
        optimiser = torch.optim.Adam([planes], lr=_RATE, eps=1e-12)
        for _ in range(steps):
            (gradient,) = torch.autograd.grad(count * fit_loss(readers, planes, estimates), planes)
            planes.grad = gradient
            optimiser.step()
    return planes.detach()


def predict(
    views: PosedViews,
    ray_mesh: RayMesh,
    environment: Environment,
    material: MaterialName,
    *,
    resolution: int = 128,
    generator: torch.Generator,
    prior: SmallPrior | None = None,
) -> Triplane:
    """Planes of an object, and the networks that read them, on the CPU.

    Args:
        views: RGB pictures of the object, on the CPU; the training views of a scene.
        environment: The light of the pictures, with three colours.
        material: `neural`: base colour and six latents; `pbr`: base colour, roughness, metallicity.
        generator: Draws surface points and shadow rays, on the CPU.
        prior: Instead of the shipped one.
    Raises:
        SceneError: no view shows the mesh.
        RunError: the shipped weights are damaged, or were made for another decoder than the shipped one.
    """
    prior = read_small_prior(material) if prior is None else prior
    if ray_mesh.device.type != "cpu":
        ray_mesh = RayMesh(ray_mesh.mesh.to("cpu"))
    chosen = views[well_spread(views.cameras.camera_to_world[:, :, 3], _MOST_VIEWS)]
    with torch.no_grad():
        environment = replace(environment, image=environment.image.cpu())
        observations = _observe(chosen, ray_mesh, environment, generator)
        estimates = prior.estimate(prior(observations), material)
    planes = fit_planes(prior.readers_of(material), Estimates(observations.positions, *estimates))[0]
    return Triplane.filled(prior.readers_of(material), planes, resolution)


def _observe(
    views: PosedViews, ray_mesh: RayMesh, environment: Environment, generator: torch.Generator
) -> Observations:
    """What views show of points of the mesh; B is 1."""
    points = sample_surface(ray_mesh.mesh, _NUM_POINTS, generator)
    eyes = views.cameras.camera_to_world[:, :, 3]
    known = known_light(points, eyes, ray_mesh, environment, generator)
    colours, shown = views.at(points.positions)
    visible = known.visible & shown
    if not bool(visible.any()):
        raise SceneError(
            f"none of {len(eyes)} views shows the mesh: {int(known.visible.sum())} of its points face a camera, but "
            "the object is at none of their pixels; are mesh and cameras in the same world, and are alpha and masks "
            "right?"
        )
    mean = environment.mean_radiance().mean().clamp(min=1e-12)
    colours = torch.where(visible[..., None], colours / mean, 0.0)
    return replace(known, colours=colours, visible=visible).alone()


def read_small_prior(material: MaterialName, folder: Path = SHIPPED) -> SmallPrior:
    """The prior in a folder, ready to predict.

    Latents mean something only beside the decoder that they were made for, so the record has its SHA-256.

    Raises:
        RunError: a file is missing or damaged, or the latents belong to another decoder than the shipped one.
    """
    record, path, decoder = read_record(folder), folder / WEIGHTS, shipped_decoder_sha256()
    made_for = record.get("decoder_sha256")
    if material == "neural" and made_for != decoder:
        raise RunError(
            f"the prior in {folder} was trained for the material decoder {str(made_for)[:12]}, but the decoder in use "
            f"is {decoder[:12]}: its latents would mean something else; train it again (python -m tools.train_prior) "
            "or use --pipeline.model.material pbr"
        )
    prior = SmallPrior()
    try:
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != record.get("sha256"):
            raise RunError(f"{path} is not the file that {RECORD} describes; install the package again")
        prior.load_state_dict(safetensors.torch.load(data))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise RunError(f"{path} can't be read as weights of the prior: {error}") from error
    return prior.eval().requires_grad_(requires_grad=False)


def read_record(folder: Path = SHIPPED) -> dict[str, Any]:
    """How a prior was made. Raises RunError: the record is missing or no JSON."""
    path = folder / RECORD
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"{path} can't be read: {error}") from error


def shipped_decoder_sha256() -> str:
    """Of the weights of the neural material that come with the package."""
    return hashlib.sha256(neural.SHIPPED.read_bytes()).hexdigest()
