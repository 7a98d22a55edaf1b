"""The small prior: from what views show of surface points to the material at each of them.

Notation: `B` objects, `N` points, `V` views, `P` parameters of a material, `W` numbers of an embedding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from unmix_plugin.neumatex.prior.observations import (
    NUM_POINT_FEATURES,
    NUM_VIEW_FEATURES,
    point_features,
    view_features,
)
from unmix_plugin.neumatex.triplane import Readers, bounded_log_variance

MaterialName = Literal["neural", "pbr"]
"""What an object's planes can be read as in a fit."""
TaskName = Literal["neural", "pbr", "layers"]
"""What the embeddings are trained to tell; the layers are there for the training alone."""
NUM_PARAMETERS: dict[TaskName, int] = {"neural": 9, "pbr": 5, "layers": 14}
_VIEW_WIDTH, _POINT_WIDTH = 48, 128


@dataclass(frozen=True)
class Observations:
    """What is known of points and what views show of them; light is divided by the environment's mean."""

    positions: Float[Tensor, "B N 3"]
    colours: Float[Tensor, "B N V 3"]
    visible: Bool[Tensor, "B N V"]
    cosines: Float[Tensor, "B N V"]
    mirrored: Float[Tensor, "B N V K 3"]
    mirror_open: Float[Tensor, "B N V"]
    irradiance: Float[Tensor, "B N 3"]
    unshadowed: Float[Tensor, "B N 3"]

    def selected(self, points: Int[Tensor, " n"], views: Int[Tensor, " v"]) -> Observations:
        """Some of the points and some of the views, in the order asked for."""

        def both(values: Tensor) -> Tensor:
            return values[:, points][:, :, views]

        return Observations(
            positions=self.positions[:, points],
            colours=both(self.colours),
            visible=both(self.visible),
            cosines=both(self.cosines),
            mirrored=both(self.mirrored),
            mirror_open=both(self.mirror_open),
            irradiance=self.irradiance[:, points],
            unshadowed=self.unshadowed[:, points],
        )


class SmallPrior(nn.Module):
    """Encoder of observations, what it says of each point, and the readers of planes that are fitted to that."""

    def __init__(self) -> None:
        super().__init__()
        self.view_encoder = _perceptron(NUM_VIEW_FEATURES, _VIEW_WIDTH, _VIEW_WIDTH)
        self.point_encoder = _perceptron(3 * _VIEW_WIDTH + NUM_POINT_FEATURES, _POINT_WIDTH, _POINT_WIDTH)
        self.object_encoder = _perceptron(_POINT_WIDTH, 64, _POINT_WIDTH)
        self.mixer = _perceptron(_POINT_WIDTH, _POINT_WIDTH, _POINT_WIDTH)
        self.heads = nn.ModuleDict(
            {name: nn.Linear(_POINT_WIDTH, 2 * p) for name, p in NUM_PARAMETERS.items()}
        )
        self.neural_readers = Readers(NUM_PARAMETERS["neural"])
        self.pbr_readers = Readers(NUM_PARAMETERS["pbr"])

    def readers_of(self, material: MaterialName) -> Readers:
        """The networks that read a material from planes."""
        return self.neural_readers if material == "neural" else self.pbr_readers

    def forward(self, observations: Observations) -> Float[Tensor, "B N W"]:
        """Embeddings of points: what all their views show, and what the object is like as a whole."""
        o = observations
        seen = o.visible.any(dim=-1).float()
        points = self._points(o)
        whole = (points * seen[..., None]).sum(dim=1) / seen.sum(dim=1, keepdim=True).clamp(min=1)
        return self.mixer(points + self.object_encoder(whole)[:, None])

    def estimate(
        self, embeddings: Float[Tensor, "B N W"], task: TaskName
    ) -> tuple[Float[Tensor, "B N P"], Float[Tensor, "B N P"]]:
        """Parameters in (0, 1) and their log-variances."""
        raw, raw_variance = self.heads[task](embeddings).chunk(2, dim=-1)
        return torch.sigmoid(raw), bounded_log_variance(raw_variance)

    def _points(self, o: Observations) -> Float[Tensor, "B N W"]:
        """Embeddings of points from all their views; the order of the views does not matter."""
        reaching = o.irradiance * o.unshadowed
        views = view_features(o.colours, o.cosines, o.mirrored, o.mirror_open, reaching)
        encoded = self.view_encoder(views)
        mask = o.visible[..., None].float()
        total = mask.sum(dim=-2).clamp(min=1)
        mean = (encoded * mask).sum(dim=-2) / total
        spread = ((encoded - mean[..., None, :]).square() * mask).sum(dim=-2) / total
        largest = torch.where(o.visible[..., None], encoded, -1e4).amax(dim=-2)
        largest = torch.where(o.visible.any(dim=-1, keepdim=True), largest, 0.0)
        known = point_features(
            o.positions, o.colours, o.visible, o.mirrored, o.mirror_open, o.irradiance, o.unshadowed
        )
        return self.point_encoder(torch.cat([mean, (spread + 1e-6).sqrt(), largest, known], dim=-1))


def _perceptron(*sizes: int) -> nn.Sequential:
    inputs, hidden, outputs = sizes
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, outputs), nn.SiLU())
