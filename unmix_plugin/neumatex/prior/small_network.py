"""The small prior: from what views show of surface points to the material at each of them.

Notation: `B` objects, `N` points, `V` views, `P` parameters of a material, `W` numbers of an embedding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

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
_VIEW_WIDTH, _POINT_WIDTH, _NUM_HEADS = 64, 128, 4
_NUM_EXCHANGES = 3
MOST_ASKED = 640
"""Points of an object that the others learn from: the first ones, which are as random as all."""


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
        self.exchanges = nn.ModuleList([PointExchange(_POINT_WIDTH) for _ in range(_NUM_EXCHANGES)])
        self.last_norm = nn.LayerNorm(_POINT_WIDTH)
        self.heads = nn.ModuleDict(
            {name: nn.Linear(_POINT_WIDTH, 2 * p) for name, p in NUM_PARAMETERS.items()}
        )
        self.neural_readers = Readers(NUM_PARAMETERS["neural"])
        self.pbr_readers = Readers(NUM_PARAMETERS["pbr"])

    def readers_of(self, material: MaterialName) -> Readers:
        """The networks that read a material from planes."""
        return self.neural_readers if material == "neural" else self.pbr_readers

    def forward(self, observations: Observations) -> Float[Tensor, "B N W"]:
        """Embeddings of points: what their views show, and what other points of the object are like."""
        seen = observations.visible.any(dim=-1)
        points = self._points(observations)
        for exchange in self.exchanges:
            points = exchange(points, seen)
        return self.last_norm(points)

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


class PointExchange(nn.Module):
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
        asked, known = normed[:, :MOST_ASKED], seen[:, :MOST_ASKED]
        known = known | ~known.any(dim=-1, keepdim=True)
        keys, values = self.keys_and_values(asked).chunk(2, dim=-1)
        heads = [_in_heads(part) for part in (self.queries(normed), keys, values)]
        found = functional.scaled_dot_product_attention(*heads, attn_mask=known[:, None, None])
        points = points + self.joined(found.transpose(1, 2).flatten(2))
        return points + self.perceptron(self.second_norm(points))


def _in_heads(values: Float[Tensor, "B N W"]) -> Float[Tensor, "B H N w"]:
    return values.unflatten(-1, (_NUM_HEADS, -1)).transpose(1, 2)


def _perceptron(*sizes: int) -> nn.Sequential:
    inputs, hidden, outputs = sizes
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, outputs), nn.SiLU())
